"""Brushes: local changes of worlds, as functions of positions and states.

Damage of training pools, the viewer and agents use them. They work on batches, with a centre for
each world, and are differentiable in positions, states, centres and amounts, except for the choice
of particles inside. Nothing waits for the device.

Arguments that a docstring does not describe are those of `push`, in all functions. `box` has the
sides of the periodic box [length units], across whose edges a brush works, or is None in open
space. Positions may leave the box; the next step wraps them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from npa_envs.checks import as_list, check_alike, check_world, checked_number
from npa_envs.errors import NPAError, shown
from npa_envs.ops.brush_sums import brush_sums, gusts
from npa_envs.ops.world_mean import world_mean
from npa_envs.world.randomness import WorldRandom

Sides = tuple[float, ...] | None


def offsets_from(x: Tensor, centre: Tensor, box: Sides = None) -> Tensor:
    """Return vectors from `centre` to each particle's nearest image in the box, [B, N, D]."""
    check_world(x, x)
    _check_vector("centre", centre, x)
    if box is not None and len(as_list(box) or ()) != x.shape[2]:
        raise NPAError(f"box must have {x.shape[2]} sides, got {shown(box)}: give one for each")
    return nearest_image(x - centre[:, None], box)


def nearest_image(vectors: Tensor, box: Sides) -> Tensor:
    """Return the nearest periodic images to the origin of vectors [..., D], in the same shape."""
    if box is None:
        return vectors
    # One side at a time: a tensor of the sides would be copied to the device.
    columns = zip(vectors.unbind(dim=-1), box, strict=True)
    return torch.stack([v - side * torch.round(v / side) for v, side in columns], dim=-1)


def inside_ball(x: Tensor, *, centre: Tensor, radius: float | Tensor, box: Sides = None) -> Tensor:
    """Return which particles are at most `radius` away from `centre`, bool, shape [B, N]."""
    distance = torch.linalg.vector_norm(offsets_from(x, centre, box), dim=-1)
    return torch.le(distance, _per_world("radius", radius, x).squeeze(-1))


def softness(x: Tensor, *, centre: Tensor, radius: float | Tensor, box: Sides = None) -> Tensor:
    """Return each particle's weight under a soft brush, [B, N, 1]: (1 - r²)² for r < 1, else 0.

    r is the particle's distance from `centre`, divided by `radius`.
    """
    size = _per_world("radius", radius, x)
    square = offsets_from(x, centre, box).square().sum(dim=-1, keepdim=True)
    # Masked before the division: with a radius of zero weights are 0 and not NaN.
    square = square / torch.where(size > 0, size, torch.ones_like(size)).square()
    return torch.where(size > 0, (1.0 - square).clamp_min(0.0), 0.0).square()


def sums_under_brushes(
    centres: Tensor,
    points: Tensor,
    values: Tensor,
    *,
    radius: float,
    box: Sides = None,
    moments: bool = False,
) -> Tensor:
    """Return sums over points of their values, weighted by `softness` of each brush, [B, J, W].

    A world's sums are the same in every batch, bit for bit. In 2D.

    Args:
        centres: Centres of J brushes [length units], shape [B, J, 2].
        points: I points, or particles [length units], shape [B, I, 2].
        values: Values of the points, shape [B, I, W].
        radius: Radius of all brushes [length units].
        moments: The sums of 1 and of offsets from the centre, in radii, come first: [B, J, 3 + W].
    """
    tensors = centres, points, values
    if not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)):
        return brush_sums(*tensors, radius, [*(box or (0.0, 0.0))], moments)
    away = nearest_image(points[:, None] - centres[:, :, None], box) / radius
    weights = (1.0 - away.square().sum(dim=-1, keepdim=True)).clamp_min(0.0).square()
    terms = values[:, None].expand(-1, centres.shape[1], -1, -1)
    if moments:
        terms = torch.cat((torch.ones_like(weights), away, terms), dim=-1)
    sums = points.shape[1] * world_mean((weights * terms).transpose(1, 2).flatten(2))
    return sums.view(*centres.shape[:2], -1)


