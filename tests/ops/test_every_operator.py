"""What holds of every differentiable operator: however it is asked, it answers the same.

Second derivatives are right or refused; they never vanish.
"""

from dataclasses import replace

import pytest
import torch
from torch.testing._internal.two_tensor import TwoTensor
from worlds import assert_same, lively_rule, random_world

import npa_envs
from npa_envs.ops import render_gaussians, splat
from npa_envs.ops.pictures.cameras import orbit


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
    """A value, and the gradient of its sum by the states, as given in memory."""
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
    # The cotangent of a sum has strides of zero; this one has none.
    cotangent = torch.ones_like(value).contiguous()
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
def test_a_second_derivative_is_refused_however_the_first_is_asked_for(name, device):
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


def test_a_compiled_function_refuses_second_derivatives_too():
    x, s = torch.rand(1, 12, 2), torch.randn(1, 12, 4, requires_grad=True)
    squares = lambda x, s: npa_envs.perceive(x, s, 0.3).square().sum()  # noqa: E731
    compiled = torch.compile(squares, backend="aot_eager")
    (gradient,) = torch.autograd.grad(compiled(x, s), s, create_graph=True)
    penalty = gradient.square().sum()
    with pytest.raises(RuntimeError, match="double backward"):
        penalty.backward()


@pytest.mark.parametrize("wrapped", ["x", "s", "both"])
def test_tensors_that_wrap_others_have_the_results_of_each(wrapped):
    x, s = random_world(1, 31, 3, 5, dtype=torch.float32, device="cpu")
    others = [0.5 * v if wrapped in (n, "both") else v for n, v in (("x", x), ("s", s))]
    given = zip((x, s), others, strict=True)
    pairs = [v if own is v else TwoTensor(v, own) for v, own in given]
    found = npa_envs.perceive(*pairs, 0.3)
    expected = [npa_envs.perceive(*worlds, 0.3) for worlds in ((x, s), others)]
    assert_same((found.a, found.b), expected)
    with pytest.raises(npa_envs.NPAError, match=r"memory of their own, got .*TwoTensor"):
        npa_envs.perception_fields(*pairs, 0.3)


def test_nested_tensors_are_refused():
    x, s = random_world(2, 31, 3, 5, dtype=torch.float32, device="cpu")
    nested = [torch.nested.nested_tensor([value[0], value[1, :9]]) for value in (x, s)]
    with pytest.raises(npa_envs.NPAError, match="x must be one dense tensor, got a nested one"):
        npa_envs.perceive(*nested, 0.3)
