"""What holds of every differentiable operator: however it is asked, it answers the same.

Torch derives nothing but backward passes from kernels: all else is rejected, and never vanishes.
"""

import copy
import functools
from dataclasses import replace

import pytest
import torch
from support.refusals import refused
from support.slow import slow
from support.worlds import assert_same, random_world, tensors
from support.worlds import lively_rule as made_rule
from torch.autograd import forward_ad
from torch.testing._internal.two_tensor import TwoTensor

import npa_envs
from npa_envs import reference
from npa_envs.ops import launch, orbit, render_gaussians, splat
from npa_envs.ops.cpu_threads import RANGES_PER_THREAD, even_ranges, run_together
from npa_envs.ops.perceive import NeighbourState
from npa_envs.ops.physics import Limits, Physics, make_physics
from npa_envs.ops.pictures.splat import picture_losses
from npa_envs.ops.update import ActedWorlds, PreparedActions

lively_rule = functools.cache(made_rule)
"""A rule cannot be made within a function of torch.func."""


def picture_of_gaussians(x, s):
    scales, quaternions = torch.full_like(x, 0.1), torch.ones_like(s[..., :4])
    opacities, cameras = torch.ones_like(x[..., 0]), orbit(1, width=16, height=16).to(x.device)
    if not x.is_contiguous():
        turned = cameras.world_to_camera.mT.contiguous().mT
        cameras = replace(cameras, world_to_camera=turned)
    return render_gaussians(x, scales, quaternions, opacities, s[..., :3], cameras).image


def states_of_rollout(x, s, memory="store", **options):
    rule = lively_rule(x.device, x.dtype, x.shape[2], s.shape[2], **options)
    generator = torch.Generator(x.device).manual_seed(0)
    return npa_envs.rollout(rule, x, s, 3, generator=generator, memory=memory)[1]


OPERATORS = {
    "perception": lambda x, s: npa_envs.perceive(x, s, 0.3),
    "perception, by positions": lambda x, s: npa_envs.perceive(x, s, 0.3, detach_positions=False),
    "perception of species": lambda x, s: npa_envs.perceive_species(x, s, (20, 11), 0.3),
    "a rollout": states_of_rollout,
    "a rollout that recomputes": lambda x, s: states_of_rollout(x, s, memory="minimal"),
    "a static rollout": lambda x, s: states_of_rollout(x, s, static=True),
    "an equivariant rollout": lambda x, s: states_of_rollout(x, s, equivariant=True),
    "a picture": lambda x, s: splat(x[..., :2], s[..., :3], resolution=16, pixel_size=0.1),
    "a picture of Gaussians": picture_of_gaussians,
}
every_operator = pytest.mark.parametrize("name", OPERATORS)


def outcome(name, x, s):
    """Return an operator's result, and the gradient of its sum with respect to the states."""
    s = s.detach().requires_grad_()
    value = OPERATORS[name](x, s)
    return value.detach(), *torch.autograd.grad(value.sum(), s)


@every_operator
def test_memory_graphs_and_streams_change_nothing(name, device):
    x, s = random_world(2, 31, 3, 5, dtype=torch.float32, device=device)
    expected = outcome(name, x, s)
    strided = [value.permute(2, 1, 0).contiguous().permute(2, 1, 0) for value in (x, s)]
    assert_same(outcome(name, *strided), expected)
    leaf = s.clone().requires_grad_()
    value = OPERATORS[name](x, leaf)
    # The cotangent of a sum has strides of zero; this one has none, and begins anywhere in memory.
    cotangent = torch.ones(value.numel() + 1, device=device)[1:].view_as(value)
    for _ in range(2):
        bars = torch.autograd.grad(value, leaf, cotangent, retain_graph=True)
        assert_same((value.detach(), *bars), expected)
    with torch.no_grad():
        quiet = OPERATORS[name](x, leaf)
    assert quiet.grad_fn is None
    assert torch.equal(quiet, expected[0])
    if device.type == "cuda":
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            beside = outcome(name, x, s)
        torch.cuda.current_stream().wait_stream(stream)
        assert_same(beside, expected)


@every_operator
def test_a_second_derivative_is_rejected_however_the_first_is_asked_for(name, device):
    x, s = random_world(1, 31, 3, 5, dtype=torch.float32, device=device)
    s.requires_grad_()
    for cotangent in (None, 1.0):
        result = OPERATORS[name](x, s)
        value = result.sum() if cotangent is None else (cotangent * result).square().sum()
        with pytest.raises(npa_envs.NPAError, match=r"create_graph must be False .*reference"):
            torch.autograd.grad(value, s, create_graph=True)
        # The first alone is as ever.
        (gradient,) = torch.autograd.grad(OPERATORS[name](x, s).sum(), s)
        assert float(gradient.abs().max()) > 0.0


