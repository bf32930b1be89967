"""Several processes that train one rule: the same curve for any number, and what ends them."""

import os
import re
import signal
import threading
import time

import pytest
import torch
import torch.distributed as dist
from support.clock import wait_until
from support.processes import on_ranks
from support.slow import slow
from support.training_runs import log_of
from support.worlds import assert_same

from npa_envs.errors import NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import TASKS, Trainer, override, preset, process_launcher, train
from npa_envs.training.checkpoint import load_checkpoint
from npa_envs.training.cycle import TrainingCycle
from npa_envs.training.process_group import ProcessGroup
from npa_envs.training.process_launcher import LOST_CODE, Heartbeat, joined_processes

LIVELY = {"max_age_range": (4, 400), "stillness_weight": 1.0, "stillness_min_age": 4}
LIVELY |= {"damage_share": 0.5, "world_count": 4, "pool_size": 16, "picture_interval": 2}
"""Worlds that age, are to rest or are damaged in some places, and are replaced."""

SEEDED = {"seed_interval": 3, "fresh_share": 0.7, "damage_share": 0.5}
SEEDED |= {"world_count": 4, "pool_size": 8}
"""Batches with several fresh seeds; worlds of some places are damaged."""

ESCAPING = {"escape_share": 0.1, "escape_weight": 10.0, "world_count": 4, "pool_size": 8}
"""Worlds that lose particles, some more than others."""

WOUNDED = LIVELY | {"wound_chance": 0.5, "wound_min_age": 4, "wound_weight": 0.5}
WOUNDED |= {"cut_gap": 0.1, "cut_anywhere": True, "damage_radius": 0.2}
"""Worlds that remember the pixels of their last wound."""


FEW = {"iterations": 3, "steps": (3, 5)}
BASE = {"iterations": 5, "milestones": [2], "dtype": "float64", "steps": (3, 6)}
BASE |= {"picture_interval": 0}


def tiny(out, **fields):
    return preset("tiny", out=out, particle_count=64, resolution=16, **BASE | fields)


def trainer_of(config, **options):
    return Trainer(Morphogenesis2D(config.task), config, task_name="morphogenesis2d", **options)


def trained(config, **options):
    """What a process of a run does; the log is the first one's."""
    return trainer_of(config, **options).run(progress=False).interrupted


def disturbed(config, iteration, disturb):
    """A trainer that calls `disturb` before an iteration."""
    trainer = trainer_of(config)
    iterate = trainer.iterate

    def disturbing():
        if trainer.iteration == iteration:
            disturb()
        iterate()

    trainer.iterate = disturbing
    return trainer


def make_cycle(config):
    """Worlds of a rule that moves nothing, which draw by themselves."""
    task = Morphogenesis2D(config.task)
    rule = task.make_rule(torch.Generator().manual_seed(0)).double()
    torch.nn.init.zeros_(rule.output.weight)
    cpu = torch.device("cpu")
    return TrainingCycle(task, rule, config, cpu, torch.Generator(), per_world_streams=True)


@pytest.fixture(scope="module", autouse=True)
def loaded_kernels(tmp_path_factory):
    """Load once what each forked process would have to load by itself."""
    folder = tmp_path_factory.mktemp("loaded")
    assert not trained(tiny(folder / "alone", **LIVELY))
    make_cycle(tiny(folder / "grouped", iterations=1, milestones=[1], **LIVELY)).run(0)


CASES = [
    *(("morphogenesis2d", fields, 1e-10) for fields in (SEEDED, ESCAPING, WOUNDED)),
    *(slow("morphogenesis2d", fields, 1e-10) for fields in ({}, LIVELY)),
    # Its 16-bit numbers would differ between processes that did not step together.
    ("morphogenesis2d", {"optimiser": "muon", "learning_rate": 5e-3}, 1e-2),
    *(slow(task, FEW | SEEDED, 1e-10) for task in TASKS),
]


