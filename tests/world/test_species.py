"""Several rules in one world: what they see of each other, and that physics exists once."""

import functools

import pytest
import torch
from support.worlds import assert_near, cotangents, lively_rule, random_world, relative_error

import npa_envs
from npa_envs import reference as oracle
from npa_envs.errors import NPAError

FIELD_ERRORS = {torch.float64: 1e-13, torch.float32: 2e-6}
"""Largest relative error of fields by species (worst seen 2e-15 and 2e-7)."""


make_rule = functools.partial(lively_rule, eps0=0.3)


def make_world(device, particle_count=60, space_dim=2):
    return random_world(2, particle_count, space_dim, 5, dtype=torch.float64, device=device)


def seeded(device, seed=4):
    return torch.Generator(device).manual_seed(seed)


def fields_by_species(x, counts, eps, box):
    """The fields of each species by pairs: the smoothing and the spiky kernel summed over it."""
    r = oracle.differences(x, box)
    weight = oracle.smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2])
    kernel = oracle.spiky_gradient(r, eps)
    rho = [part.sum(dim=2) for part in weight.split(counts, dim=2)]
    drho = [part.sum(dim=2) for part in kernel.split(counts, dim=2)]
    return torch.stack(rho, dim=2), torch.stack(drho, dim=2)


@pytest.mark.parametrize("counts", [(50,), (1, 49), (13, 30, 7)])
@pytest.mark.parametrize(
    ("space_dim", "box"), [(2, None), (2, (1.4, 1.8)), (3, None), (3, (1.4, 1.5, 1.6))]
)
@pytest.mark.parametrize("static", [False, True])
def test_species_with_one_rule_are_one_species(counts, space_dim, box, static, device):
    rule = make_rule(device, space_dim=space_dim, static=static)
    x, s = make_world(device, 50, space_dim)
    options = {"box": box, "return_path_length": True}
    if not static:
        options |= {"update_prob": 0.4, "dt": 0.5, "position_noise": 0.01, "eps": 0.25}
    expected = npa_envs.rollout(rule, x, s, 20, generator=seeded(device), **options)
    result = npa_envs.rollout_species(
        [rule] * len(counts), x, s, 20, counts=counts, generator=seeded(device), **options
    )
    assert (expected[1] - s).abs().max() > 0.1
    assert_near(result, expected, 1e-12)


def test_rules_that_are_no_plain_networks_run_as_they_are(device):
    class Doubled(npa_envs.NPARule):
        def forward(self, perception):
            return 2.0 * super().forward(perception)

    plain = make_rule(device)
    doubled = Doubled(**plain.hyper_parameters()).to(plain.hidden.weight)
    doubled.load_state_dict(plain.state_dict())
    with torch.no_grad():
        doubled.output.weight *= 0.5
    x, s = make_world(device)
    expected = npa_envs.rollout(plain, x, s, 5, generator=seeded(device))
    for rules in ([doubled, plain], [doubled, doubled]):
        result = npa_envs.rollout_species(rules, x, s, 5, counts=[20, 40], generator=seeded(device))
        assert_near(result, expected, 1e-12)


@pytest.mark.parametrize("by_species", [False, True])
def test_species_out_of_reach_see_themselves_as_alone(by_species, device):
    perception = "per_species" if by_species else "shared"
    rules = [make_rule(device, seed=k, species_count=by_species * 2) for k in range(2)]
    x, s = make_world(device)
    x = torch.cat((x[:, :20], x[:, 20:] + 50.0), dim=1)
    options = {"update_prob": 1.0, "counts": [20, 40], "perception": perception}
    shared = npa_envs.rollout_species(rules, x, s, 5, **options)
    own = npa_envs.rollout_species(rules, x, s, 5, density_counts=[20, 40], **options)
    if by_species:
        # Alone, with a species of nobody's: particles far away of which each sees none.
        z = npa_envs.perceive_species(x[:, :20], s[:, :20], [20], 0.3)
        blank = z.new_zeros(*z.shape[:2], 3)
        z = torch.cat((z[..., :23], blank[..., :1], z[..., 23:], blank[..., 1:]), dim=-1)
        update = rules[0](z)
        delta = update[..., :2]
        step = 0.5 * 0.3 * delta / (1.0 + delta.norm(dim=-1, keepdim=True))
        first = npa_envs.rollout_species(rules, x, s, 1, density_counts=[20, 40], **options)
        assert (first[0][:, :20] - x[:, :20] - step).abs().max() < 1e-12
    else:
        alone = npa_envs.rollout(rules[0], x[:, :20], s[:, :20], 5, update_prob=1.0)
        assert_near([value[:, :20] for value in own], alone, 1e-11)
    assert (own[0] - shared[0]).abs().max() > 1e-4


