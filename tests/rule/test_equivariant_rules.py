"""Rules that know no direction: turned starts, kernels, worlds of several species."""

import copy

import pytest
import torch
from support.worlds import assert_near, lively_rule, random_world, relative_error

import npa_envs
from npa_envs.kernels.cuda.equivariance import fits_block, rows_of_warp
from npa_envs.ops.equivariance import VectorSizes, read_rows
from npa_envs.rule.rule import NPARule

RULES = {
    "2D": {"space_dim": 2},
    "chiral": {"space_dim": 2, "chiral": True},
    "3D": {"space_dim": 3},
    "smooth": {"space_dim": 2, "moment_inverse": "smooth"},
    "without states' gradients": {"space_dim": 3, "state_gradient": False},
    "without the density's": {"space_dim": 2, "chiral": True, "density_gradient": False},
}


def equivariant(device="cpu", dtype=torch.float64, **options):
    """Return a rule of five channels that moves its particles."""
    options = {"equivariant": True, "mixed_vectors": 3, "gain": 4.0, **options}
    return lively_rule(device, dtype, eps0=0.3, **options)


def turns_of(space_dim, count=16):
    """Return random rotation matrices, shape [count, D, D], float64."""
    matrices = torch.randn(count, space_dim, space_dim, generator=torch.Generator().manual_seed(5))
    q, r = torch.linalg.qr(matrices.double())
    q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
    q[:, 0] *= torch.linalg.det(q).sign()[:, None]
    return q


@torch.no_grad()
def largest_difference(rule, x, s, turns):
    """Return how far worlds that were turned first end from the world that is turned afterwards.

    All of them draw the same numbers. Also returns how far particles have moved.
    """
    turns = torch.cat((torch.eye(x.shape[2]).double()[None], turns)).to(x.device)
    weight = rule.hidden.weight
    starts = (x @ turns.mT).to(weight), s.to(weight).expand(len(turns), -1, -1)
    random = npa_envs.WorldRandom([3] * len(turns), device=x.device)
    after = npa_envs.rollout(rule, *starts, 1, generator=random, cuda_graph=False)
    expected = after[0][:1].double() @ turns.mT
    differences = after[0] - expected, after[1] - after[1][:1]
    moved = float((after[0][0] - starts[0][0]).norm(dim=-1).mean())
    return max(float(difference.abs().max()) for difference in differences), moved


# Worst difference measured: 8.3e-6 and 2e-14.
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 4e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("case", RULES)
def test_turned_starts_stay_turned(case, dtype, bound, device):
    options = RULES[case]
    rule = equivariant(device, dtype, **options)
    x, s = random_world(1, 160, options["space_dim"], 5, dtype=torch.float64, device=device)
    s = s.clamp(-1.0, 1.0)
    worst, moved = largest_difference(rule, x, s, turns_of(options["space_dim"]))
    assert worst < bound
    assert moved > 1e-3


def test_plain_rules_and_mirrors_tell_where_it_ends():
    x, s = random_world(1, 160, 2, 5, dtype=torch.float64, device="cpu")
    plain = lively_rule("cpu", eps0=0.3)
    assert largest_difference(plain, x, s, turns_of(2, 1))[0] > 1e-3
    mirror = torch.tensor([[[1.0, 0.0], [0.0, -1.0]]], dtype=torch.float64)
    assert largest_difference(equivariant(), x, s, mirror)[0] < 1e-12
    assert largest_difference(equivariant(chiral=True), x, s, mirror)[0] > 1e-3


@pytest.mark.parametrize(("count", "mixed_vectors"), [(50, 8), (203, 8), (1, 8), (9, 33), (23, 5)])
# Worst error measured: 1.1e-5, of the bias, whose gradients by rows all but cancel.
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-13), (torch.float32, 5e-5)])
@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("case", RULES)
def test_kernels_of_rows_are_the_formulas(case, static, dtype, bound, count, mixed_vectors, device):
    options = RULES[case] | {"mixed_vectors": mixed_vectors}
    exact = equivariant(device, static=static, **options)
    with torch.no_grad():
        # What moves nothing learns to.
        exact.steering[:1] = 0.0
    rule = copy.deepcopy(exact).to(dtype)
    network = rule.network()
    z = torch.randn(count, rule.perception_dim, generator=torch.Generator().manual_seed(2))
    rows = torch.nn.functional.pad(z, (0, network.row_width - rule.perception_dim))
    rows[:, rule.perception_dim] = 1.0
    rows = rows.to(device)
    results = []
    for run, wide in ((network, rows.to(dtype)), (exact, rows[:, : rule.perception_dim].double())):
        wide = wide.clone().requires_grad_()
        update = run(wide)[:, : rule.update_dim]
        weights = (exact if run is exact else rule).network_weights()[: 4 if static else 5]
        bar = torch.linspace(-1.0, 1.0, update.numel(), device=device).to(update).view_as(update)
        gradients = torch.autograd.grad(update, (wide, *weights), bar)
        by_rows = gradients[0][:, : rule.perception_dim]
        results.append([update.detach(), by_rows, *gradients[1:]])
    for ours, theirs in zip(*results, strict=True):
        assert relative_error(ours.double(), theirs) < bound


