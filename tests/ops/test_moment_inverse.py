"""The smooth inverse of moment matrices: its limits, and kernels against the oracle."""

import math

import pytest
import torch
from worlds import degenerate_world, random_world, relative_error

import npa_envs
from npa_envs import reference as oracle
from npa_envs.kernels import mathematics as moments
from npa_envs.ops.perceive import Terms, survey

DTYPES = (torch.float32, torch.float64)

# Worst error measured on the CPU, then the bound of the test: a few times larger.
FORWARD = {torch.float32: 2e-6, torch.float64: 5e-15}
GRADIENT = {torch.float32: 5e-6, torch.float64: 1e-14}
POSITION_GRADIENT = {torch.float32: 2e-5, torch.float64: 2e-14}

SMOOTH = Terms(moment_inverse="smooth")


def sides(box, space_dim):
    return (1.4, 1.9, 1.5)[:space_dim] if box else None


def random_moments(space_dim, seed=0):
    """Symmetric positive semidefinite matrices with determinants of all sizes, [64, D, D]."""
    generator = torch.Generator().manual_seed(seed)
    options = {"generator": generator, "dtype": torch.float64}
    axes = torch.linalg.qr(torch.randn(64, space_dim, space_dim, **options)).Q
    eigenvalues = 10.0 ** (-4.0 * torch.rand(64, space_dim, **options))
    return axes @ torch.diag_embed(eigenvalues) @ axes.mT


def moment_across(determinants, space_dim):
    """Slanted matrices with eigenvalues 1, ..., 1 and one that is the determinant."""
    axes = torch.linalg.qr(torch.arange(1.0, space_dim**2 + 1).view(space_dim, -1).sqrt()).Q
    eigenvalues = torch.ones(len(determinants), space_dim, dtype=torch.float64)
    eigenvalues[:, -1] = determinants
    return axes.double() @ torch.diag_embed(eigenvalues) @ axes.double().mT


def largest_entry(tensor):
    return float(tensor.abs().max())


# The function


def test_both_modules_soften_alike():
    assert moments.MOMENT_SOFTENING == oracle.MOMENT_SOFTENING


