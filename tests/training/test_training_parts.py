"""Pool, optimiser, iteration and loss statistics, each by itself."""

import math

import pytest
import torch
from support.circle_task import CircleTask, circle_config, plain_rollout
from support.refusals import Trap, refused
from torch import nn

from npa_envs.checks import check_device, parse_device
from npa_envs.rule.rule import NPARule, fate_parameters
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint
from npa_envs.training.cycle import WorldPool
from npa_envs.training.iteration import EagerIteration, power_mean
from npa_envs.training.loss_statistics import LossStatistics
from npa_envs.training.optimiser import FATE_RATE, RuleOptimiser, layer_weights, normalise_gradients
from npa_envs.training.process_group import ALONE, RunRandomness
from npa_envs.world.particles import Particles


def make_pool(device="cpu"):
    x = torch.arange(6.0, device=device)[:, None, None].repeat(1, 4, 2)
    return WorldPool(Particles(x, x[..., :1].repeat(1, 1, 3)))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 11.0, -11.0])
@pytest.mark.parametrize("where", ["x", "s"])
def test_pool_replaces_worlds_that_run_away_and_only_those(bad, where, device):
    pool = make_pool(device=device)
    x, s = (torch.full((3, 4, c), v, device=device) for c, v in ((2, 7.0), (3, 8.0)))
    (x if where == "x" else s)[1, 2, 1] = bad
    fresh_x, fresh_s = torch.full_like(x, 0.5), torch.full_like(s, 0.25)
    replaced = pool.write(
        torch.tensor([5, 0, 3], device=device), Particles(x, s), Particles(fresh_x, fresh_s)
    )
    assert replaced.tolist() == [False, True, False]
    assert pool.worlds.x[:, 0, 0].tolist() == [0.5, 1, 2, 7, 4, 7]
    assert pool.worlds.s[:, 0, 0].tolist() == [0.25, 1, 2, 8, 4, 8]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_each_gradient_is_divided_by_its_own_norm_and_one_that_is_not_finite_is_zero(bad, device):
    values = [[[3.0, 4.0]], [-1e-3], [0.0, 0.0], [1.0, bad]]
    gradients = [torch.tensor(value, device=device) for value in values]
    normalise_gradients(gradients)
    expected = ([[0.6, 0.8]], [-1.0], [0.0, 0.0], [0.0, 0.0])
    for gradient, answer in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient.cpu(), torch.tensor(answer), atol=2e-5, rtol=1e-5)


def test_first_step_of_each_repeat_has_the_full_learning_rate_and_fresh_moments(tmp_path):
    config = circle_config(tmp_path, iterations=3, repeats=2, milestones=[1])
    path = []
    parameter = nn.Parameter(torch.zeros(1))
    optimiser = RuleOptimiser([parameter], config, nn.Identity())
    for iteration, value in enumerate((1.0, 1.0, 1.0, -1.0)):
        parameter.grad = torch.tensor([value])
        normalise_gradients([parameter.grad])
        optimiser.step(iteration)
        path.append(parameter.item())
    # With fresh moments AdamW's first step is the learning rate, against the gradient's sign.
    assert path[0] == pytest.approx(-0.01, rel=1e-3)
    assert path[1] - path[0] == pytest.approx(-0.003, rel=1e-3)
    assert path[3] - path[2] == pytest.approx(0.01, rel=1e-3)
    # Weights without gradient decay.
    parameter, config = nn.Parameter(torch.ones(1)), circle_config(tmp_path, weight_decay=0.5)
    parameter.grad = torch.zeros(1)
    RuleOptimiser([parameter], config, nn.Identity()).step(0)
    assert parameter.item() == pytest.approx(1 - 0.01 * 0.5)


@pytest.mark.parametrize(
    "options", [{"divides": True}, {"code_names": ("a", "b"), "code_dim": 2}, {"equivariant": True}]
)
def test_muon_makes_steps_of_matrices_orthogonal_and_leaves_all_else_to_adamw(tmp_path, options):
    config = circle_config(tmp_path, optimiser="muon", learning_rate=1e-2, weight_decay=0.5)
    rule = NPARule(2, 4, 8, eps0=0.1, **options)
    matrices = layer_weights(rule)
    layers = [rule.hidden.weight, rule.output.weight]
    assert set(matrices) == {*layers, *([rule.mixing] if rule.equivariant else [])}
    parameters = list(rule.parameters())
    before = [p.detach().clone() for p in parameters]
    for p in parameters:
        p.grad = torch.randn_like(p)
    optimiser = RuleOptimiser(parameters, config, rule)
    normalise_gradients([p.grad for p in parameters])
    optimiser.step(0)
    fates = set(map(id, fate_parameters(rule)))
    for parameter, old in zip(parameters, before, strict=True):
        rate = 1e-2 * (FATE_RATE if id(parameter) in fates else 1.0)
        step = (1.0 - 0.5 * rate) * old - parameter.detach()
        if any(parameter is matrix for matrix in matrices):
            # Newton and Schulz's iteration leaves singular values near 1; so long are AdamW's steps
            # in the mean of a matrix's entries.
            sizes = torch.linalg.svdvals(step) / (0.2 * max(step.shape) ** 0.5 * rate)
            assert sizes.min() > 0.6
            assert sizes.max() < 1.3
            turned = torch.linalg.svdvals(parameter.grad.T @ step)
            assert torch.trace(parameter.grad.T @ step) > 0.95 * turned.sum()
        else:
            assert torch.allclose(step, rate * parameter.grad.sign(), rtol=1e-2, atol=1e-6)


