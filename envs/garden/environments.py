"""What the environments of living worlds are made of."""

from __future__ import annotations

from typing import ClassVar

from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.garden.spaces import BrushSpaces
from npa_envs.envs.garden.worlds import LIVING


class GardenEnv(NPAEnv):
    """One living world as a Gymnasium environment; subclasses name the task.

    The sections below belong to the docstring of every subclass, after its own of the same name.

    ## Observation space

    | `observe` | Observed | Unit |
    |---|---|---|
    | `"grid"` | what lacks at each place of a grid, [6 P²] with P = `place_count` | dimensionless |
    | `"picture"` | a coarse picture, [4 G²] with G = `picture_size` | dimensionless |
    | `"moments"` | means over all particles, [5 + 3C] | lengths, dimensionless |

    The grid has P × P places, row by row from the bottom up, from −`place_reach` to `place_reach`
    along x and y of the picture's middle. Each place has six numbers: what a brush there would hold
    of the target less what it holds now. These are the number of particles, its products with their
    x and y from the brush in brush radii, and red, green and blue. The first is 2 and the others
    are 4 where as many particles lack as a brush holds at an average place of the target.

    The picture is red, green, blue, then density, each row by row from the bottom up; it spans
    [-1, 1] × [-1, 1] around the picture's middle. Colours are sums over particles, as the density
    is. `observe_error=True` adds four channels: the target's picture less this one.

    Moments are the means of x and y; then, about that place, of x², x y, y², of each state, of x
    times each state, and of y times each state. Numbers are clipped to ±8.

    ## Action space

    With `actions="grid"`, `Box(-1, 1, (P², W), float32)`: a row for the brush at each place of the
    grid. All act at once, their effects add up, and then the rule runs for `rule_steps` steps.
    Zeros do nothing.

    | Columns | Action a | An action of 1 is | Effect where the brush holds w of a particle |
    |---|---|---|---|
    | 2, of `"push"` | how far to push | `push_length` | x ← x + w `push_length` a |
    | 1, of `"wipe"` | how much to wipe | all of it | s ← s − w a s |
    | 1 a channel, of `"inject"` | what to inject | `state_scale` | s ← s + w `state_scale` a |
    | 1, of `"rate"` | how fast to live | twice as fast | steps of the rule count 1 + w a times |

    `tools` says which columns there are; the default has `"push"` alone. `"inject"` has one for
    each of `inject_channels`. w = (1 − r²)² at r brush radii from the brush, 0 outside. What is
    wiped is clipped to [0, 1] of a state, rates to [0, 2], entries to [-1, 1]. A number that is not
    finite raises `NPAError` and leaves the world as it was. `env.unwrapped.task.step(x, s, action,
    random)` is differentiable in all of them, but for the correction of moments that
    [perception](../mathematics.md#perception) holds constant.

    With `actions="free"`, `Box(-1, 1, (K, 2 + W), float32)`: there are K = `brush_count` brushes,
    and two columns more in front say where each is used, along x and y [length units].

    With `actions="discrete"`, `MultiDiscrete` with four numbers for each of K brushes: its place
    on the grid along x and along y; its tool, which is nothing, a push in one of eight directions,
    wipe, inject each channel up or down, stop, quicken, as far as there are such tools; and its
    strength, among `strength_count`.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss` | reset, step | L as it is now: how far the picture is from the target's |
    | `loss_density`, `loss_colour` | reset, step | the parts of the loss |
    | `reward_density`, `reward_colour` | step | how much each part fell in this step |
    | `success`, `diverged` | step | whether it did so in this step, bool |
    | `reason` | last step | why the episode ended, see above; None for worlds that go on |

    ## Vectorized environment

    As in [every environment](Morphogenesis2D.md#vectorized-environment), but on a CPU worlds are
    stepped one after the other: a batch saves no time there.
    """

    parts = LIVING
    form_type: ClassVar[type[BrushSpaces]] = BrushSpaces


class GardenVectorEnv(NPAVectorEnv):
    """B living worlds, stepped together; subclasses name the task."""

    parts = LIVING
    form_type: ClassVar[type[BrushSpaces]] = BrushSpaces
