"""Captured rollouts among torch's modes, other threads and other work on the device."""

import os
import subprocess
import sys
import threading

import pytest
import torch
from test_captured_rollouts import (
    DEVICE,
    as_launched,
    is_captured,
    make_rule,
    run,
    same,
    together,
    worlds,
)

import npa_envs
from npa_envs.ops import launch
from npa_envs.world.cuda_graph import capture, plain_tensors

pytestmark = [pytest.mark.gpu, pytest.mark.usefixtures("nothing_captured")]


@pytest.mark.parametrize("by_world", [False, True])
def test_what_is_captured_in_inference_mode_serves_other_calls(by_world):
    rule = make_rule()
    x, s = worlds()
    expected = run(rule, x, s, cuda_graph=False, gradients=False, by_world=by_world)
    for mode in (torch.inference_mode, torch.no_grad, torch.inference_mode):
        for _ in range(4):
            with mode():
                generator = torch.Generator(DEVICE).manual_seed(0)
                if by_world:
                    generator = npa_envs.WorldRandom([0, 1, 2], device=DEVICE)
                result = npa_envs.rollout(rule, x, s, 7, generator=generator)
            same(list(result), expected[:2])
    assert is_captured()


def test_threads_that_share_a_generator_draw_different_numbers():
    rule = make_rule()
    x, s = worlds()
    with torch.no_grad():
        for _ in range(4):
            npa_envs.rollout(rule, x, s, 20)
    result = []
    start = threading.Barrier(4)

    def work():
        with torch.no_grad():
            for _ in range(20):
                start.wait()
                result.append(npa_envs.rollout(rule, x, s, 20)[1])

    together(*[work] * 4)
    sums = {float(states.double().sum()) for states in result}
    assert len(sums) == len(result) == 80


def test_with_cuda_as_default_device():
    rule = make_rule()
    torch.set_default_device(DEVICE)
    try:
        as_launched(rule)
        npa_envs.perceive(*worlds(), 0.3)
        with torch.inference_mode(), plain_tensors():
            made = torch.zeros(2)
    finally:
        torch.set_default_device(None)
    assert is_captured()
    assert made.device.type == "cpu"
    made.add_(1)


def test_matrix_precision_chosen_in_the_new_way(monkeypatch):
    rule = make_rule()
    for precision in ("ieee", "tf32"):
        monkeypatch.setattr(torch.backends.cuda.matmul, "fp32_precision", precision)
        as_launched(rule)


def test_others_draw_while_something_is_captured():
    numbers = torch.zeros(10, device=DEVICE)
    drawn = []

    def draw():
        with torch.cuda.stream(torch.cuda.Stream()):
            drawn.append(torch.randn(1000, device=DEVICE))

    def function():
        numbers.add_(1)
        together(draw)

    draw()
    torch.cuda.manual_seed(0)
    graph = capture(function, DEVICE, alone=True)
    graph.replay()
    draw()
    torch.cuda.manual_seed(0)
    draw()
    draw()
    torch.cuda.synchronize()
    assert torch.equal(drawn[1], drawn[3])
    assert torch.equal(drawn[2], drawn[4])
    assert numbers.tolist() == [1.0] * 10


def test_launches_keep_none_of_their_tensors():
    rule = make_rule()
    x, s = worlds(count=8, particles=20_000)
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    # As in a process that launches these kernels for the first time.
    launch._thread.by_kernel.clear()
    with torch.no_grad():
        npa_envs.rollout(rule, x, s, 3, eps=0.01, cuda_graph=False)
    torch.cuda.synchronize()
    assert torch.cuda.memory_allocated() <= before + 2**20


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PYTORCH_CUDA_ALLOC_CONF", "backend:cudaMallocAsync"),
        ("PYTORCH_CUDA_ALLOC_CONF", "expandable_segments:True"),
        ("PYTORCH_NO_CUDA_MEMORY_CACHING", "1"),
    ],
)
def test_other_ways_to_take_memory(name, value):
    code = """
import gymnasium, torch, npa_envs
rule = npa_envs.NPARule(2, 8, 32, eps0=0.3).cuda()
x, s = torch.rand(2, 60, 2, device="cuda"), torch.rand(2, 60, 8, device="cuda")
for _ in range(4):
    npa_envs.rollout(rule, x, s, 5)[1].sum().backward()
envs = gymnasium.make_vec(
    "npa/Morphogenesis2D-v0", num_envs=2, vectorization_mode="vector_entry_point",
    particle_count=60, eps=0.3, device="cuda", output="torch",
)
envs.reset(seed=0)
for _ in range(4):
    envs.step(torch.zeros(envs.action_space.shape))
"""
    options = {"capture_output": True, "encoding": "utf-8", "timeout": 120, "check": False}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=os.environ | {name: value}, **options)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("gradients", [False, True])
def test_compiled_with_graphs_of_its_own(gradients):
    rule = make_rule()

    def function(x, s):
        after = npa_envs.rollout(rule, x, s, 3, update_prob=1.0)
        return after[1].square().sum() + npa_envs.perceive(*after, 0.3).sum()

    compiled = torch.compile(function, mode="reduce-overhead")
    for call in range(4):
        x, s = worlds(seed=call)
        torch.compiler.cudagraph_mark_step_begin()
        with torch.set_grad_enabled(gradients):
            result = compiled(x, s)
            assert torch.allclose(result, function(x, s), rtol=1e-4)
            if gradients:
                torch.autograd.grad(result, rule.hidden.weight)