def blow(
    x: Tensor, random: WorldRandom, move: Tensor, hit: Tensor, *, gust_radius: float, box: Sides
) -> tuple[Tensor, Tensor]:
    """Return x, [B, N, 2], with random particles pushed by `move`, [B, 2]; which are hit, [B, N].

    Hit are those within `hit`, [B], of a random particle [length units]. Without gradient; the
    particles are the third and fourth draw of the streams in this step.
    """
    streams = [random.keys, random.episodes, random.steps]
    return gusts(x.contiguous(), streams, move, hit, gust_radius, [*(box or (0.0, 0.0))])


def push(
    x: Tensor,
    *,
    centre: Tensor,
    move: Tensor,
    radius: float | Tensor,
    strength: float | Tensor = 1.0,
    box: Sides = None,
) -> Tensor:
    """Return positions after a brush has moved the particles under it, shape [B, N, D].

    A particle follows the movement by `strength` times its weight by `softness`.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        centre: Where the brush is in each world [length units], shape [B, D].
        move: Displacement of the brush [length units], shape [B, D].
        radius: Radius of the brush [length units], at least 0; a number or a tensor of shape [B].
        strength: Fraction of the movement that a particle in the centre follows (dimensionless),
            from 0 to 1; a number or a tensor of shape [B].
        box: Sides of the periodic box [length units], shape [D], or None.

    Raises:
        NPAError: Shapes, dtypes or devices do not fit each other, or a number is out of its range.
    """
    check_world(x, x)
    _check_vector("move", move, x)
    strength = _per_world("strength", strength, x, highest=1.0)
    return x + strength * softness(x, centre=centre, radius=radius, box=box) * move[:, None]


def inject(
    x: Tensor,
    s: Tensor,
    *,
    centre: Tensor,
    radius: float | Tensor,
    state: Tensor,
    strength: float | Tensor = 1.0,
    box: Sides = None,
) -> Tensor:
    """Return states after a brush has blended those under it with a given state, [B, N, C].

    Args:
        s: Particle states (dimensionless), shape [B, N, C].
        state: State to inject in each world (dimensionless), shape [B, C].
        strength: Weight of that state for a particle in the centre (dimensionless), from 0 to 1; a
            number or a tensor of shape [B]. Elsewhere it is multiplied by `softness`.
    """
    check_world(x, s)
    _check_vector("state", state, s, "C")
    strength = _per_world("strength", strength, x, highest=1.0)
    return s + strength * softness(x, centre=centre, radius=radius, box=box) * (state[:, None] - s)


def state_around(
    x: Tensor, s: Tensor, *, centre: Tensor, radius: float | Tensor, box: Sides = None
) -> tuple[Tensor, Tensor]:
    """Return the mean state under a soft brush, [B, C], and whether a particle is there, bool [B].

    `softness` weights the mean. Without a particle it is 0.
    """
    check_world(x, s)
    weights = softness(x, centre=centre, radius=radius, box=box)
    total = weights.sum(dim=1)
    holds = total > 0
    mean = (weights * s).sum(dim=1) / torch.where(holds, total, torch.ones_like(total))
    return mean, holds[:, 0]


def wipe_state(
    x: Tensor, s: Tensor, *, centre: Tensor, radius: float | Tensor, box: Sides = None
) -> Tensor:
    """Return a copy of the states with 0 for particles inside a ball, shape [B, N, C]."""
    check_world(x, s)
    inside = inside_ball(x, centre=centre, radius=radius, box=box)
    return s.masked_fill(inside[..., None], 0.0)