def test_a_compiled_function_rejects_second_derivatives_too():
    x, s = torch.rand(1, 12, 2), torch.randn(1, 12, 4, requires_grad=True)
    squares = lambda x, s: npa_envs.perceive(x, s, 0.3).square().sum()  # noqa: E731
    compiled = torch.compile(squares, backend="aot_eager")
    (gradient,) = torch.autograd.grad(compiled(x, s), s, create_graph=True)
    penalty = gradient.square().sum()
    with pytest.raises(RuntimeError, match="double backward"):
        penalty.backward()


@pytest.mark.parametrize("wrapped", ["x", "s", "both"])
def test_tensors_that_wrap_others_have_the_results_of_each_or_are_rejected(wrapped):
    x, s = random_world(1, 31, 3, 5, dtype=torch.float32, device="cpu")
    others = [0.5 * v if wrapped in (n, "both") else v for n, v in (("x", x), ("s", s))]
    arguments = zip((x, s), others, strict=True)
    pairs = [v if own is v else TwoTensor(v, own) for v, own in arguments]
    found = npa_envs.perceive(*pairs, 0.3)
    expected = [npa_envs.perceive(*worlds, 0.3) for worlds in ((x, s), others)]
    assert_same((found.a, found.b), expected)
    fields = npa_envs.perception_fields(*pairs, 0.3)
    expected = [npa_envs.perception_fields(*worlds, 0.3) for worlds in ((x, s), others)]
    for field, own, other in zip(fields, *expected, strict=True):
        assert_same((field.a, field.b), (own, other))
    physics = make_physics(3, 5, torch.float32, eps=0.3)
    refused(r"memory of their own, got .*TwoTensor", NeighbourState, *pairs, physics)
    nested = torch.nested.nested_tensor([x[0], x[0, :9]])
    refused("x must be one dense tensor, got a nested one", npa_envs.perceive, nested, s, 0.3)


TANGENT = r" must carry no tangent of forward-mode derivatives .*reference"
TRANSFORM = r" must not be given within a function of torch.func .*reference"


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
            # No product: torch's own may depend on its number of threads.
            return 2.0 * perception[..., : self.update_dim]

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
def test_a_tangent_is_rejected(name, gradients, device):
    x, s = world(device)
    with torch.set_grad_enabled(gradients), forward_ad.dual_level():
        # Nothing is rejected where nothing is asked for.
        EVERYTHING[name](x, s)
        for arguments in (
            (x, forward_ad.make_dual(s, torch.ones_like(s))),
            (forward_ad.make_dual(x, torch.ones_like(x)), s),
        ):
            if arguments[0] is x and name == "fields of species":
                continue
            if arguments[1] is s and name == "a mean":
                continue
            with pytest.raises(npa_envs.NPAError, match=TANGENT):
                EVERYTHING[name](*arguments)


def acted_and_observed(x, s):
    """Return worlds after two actions, and their perception twice, by recorded launches."""
    x, s = x.detach().clone(), s.detach().clone()
    diverged, enabled = torch.zeros(len(x), dtype=torch.uint8), torch.ones(1, dtype=torch.uint8)
    limits = Limits(perception=1.0, position=0.6, state=10.0)
    physics = Physics(3, 5, 0.3, 0.3, max_displacement=0.1, limits=limits)
    actions = PreparedActions(ActedWorlds(x, s, None, None, enabled, diverged), physics)
    for k in range(2):
        actions(torch.cat((x, s), dim=-1).roll(k, dims=1))
    neighbours = NeighbourState(x, s, physics)
    first = neighbours.perceive()
    return x, s, diverged, first, neighbours.perceive(torch.empty_like(first))


WITHOUT_PRODUCTS = (
    "perception, by positions",
    "perception of species",
    "fields",
    "a rollout of an own network",
    "a picture",
    "a picture of Gaussians",
    "losses of a picture",
)