@pytest.mark.parametrize("space_dim", [2, 3])
def test_the_adjugate_is_the_inverse_times_the_determinant(space_dim):
    moment = random_moments(space_dim)
    expected = torch.linalg.det(moment)[:, None, None] * torch.linalg.inv(moment)
    torch.testing.assert_close(oracle.adjugate(moment), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_the_smooth_inverse_is_a_mean_of_inverse_and_identity(space_dim):
    """With the weight det² / (det² + τ²) of the inverse, which is one half at det = τ."""
    moment = random_moments(space_dim, seed=1)
    determinant = torch.linalg.det(moment)[:, None, None]
    weight = determinant**2 / (determinant**2 + oracle.MOMENT_SOFTENING**2)
    unit = torch.eye(space_dim, dtype=torch.float64)
    expected = weight * torch.linalg.inv(moment) + (1.0 - weight) * unit
    torch.testing.assert_close(oracle.smooth_inverse(moment), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_moment_matrix_without_an_inverse_leaves_gradients_as_they_are(space_dim):
    unit = torch.eye(space_dim, dtype=torch.float64)
    line = torch.zeros(space_dim, space_dim, dtype=torch.float64)
    line[0, 0] = 0.7
    for moment in (torch.zeros_like(unit), line):
        assert torch.equal(oracle.smooth_inverse(moment), unit)
    assert largest_entry(oracle.smooth_inverse(unit) - unit) < 1e-15


@pytest.mark.parametrize("space_dim", [2, 3])
def test_the_smooth_inverse_is_bounded(space_dim):
    """By 1 / (2 τ) + 1 where no eigenvalue is above 1; thresholds of 1e-3 let 1000 through."""
    determinants = torch.logspace(-12, 0, 10_001, dtype=torch.float64)
    moment = moment_across(determinants, space_dim)
    largest = torch.linalg.matrix_norm(oracle.smooth_inverse(moment), ord=2).max()
    assert 0.9 / (2.0 * oracle.MOMENT_SOFTENING) < largest < 1.0 + 0.5 / oracle.MOMENT_SOFTENING
    by_threshold = torch.linalg.matrix_norm(oracle.threshold_inverse(moment), ord=2).max()
    assert by_threshold > 990.0


@pytest.mark.parametrize("space_dim", [2, 3])
def test_only_the_threshold_jumps(space_dim):
    """From one determinant to the next, at ever finer steps around 1e-3."""

    def jump(inverse, step):
        determinants = oracle.MOMENT_THRESHOLD * (1.0 + step * torch.arange(-8.0, 8.0).double())
        return largest_entry(inverse(moment_across(determinants, space_dim)).diff(dim=0))

    jumps = [jump(oracle.smooth_inverse, step) for step in (1e-2, 1e-4, 1e-6)]
    assert jumps[0] < 0.15
    assert jumps[1] == pytest.approx(1e-2 * jumps[0], rel=0.05)
    assert jumps[2] == pytest.approx(1e-4 * jumps[0], rel=0.05)
    assert jump(oracle.threshold_inverse, 1e-6) > 100.0


@pytest.mark.parametrize("space_dim", [2, 3])
def test_the_smooth_inverse_turns_with_its_matrix(space_dim):
    moment = random_moments(space_dim, seed=2)
    generator = torch.Generator().manual_seed(3)
    turn = torch.linalg.qr(torch.randn(space_dim, space_dim, generator=generator).double()).Q
    turned = oracle.smooth_inverse(turn @ moment @ turn.T)
    expected = turn @ oracle.smooth_inverse(moment) @ turn.T
    torch.testing.assert_close(turned, expected, rtol=1e-9, atol=1e-11)


# The operators


def both(x, s, eps, box=None):
    """Perception and its gradients by states and positions, by the library and by the oracle."""
    answers = []
    for module, y, t in ((npa_envs, x, s), (oracle, x.cpu().double(), s.cpu().double())):
        y, t = (tensor.detach().clone().requires_grad_() for tensor in (y, t))
        z = module.perceive(y, t, eps, eps, box, detach_positions=False, moment_inverse="smooth")
        draws = torch.Generator().manual_seed(1)
        cotangent = torch.randn(z.shape, dtype=torch.float64, generator=draws)
        gradients = torch.autograd.grad(z, (t, y), cotangent.to(z))
        answers.append((z, *gradients))
    return answers


def assert_equal_to_the_oracle(x, s, eps, box=None):
    bounds = (FORWARD[x.dtype], GRADIENT[x.dtype], POSITION_GRADIENT[x.dtype])
    for value, exact, bound in zip(*both(x, s, eps, box), bounds, strict=True):
        assert value.isfinite().all()
        assert relative_error(value, exact) < bound


@pytest.mark.parametrize("state_dim", [3, 16])
@pytest.mark.parametrize("box", [False, True], ids=("open", "box"))
@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_smooth_perception_and_its_adjoints_equal_the_oracle(
    dtype, space_dim, box, state_dim, device
):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=dtype, device=device)
    assert_equal_to_the_oracle(x, s, 0.3, sides(box, space_dim))


@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_degenerate_geometry_equals_the_oracle(dtype, space_dim, device):
    x, s = degenerate_world(space_dim, 4, dtype=dtype, device=device)
    assert_equal_to_the_oracle(x, s, 0.15)


@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_fields_and_observations_are_corrected_smoothly_too(dtype, space_dim, device):
    x, s = random_world(2, 60, space_dim, 5, dtype=dtype, device=device)
    exact = oracle.fields(x.cpu().double(), s.cpu().double(), 0.2, moment_inverse="smooth")
    fields = npa_envs.perception_fields(x, s, 0.2, moment_inverse="smooth")
    for value, expected in zip(fields, exact, strict=True):
        assert relative_error(value, expected) < FORWARD[dtype]
    surveyed = survey(x, s, eps=0.2, eps0=0.2, box=None, terms=SMOOTH, limit=1e3).perceive()
    expected = oracle.perceive(
        x.cpu().double(), s.cpu().double(), 0.2, 0.2, moment_inverse="smooth"
    )
    assert relative_error(surveyed, expected) < FORWARD[dtype]


def test_the_default_is_the_threshold(device):
    x, s = random_world(2, 90, 2, 6, dtype=torch.float32, device=device)
    z = npa_envs.perceive(x, s, 0.15)
    assert torch.equal(z, npa_envs.perceive(x, s, 0.15, moment_inverse="threshold"))
    smooth = npa_envs.perceive(x, s, 0.15, moment_inverse="smooth")
    gradients = slice(12, 24)
    assert not torch.equal(z[..., gradients], smooth[..., gradients])
    assert torch.equal(z[..., :12], smooth[..., :12])
    assert torch.equal(z[..., 24:], smooth[..., 24:])


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


@pytest.mark.parametrize("space_dim", [2, 3])
def test_smooth_perception_turns_with_the_world(space_dim, device):
    x, s = random_world(2, 70, space_dim, 4, dtype=torch.float64, device=device)
    generator = torch.Generator().manual_seed(3)
    turn = torch.linalg.qr(torch.randn(space_dim, space_dim, generator=generator).double()).Q
    turn = turn.to(device)

    def gradients(x):
        z = npa_envs.perceive(x, s, 0.3, moment_inverse="smooth")
        return z[..., 8 : 8 + 4 * space_dim].unflatten(-1, (4, space_dim))

    assert relative_error(gradients(x @ turn.T), gradients(x) @ turn.T) < 1e-12


def test_another_word_is_refused():
    x, s = random_world(1, 4, 2, 3, dtype=torch.float32, device="cpu")
    message = "moment_inverse must be 'threshold' or 'smooth', got 'soft'"
    for call in (npa_envs.perceive, npa_envs.perception_fields):
        with pytest.raises(npa_envs.NPAError, match=message):
            call(x, s, 0.1, moment_inverse="soft")
    with pytest.raises(npa_envs.NPAError, match=message):
        npa_envs.NPARule(moment_inverse="soft")
    with pytest.raises(npa_envs.NPAError, match="got None"):
        npa_envs.perceive(x, s, 0.1, moment_inverse=None)


def test_gain_of_a_grown_world_stays_small():
    """Where particles have neighbours all around, both inverses are the same to the permille."""
    axis = torch.arange(-0.5, 0.5, 0.03, dtype=torch.float64)
    x = torch.cartesian_prod(axis, axis)[None]
    s = torch.sin(7.0 * x).sum(-1, keepdim=True)
    threshold = oracle.fields(x, s, 0.1)
    smooth = oracle.fields(x, s, 0.1, moment_inverse="smooth")
    determinant = torch.linalg.det(threshold.moment)
    assert math.isclose(float(determinant.median()), 1.0, abs_tol=0.1)
    assert float(determinant.min()) > 0.1
    assert relative_error(smooth.grad1, threshold.grad1) < 1e-3
