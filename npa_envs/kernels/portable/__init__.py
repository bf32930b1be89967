"""Kernels in plain Warp for CPU and CUDA, float32 and float64: the formulas of `reference.py`.

Arguments of many kernels; `SortedWorlds` in `ops/sort.py` has more. Rows number active particles.

- `range_start`: first index of a part of a launch, where CPU threads share it.
- `particles`: sorted positions with volumes 1 / ρ; `particle_count` of them make a world.
- `source`: original (caller's) index of each sorted particle.
- `starts`: first sorted index of each cell; from `active_offset` on, first row plus `row_base`.
- `row_of`: row of each particle, by original index; -1: inactive, or beyond `row_capacity` rows.
- `width`, `group_count`: channels of a group; groups that the channels of a state fill.
- `aligned`: 1 if adjacent channels can be read at once; `moving`: 0 if only states change.
- `x_bar`: dL/dx, the gradient of the loss L by x, called a cotangent; shaped like x.
"""
