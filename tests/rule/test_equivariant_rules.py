"""Rules that know no direction: turned starts, kernels, files, and who runs such rules."""

import copy
import json

import numpy as np
import pytest
import torch
from test_rule_files import assert_same_rule, pack
from worlds import assert_near, lively_rule, random_world, relative_error

import npa_envs
from npa_envs.cli import main
from npa_envs.kernels.cuda.equivariance import fits_block, rows_of_warp
from npa_envs.ops.equivariance import VectorForm, read_rows
from npa_envs.rule.rule import NPARule

KINDS = {
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
    """Return rotations, shape [count, D, D], in float64."""
    matrices = torch.randn(count, space_dim, space_dim, generator=torch.Generator().manual_seed(5))
    q, r = torch.linalg.qr(matrices.double())
    q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
    q[:, 0] *= torch.linalg.det(q).sign()[:, None]
    return q


@torch.no_grad()
def largest_difference(rule, x, s, turns):
    """Return how far turned worlds end from where the world, turned afterwards, ends.

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
@pytest.mark.parametrize("kind", KINDS)
def test_turned_starts_stay_turned(kind, dtype, bound, device):
    options = KINDS[kind]
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
@pytest.mark.parametrize("kind", KINDS)
def test_kernels_of_rows_are_the_formulas(kind, static, dtype, bound, count, mixed_vectors, device):
    options = KINDS[kind] | {"mixed_vectors": mixed_vectors}
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
    found = []
    for run, wide in ((network, rows.to(dtype)), (exact, rows[:, : rule.perception_dim].double())):
        wide = wide.clone().requires_grad_()
        update = run(wide)[:, : rule.update_dim]
        weights = (exact if run is exact else rule).network_weights()[: 4 if static else 5]
        bar = torch.linspace(-1.0, 1.0, update.numel(), device=device).to(update).view_as(update)
        gradients = torch.autograd.grad(update, (wide, *weights), bar)
        by_rows = gradients[0][:, : rule.perception_dim]
        found.append([update.detach(), by_rows, *gradients[1:]])
    for ours, theirs in zip(*found, strict=True):
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
    form = VectorForm(2, 10, 6, 8, chiral=True)
    rows, mixing = torch.randn(count, 24, device=device), torch.randn(6, 8, device=device)
    found = []
    for wanted in ("rows", "mixing", "both"):
        leaves = [rows.clone(), mixing.clone()]
        wanted_leaves = leaves if wanted == "both" else leaves[wanted == "mixing" :][:1]
        for leaf in wanted_leaves:
            leaf.requires_grad_()
        mixed, inputs = read_rows(*leaves, form, form.input_dim + 3)
        found.append(torch.autograd.grad((mixed.sum() + inputs).sum(), wanted_leaves))
    assert torch.equal(found[0][0], found[2][0])
    assert torch.equal(found[1][0], found[2][1])
    assert bool(found[1][0].any()) == (count > 0)


def test_rows_in_plenty_are_all_read(device):
    form = VectorForm(2, 10, 6, 8, chiral=True)
    generator = torch.Generator().manual_seed(4)
    rows, mixing = (
        torch.randn(*shape, generator=generator, dtype=torch.float64).to(device)
        for shape in ((20_001, 24), (form.perceived, form.mixed))
    )
    found = []
    for dtype in (torch.float32, torch.float64):
        leaves = [value.to(dtype).requires_grad_() for value in (rows, mixing)]
        mixed, inputs = read_rows(*leaves, form, form.input_dim + 3)
        loss = (mixed.square().sum() + inputs.square().sum()) / len(rows)
        found.append([mixed, inputs, *torch.autograd.grad(loss, leaves)])
    for ours, theirs in zip(*found, strict=True):
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


# The authors' formats.


def authors_rule(seed=0, state_dim=3, mixed=2, hidden_dim=5):
    """Return the tensors of a rule by the names of the authors' state dict."""
    generator = torch.Generator().manual_seed(seed)
    inputs, outputs = 2 * state_dim + mixed * (mixed + 1) // 2, state_dim + mixed
    shapes = {
        "model.W_hidden": (state_dim + 1, mixed),
        "model.W_out": (mixed, 1),
        "model.mlp.0.weight": (hidden_dim, inputs),
        "model.mlp.0.bias": (hidden_dim,),
        "model.mlp.2.weight": (outputs, hidden_dim),
        "model.mlp.2.bias": (outputs,),
    }
    state = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    return state | {"eps0": torch.tensor(0.1), "N0": torch.tensor(4096), "alpha": torch.tensor(0.5)}


def authors_update(state, z):
    """Return [δ ; Δs] of perception vectors, written out pair by pair."""
    mixing, steering = state["model.W_hidden"], state["model.W_out"]
    channels, mixed = mixing.shape[0] - 1, mixing.shape[1]
    vectors = z[:, 2 * channels :].view(len(z), channels + 1, 2)
    u = [sum(mixing[i, a] * vectors[:, i] for i in range(channels + 1)) for a in range(mixed)]
    products = [(u[a] * u[b]).sum(-1) for a in range(mixed) for b in range(a, mixed)]
    inputs = torch.cat((z[:, : 2 * channels], torch.stack(products, dim=1)), dim=1)
    hidden = torch.relu(inputs @ state["model.mlp.0.weight"].T + state["model.mlp.0.bias"])
    y = hidden @ state["model.mlp.2.weight"].T + state["model.mlp.2.bias"]
    gates = torch.relu(y[:, channels:])
    delta = sum(u[a] * gates[:, a : a + 1] * steering[a, 0] for a in range(mixed))
    return torch.cat((delta, y[:, :channels]), dim=1)


def padded(tensor):
    return torch.nn.functional.pad(tensor, (0, -tensor.shape[-1] % 4))


def demo_tensors(state):
    """Return the tensors as the web demo has them: padded, the mixtures' weights four times."""
    return {
        "W_hidden": state["model.W_hidden"].repeat_interleave(4, dim=-1),
        "W_out": state["model.W_out"].repeat_interleave(4, dim=-1),
        "w1.weight": padded(state["model.mlp.0.weight"]),
        "w1.bias": padded(state["model.mlp.0.bias"]),
        "w2.weight": padded(state["model.mlp.2.weight"]),
        "w2.bias": padded(state["model.mlp.2.bias"]),
    }


def packed(tensors, stacked=False):
    first = (lambda t: t) if stacked else (lambda t: t.numpy())
    entry = {name: pack(first(tensor)) for name, tensor in tensors.items()}
    return entry | {"eps0": 0.10000000149011612, "N0": 4096, "alpha": 0.5}


def stack_of(rules):
    tensors = [demo_tensors(state) for state in rules]
    return packed({name: torch.stack([t[name] for t in tensors]) for name in tensors[0]})


def assert_runs_as(rule, state):
    z = torch.randn(30, rule.perception_dim, generator=torch.Generator().manual_seed(8))
    assert (rule.space_dim, rule.eps0, rule.alpha) == (2, 0.1, 0.5)
    assert relative_error(rule(z), authors_update(state, z)) < 1e-6


def test_the_authors_equivariant_rules_run_as_theirs(tmp_path):
    rules = [authors_rule(seed) for seed in range(3)]
    torch.save(rules[0], tmp_path / "npa.pth")
    assert_runs_as(npa_envs.load_rule(tmp_path / "npa.pth"), rules[0])
    path = tmp_path / "models.json"
    entries = {name: packed(demo_tensors(rules[k])) for k, name in enumerate("ab")}
    path.write_text(json.dumps(entries), encoding="utf-8")
    assert_runs_as(npa_envs.load_rule(f"{path}#b"), rules[1])
    path.write_text(json.dumps(stack_of(rules)), encoding="utf-8")
    for number, state in enumerate(rules):
        assert_runs_as(npa_envs.load_rule(f"{path}#{number}"), state)


def plain_stack(rules):
    """Return plain rules as a stack."""
    outputs = [torch.cat((rule.output.weight[2:], rule.output.weight[:2])).T for rule in rules]
    tensors = {
        "w1.weight": torch.stack([padded(rule.hidden.weight) for rule in rules]),
        "w1.bias": torch.stack([rule.hidden.bias for rule in rules]),
        "w2.weight.T": torch.stack([padded(output) for output in outputs]),
    }
    return packed({name: tensor.detach() for name, tensor in tensors.items()})


def test_stacks_of_plain_rules_are_by_species_by_numbers(tmp_path):
    torch.manual_seed(0)
    rules, path = [NPARule(2, 5, 8) for _ in range(3)], tmp_path / "models_digits.json"
    path.write_text(json.dumps(plain_stack(rules)), encoding="utf-8")
    for number, rule in enumerate(rules):
        assert_same_rule(npa_envs.load_rule(f"{path}#{number}"), rule)
    with pytest.raises(npa_envs.NPAError, match="several rules: add #name; names: 0, 1, 2"):
        npa_envs.load_rule(path)
    for wrong in ("3", "-1", "lizard", "", "9" * 5000):
        with pytest.raises(npa_envs.NPAError, match=f"no rule '{wrong[:20]}.*known: 0, 1, 2"):
            npa_envs.load_rule(f"{path}#{wrong}")
    path.write_text(json.dumps(plain_stack(rules[:1])), encoding="utf-8")
    assert_same_rule(npa_envs.load_rule(path), rules[0])


def ones(*shape):
    return pack(np.ones(shape))


BAD_ENTRIES = {
    "a missing tensor": (lambda e: e.pop("w2.bias"), "lacks 'w2.bias'"),
    "fewer mixtures": (lambda e: e.update(W_out=ones(1, 4)), "must have the sh"),
    "few inputs": (lambda e: e.update({"w1.weight": ones(5, 8)}), "must have"),
    "no channels": (lambda e: e.update(W_hidden=ones(1, 8)), "must have the"),
    "NaN": (lambda e: e.update({"w1.bias": pack(np.full(5, np.nan))}), "finite"),
    "no radius": (lambda e: e.pop("eps0"), "eps0 must be a number, got None"),
}


@pytest.mark.parametrize("case", BAD_ENTRIES)
def test_wrong_files_of_equivariant_rules_are_refused(tmp_path, case):
    change, message = BAD_ENTRIES[case]
    entry, path = packed(demo_tensors(authors_rule())), tmp_path / "models.json"
    change(entry)
    path.write_text(json.dumps({"mine": entry}), encoding="utf-8")
    with pytest.raises(npa_envs.NPAError, match=f"cannot load a rule from .*: .*{message}"):
        npa_envs.load_rule(path)


def test_wrong_stacks_and_state_dicts_are_refused(tmp_path):
    stack, path = stack_of([authors_rule(0), authors_rule(1)]), tmp_path / "models.json"
    stack["w2.bias"] = ones(1, 8)
    path.write_text(json.dumps(stack), encoding="utf-8")
    with pytest.raises(npa_envs.NPAError, match=r"w2\.bias must have as many rules as w1\.weight"):
        npa_envs.load_rule(f"{path}#1")
    stack["w1.weight"]["shape"][0] = 10**9
    path.write_text(json.dumps(stack), encoding="utf-8")
    with pytest.raises(npa_envs.NPAError, match="or be a stack of rules whose"):
        npa_envs.load_rule(f"{path}#1")
    state = authors_rule()
    del state["model.W_out"]
    torch.save(state, tmp_path / "npa.pth")
    with pytest.raises(npa_envs.NPAError, match=r"missing: \['model.W_out'\]"):
        npa_envs.load_rule(tmp_path / "npa.pth")


# Who runs such rules.


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
    """The same rule, run as the module that it is."""

    def __init__(self, rule):
        vars(self).update(vars(rule))

    def forward(self, perception):
        return super().forward(perception)


def test_pages_and_collections_refuse_what_they_cannot_run(tmp_path):
    path = tmp_path / "mine.safetensors"
    npa_envs.save_rule(NPARule(equivariant=True), path)
    for out in ("page.html", "models.json"):
        assert main(["export-web", str(path), "--out", str(tmp_path / out)]) != 0
        assert not (tmp_path / out).exists()