def test_a_species_that_sleeps_stays_where_it_is_and_leaves_others_their_updates(device):
    rules = [make_rule(device), make_rule(device, seed=1)]
    x, s = make_world(device)
    awake_x, awake_s = npa_envs.rollout_species(rules, x, s, 1, counts=[30, 30], update_prob=1.0)
    for chances, asleep in (((1e-12, 1.0), slice(0, 30)), ((1.0, 1e-12), slice(30, 60))):
        after_x, after_s = npa_envs.rollout_species(
            rules, x, s, 1, counts=[30, 30], update_prob=chances, generator=seeded(device)
        )
        expected_x, expected_s = awake_x.clone(), awake_s.clone()
        expected_x[:, asleep], expected_s[:, asleep] = x[:, asleep], s[:, asleep]
        assert_near((after_x, after_s), (expected_x, expected_s), 1e-13)


@pytest.mark.parametrize("periodic", [False, True])
def test_fields_of_each_species_are_sums_over_it(dtype, space_dim, periodic, device):
    counts = [70, 1, 130]
    box = (1.4, 1.7, 1.5)[:space_dim] if periodic else None
    x, s = random_world(3, 201, space_dim, 4, dtype=dtype, device=device)
    result = npa_envs.species_fields(x, counts, eps=0.3, box=box)
    expected = fields_by_species(x.cpu().double(), counts, 0.3, box)
    total = npa_envs.perception_fields(x, s, 0.3, box)
    for value, answer in zip(result, expected, strict=True):
        assert relative_error(value, answer) < FIELD_ERRORS[dtype]
    assert relative_error(result.rho.sum(2), total.rho) < FIELD_ERRORS[dtype]
    assert relative_error(result.drho.sum(2), total.drho) < FIELD_ERRORS[dtype]


def test_fields_of_species_can_be_compiled(device):
    x, _ = make_world(device)

    def density_of_the_second(x):
        return npa_envs.species_fields(x, [20, 40], eps=0.3).rho[..., 1] * 2.0

    compiled = torch.compile(density_of_the_second, backend="aot_eager", fullgraph=True)
    assert torch.equal(compiled(x), density_of_the_second(x))


def test_every_species_is_perceived_with_the_logarithm_of_its_gradient(device):
    counts = [20, 40]
    x, s = make_world(device)
    z = npa_envs.perceive_species(x, s, counts, 0.3, 0.2)
    shared = npa_envs.perceive(x, s, 0.3, 0.2)
    rho, drho = fields_by_species(x.cpu(), counts, 0.3, None)
    scale = 0.3 / 0.2
    density = scale**2 * rho / 60
    gradient = oracle.log_scale(scale**3 * drho / 60).flatten(2)
    assert torch.equal(z[..., :22], shared)
    assert relative_error(z[..., 22:24], density) < 1e-13
    assert relative_error(z[..., 24:], gradient) < 1e-13


@pytest.mark.parametrize("perception", ["shared", "per_species"])
@pytest.mark.parametrize("update_prob", [1.0, 0.5])
def test_each_species_follows_its_own_rule(update_prob, perception, device):
    """One step, and its gradients: what its own rule makes of what a particle perceives."""
    species_count = 2 * (perception == "per_species")
    rules = [
        make_rule(device, species_count=species_count),
        make_rule(device, seed=1, hidden_dim=20, alpha=0.2, species_count=species_count),
    ]
    counts = [20, 40]
    x, s = make_world(device)
    s.requires_grad_()
    options = {"eps": 0.25, "update_prob": update_prob, "perception": perception}
    result = npa_envs.rollout_species(
        rules, x, s, 1, counts=counts, generator=seeded(device), **options
    )
    mask = torch.ones(2, 60, dtype=torch.uint8, device=device)
    if update_prob < 1.0:
        mask.bernoulli_(update_prob, generator=seeded(device))
    z = npa_envs.perceive_species(x, s, counts, 0.25, 0.3)[..., : rules[0].perception_dim]
    update = torch.cat((rules[0](z[:, :20]), rules[1](z[:, 20:])), dim=1) * mask[..., None]
    delta = update[..., :2]
    reach = 0.25 * torch.tensor([0.5] * 20 + [0.2] * 40, dtype=x.dtype, device=device)[:, None]
    moved = x + reach * delta / (1.0 + delta.norm(dim=-1, keepdim=True))
    expected = moved, s + update[..., 2:]
    assert_near(result[:1], expected[:1], 1e-13)
    assert_near(result[1:], expected[1:], 1e-12 if species_count else 1e-13)
    inputs = [s, *rules[0].parameters(), *rules[1].parameters()]
    gradients = [torch.autograd.grad(v, inputs, cotangents(v)) for v in (result, expected)]
    for value, answer in zip(*gradients, strict=True):
        assert answer.norm() > 1e-3
        assert relative_error(value, answer) < 1e-12


