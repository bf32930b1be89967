"""Random and hard worlds for the numerical tests, and how errors are measured."""

import torch


def relative_error(value, expected):
    """Return the relative L2 error in float64."""
    difference = value.detach().cpu().double() - expected.detach().cpu().double()
    return float(difference.norm() / expected.detach().cpu().double().norm())


def random_world(world_count, particle_count, space_dim, state_dim, *, dtype, device, seed=0):
    """Return worlds with about twenty neighbours at eps 0.3, positions in [-0.7, 0.7]^D."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(world_count, particle_count, space_dim, generator=generator) * 1.4 - 0.7
    s = torch.randn(world_count, particle_count, state_dim, generator=generator)
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