@pytest.mark.parametrize(("task", "fields", "tolerance"), CASES)
def test_two_processes_have_the_curve_of_one(tmp_path, task, fields, tolerance):
    if task == "point_classification":
        pytest.importorskip("sklearn")

    def run(name):
        sizes = {"particle_count": 64, "resolution": 16} if task == "morphogenesis2d" else {}
        config = preset("tiny", task, out=tmp_path / name, **BASE | sizes | fields)
        return train(config, task, progress=False).interrupted

    run("loads kernels")
    for count in (1, 2):
        assert on_ranks(count, lambda n=count: run(str(n)), tmp_path) == [False] * count
    for one, two in zip(log_of(tmp_path / "1"), log_of(tmp_path / "2"), strict=True):
        assert one == pytest.approx(two, rel=tolerance, abs=1e-4 * tolerance)
    single, double = (load_checkpoint(tmp_path / n / "checkpoint.pt") for n in ("1", "2"))
    for name in ("rule", "pool") if tolerance < 1e-9 else ():
        torch.testing.assert_close(single[name], double[name], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("fresh_share", [0.0, 0.25, 0.5, 0.75])
def test_seeds_come_into_the_part_of_the_pool_of_every_world(tmp_path, fresh_share):
    # Where nothing moves, only worlds that began anew are others than at the beginning.
    fields = {"world_count": 4, "pool_size": 8, "seed_interval": 1, "fresh_share": fresh_share}
    cycle = make_cycle(tiny(tmp_path, **fields, damage_share=0.0, learning_rate=1e-30))
    before = cycle.pool.worlds.x.clone()
    for iteration in range(4):
        cycle.run(iteration)
    changed = (cycle.pool.worlds.x - before).abs().amax(dim=(1, 2)) > 1e-3
    assert changed.view(4, 2).any(dim=1).all()


def test_a_run_goes_on_with_another_number_of_processes(tmp_path):
    whole, parts = (tiny(tmp_path / name, **LIVELY) for name in ("whole", "parts"))
    on_ranks(1, lambda: trained(whole), tmp_path)
    first = override(parts, iterations=5, checkpoint_interval=2)

    def until_the_fourth():
        trainer = trainer_of(first)
        for _ in range(3):
            trainer.iterate()
        trainer.save()

    assert on_ranks(2, until_the_fourth, tmp_path) == [None, None]
    # Alone, outside of any group, and all the same as it was begun.
    assert not trained(override(parts, checkpoint_interval=2), resume=True)
    end = [load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts")]
    for name in end[0]["rule"]:
        torch.testing.assert_close(end[0]["rule"][name], end[1]["rule"][name])
    # A run that one process has begun alone goes on with several.
    alone = tiny(tmp_path / "alone", world_count=2, pool_size=8)
    trained(alone)
    longer = override(alone, repeats=2)
    assert on_ranks(2, lambda: trained(longer, resume=True), tmp_path) == [False, False]
    assert [record["iteration"] for record in log_of(tmp_path / "alone")] == list(range(1, 11))
    # And one that several have begun knows its own randomness from then on.
    saved = load_checkpoint(tmp_path / "alone" / "checkpoint.pt")
    assert list(saved["random_states"]) == ["schedule"]


def test_parameters_that_differ_are_refused_and_the_checkpoint_stays(tmp_path):
    config = tiny(tmp_path / "run")

    def drift():
        trainer = trainer_of(config)
        if not ProcessGroup.current().first:
            with torch.no_grad():
                next(trainer.rule.parameters())[0, 0] += 0.5
        trainer.iterate()
        trainer.save()

    for message in on_ranks(2, drift, tmp_path):
        assert "parameters must be the same on all 2 processes, but " in message
        assert "by at most 0.5" in message
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["iteration"] == 0


def kill_other():
    if not ProcessGroup.current().first:
        os.kill(os.getpid(), signal.SIGKILL)


def fill_disk():
    # The log has room for its line, a checkpoint has not.
    if ProcessGroup.current().first:
        resource = pytest.importorskip("resource")
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, resource.RLIM_INFINITY))


@pytest.mark.parametrize(
    ("disturb", "first_message", "other_result"),
    [
        (kill_other, "process 0 of 2 has lost another one", str(-signal.SIGKILL)),
        (fill_disk, "cannot write .*the disk is full", "process 1 of 2 has lost another one"),
    ],
)
def test_what_ends_one_process_ends_the_others_and_the_run_goes_on_from_its_checkpoint(
    tmp_path, disturb, first_message, other_result
):
    config = tiny(tmp_path / "run", iterations=30, checkpoint_interval=2)

    def disturbed_run():
        disturbed(config, 5, disturb).run(progress=False)

    first, other = on_ranks(2, disturbed_run, tmp_path)
    assert re.search(first_message, first)
    assert other_result in str(other)
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["iteration"] == 4
    assert trained(config, resume=True) is False
    assert log_of(tmp_path / "run")[-1]["iteration"] == 30


def test_all_processes_stop_after_the_same_iteration_where_one_is_asked_to(tmp_path):
    config = tiny(tmp_path / "run", iterations=60)

    def stop():
        if ProcessGroup.current().first:
            return
        # Twice: torchrun passes on what a terminal has sent already.
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)

    def stopped_run():
        trainer = disturbed(config, 3, stop)
        return trainer.run(progress=False).interrupted, trainer.iteration

    one, other = on_ranks(2, stopped_run, tmp_path)
    assert one == other
    assert one[0]
    assert 3 < one[1] <= 13
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["iteration"] == one[1]


