"""Perception with `wp.HashGrid` in two plain passes: a simple baseline in Warp alone.

It shares only the kernel functions W and K with the library's kernels. Its adjoint is that of
`wp.Tape`.
"""

import contextlib
import functools
import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from npa_envs.kernels.domain import domain_types, make_domain, scalar_name
from npa_envs.kernels.mathematics import MOMENT_THRESHOLD, smoothing, spiky_factor
from npa_envs.ops.launch import SCALARS, warp_device
from npa_envs.runtime import quiet_warp

PER_CELL = 4
"""Particles in a bucket of the hash grid, on average at most."""


class GridFields(NamedTuple):
    """Fields of every particle, unscaled, as those of the same names in `PerceptionFields`."""

    rho: Tensor
    blur: Tensor
    grad1: Tensor
    drho: Tensor


def grid_fields(x: Tensor, s: Tensor, eps: float) -> GridFields:
    """Return the fields of worlds x [B, N, D], s [B, N, C] in open space.

    `blur` and `grad1` are differentiable in s; as in the library the correction of the gradient is
    not differentiated.
    """
    return GridFields(*_GridFields.apply(x.detach(), s, eps))


class _GridFields(torch.autograd.Function):
    """Autograd function of `grid_fields`: sums on a `wp.Tape` where s requires a gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, s: Tensor, eps: float) -> tuple[Tensor, ...]:
        world_count, particle_count, space_dim = x.shape
        total, state_dim = world_count * particle_count, s.shape[2]
        scalar = SCALARS[x.dtype]
        kernels = grid_kernels(space_dim, scalar, state_dim)
        domain = make_domain(space_dim, scalar, eps, None, particle_count)
        points = x.new_zeros(total, 3)
        points[:, :space_dim] = x.reshape(total, space_dim)
        world = torch.arange(world_count, dtype=torch.int32, device=x.device)
        world = world.repeat_interleave(particle_count)
        rho = x.new_empty(total)
        blur, drho = x.new_empty(total, state_dim), x.new_empty(total, space_dim)
        gradient = x.new_empty(total, state_dim, space_dim)
        moment = x.new_empty(total, space_dim, space_dim)
        ctx.tape, taped = wp.Tape(), ctx.needs_input_grad[1]
        # A tape reads its grid again, which must not have been rebuilt for another world.
        new_grid = _grid.__wrapped__ if taped else _grid
        grid = new_grid(x.device, scalar, space_dim, _side(total, space_dim))
        with _warp_like_torch(x.device):
            states, *sums = (
                wp.from_torch(tensor.detach().contiguous(), requires_grad=taped)
                for tensor in (s.reshape(total, state_dim), blur, gradient)
            )
            places, groups = _constant(points, kernels.point), _constant(world)
            moments, rises = _constant(moment, kernels.square), _constant(drho, kernels.vector)
            grid.build(places, eps, groups=groups)
            given = [domain, scalar(eps), grid.id, places, groups, _constant(rho)]
            where = {"dim": total, "device": warp_device(x.device)}
            wp.launch(kernels.sum_density, inputs=given, **where)
            with ctx.tape if taped else contextlib.nullcontext():
                wp.launch(
                    kernels.sum_fields, inputs=[*given, states, *sums, moments, rises], **where
                )
            wp.launch(kernels.correct, inputs=[moments, _constant(gradient)], **where)
        ctx.arrays, ctx.shape = (states, *sums, grid), s.shape
        shape = (world_count, particle_count)
        fields = (rho, blur, gradient, drho)
        outputs = tuple(field.view(*shape, *field.shape[1:]) for field in fields)
        ctx.mark_non_differentiable(outputs[0], outputs[3])
        return outputs

    @staticmethod
    def backward(ctx: Any, _: Tensor, *bars: Tensor) -> tuple[None, Tensor, None]:
        states, *sums, _grid = ctx.arrays
        with _warp_like_torch(bars[0].device):
            ctx.tape.zero()
            grads = {
                array: wp.from_torch(bar.reshape(array.shape).contiguous(), requires_grad=False)
                for array, bar in zip(sums, bars[:2], strict=True)
            }
            ctx.tape.backward(grads=grads)
        return None, wp.to_torch(states.grad).view(ctx.shape), None


def _constant(tensor: Tensor, dtype: Any = None) -> Any:
    """Return a tensor as a Warp array that has no gradient."""
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


@contextlib.contextmanager
def _warp_like_torch(device: torch.device) -> Iterator[None]:
    """Let Warp work on torch's current stream, without messages."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(quiet_warp())
        if device.type == "cuda":
            current = torch.cuda.current_stream(device)
            stack.enter_context(wp.ScopedStream(wp.stream_from_torch(current)))
        yield


