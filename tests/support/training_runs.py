"""Short training runs for tests: logs, kills in the middle, a CPU stand-in for CUDA graphs."""

import contextlib

import pytest
import torch
from support.circle_task import CircleTask, plain_rollout
from support.worlds import tensors
from torch.utils._python_dispatch import TorchDispatchMode

from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import JsonlLog, Trainer, preset
from npa_envs.training.cycle import TrainingCycle
from npa_envs.world.particles import Particles


def heart_task(**fields):
    sizes = {"resolution": 64, "particle_count": 512, "target_point_count": 512}
    return Morphogenesis2D(preset("tiny", target="heart", **sizes, **fields).task)


def grown(task, world_count, noise):
    """Worlds that are the target but for a little noise, in another place, as rules grow it."""
    points, colours = task.target.points, task.target.colours
    drawn = torch.randn(points.shape, generator=torch.Generator().manual_seed(3))
    x = (points + noise * drawn + torch.tensor([0.2, -0.1])).expand(world_count, -1, -1).clone()
    s = x.new_zeros(*x.shape[:2], task.config.state_dim)
    s[..., -3:] = colours - 0.5
    return Particles(x, s)


def trainer_of(config, task=None, **options):
    options = {"task_name": "circle", "rollout": plain_rollout} | options
    return Trainer(task or CircleTask(), config, **options)


def train(config, task=None, **options):
    return trainer_of(config, task, **options).run(progress=False)


def log_of(folder):
    """The log without its times, which differ from run to run."""
    records = JsonlLog(folder / "log.jsonl").records()
    return [{k: v for k, v in record.items() if k != "seconds"} for record in records]


class Killed(BaseException):
    pass


class KilledTask(CircleTask):
    """Ends the program, as a kill would, in the loss of an iteration."""

    def __init__(self, iteration, end):
        super().__init__()
        self.calls_before = iteration  # One of them is the trainer's look at the terms.
        self.end = end

    def loss(self, worlds):
        if self.loss_calls == self.calls_before:
            self.end()
        return super().loss(worlds)


def kill():
    raise Killed


def runaway(rule, worlds, steps, **options):
    """A rollout that moves the second world so far away that the pool replaces it."""
    after = plain_rollout(rule, worlds, steps, **options)
    return after._replace(x=after.x + torch.tensor([0.0, 100.0, 0.0])[:, None, None])


@contextlib.contextmanager
def full_disk(file_size):
    """The system refuses to write files beyond a size [bytes], as it does on a full disk."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


class Recording(TorchDispatchMode):
    """A CUDA graph for the CPU: the same operations on the same memory, with numbers as they were.

    The second call of the function is recorded, as by `npa_envs.world.cuda_graph.GraphedCallable`.
    """

    def __init__(self, function):
        super().__init__()
        self.function = function
        self.calls = 0
        self.recorded = []

    @torch.no_grad()
    def __call__(self):
        self.calls += 1
        if self.calls == 2:
            with self:
                self.function()
        elif self.calls == 1:
            self.function()
        else:
            for operation, args, kwargs, out in self.recorded:
                again = operation(*args, **kwargs)
                memory = {t.untyped_storage().data_ptr() for t in tensors(args, kwargs)}
                for old, new in zip(tensors(out), tensors(again), strict=True):
                    if old.untyped_storage().data_ptr() not in memory:
                        old.copy_(new)

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        assert "_local_scalar_dense" not in operation.name(), "this would wait for the device"
        out = operation(*args, **(kwargs or {}))
        self.recorded.append((operation, args, kwargs or {}, out))
        return out


def lively_rule(task, dtype=torch.float32):
    """An untrained rule whose read-out, where there is one, says something other than nothing."""
    rule = task.make_rule(torch.Generator().manual_seed(1)).to(dtype)
    with torch.no_grad():
        for parameter in () if rule.readout is None else rule.readout.parameters():
            parameter.normal_(std=0.5, generator=torch.Generator().manual_seed(2))
    return rule


def worlds_of(task, world_count, dtype=torch.float32):
    """Fresh worlds of a task, with states about 0.3."""
    generator = torch.Generator().manual_seed(0)
    x, s, *_ = task.seed(world_count, generator=generator)
    return x.to(dtype), 0.3 * torch.randn(s.shape, generator=generator, dtype=dtype)


def make_cycle(config, task, device="cpu", rollout=None, **options):
    device = torch.device(device)
    schedule = torch.Generator().manual_seed(config.seed)
    rule = task.make_rule(schedule).to(device, config.torch_dtype)
    return TrainingCycle(task, rule, config, device, schedule, rollout, **options), rule