def test_forms_that_a_block_of_cuda_has_room_for():
    assert fits_block(2, 32, 17, 8, True)
    assert fits_block(3, 48, 25, 8, False)
    # Too many mixing weights, too many products, numbers of vectors beyond a byte.
    assert not fits_block(3, 256, 129, 8, False)
    assert not fits_block(2, 32, 17, 48, True)
    assert not fits_block(2, 0, 1, 256, False)
    assert [rows_of_warp(mixed) for mixed in (1, 8, 9, 16, 17, 33)] == [4, 4, 3, 2, 1, 1]


@pytest.mark.parametrize("count", [0, 5])
def test_gradients_are_taken_of_what_needs_them(count, device):
    form = VectorSizes(2, 10, 6, 8, chiral=True)
    rows, mixing = torch.randn(count, 24, device=device), torch.randn(6, 8, device=device)
    results = []
    for wanted in ("rows", "mixing", "both"):
        leaves = [rows.clone(), mixing.clone()]
        wanted_leaves = leaves if wanted == "both" else leaves[wanted == "mixing" :][:1]
        for leaf in wanted_leaves:
            leaf.requires_grad_()
        mixed, inputs = read_rows(*leaves, form, form.input_dim + 3)
        results.append(torch.autograd.grad((mixed.sum() + inputs).sum(), wanted_leaves))
    assert torch.equal(results[0][0], results[2][0])
    assert torch.equal(results[1][0], results[2][1])
    assert bool(results[1][0].any()) == (count > 0)


def test_rows_in_plenty_are_all_read(device):
    form = VectorSizes(2, 10, 6, 8, chiral=True)
    generator = torch.Generator().manual_seed(4)
    rows, mixing = (
        torch.randn(*shape, generator=generator, dtype=torch.float64).to(device)
        for shape in ((20_001, 24), (form.perceived, form.mixed))
    )
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [value.to(dtype).requires_grad_() for value in (rows, mixing)]
        mixed, inputs = read_rows(*leaves, form, form.input_dim + 3)
        loss = (mixed.square().sum() + inputs.square().sum()) / len(rows)
        results.append([mixed, inputs, *torch.autograd.grad(loss, leaves)])
    for ours, theirs in zip(*results, strict=True):
        assert relative_error(ours, theirs) < 1e-6


BLIND = {"equivariant": True, "state_gradient": False, "density_gradient": False}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"equivariant": torch.ones(2)}, "equivariant must be True or False"),
        ({"chiral": True}, "chiral needs equivariant=True"),
        (
            {"equivariant": True, "chiral": True, "space_dim": 3},
            "chiral needs .* got equivariant=True and space_dim=3",
        ),
        ({"equivariant": True, "species_count": 2}, "perceives all species alike"),
        (
            {"equivariant": True, "mixed_vectors": 0},
            "mixed_vectors must be a whole number of at least 1, got 0",
        ),
        (BLIND, "needs vectors to perceive"),
    ],
)
def test_what_does_not_go_together_is_refused(options, message):
    with pytest.raises(npa_envs.NPAError, match=message):
        NPARule(**options)


def test_species_of_both_kinds_share_a_world():
    rules = [equivariant(seed=1), lively_rule("cpu", eps0=0.3, seed=2)]
    x, s = random_world(2, 60, 2, 5, dtype=torch.float64, device="cpu")
    runs = []
    for one in (rules[0], Unfolded(rules[0])):
        generator = torch.Generator().manual_seed(3)
        options = {"counts": (30, 30), "generator": generator}
        with torch.no_grad():
            runs.append(npa_envs.rollout_species([one, rules[1]], x, s, 4, **options))
    assert_near(runs[0], runs[1], 1e-12)


class Unfolded(NPARule):
    """The same rule, which steps run by `forward` and not by its folded network."""

    def __init__(self, rule):
        self.share(rule)

    def forward(self, perception):
        return super().forward(perception)