def make_iteration(config, device="cpu"):
    task, device = CircleTask(), torch.device(device)
    rule = task.make_rule(torch.Generator().manual_seed(1)).to(device, config.torch_dtype)
    generator = torch.Generator(device).manual_seed(2)
    x, s, *_ = task.seed(config.world_count, generator=generator, device=device)
    x, s = x.to(config.torch_dtype), s.to(config.torch_dtype)
    generator.manual_seed(3)
    return task, rule, EagerIteration(task, rule, config, Particles(x, s), generator, plain_rollout)


def test_iteration_leaves_the_worlds_the_terms_and_the_gradients(tmp_path):
    config = circle_config(tmp_path, dtype="float64")
    task, rule, iteration = make_iteration(config)
    iteration.run(5)
    gradients = [p.grad.clone() for p in iteration.parameters]

    generator = torch.Generator().manual_seed(3)
    after = plain_rollout(
        rule, iteration.start, 5, eps=task.eps, box=None, update_prob=0.5,
        memory="store", generator=generator, return_path_length=True
    )  # fmt: skip
    total, parts = task.loss(after)
    rule.zero_grad()
    total.backward()
    assert torch.equal(iteration.end.x, after.x.detach())
    assert torch.equal(iteration.end.s, after.s.detach())
    assert iteration.term_names == ("loss", "distance", "state", "motion")
    assert iteration.terms.tolist() == [total.item(), *(v.item() for v in parts.values())]
    for ours, parameter in zip(gradients, rule.parameters(), strict=True):
        assert ours.abs().max() > 0
        torch.testing.assert_close(ours, parameter.grad, rtol=1e-12, atol=0)
    # Masks differ from run to run.
    iteration.run(5)
    assert not torch.equal(iteration.end.x, after.x.detach())


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
def test_the_stillness_loss_is_of_worlds_past_their_minimum_age(tmp_path, power):
    fields = {"dtype": "float64", "max_age_range": (8, 64), "pool_size": 9}
    _, _, plain = make_iteration(circle_config(tmp_path, **fields))
    fields |= {"stillness_weight": 0.5, "stillness_power": power}
    task, _, iteration = make_iteration(circle_config(tmp_path, **fields))
    assert iteration.term_names == (*plain.term_names, "stillness")
    # The second of three worlds is old enough; both iterations draw the same masks.
    iteration.past_min_age[1] = True
    for one in (plain, iteration):
        one.run(6)
    assert torch.equal(iteration.end.x, plain.end.x)
    # Particles of this task go straight on, so that their path is as long as their way.
    way = (iteration.end.x - iteration.start.x)[1].norm(dim=-1) / task.eps
    change = (iteration.end.s - iteration.start.s)[1].abs()
    way, change = (each.pow(power).mean() ** (1.0 / power) for each in (way, change))
    stillness = 3.0 * iteration.terms[-1]
    assert stillness >= way + change - 1e-12
    assert stillness < 3.0 * (way + change)
    torch.testing.assert_close(iteration.terms[0], plain.terms[0] + 0.5 * iteration.terms[-1])


@pytest.mark.parametrize("power", [1.0, 4.0, 8.0])
def test_power_means_of_small_motions_are_right_in_float32(power):
    values = torch.linspace(-1e-4, 1e-4, 900).view(3, 300).requires_grad_()
    mean = power_mean(values, power)
    expected = values.detach().double().abs().pow(power).mean(dim=1).pow(1.0 / power)
    torch.testing.assert_close(mean.double(), expected, rtol=1e-4, atol=0.0)
    assert torch.autograd.grad(mean.sum(), values)[0].abs().max() > 1e-3


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
def test_worlds_that_do_not_move_have_finite_gradients_of_stillness(tmp_path, power):
    config = circle_config(
        tmp_path, max_age_range=(8, 64), pool_size=9, stillness_weight=0.5, stillness_power=power
    )
    _, rule, iteration = make_iteration(config)
    with torch.no_grad():
        rule.output.weight.zero_()
    iteration.past_min_age[:] = True
    iteration.run(3)
    assert torch.equal(iteration.end.x, iteration.start.x)
    assert all(gradient.isfinite().all() for gradient in iteration.gradients)