@pytest.mark.parametrize("name", [*WITHOUT_PRODUCTS, "actions and observation"])
@pytest.mark.parametrize("world_count", [1, 12])
def test_results_are_the_same_bits_for_every_number_of_threads(name, world_count, monkeypatch):
    cuts = []

    def counted(calls):
        cuts.append(len(calls))
        run_together(calls)

    monkeypatch.setattr(launch, "even_ranges", lambda count, _: even_ranges(count, 1))
    monkeypatch.setattr(launch, "run_together", counted)
    worlds = random_world(world_count, 31, 3, 5, dtype=torch.float32, device="cpu")
    worlds = [value.requires_grad_() for value in worlds]
    own_rule(worlds[0].device)  # Made here, as making it draws random numbers.

    def results():
        torch.manual_seed(0)
        values = tensors(
            (EVERYTHING | {"actions and observation": acted_and_observed})[name](*worlds)
        )
        if not values[0].requires_grad:
            return values
        return values, torch.autograd.grad(values[0].square().sum(), worlds, allow_unused=True)

    default = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        expected = results()
        assert not cuts
        for thread_count in (2, 3):
            cuts.clear()
            torch.set_num_threads(thread_count)
            assert_same(results(), expected)
            assert world_count == 1 or max(cuts) == thread_count * RANGES_PER_THREAD
    finally:
        torch.set_num_threads(default)


@pytest.mark.parametrize("name", ["perception", slow("a rollout"), "a picture", slow("a mean")])
def test_compiled_functions_reject_tangents(name, device):
    x, s = world(device)
    torch.compiler.reset()
    value = torch.compile(EVERYTHING[name], backend="eager")
    plain = value(x, s)
    with torch.no_grad(), forward_ad.dual_level():
        assert_same(value(x, s), plain)
        dual = forward_ad.make_dual(x, torch.ones_like(x))
        refused(TANGENT, value, dual, forward_ad.make_dual(s, torch.ones_like(s)))
    function = functools.partial(EVERYTHING[name], x)
    jvp = torch.compile(lambda s: torch.func.jvp(function, (s,), (s,)), backend="eager")
    refused(f"{TANGENT}|{TRANSFORM}", jvp, s)


@everything
def test_functions_of_torch_func_are_rejected(name, device):
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
        refused(TRANSFORM, ask)


@every_operator
def test_a_batch_of_cotangents_is_rejected(name, device):
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


def test_the_reference_has_the_jacobians_that_are_rejected(device):
    x, s = world(device, torch.float64)
    x, s = x[:, :4], s[:, :4, :2]

    def referred(s):
        return reference.perceive(x, s, 0.8, 0.8)

    jacobian = torch.autograd.functional.jacobian
    expected = jacobian(lambda s: npa_envs.perceive(x, s, 0.8), s)
    for result in (
        jacobian(referred, s, strategy="forward-mode", vectorize=True),
        jacobian(referred, s, vectorize=True),
        torch.func.jacfwd(referred)(s),
        torch.func.jacrev(referred)(s),
    ):
        torch.testing.assert_close(result, expected, rtol=1e-9, atol=1e-11)
    assert torch.func.hessian(lambda s: referred(s).sum())(s).any()


class Rollout(torch.nn.Module):
    def __init__(self, rule):
        super().__init__()
        self.rule = rule

    def forward(self, x, s):
        return npa_envs.rollout(self.rule, x, s, 3)


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("how", ["functional call", "attribute", "states"])
def test_prepared_rollouts_reject_tangents_of_weights_and_states(plain, how, device):
    x, s = world(device)
    rule = copy.deepcopy(own_rule(device))
    if plain:
        rule = made_rule(device, torch.float32, 3, 5)
    model, weight = Rollout(rule), rule.output.weight.detach()
    with torch.no_grad(), forward_ad.dual_level():
        # The third call of a kind makes steps prepared by the first two.
        for _ in range(4):
            model(x, s)
        dual = forward_ad.make_dual(weight, torch.ones_like(weight))
        weights = {"rule.output.weight": dual} if how == "functional call" else {}
        if how == "attribute":
            del rule.output.weight
            rule.output.weight = dual
        elif how == "states":
            s = forward_ad.make_dual(s, torch.ones_like(s))
        for _ in range(4):
            name = "s" if how == "states" else "rule"
            refused(name + TANGENT, torch.func.functional_call, model, weights, (x, s))


def test_a_tangent_that_an_own_network_makes_is_rejected(device):
    x, s = world(device)

    class Dual(npa_envs.NPARule):
        def forward(self, perception):
            update = super().forward(perception)
            return forward_ad.make_dual(update, torch.ones_like(update))

    rule = Dual(3, 5, 8).to(x)
    raises = pytest.raises(npa_envs.NPAError, match="update" + TANGENT)
    with torch.no_grad(), forward_ad.dual_level(), raises:
        npa_envs.rollout(rule, x, s, 2)
