"""Torch derives nothing but backward passes from kernels: all else is refused, and says so."""

import copy
import functools

import pytest
import test_every_operator
import torch
from test_every_operator import OPERATORS, every_operator
from torch.autograd import forward_ad
from worlds import assert_same, random_world
from worlds import lively_rule as made_rule

import npa_envs
from npa_envs import reference
from npa_envs.ops.pictures.losses import picture_losses
from npa_envs.world.brushes import push

TANGENT = r" must carry no tangent of forward-mode derivatives .*reference"
TRANSFORM = r" must not be given within a function of torch.func .*reference"


lively_rule = functools.cache(made_rule)
"""A rule cannot be made within a function of torch.func."""


@pytest.fixture(autouse=True)
def _rules_made_once(monkeypatch):
    monkeypatch.setattr(test_every_operator, "lively_rule", lively_rule)


def world(device, dtype=torch.float32):
    return random_world(1, 31, 3, 5, dtype=dtype, device=device)


def loss_of_picture(x, s):
    target = torch.zeros(8, 8, 4, device=x.device)
    options = {"goal": x.new_zeros(2), "shift": 0.5, "pixel_size": 0.2}
    return picture_losses(x[..., :2].contiguous(), s, target, **options)[0]


def states_of_species(x, s):
    rules = [lively_rule(x.device, x.dtype, 3, 5) for _ in range(2)]
    return npa_envs.rollout_species(rules, x, s, 2, counts=(20, 11))[1]


def states_of_own_network(x, s):
    return own_rule(x.device).step(x, s)


@functools.cache
def own_rule(device):
    class Own(npa_envs.NPARule):
        def forward(self, perception):
            return 2.0 * super().forward(perception)

        def step(self, x, s):
            return npa_envs.step(self, x, s)[1]

    return Own(3, 5, 8).to(device)


UNDIFFERENTIATED = {
    "fields": lambda x, s: npa_envs.perception_fields(x, s, 0.3).blur,
    "fields of species": lambda x, s: npa_envs.species_fields(x, (20, 11), eps=0.3).rho,
    "a mean": lambda x, s: npa_envs.world_mean(s),
    "losses of a picture": loss_of_picture,
    "a rollout of species": states_of_species,
    "a rollout of an own network": states_of_own_network,
    "what is at rest": lambda x, s: npa_envs.at_rest(lively_rule(x.device, x.dtype, 3, 5), x, s),
}
EVERYTHING = OPERATORS | UNDIFFERENTIATED
everything = pytest.mark.parametrize("name", EVERYTHING)


@everything
@pytest.mark.parametrize("gradients", [False, True])
def test_a_tangent_is_refused(name, gradients, device):
    x, s = world(device)
    with torch.set_grad_enabled(gradients), forward_ad.dual_level():
        # Nothing is refused where nothing is asked for.
        EVERYTHING[name](x, s)
        for given in (
            (x, forward_ad.make_dual(s, torch.ones_like(s))),
            (forward_ad.make_dual(x, torch.ones_like(x)), s),
        ):
            if given[0] is x and name == "fields of species":
                continue
            if given[1] is s and name == "a mean":
                continue
            with pytest.raises(npa_envs.NPAError, match=TANGENT):
                EVERYTHING[name](*given)


@pytest.mark.parametrize("name", ["perception", "a rollout", "a picture", "a mean"])
def test_compiled_functions_refuse_tangents(name, device):
    x, s = world(device)
    torch.compiler.reset()
    value = torch.compile(EVERYTHING[name], backend="eager")
    plain = value(x, s)
    with torch.no_grad(), forward_ad.dual_level():
        assert_same(value(x, s), plain)
        dual = forward_ad.make_dual(x, torch.ones_like(x))
        with pytest.raises(npa_envs.NPAError, match=TANGENT):
            value(dual, forward_ad.make_dual(s, torch.ones_like(s)))
    function = functools.partial(EVERYTHING[name], x)
    jvp = torch.compile(lambda s: torch.func.jvp(function, (s,), (s,)), backend="eager")
    with pytest.raises(npa_envs.NPAError, match=f"{TANGENT}|{TRANSFORM}"):
        jvp(s)


@everything
def test_functions_of_torch_func_are_refused(name, device):
    x, s = world(device)
    value = EVERYTHING[name]
    value(x, s)
    asks = (
        lambda: torch.func.jvp(lambda s: value(x, s), (s,), (s,)),
        lambda: torch.func.vjp(lambda s: value(x, s), s),
        lambda: torch.func.grad(lambda s: value(x, s).sum())(s),
        lambda: torch.func.jacrev(lambda s: value(x, s))(s),
        lambda: torch.func.jacfwd(lambda s: value(x, s))(s),
        lambda: torch.func.hessian(lambda s: value(x, s).sum())(s),
        lambda: torch.vmap(lambda s: value(x, s))(torch.stack((s, s))),
    )
    for ask in asks:
        with pytest.raises(npa_envs.NPAError, match=TRANSFORM):
            ask()