def test_statistics_are_the_means_of_the_interval(tmp_path, device):
    _, _, iteration = make_iteration(circle_config(tmp_path), device=device)
    statistics, resumed = LossStatistics(iteration), LossStatistics(iteration)

    def expected(mean, steps, replaced):
        terms = dict.fromkeys(iteration.term_names, mean)
        return terms | {"steps": steps, "replaced_worlds": replaced}, True

    for number, value in enumerate([1.0, 2.0, 6.0], start=1):
        iteration.terms.fill_(value)
        statistics.begin(number, 4 * number)
        statistics.add(torch.tensor([number == 2, False], device=device))
    resumed.load_state_dict(statistics.state_dict())
    statistics.send()
    # What is added before the numbers are received belongs to the next interval.
    iteration.terms.fill_(5.0)
    statistics.begin(4, 7)
    statistics.add(torch.tensor([False], device=device))
    assert statistics.receive() == expected(3.0, 8.0, 1)
    statistics.send()
    assert statistics.receive() == expected(5.0, 7.0, 0)
    resumed.send()
    assert resumed.receive() == expected(3.0, 8.0, 1)


def test_worlds_and_masks_are_drawn_independently(tmp_path):
    schedule = torch.Generator().manual_seed(0)
    cpu, config = torch.device("cpu"), circle_config(tmp_path)
    drawn = RunRandomness(config, cpu, schedule, ALONE, per_world_streams=False)
    assert torch.rand(4, generator=drawn.worlds).ne(torch.rand(4, generator=drawn.masks)).all()


@pytest.mark.parametrize(
    ("names", "rule"),
    [
        (("banana", "", "cuda:-1"), "must name a device"),
        (("mps", "meta", torch.device("mps")), "must be 'cpu' or 'cuda'"),
        (("cpu:3", "cpu:256"), "must be 'cpu' without a number"),
        (("cuda:256", "cuda:99999"), "must have a number that torch can"),
        ((None, 0), "must be text"),
    ],
)
def test_what_names_no_device_is_refused(names, rule):
    for name in names:
        for check in (check_device, *[parse_device] * (not isinstance(name, torch.device))):
            refused(f"device {rule}.*, got .*use 'cpu'", check, name)


def test_a_cuda_device_must_be_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for name in ("cuda", "cuda:0", torch.device("cuda", 1)):
        refused(r"got 'cuda.*sees 0 CUDA devices: use 'cpu'", check_device, name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert check_device("cuda") == torch.device("cuda:0")
    assert check_device(torch.device("cuda:1")) == torch.device("cuda:1")
    refused("got 'cuda:2', but it sees 2 CUDA devices", check_device, "cuda:2")
    assert check_device("cpu") == torch.device("cpu") == check_device(torch.device("cpu"))


def damaged(damage):
    """Return a function that writes a checkpoint and damages it."""

    def write(path):
        save_checkpoint(path, {"pool": torch.zeros(1000)})
        load_checkpoint(path)
        path.write_bytes(damage(path.read_bytes()))

    return write


def other_version(path):
    save_checkpoint(path, {})
    torch.save(torch.load(path, weights_only=True) | {"format_version": 99}, path)


DAMAGED = r"checkpoint\.pt' is not a checkpoint or is damaged"
OURS = "npa-envs checkpoint"
BAD_CHECKPOINTS = {
    "empty": (lambda path: path.write_bytes(b""), DAMAGED),
    "truncated": (damaged(lambda data: data[:-500]), DAMAGED),
    "changed bytes": (damaged(lambda data: data.replace(bytes(4000), b"x" * 4000)), DAMAGED),
    "code": (
        lambda path: torch.save({"format": OURS, "a": Trap(path.with_name("ran"))}, path),
        DAMAGED,
    ),
    "another file": (lambda path: torch.save({"a": 1}, path), "is not a checkpoint of npa-envs"),
    "no version": (lambda path: torch.save({"format": OURS}, path), "has checkpoint format None"),
    "another version": (other_version, "has checkpoint format 99, this version reads 1"),
}


@pytest.mark.parametrize("case", BAD_CHECKPOINTS)
def test_what_is_no_checkpoint_is_refused_and_never_run(tmp_path, case):
    write, message = BAD_CHECKPOINTS[case]
    write(tmp_path / "checkpoint.pt")
    refused(message, load_checkpoint, tmp_path / "checkpoint.pt")
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