@pytest.mark.gpu
@pytest.mark.parametrize("perception", ["shared", "per_species"])
def test_devices_agree(perception):
    species_count = 0 if perception == "shared" else 2
    options = {"counts": [1000, 500], "perception": perception, "update_prob": (0.5, 0.3)}
    x, s = make_world("cpu", 1500)
    results = []
    for device in ("cpu", "cuda"):
        rules = [make_rule(device, seed=k, species_count=species_count, gain=2.0) for k in range(2)]
        random = npa_envs.WorldRandom([1, 2], device=device)
        worlds = x.to(device), s.to(device)
        with torch.no_grad():
            results.append(npa_envs.rollout_species(rules, *worlds, 4, generator=random, **options))
    assert_near(*results, 1e-10)


PLAIN, OTHER = make_rule("cpu"), make_rule("cpu", seed=1)
BY_SPECIES = make_rule("cpu", species_count=2)
X, S = make_world("cpu")
BROKEN = X.index_fill(1, torch.tensor(3), torch.nan)


def with_rule(**options):
    return {"rules": [PLAIN, make_rule("cpu", **options)]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_rule(state_dim=6), "agree in state_dim, got 5 for rule 0 and 6 for rule 1"),
        (with_rule(moment_inverse="smooth"), "agree in moment_inverse, got threshold for rule 0"),
        (with_rule(density_gradient=False), "density_gradient, got True for rule 0 and False for"),
        (
            {"rules": [PLAIN, BY_SPECIES]},
            "'shared' of 2 species needs .*species_count=0, got 2 for rule",
        ),
        ({"rules": PLAIN}, r"one NPARule for each species, got NPARule: give \(rule,\)"),
        ({"rules": [PLAIN, "gecko"]}, "one NPARule for each species, got NPARule, str"),
        ({"rules": [PLAIN]}, "one for each species, got 1 rules and 2 counts"),
        ({"perception": "per_species"}, "needs rules with species_count=2, got 0 for rule 0"),
        ({"perception": "own"}, "'shared' or 'per_species', got 'own'"),
        ({"counts": [20, 41]}, r"sum to the 60 particles .* \(20, 41\), .* to 61"),
        ({"counts": [60, 0]}, r"at least 1 for every species, got \(60, 0\)"),
        ({"counts": 60}, r"one number of particles for each species, got 60"),
        ({"counts": [20.5, 39.5]}, "an entry of counts must be an integer"),
        ({"counts": []}, "1 to 64 species, got 0"),
        ({"density_counts": [60]}, "one for each of 2 species, got 1"),
        ({"cuda_graph": "yes"}, "cuda_graph must be 'auto', 'whole', True or False, got 'yes'"),
        ({"memory": "little"}, "'store', 'recompute' or 'minimal', got 'little'"),
        ({"update_prob": [0.5]}, "one for each of 2 species, got 1"),
        ({"update_prob": [0.5, 1.5]}, r"lie in \(0, 1\], got 1\.5"),
        ({"update_prob": "half"}, "must be a number, got 'half'"),
        (lambda: npa_envs.rollout(BY_SPECIES, X, S, 1), "species_count=2: run it with"),
        (lambda: make_rule("cpu", species_count=-1), "number of at least 0, got -1"),
        (lambda: npa_envs.species_fields(X[0], [60], eps=0.3), r"shape \[B, N, D\]"),
        (lambda: npa_envs.perceive_species(X, S, [50], 0.3), "sum to the 60 particles"),
        (lambda: npa_envs.species_fields(BROKEN, [60], eps=0.3), "world 0, particle 3"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    arguments = {"rules": [PLAIN, OTHER], "x": X, "s": S, "steps": 1, "counts": [20, 40]}
    with pytest.raises(NPAError, match=message):
        change() if callable(change) else npa_envs.rollout_species(**arguments | change)
