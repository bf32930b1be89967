"""Kernels in plain Warp for CPU and CUDA, float32 and float64: the formulas of `reference.py`.

Arguments of many kernels here and in `kernels/cuda/`. Active particles, those that a step updates,
are numbered in sorted order: a number is a row, of perception and of updates.

- `range_start`: first index of a part of a launch, where CPU threads share it.
- `particles`: sorted positions with volumes 1 / ρ; `particle_count` of them make a world.
- `original_index`: the caller's index of each sorted particle.
- `starts`: entry c is the first sorted index of cell c, counted through all worlds, entry c + 1 the
  end. Entry `active_offset` + c is the first row of cell c, plus `row_base`; the last one of all is
  the number of rows plus `row_base`. Without a mask both are 0, as rows are sorted indices.
- `row_of`: row of each particle, by original index; -1: inactive, or beyond `row_capacity` rows.
- `row_particle`, `row_index`, `row_positions`: original index, sorted index, position of each row.
  Kernels that sort leave out the rows, or the sorted states, where these arrays are empty.
- `bar_row`: row of each row's perception, and of the gradient by it; if empty, the same.
- `width`, `group_count`: channels of a group; groups that the channels of a state fill.
- `aligned`: 1 if adjacent channels can be read at once; `moving`: 0 if only states change.
- `x_bar`: dL/dx, the gradient of the loss L with respect to x, called its cotangent; shaped like x.
"""
