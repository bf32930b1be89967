"""Tensors for numerical tests: random and degenerate worlds, gradients, comparisons."""

import torch
from torch.utils._pytree import tree_leaves

import npa_envs
from npa_envs.ops.perceive import perceive_rows
from npa_envs.ops.physics import Terms, make_physics


def tensors(*values):
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, torch.Tensor)]


def assert_same(ours, theirs):
    """Compare all tensors in two structures, bit for bit."""
    ours, theirs = tensors(ours), tensors(theirs)
    assert len(ours) == len(theirs) > 0
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)


def assert_near(values, expected, bound):
    """Compare tensors number by number; the bound is of the largest difference."""
    for value, answer in zip(values, expected, strict=True):
        assert float((value.cpu() - answer.cpu()).detach().abs().max()) < bound


def relative_error(value, expected):
    """Return the relative L2 error in float64."""
    difference = value.detach().cpu().double() - expected.detach().cpu().double()
    return float(difference.norm() / expected.detach().cpu().double().norm())


def seeded(seed=0, device="cpu"):
    """Return torch's generator of a device, with a seed."""
    return torch.Generator(device).manual_seed(seed)


def random_world(world_count, particle_count, space_dim, state_dim, *, dtype, device, seed=0):
    """Return worlds with about twenty neighbours at eps 0.3, positions in [-0.7, 0.7]^D."""
    generator = torch.Generator().manual_seed(seed)
    x = (
        torch.rand(world_count, particle_count, space_dim, generator=generator, device="cpu") * 1.4
        - 0.7
    )
    s = torch.randn(world_count, particle_count, state_dim, generator=generator, device="cpu")
    return x.to(device, dtype), s.to(device, dtype)


def degenerate_world(space_dim, state_dim, *, dtype, device):
    """Return one world with an isolated, coincident, collinear and clumped particles."""
    generator = torch.Generator().manual_seed(7)
    scattered = torch.rand(40, space_dim, generator=generator) * 0.8 - 0.4
    line = torch.zeros(12, space_dim)
    line[:, 0] = torch.linspace(2.0, 2.5, 12)
    clump = -2.0 + 1e-3 * torch.randn(20, space_dim, generator=generator)
    coincident = torch.full((5, space_dim), 4.0)
    pair = torch.full((2, space_dim), -4.0)
    pair[1, 0] += 1e-4
    isolated = torch.full((1, space_dim), 50.0)
    x = torch.cat((scattered, line, clump, coincident, pair, isolated))[None]
    s = torch.randn(1, x.shape[1], state_dim, generator=generator)
    return x.to(device, dtype), s.to(device, dtype)


def lively_rule(
    device, dtype=torch.float64, space_dim=2, state_dim=5, *, seed=0, hidden_dim=12, eps0=0.2,
    gain=8.0, **options,
):  # fmt: skip
    """Return a rule whose updates are large enough to matter."""
    torch.manual_seed(seed)
    rule = npa_envs.NPARule(space_dim, state_dim, hidden_dim, eps0=eps0, **options)
    with torch.no_grad():
        rule.output.weight *= gain
    return rule.to(device, dtype)


def sides(box, space_dim):
    """Return the sides of a box: None, "square" or "oblong"."""
    if box is None:
        return None
    return (1.4,) * space_dim if box == "square" else (1.4, 1.9, 1.5)[:space_dim]


def exact(*values):
    """Return copies in float64 on the CPU, where the oracles work."""
    return [value.detach().cpu().double() for value in values]


def cotangents(values, seed=1):
    """Return normal numbers like the values, the same for every dtype and device."""
    generator = torch.Generator().manual_seed(seed)
    return [
        torch.randn(v.shape, generator=generator, dtype=torch.float64).to(v).detach()
        for v in values
    ]


def with_gradients(function, *inputs):
    """Return what a function makes of inputs, then their gradients along random cotangents."""
    leaves = [value.detach().clone().requires_grad_() for value in inputs]
    found = tensors(function(*leaves))
    gradients = torch.autograd.grad(found, leaves, cotangents(found))
    return [*(value.detach() for value in found), *gradients]


def random_mask(x, probability=0.5):
    """Return an update mask of worlds, uint8, shape [B, N]."""
    mask = torch.rand(x.shape[:2], generator=torch.Generator().manual_seed(2)) < probability
    return mask.to(x.device, torch.uint8)


def rows_of(
    x, s, mask=None, *, eps=0.3, eps0=None, box=None, terms=None, width=None, capacity=None
):
    """Perceive the active particles, by default in as many rows and columns as they need."""
    options = {"eps": eps, "eps0": eps0, "box": box, "terms": terms or Terms()}
    physics = make_physics(x.shape[2], s.shape[2], x.dtype, **options)
    active = x.shape[0] * x.shape[1] if mask is None else max(int(mask.sum()), 1)
    return perceive_rows(
        x,
        s,
        physics,
        mask=mask,
        row_capacity=capacity or active,
        row_width=width or physics.perception_dim,
    )
