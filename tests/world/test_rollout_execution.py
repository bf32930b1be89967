"""Every way of running a rollout gives the same worlds and gradients."""

import pytest
import torch
from support.worlds import assert_same, random_world

import npa_envs

STEPS = 6


class Normalised(npa_envs.NPARule):
    """A rule whose forward pass changes buffers and counts."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.norm = torch.nn.BatchNorm1d(self.perception_dim)
        self.calls = 0

    def forward(self, perception):
        self.calls += 1
        return super().forward(self.norm(perception))


class Forgetful(npa_envs.NPARule):
    """A rule that draws from torch's own generator."""

    def forward(self, perception):
        return torch.nn.functional.dropout(super().forward(perception), 0.5)


RULES = {
    "plain": (npa_envs.NPARule, {}, {"position_noise": 0.01, "dt": 0.5}),
    "periodic": (npa_envs.NPARule, {}, {"box": (1.4, 1.8), "update_prob": 1.0}),
    "walls": (npa_envs.NPARule, {"alpha": 3.0}, {"box": 0.7, "boundary": "reflecting"}),
    "static": (npa_envs.NPARule, {"static": True}, {}),
    "dividing": (npa_envs.NPARule, {"divides": True}, {}),
    "equivariant": (npa_envs.NPARule, {"equivariant": True, "chiral": True}, {}),
    "normalised": (Normalised, {}, {}),
    "forgetful": (Forgetful, {}, {}),
}
CHANGING = ("normalised", "forgetful")
"""Rules that change with each call, or whose draws are not those of the worlds."""


@torch.no_grad()
def one_by_one(rule, x, s, **options):
    for _ in range(STEPS):
        x, s = npa_envs.step(rule, x, s, **options)
    return x, s


@torch.no_grad()
def repeated(rule, x, s, *, generator, **options):
    """The last of several calls, which is recorded on a CPU and captured on CUDA."""
    state = generator.get_state()
    for _ in range(4):
        generator.set_state(state)
        worlds = npa_envs.rollout(rule, x, s, STEPS, generator=generator, **options)
    return worlds


def one_species(rule, x, s, **options):
    return npa_envs.rollout_species([rule], x, s, STEPS, counts=[x.shape[1]], **options)


def rollout(rule, x, s, **options):
    worlds = npa_envs.rollout(rule, x, s, STEPS, **options)
    return [value[-1] for value in worlds] if "keep_every" in options else worlds


def under_autocast(rule, x, s, **options):
    with torch.autocast(x.device.type, dtype=torch.bfloat16):
        return npa_envs.rollout(rule, x, s, STEPS, **options)


WAYS = {
    "recompute": (rollout, {"memory": "recompute"}),
    "minimal": (rollout, {"memory": "minimal"}),
    "watched": (rollout, {"on_divergence": "raise", "memory": "minimal"}),
    "trajectory": (rollout, {"keep_every": 2}),
    "one by one": (one_by_one, {}),
    "repeated": (repeated, {}),
    "autocast": (under_autocast, {}),
    "one species": (one_species, {}),
    "recomputed species": (one_species, {"memory": "minimal"}),
}


def make(name, device):
    """Return a rule, worlds, and options of their rollouts."""
    cls, hyper_parameters, options = RULES[name]
    torch.manual_seed(0)
    rule = cls(2, 5, 8, eps0=0.3, **hyper_parameters).to(device)
    torch.nn.init.normal_(rule.output.weight)
    return rule, *random_world(2, 40, 2, 5, dtype=torch.float32, device=device), options


def run(name, device, function=rollout, **own_options):
    """Return the worlds after a rollout and, unless the way has none, its gradients."""
    rule, x, s, options = make(name, device)
    s.requires_grad_()
    generator = torch.Generator(device).manual_seed(1)
    worlds = function(rule, x, s, generator=generator, **options, **own_options)
    if not worlds[1].requires_grad:
        return worlds, ()
    loss = sum(value.square().sum() for value in worlds)
    gradients = torch.autograd.grad(loss, [s, *rule.parameters()], materialize_grads=True)
    return worlds, gradients


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", RULES)
def test_every_way_of_running_gives_the_same(name, way, device):
    function, options = WAYS[way]
    if name == "dividing" and function is one_species:
        pytest.skip("species do not divide")
    if name in CHANGING and function is repeated:
        pytest.skip("this rule changes in each call")
    expected, expected_gradients = run(name, device, cuda_graph=False)
    worlds, gradients = run(name, device, function, **options)
    assert_same((worlds, gradients), (expected, expected_gradients[: len(gradients)]))


@pytest.mark.parametrize("name", [name for name in RULES if name not in CHANGING])
@torch.no_grad()
def test_each_world_of_a_batch_runs_as_alone(name, device):
    rule, x, s, options = make(name, device)
    # Up to the rounding of the rule's products, which in some libraries depends on their size.
    steps, tolerance = 2, 1e-6

    def grown(worlds):
        generator = npa_envs.WorldRandom([7, 8][worlds], device=device)
        return npa_envs.rollout(rule, x[worlds], s[worlds], steps, generator=generator, **options)

    together = grown(slice(None))
    for world in range(2):
        alone = grown(slice(world, world + 1))
        for value, expected in zip(alone, together, strict=True):
            torch.testing.assert_close(value[0], expected[world], rtol=0.0, atol=tolerance)
