"""Captured rollouts: what they give is what launched ones give, bit for bit."""

import functools
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from support.processes import run_alone
from support.worlds import random_world
from torch.utils.checkpoint import checkpoint

import npa_envs
from npa_envs.ops import launch
from npa_envs.world import capture_cache
from npa_envs.world.cuda_graph import capture, plain_tensors

pytestmark = [pytest.mark.gpu, pytest.mark.usefixtures("nothing_captured")]

DEVICE = torch.device("cuda", 0)
EPS = 0.3


def worlds(count=3, particles=60, space_dim=2, seed=0, dtype=torch.float32):
    return random_world(count, particles, space_dim, 8, dtype=dtype, device=DEVICE, seed=seed)


class Doubled(npa_envs.NPARule):
    runs = 0

    def forward(self, perception):
        Doubled.runs += 1
        return 2.0 * super().forward(perception)


def make_rule(space_dim=2, dtype=torch.float32, seed=0, kind=npa_envs.NPARule, **options):
    torch.manual_seed(seed)
    rule = kind(space_dim, 8, 32, eps0=EPS, **options)
    for parameter in rule.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return rule.to(DEVICE, dtype)


def run(rule, x, s, steps=7, *, seed=0, gradients=True, by_world=False, **options):
    """Return what a rollout gives, its gradients, and what its generator draws next."""
    generator = torch.Generator(DEVICE).manual_seed(seed)
    if by_world:
        generator = npa_envs.WorldRandom([seed + k for k in range(len(x))], device=DEVICE)
    x, s = x.clone().requires_grad_(gradients), s.clone().requires_grad_(gradients)
    options = {"generator": generator, "return_path_length": True, **options}
    with torch.set_grad_enabled(gradients):
        results = npa_envs.rollout(rule, x, s, steps, **options)
    result = list(results)
    if gradients:
        loss = sum(value.sin().sum() for value in results)
        weights = [weight for weight in rule.parameters() if weight.requires_grad]
        result += torch.autograd.grad(loss, [x, s, *weights], allow_unused=True)
    drawn = generator.uniform(3) if by_world else torch.rand(3, device=DEVICE, generator=generator)
    return [*result, drawn]