@every_operator
def test_a_batch_of_cotangents_is_refused(name, device):
    x, s = world(device)
    s.requires_grad_()
    result = OPERATORS[name](x, s)
    bars = torch.ones(2, *result.shape, device=device)
    for _ in range(2):
        with pytest.raises(npa_envs.NPAError, match=r"is_grads_batched must be False .*vectorize"):
            torch.autograd.grad(result, s, bars, is_grads_batched=True, retain_graph=True)
    # One after the other they are as ever.
    (gradient,) = torch.autograd.grad(result, s, bars[0])
    assert float(gradient.abs().max()) > 0.0


def test_jacobians_are_right_or_refused(device):
    x, s = world(device, torch.float64)
    x, s = x[:, :4], s[:, :4, :2]

    def perceived(s):
        return npa_envs.perceive(x, s, 0.8)

    jacobian = torch.autograd.functional.jacobian
    expected = jacobian(lambda s: reference.perceive(x, s, 0.8, 0.8), s)
    torch.testing.assert_close(jacobian(perceived, s), expected, rtol=1e-9, atol=1e-11)
    with pytest.raises(npa_envs.NPAError, match=TANGENT):
        jacobian(perceived, s, strategy="forward-mode", vectorize=True)
    with pytest.raises(npa_envs.NPAError, match="is_grads_batched must be False"):
        jacobian(perceived, s, vectorize=True)


def test_the_reference_that_the_errors_name_has_them_all():
    x, s = world("cpu", torch.float64)
    x, s = x[:, :4], s[:, :4, :2]

    def perceived(s):
        return reference.perceive(x, s, 0.8, 0.8)

    jacobian = torch.autograd.functional.jacobian
    expected = jacobian(perceived, s)
    for found in (
        jacobian(perceived, s, strategy="forward-mode", vectorize=True),
        jacobian(perceived, s, vectorize=True),
        torch.func.jacfwd(perceived)(s),
        torch.func.jacrev(perceived)(s),
    ):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11)
    assert torch.func.hessian(lambda s: perceived(s).sum())(s).any()


class Rollout(torch.nn.Module):
    def __init__(self, rule):
        super().__init__()
        self.rule = rule

    def forward(self, x, s):
        return npa_envs.rollout(self.rule, x, s, 3)


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("how", ["functional call", "attribute"])
def test_a_rule_whose_weights_carry_tangents_is_refused(plain, how, device):
    x, s = world(device)
    rule = copy.deepcopy(own_rule(device))
    if plain:
        rule = made_rule(device, torch.float32, 3, 5)
    model, weight = Rollout(rule), rule.output.weight.detach()
    with torch.no_grad(), forward_ad.dual_level():
        dual = forward_ad.make_dual(weight, torch.ones_like(weight))
        given = {"rule.output.weight": dual} if how == "functional call" else {}
        if how == "attribute":
            del rule.output.weight
            rule.output.weight = dual
        # The third call of a kind makes steps prepared by the first two.
        for _ in range(4):
            with pytest.raises(npa_envs.NPAError, match="rule" + TANGENT):
                torch.func.functional_call(model, given, (x, s))


def test_prepared_steps_refuse_tangents_as_launched_ones_do(device):
    x, s = world(device)
    rule = lively_rule(device, torch.float32, 3, 5)
    with torch.no_grad(), forward_ad.dual_level():
        plain = [npa_envs.rollout(rule, x, s, 3, update_prob=1.0) for _ in range(4)]
        dual = forward_ad.make_dual(s, torch.ones_like(s))
        for _ in range(4):
            with pytest.raises(npa_envs.NPAError, match="s" + TANGENT):
                npa_envs.rollout(rule, x, dual, 3, update_prob=1.0)
        assert_same(npa_envs.rollout(rule, x, s, 3, update_prob=1.0), plain[0])


def test_a_tangent_that_an_own_network_makes_is_refused(device):
    x, s = world(device)

    class Dual(npa_envs.NPARule):
        def forward(self, perception):
            update = super().forward(perception)
            return forward_ad.make_dual(update, torch.ones_like(update))

    rule = Dual(3, 5, 8).to(x)
    raises = pytest.raises(npa_envs.NPAError, match="update" + TANGENT)
    with torch.no_grad(), forward_ad.dual_level(), raises:
        npa_envs.rollout(rule, x, s, 2)


def test_brushes_have_forward_derivatives():
    x, _ = world("cpu")
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(x, torch.ones_like(x))
        zero = x.new_zeros(1, 3)
        moved = push(dual, centre=zero, move=zero, radius=0.1)
        torch.testing.assert_close(forward_ad.unpack_dual(moved).tangent, torch.ones_like(x))