def _side(total: int, space_dim: int) -> int:
    """Return the buckets of a hash grid along each axis, a power of two."""
    return 2 ** math.ceil(math.log2(total / PER_CELL) / space_dim) if total > PER_CELL else 1


@functools.cache
def _grid(device: torch.device, scalar: Any, space_dim: int, side: int) -> Any:
    """Return the cached hash grid of a kind, which each call rebuilds; in 2D it is flat."""
    make: Any = wp.HashGrid
    depth = side if space_dim == 3 else 1
    return make(side, side, depth, device=warp_device(device), dtype=scalar)


@functools.cache
def grid_kernels(space_dim: int, scalar: type, state_dim: int) -> SimpleNamespace:
    """Return the kernels of one variant: density, sums, correction; and their types."""
    Domain = domain_types(space_dim, scalar).Domain
    point = wp.types.vector(3, scalar)
    vector = wp.types.vector(space_dim, scalar)
    square = wp.types.matrix((space_dim, space_dim), scalar)
    channels = wp.types.vector(state_dim, scalar)
    gradients = wp.types.matrix((state_dim, space_dim), scalar)
    module = wp.get_module(f"hash_grid_{space_dim}d_{scalar_name(scalar)}_c{state_dim}")

    @wp.kernel(enable_backward=False, module=module)
    def sum_density(
        domain: Domain,
        radius: scalar,
        grid: wp.uint64,
        points: wp.array(dtype=point),
        world: wp.array(dtype=wp.int32),
        # outputs
        density: wp.array(dtype=scalar),
    ):
        """Sum the smoothing kernel over the neighbours of each particle."""
        i = wp.tid()
        total = scalar(0.0)
        query = wp.hash_grid_query(grid, points[i], radius, world[i])
        for j in query:
            offset = points[j] - points[i]
            squared = wp.dot(offset, offset)
            if squared < domain.squared_eps:
                total += smoothing(squared, domain.inverse_squared_eps, domain.smoothing_norm)
        density[i] = total

    @wp.kernel(module=module)
    def sum_fields(
        domain: Domain,
        radius: scalar,
        grid: wp.uint64,
        points: wp.array(dtype=point),
        world: wp.array(dtype=wp.int32),
        density: wp.array(dtype=scalar),
        states: wp.array2d(dtype=scalar),
        # outputs
        blur: wp.array2d(dtype=scalar),
        gradient: wp.array3d(dtype=scalar),
        moments: wp.array(dtype=square),
        density_gradient: wp.array(dtype=vector),
    ):
        """Sum smoothed states, state gradients, moment matrices and the density gradient."""
        i = wp.tid()
        smooth, slope = channels(), gradients()
        moment, rise = square(), vector()
        query = wp.hash_grid_query(grid, points[i], radius, world[i])
        for j in query:
            offset = points[j] - points[i]
            squared = wp.dot(offset, offset)
            if squared < domain.squared_eps:
                volume = scalar(1.0) / density[j]
                weight = volume * smoothing(
                    squared, domain.inverse_squared_eps, domain.smoothing_norm
                )
                factor = spiky_factor(wp.sqrt(squared), domain.inverse_eps, domain.spiky_norm)
                r = vector()
                for d in range(wp.static(space_dim)):
                    r[d] = offset[d]
                kernel = factor * r
                rise += kernel
                moment += volume * wp.outer(r, kernel)
                for c in range(wp.static(state_dim)):
                    smooth[c] += weight * states[j, c]
                    difference = volume * (states[j, c] - states[i, c])
                    for d in range(wp.static(space_dim)):
                        slope[c, d] += difference * kernel[d]
        moments[i] = moment
        density_gradient[i] = rise
        for c in range(wp.static(state_dim)):
            blur[i, c] = smooth[c]
            for d in range(wp.static(space_dim)):
                gradient[i, c, d] = slope[c, d]

    @wp.kernel(enable_backward=False, module=module)
    def correct(moments: wp.array(dtype=square), gradient: wp.array3d(dtype=scalar)):
        """Correct state gradients by the inverse moment matrix, in place."""
        i = wp.tid()
        moment = moments[i]
        if wp.abs(wp.determinant(moment)) >= scalar(wp.static(MOMENT_THRESHOLD)):
            inverse = wp.inverse(moment)
            for c in range(wp.static(state_dim)):
                slope = vector()
                for d in range(wp.static(space_dim)):
                    slope[d] = gradient[i, c, d]
                slope = slope * inverse
                for d in range(wp.static(space_dim)):
                    gradient[i, c, d] = slope[d]

    return SimpleNamespace(
        sum_density=sum_density,
        sum_fields=sum_fields,
        correct=correct,
        point=point,
        vector=vector,
        square=square,
    )
