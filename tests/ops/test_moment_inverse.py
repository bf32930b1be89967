"""The smooth inverse of moment matrices, and where perception with it differs."""

import torch

import npa_envs
from npa_envs import reference as oracle


def random_moments(space_dim, seed=0):
    """Symmetric positive semidefinite matrices with determinants of all sizes, [64, D, D]."""
    generator = torch.Generator().manual_seed(seed)
    options = {"generator": generator, "dtype": torch.float64}
    axes = torch.linalg.qr(torch.randn(64, space_dim, space_dim, **options)).Q
    eigenvalues = 10.0 ** (-4.0 * torch.rand(64, space_dim, **options))
    return axes @ torch.diag_embed(eigenvalues) @ axes.mT


def largest_entry(tensor):
    return float(tensor.abs().max())


def test_the_smooth_inverse_is_a_mean_of_inverse_and_identity(space_dim):
    """With the weight det² / (det² + τ²) of the inverse, which is one half at det = τ."""
    moment = random_moments(space_dim, seed=1)
    determinant = torch.linalg.det(moment)[:, None, None]
    weight = determinant**2 / (determinant**2 + oracle.MOMENT_SOFTENING**2)
    unit = torch.eye(space_dim, dtype=torch.float64)
    expected = weight * torch.linalg.inv(moment) + (1.0 - weight) * unit
    torch.testing.assert_close(oracle.smooth_inverse(moment), expected, rtol=1e-8, atol=1e-10)


def test_a_moment_matrix_without_an_inverse_leaves_gradients_as_they_are(space_dim):
    unit = torch.eye(space_dim, dtype=torch.float64)
    line = torch.zeros(space_dim, space_dim, dtype=torch.float64)
    line[0, 0] = 0.7
    for moment in (torch.zeros_like(unit), line):
        assert torch.equal(oracle.smooth_inverse(moment), unit)
    assert largest_entry(oracle.smooth_inverse(unit) - unit) < 1e-15


def test_only_the_perception_by_threshold_jumps(device):
    """A particle sinks into the line through two others: the corner that it sees goes flat."""
    heights = torch.linspace(0.0, 0.03, 30_001, dtype=torch.float64)
    x = torch.zeros(len(heights), 3, 2, dtype=torch.float64, device=device)
    x[:, 1, 0], x[:, 2, 0], x[:, 2, 1] = 0.04, 0.05, heights.to(device)
    s = torch.tensor([[0.0], [1.0], [-1.0]], dtype=torch.float64, device=device).expand(
        len(heights), -1, -1
    )

    def largest_jump(moment_inverse):
        z = npa_envs.perceive(x, s, 0.1, moment_inverse=moment_inverse)
        return largest_entry(z[:, 0].diff(dim=0))

    assert largest_jump("smooth") < 1e-2
    assert largest_jump("threshold") > 1.0