def same(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert (one is None) == (other is None)
        assert one is None or (torch.equal(one, other) and one.isfinite().all())


def as_launched(rule, calls=4, cuda_graph="auto", **options):
    """Check that calls that may be captured give what launched ones give."""
    for call in range(calls):
        form = {"space_dim": rule.space_dim, "dtype": rule.hidden.weight.dtype}
        x, s = worlds(seed=call, **form)
        expected = run(rule, x, s, seed=call, cuda_graph=False, **options)
        same(run(rule, x, s, seed=call, cuda_graph=cuda_graph, **options), expected)


def together(*works):
    """Run works in threads of their own, and raise their first error."""
    with ThreadPoolExecutor(len(works)) as pool:
        for done in [pool.submit(work) for work in works]:
            done.result()


def is_captured():
    return capture_cache.captured_memory(DEVICE) > 0


@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize(
    ("form", "options"),
    [
        ({}, {}),
        ({}, {"update_prob": 1.0, "box": (1.4, 1.8)}),
        ({}, {"position_noise": 0.01, "dt": 0.5}),
        ({}, {"detach_positions": False}),
        ({}, {"memory": "recompute"}),
        ({}, {"memory": "minimal"}),
        ({}, {"keep_every": 7}),
        ({}, {"keep_every": 1}),
        ({}, {"by_world": True, "position_noise": 0.01}),
        ({}, {"steps": 1}),
        ({}, {"steps": 150}),
        ({"dtype": torch.float64}, {}),
        ({"space_dim": 3}, {}),
        ({"static": True}, {}),
        ({"moment_inverse": "smooth"}, {}),
        ({"equivariant": True, "chiral": True}, {}),
        ({"dtype": torch.float64, "space_dim": 3, "equivariant": True}, {}),
        ({"readout_dim": 3, "readout_hidden_dim": 4}, {}),
    ],
    ids=str,
)
def test_a_captured_rollout_is_the_launched_one(form, options, gradients):
    rule = make_rule(**form)
    as_launched(rule, 2, gradients=gradients, **options)
    assert not is_captured()
    as_launched(rule, 3, gradients=gradients, **options)
    assert is_captured()


def test_numbers_of_steps_vary():
    rule = make_rule()
    x, s = worlds()
    for call, steps in enumerate((5, 9, 5, 9, 12, 1, 9, 0, 5, 70)):
        expected = run(rule, x, s, steps, seed=call, cuda_graph=False)
        same(run(rule, x, s, steps, seed=call, cuda_graph="auto"), expected)


def test_the_global_generator_goes_on_as_launched():
    rule = make_rule()
    x, s = worlds()
    seen = []
    for cuda_graph in (False, "auto"):
        torch.manual_seed(3)
        drawn = []
        with torch.no_grad():
            for _ in range(5):
                drawn += npa_envs.rollout(rule, x, s, 6, cuda_graph=cuda_graph)
                drawn.append(torch.rand(2, device=DEVICE))
        seen.append(drawn)
    same(*seen)
    assert not torch.equal(seen[0][0], seen[0][3])


@pytest.mark.parametrize("kind", [npa_envs.NPARule, Doubled])
def test_weights_are_read_anew_and_results_are_kept(kind):
    rule = make_rule(kind=kind)
    x, s = worlds()
    kept = []
    for call in range(6):
        expected = run(rule, x, s, seed=call, cuda_graph=False)
        result = run(rule, x, s, seed=call, cuda_graph="auto")
        kept.append((result, [None if value is None else value.clone() for value in result]))
        same(result, expected)
        with torch.no_grad():
            for parameter in rule.parameters():
                parameter.mul_(1.01)
        if call == 3 and kind is npa_envs.NPARule:
            rule = make_rule(seed=5)
        if call == 4:
            rule = rule.cpu().to(DEVICE)
            rule.load_state_dict(make_rule(seed=6).state_dict())
    for result, copies in kept:
        same(result, copies)


def optimise(rule, x, s, cuda_graph, arrange):
    generator = torch.Generator(DEVICE).manual_seed(0)
    optimiser = torch.optim.SGD(rule.parameters(), lr=1e-6)
    roll = functools.partial(npa_envs.rollout, rule, generator=generator, cuda_graph=cuda_graph)
    for _ in range(6):
        optimiser.zero_grad()
        arrange(roll, x, s)
        optimiser.step()
    return [parameter.detach().clone() for parameter in rule.parameters()]


def two_before_one_backward(roll, x, s):
    first, second = roll(x, s, 5), roll(s=s * 2.0, x=x, steps=5)
    (first[1] * second[1]).sum().backward()


def one_after_the_other(roll, x, s):
    """What is added up in another order is rounded otherwise."""
    middle = roll(x, s, 5)
    (roll(*middle, 5)[1] * middle[1]).sum().backward()


def retained(roll, x, s):
    after = roll(x, s, 5)
    after[1].sum().backward(retain_graph=True)
    roll(x, s, 5)[1].square().sum().backward()
    after[0].square().sum().backward()


def abandoned(roll, x, s):
    for _ in range(3):
        roll(x, s, 5)
    roll(x, s, 5)[1].sum().backward()


def checkpointed(roll, x, s):
    s = s.clone().requires_grad_()
    middle = checkpoint(
        lambda s: roll(x, s, 5)[1], s, use_reentrant=False, preserve_rng_state=False
    )
    middle.sum().backward()


def with_autocast(roll, x, s):
    with torch.autocast("cuda"):
        roll(x, s, 5)[1].sum().backward()


@pytest.mark.parametrize("memory", ["store", "recompute"])
@pytest.mark.parametrize(
    "arrange",
    [two_before_one_backward, one_after_the_other, retained, abandoned, with_autocast],
)
def test_training_follows_the_same_path(arrange, memory):
    def arranged(roll, x, s):
        arrange(functools.partial(roll, memory=memory), x, s)

    x, s = worlds()
    same(*(optimise(make_rule(), x, s, graph, arranged) for graph in (False, "auto")))
    assert is_captured()


def test_rollouts_within_a_checkpoint_are_launched():
    """Their draws come from the generator twice, so that only the lack of an error is certain."""
    optimise(make_rule(), *worlds(), "auto", checkpointed)
    assert not is_captured()


def test_a_second_backward_pass_is_refused_as_ever():
    rule = make_rule()
    x, s = worlds()
    for _ in range(4):
        loss = npa_envs.rollout(rule, x, s, 5)[1].sum()
        loss.backward()
        with pytest.raises(RuntimeError, match="backward through the graph a second time"):
            loss.backward()
    assert is_captured()


def test_positions_that_are_not_finite_are_refused_and_nothing_is_drawn():
    rule = make_rule()
    x, s = worlds()
    broken = x.clone()
    broken[1, 7, 0] = torch.nan
    generator = torch.Generator(DEVICE)
    with torch.no_grad():
        for _ in range(4):
            generator.manual_seed(0)
            npa_envs.rollout(rule, x, s, 5, generator=generator)
        state = generator.get_state()
        with pytest.raises(npa_envs.NPAError, match=r"x must be finite.*world 1, particle 7"):
            npa_envs.rollout(rule, broken, s, 5, generator=generator)
        assert torch.equal(generator.get_state(), state)
    as_launched(rule, 1, gradients=False)


@pytest.mark.parametrize(("cuda_graph", "launched"), [("auto", 2), (True, 1)])
def test_rules_with_a_network_of_their_own_are_captured(cuda_graph, launched):
    torch.manual_seed(0)
    rule = Doubled(2, 8, 32, eps0=EPS).to(DEVICE)
    as_launched(rule, launched, cuda_graph)
    assert not is_captured()
    as_launched(rule, 3, cuda_graph)
    assert is_captured()
    before = Doubled.runs
    run(rule, *worlds(), cuda_graph=cuda_graph)
    assert Doubled.runs == before


def test_species_are_captured():
    rules = [make_rule(seed=k) for k in range(2)]
    parameters = [own for rule in rules for own in rule.parameters()]
    for call in range(4):
        x, s = worlds(particles=50, seed=call)
        result = []
        for cuda_graph in (False, "auto"):
            generator = torch.Generator(DEVICE).manual_seed(call)
            options = {"counts": (20, 30), "update_prob": (0.5, 0.3), "generator": generator}
            after = npa_envs.rollout_species(rules, x, s, 6, cuda_graph=cuda_graph, **options)
            loss = after[0].sum() + after[1].square().sum()
            result.append([*after, *torch.autograd.grad(loss, parameters)])
        same(*result)
    assert is_captured()


@pytest.mark.parametrize("kind", [npa_envs.NPARule, Doubled])
def test_streams_and_threads(kind):
    rule = make_rule(kind=kind)
    cases = [(worlds(seed=k), k) for k in range(4)]
    expected = [run(rule, *given, seed=k, cuda_graph=False) for given, k in cases]

    def work(k, calls=1):
        for _ in range(calls):
            with torch.cuda.stream(torch.cuda.Stream()):
                result = run(rule, *cases[k][0], seed=k, cuda_graph="auto")
                torch.cuda.current_stream().synchronize()
            same(result, expected[k])

    for k in 3 * [0, 1, 2, 3]:
        work(k)
    together(*(functools.partial(work, k, 10) for k in range(4)))


def test_inside_a_graph_of_the_caller():
    rule = make_rule()
    x, s = worlds()
    with torch.no_grad():
        for _ in range(4):
            npa_envs.rollout(rule, x, s, 5, update_prob=1.0)
        expected = npa_envs.rollout(rule, x, s, 5, update_prob=1.0, cuda_graph=False)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = npa_envs.rollout(rule, x, s, 5, update_prob=1.0)
        graph.replay()
    same(result, expected)


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(capture_cache, "MEMORY_FRACTION", 1e-12)
    as_launched(make_rule(), 5)


@pytest.mark.slow
def test_nothing_leaks_over_ten_thousand_calls_of_changing_shapes():
    rule = make_rule()
    random = torch.Generator().manual_seed(0)
    taken = []
    for call in range(10_000):
        particles = 20 + 5 * int(torch.randint(4, (), generator=random))
        steps = int(torch.randint(1, 5, (), generator=random))
        x, s = worlds(1, particles, seed=call % 7)
        _, states = npa_envs.rollout(rule, x, s, steps)
        if call % 2:
            states.sum().backward()
        del states
        if call in (4_999, 9_999):
            torch.cuda.synchronize()
            taken.append((torch.cuda.memory_allocated(), capture_cache.captured_memory(DEVICE)))
    assert taken[1][0] <= taken[0][0] + 2**20
    assert taken[1][1] == taken[0][1]


# Among torch's modes, other threads and other work on the device.


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
    done = run_alone(code, **{name: value})
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
