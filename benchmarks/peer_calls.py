"""Calls by which other libraries perceive all particles of a world, and what each leaves out.

They give the fields; the correction of gradients (`corrected`), scaling and joining (`assemble`)
are torch's, where the library has them in its kernels.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from hash_grid import grid_fields
from strategies import assemble, corrected, from_fields
from torch import Tensor

from npa_envs import reference
from npa_envs.ops import perceive

MAX_NEIGHBOURS = 64
"""Columns of nvalchemi's neighbour matrix in 3D; the 3e6 particles have at most some 45."""


@dataclass(frozen=True)
class Peer:
    """One way to perceive: `run(x, s, eps)` of x [1, N, D], s [1, N, C] returns z [1, N, P]."""

    run: Callable[[Tensor, Tensor, float], Any]
    leaves_out: str = ""
    """What of z it does not compute; the error is of the rest."""
    space_dims: tuple[int, ...] = (2, 3)
    differentiable: bool = True
    graph: bool = False
    """Whether a CUDA graph of it is timed."""
    result: Callable[[Any, Tensor, float], Tensor] = lambda found, x, eps: found
    """Makes what is compared from what `run` returns, x and eps, outside of the time."""


def pairs_within(x: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Return i, j of all particles x [N, D] nearer than eps, themselves included, in torch alone.

    Particles are sorted by cells of side eps, so that three cells in a row are one range.
    """
    cell = ((x - x.amin(0)) / eps).long() + 1
    sides = (cell.amax(0) + 2).tolist()
    strides = [math.prod(sides[d + 1 :]) for d in range(len(sides))]
    key, order = sum(cell[:, d] * stride for d, stride in enumerate(strides)).sort()
    places, found = x[order], []
    for row in itertools.product((-1, 0, 1), repeat=len(sides) - 1):
        middle = key + sum(a * b for a, b in zip(row, strides[:-1], strict=True))
        first = torch.searchsorted(key, middle - 1)
        count = torch.searchsorted(key, middle + 1, right=True) - first
        i = torch.arange(len(x), device=x.device).repeat_interleave(count)
        j = torch.arange(len(i), device=x.device) + (first - count.cumsum(0) + count)[i]
        near = (places[j] - places[i]).square().sum(-1) < eps * eps
        found.append((order[i[near]], order[j[near]]))
    return torch.cat([i for i, _ in found]), torch.cat([j for _, j in found])


def edge_list_perceive(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Return perception vectors of one world x [1, N, D], s [1, N, C], shape [1, N, P]."""
    places, states = x[0], s[0]
    i, j = pairs_within(places, eps)
    r = places[j] - places[i]
    weight = reference.smoothing_kernel(r.square().sum(-1), eps, r.shape[1])
    kernel = reference.spiky_gradient(r, eps)

    def summed(terms: Tensor) -> Tensor:
        return terms.new_zeros(len(places), *terms.shape[1:]).index_add(0, i, terms)[None]

    volume = (1.0 / summed(weight))[0, j, None]
    scaled = (volume * kernel)[:, None, :]
    blur = summed(volume * weight[:, None] * states[j])
    gradient = summed((states[j] - states[i])[:, :, None] * scaled)
    gradient = corrected(gradient, summed(r[:, :, None] * scaled))
    return assemble(s, blur, gradient, summed(kernel))


def pykeops(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Perceive by sums over all pairs, which PyKeOps compiles and does not store."""
    torch_of_keops = importlib.import_module("pykeops.torch")
    i, j = torch_of_keops.Vi, torch_of_keops.Vj
    space_dim, state_dim = x.shape[2], s.shape[2]
    r = j(x[0]) - i(x[0])
    squared = (r * r).sum(-1)
    # The norms of the kernels W and K, from W(0) and K at half the radius.
    centre, half = torch.zeros(2, space_dim, dtype=torch.float64)
    half[0] = eps / 2
    smooth = float(reference.smoothing_kernel(centre[0], eps, space_dim)) / eps**6
    spiky = float(reference.spiky_gradient(half, eps)[0]) / (eps / 2) ** 2
    weight = smooth * (eps**2 - squared).relu() ** 3
    kernel = spiky * (eps - squared.sqrt()).relu() ** 2 * squared.rsqrt() * r
    volume = j(1.0 / weight.sum(1))
    offset = volume * (j(s[0]) - i(s[0]))
    blur, gradient = (volume * weight * j(s[0])).sum(1), offset.tensorprod(kernel).sum(1)
    moment = (volume * r).tensorprod(kernel).concat(kernel).sum(1)
    gradient = gradient.view(1, -1, state_dim, space_dim)
    moment, rise = moment[None].split((space_dim**2, space_dim), -1)
    gradient = corrected(gradient, moment.view(1, -1, space_dim, space_dim))
    return assemble(s, blur[None], gradient, rise)


def sph_warp_core(x: Tensor, s: Tensor, eps: float) -> Tensor:
    """Perceive all but the density gradient by sphWarpCore, with one search of neighbours.

    The moment matrix is the gradient of the positions, in the same call. Masses correct the norms
    of its kernels in 2D, which are 35 / 32 and 2 in place of 4 and 10, over pi. It caches arrays by
    address and adds to their gradients, so caches are emptied, and every operand is a copy.
    """
    sph = importlib.import_module("sphWarpCore")
    try:
        return _sph_warp_core(sph, x, s, eps)
    finally:
        importlib.import_module("sphWarpCore.utils.wp_util").clearWarpArrayCache()
        importlib.import_module("sphWarpCore.utils.wp_autograd").clearKernelArgsCache()


def _sph_warp_core(sph: Any, x: Tensor, s: Tensor, eps: float) -> Tensor:
    places, (count, space_dim) = x[0].contiguous(), x.shape[1:]
    ones, kinds = torch.ones_like(places[:, 0]), torch.zeros(count, dtype=torch.int32).to(x.device)
    open_space = torch.zeros(space_dim, dtype=torch.bool, device=x.device)
    box = places.amin(0) - eps, places.amax(0) + eps
    domain = sph.DomainDescription(*box, open_space, space_dim)
    smooth, spiky = (128.0 / 35.0, 5.0) if space_dim == 2 else (1.0, 1.0)

    def particles(mass: float, density: Tensor) -> Any:
        return sph.ParticleState(places, eps * ones, mass * ones, density, kinds)

    near = sph.radiusSearchCompactHashMap(particles(smooth, ones), domain)

    def call(operation: str, kernel: str, mass: float, density: Tensor, *values: Tensor) -> Tensor:
        properties = sph.OperationProperties(
            kernel=sph.KernelFunctions[kernel],
            operation=sph.WarpOperation[operation],
            gradientMode=sph.GradientScheme.Difference,
        )
        given = [value.clone() for value in 2 * values]
        result: Tensor = sph.warpOperation(
            particles(mass, density), properties, domain, *given, adjacency=near
        )
        return result

    rho = call("Density", "Poly6", smooth, ones)
    blur = call("Interpolate", "Poly6", smooth, rho, s[0])
    found = call("Gradient", "Spiky", spiky, rho, torch.cat((s[0], places), -1))
    # 3D gradients are labelled [N, C, D] and laid out as [N, D, C].
    found = found.reshape(count, space_dim, -1).mT if space_dim == 3 else found
    gradient = corrected(found[None, :, :-space_dim], found[None, :, -space_dim:])
    return assemble(s, blur[None], gradient, torch.zeros_like(x))[..., :-space_dim]


def nvalchemi(x: Tensor, s: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """List neighbours by nvalchemi-toolkit-ops: a matrix of indices, and counts."""
    find = importlib.import_module("nvalchemiops.torch.neighbors").neighbor_list
    matrix, counts, *_ = find(x[0], eps, method="cell_list", max_neighbors=MAX_NEIGHBOURS)
    return matrix, counts


def listed_density(found: tuple[Tensor, Tensor], x: Tensor, eps: float) -> Tensor:
    """Return the density as a sum over listed neighbours, [1, N]."""
    matrix, counts = found
    column = torch.arange(matrix.shape[1], device=x.device)
    inside = column < counts[:, None]
    r = x[0][torch.where(inside, matrix, 0).long()] - x[0][:, None]
    weight = reference.smoothing_kernel(r.square().sum(-1), eps, 3)
    own_weight = reference.smoothing_kernel(x.new_zeros(1), eps, 3)
    return (own_weight + torch.where(inside, weight, 0.0).sum(1))[None]


PEERS = {
    "npa-envs": Peer(perceive),
    "npa-envs, CUDA graph": Peer(perceive, graph=True),
    "wp.HashGrid and wp.Tape": Peer(functools.partial(from_fields, grid_fields)),
    "sphWarpCore": Peer(sph_warp_core, leaves_out="the density gradient"),
    "torch edge list": Peer(edge_list_perceive),
    "PyKeOps": Peer(pykeops),
    "nvalchemi-toolkit-ops": Peer(
        nvalchemi,
        leaves_out="all but the list of neighbours",
        space_dims=(3,),
        differentiable=False,
        result=listed_density,
    ),
}
"""Every way by its name."""