def cut(
    x: Tensor,
    s: Tensor,
    *,
    centre: Tensor,
    normal: Tensor,
    gap: float | Tensor,
    along: Tensor | None = None,
    box: Sides = None,
) -> tuple[Tensor, Tensor]:
    """Open a slit along a line (a plane in 3D) by moving particles apart.

    A particle on the line moves away from it by half the gap, one at the distance `gap` / 2 by a
    quarter of the gap, and one at `gap` or further not at all. So no particle is left within half
    the gap, and the bands on both sides of the slit are twice as dense.

    Args:
        centre: A point on the line in each world [length units], shape [B, D].
        normal: Direction across the line, of any length, shape [B, D]; a zero vector cuts nothing.
        gap: Width of the slit [length units], at least 0; a number or a tensor of shape [B].
        along: Vector from `centre` to one end of the slit; minus it leads to the other end [length
            units], shape [B, D]; a zero vector cuts nothing. None: no ends. In 3D the slit is not
            bounded in the third direction.

    Returns:
        The new positions, shape [B, N, D], and the same states.
    """
    check_world(x, s)
    _check_vector("centre", centre, x)
    _check_vector("normal", normal, x)
    width = _per_world("gap", gap, x)
    length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    # Masked before the division: a zero normal must give a shift of zero, not NaN.
    direction = normal / torch.where(length > 0, length, torch.ones_like(length))
    offset = offsets_from(x, centre, box)
    height = (offset * direction[:, None]).sum(dim=-1, keepdim=True)
    side = (height >= 0).to(x.dtype) - 0.5
    shift = side * (width - height.abs()).clamp_min(0.0)
    if along is not None:
        _check_vector("along", along, x)
        end = along.square().sum(dim=-1, keepdim=True)[:, None]
        coordinate = (offset * along[:, None]).sum(dim=-1, keepdim=True)
        shift = torch.where((coordinate.abs() <= end) & (end > 0.0), shift, 0.0)
    return x + shift * direction[:, None], s


def clump(
    x: Tensor,
    s: Tensor,
    *,
    centre: Tensor,
    radius: float | Tensor,
    factor: float | Tensor,
    box: Sides = None,
) -> tuple[Tensor, Tensor]:
    """Move the particles inside a ball towards its centre.

    Args:
        factor: Fraction by which distances from the centre shrink (dimensionless), from 0, where
            nothing moves, to 1, where all meet in the centre; a number or a tensor of shape [B].

    Returns:
        The new positions, shape [B, N, D], and the same states.
    """
    check_world(x, s)
    inside = inside_ball(x, centre=centre, radius=radius, box=box)
    factor = _per_world("factor", factor, x, highest=1.0)
    pulled = x - factor * offsets_from(x, centre, box)
    return torch.where(inside[..., None], pulled, x), s


def _per_world(name: str, value: float | Tensor, x: Tensor, *, highest: float = math.inf) -> Tensor:
    """Return a number, or one for each world, as a tensor [1, 1, 1] or [B, 1, 1]."""
    if isinstance(value, Tensor):
        if value.shape not in ((), (x.shape[0],)):
            raise NPAError(
                f"{name} must be a number or a tensor of shape [B] = [{x.shape[0]}], "
                f"got {list(value.shape)}: give one number for each world"
            )
        # Values are not checked: reading them would wait for the device.
        return value.to(x).reshape(-1, 1, 1)
    value = checked_number(name, value)
    if not 0 <= value <= min(highest, torch.finfo(x.dtype).max):
        rule = "finite and at least 0" if highest == math.inf else f"in [0, {highest:g}]"
        raise NPAError(f"{name} must be {rule}, got {shown(value)}: try 0.1")
    return x.new_full((1, 1, 1), value)


def _check_vector(name: str, vector: Tensor, like: Tensor, letter: str = "D") -> None:
    """Check that `vector` has shape [B, D], or [B, C], where `like` is [B, N, D] or [B, N, C]."""
    shape = (like.shape[0], like.shape[2])
    if not isinstance(vector, Tensor) or vector.shape != shape:
        got = tuple(vector.shape) if isinstance(vector, Tensor) else shown(vector)
        raise NPAError(
            f"{name} must have shape [B, {letter}] = {shape}, got {got}: give one vector for each "
            f"world, for example torch.zeros{shape}"
        )
    check_alike(name, vector, "x" if letter == "D" else "s", like)