@pytest.mark.parametrize(("gpus", "backend"), [(0, "gloo"), (1, "gloo"), (2, "cpu:gloo,cuda:nccl")])
def test_processes_meet_through_nccl_only_where_each_has_a_gpu(gpus, backend, monkeypatch):
    backends = []

    def join(backend):
        backends.append(backend)
        raise ValueError("enough")

    monkeypatch.setattr(dist, "is_torchelastic_launched", lambda: True)
    # As torch's builds for CUDA say, also on machines without a GPU.
    monkeypatch.setattr(dist, "is_nccl_available", lambda: True)
    monkeypatch.setattr(dist, "init_process_group", join)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    variables = {"LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "2", "CUDA_VISIBLE_DEVICES": "0,1"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(NPAError, match="must reach each other"), joined_processes():
        pass
    assert backends == [backend]


def test_worlds_of_all_processes_are_diagnosed_when_the_loss_is_not_finite(tmp_path):
    config = tiny(tmp_path / "run", world_count=4, pool_size=8)

    def diverge():
        trainer = trainer_of(config)
        if not ProcessGroup.current().first:
            trainer.pool.worlds.s[:] = 1e200
        trainer.run(progress=False)

    for message in on_ranks(2, diverge, tmp_path):
        assert "loss must stay finite" in message
        assert "worlds 1, 3 of the batch" in message
    diagnosis = torch.load(tmp_path / "run" / "diverged.pt", weights_only=True)
    assert diagnosis["x0"].shape[0] == 4


def test_what_cannot_be_shared_out_is_refused():
    assert ProcessGroup(1, 4).indices(16, 2).tolist() == [2, 3, 10, 11]
    parts = [ProcessGroup(rank, 4).local(torch.arange(16), 2) for rank in range(4)]
    assert sorted(torch.cat(parts).tolist()) == list(range(16))
    for worlds, pool, message in (
        (6, 12, "multiple of the number of processes, got 6 and 4: .*=4"),
        (4, 10, "pool_size must be a multiple .* 10 and 4: set pool_size=8"),
    ):
        with pytest.raises(NPAError, match=message):
            ProcessGroup(0, 4).check(tiny("x", world_count=worlds, pool_size=pool))
    # Alone, nothing is touched.
    numbers = torch.ones(2)
    alone = ProcessGroup.current()
    alone.reduce([numbers], numbers[0])
    alone.check_same([numbers])
    assert not alone.distributed
    assert alone.gathered(numbers, 1) is numbers
    assert_same(numbers, torch.ones(2))


# Signs of life.


@pytest.fixture
def codes(monkeypatch):
    """Exit codes with which a process would have ended; its pauses are short."""
    ended = []
    monkeypatch.setattr(process_launcher, "BEAT_SECONDS", 0.05)
    monkeypatch.setattr(process_launcher.os, "_exit", ended.append)
    return ended


def test_nobody_is_missed_who_lives_or_has_left(codes, monkeypatch):
    # No load gives a thread sixty pauses and another one none.
    monkeypatch.setattr(process_launcher, "BEAT_SECONDS", 0.01)
    monkeypatch.setattr(process_launcher, "SILENT_BEATS", 60)
    store = dist.HashStore()
    first, second = (Heartbeat(store, rank, 2) for rank in (0, 1))
    time.sleep(1.0)
    second.end(finished=True)
    time.sleep(1.0)
    first.end(finished=True)
    assert codes == []


class Store:
    """A store that fails, or that does not answer until it is thawed."""

    def __init__(self, fails):
        self.fails, self.thawed = fails, threading.Event()

    def add(self, _, __):
        if self.fails:
            raise RuntimeError("connection reset")
        self.thawed.wait()
        return 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (dist.HashStore, "process 0 of 3 has heard nothing from process 2 for"),
        (lambda: Store(fails=True), "has heard nothing from process 1"),
        (lambda: Store(fails=False), "has heard nothing from process 1"),
    ],
)
def test_a_process_or_store_that_falls_silent_is_missed(codes, capfd, make, message):
    store = make()
    own = isinstance(store, Store)
    first, *others = (Heartbeat(store, rank, 3) for rank in range(1 if own else 3))
    for other, finished in zip(others, (True, False), strict=not own):
        other.end(finished=finished)
    wait_until(lambda: codes, 60)
    assert set(codes) == {LOST_CODE}
    if own:
        store.thawed.set()
    first.end(finished=True)
    assert message in capfd.readouterr().err
