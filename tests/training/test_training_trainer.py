"""The trainer as a whole: it learns, it leaves files behind, it can be killed and resumed."""

import contextlib
import io
import math
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.circle_task import CircleTask, circle_config, plain_rollout
from support.clock import Clock
from support.refusals import refused
from support.training_runs import (
    Killed,
    KilledTask,
    full_disk,
    kill,
    log_of,
    runaway,
    train,
    trainer_of,
)
from support.worlds import assert_same

from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule, rule_metadata, save_rule
from npa_envs.rule.rule import NPARule
from npa_envs.training import DivergedError, JsonlLog, load_config, override
from npa_envs.training.checkpoint import load_checkpoint
from npa_envs.training.run_folder import ONE_REQUEST, stop_flag


def test_training_starts_from_an_initial_rule_of_its_shape(tmp_path):
    first = train(circle_config(tmp_path / "first", iterations=3))
    path = tmp_path / "first" / "rule.safetensors"
    # Named by its file, or by the run's folder.
    for name, source in (("second", path), ("third", path.parent)):
        config = circle_config(tmp_path / name, initial_rule=str(source))
        assert_same(trainer_of(config).rule.state_dict(), first.rule.state_dict())
    save_rule(NPARule(2, 5, 7), tmp_path / "other.safetensors")
    config = circle_config(tmp_path / "run", initial_rule=str(tmp_path / "other.safetensors"))
    refused(r"shape, but .* differs in .*hidden_dim \(7, here ", trainer_of, config)


def test_a_log_without_its_checkpoint_is_not_gone_on_with(tmp_path):
    config = circle_config(tmp_path / "run")
    train(config)
    (tmp_path / "run" / "checkpoint.pt").unlink()
    before = log_of(tmp_path / "run")
    refused(r"out must be a folder without a run, .* holds a log with", trainer_of, config)
    assert log_of(tmp_path / "run") == before
    train(config, overwrite=True)
    assert log_of(tmp_path / "run") == before


def test_a_loss_that_is_not_finite_is_an_error_where_its_worlds_cannot_be_written(tmp_path):
    (tmp_path / "run" / "diverged.pt").mkdir(parents=True)
    config = circle_config(tmp_path / "run", learning_rate=1e30)
    with pytest.raises(DivergedError, match=r"must stay finite.*not written: .*diverged.pt"):
        train(config)


@pytest.mark.parametrize(
    ("iteration", "fields"),
    [
        (1, {}),
        (5, {}),
        (5, {"repeats": 2, "iterations": 3, "milestones": [1]}),
        (5, {"log_interval": 2, "checkpoint_interval": 3}),
        (5, {"max_age_range": (3, 40), "pool_size": 9, "schedule": "cosine"}),
        (5, {"dtype": "float64", "damage_share": 0.0}),
        (5, {"optimiser": "muon", "weight_decay": 0.1}),
        (5, {"vary_eps": (0.5, 2.0)}),
        (5, {"initial_rule": "first"}),
    ],
)
def test_killed_and_resumed_run_has_the_same_log_bit_for_bit(
    tmp_path, monkeypatch, iteration, fields
):
    monkeypatch.chdir(tmp_path)
    if "initial_rule" in fields:
        train(circle_config("first", iterations=3))
    whole_rule = train(circle_config(tmp_path / "whole", **fields)).rule
    broken = circle_config(tmp_path / "broken", **fields)
    with pytest.raises(Killed):
        train(broken, KilledTask(iteration, end=kill))
    saved = load_checkpoint(tmp_path / "broken" / "checkpoint.pt")["iteration"]
    assert saved == (3 if iteration > 3 else 0)
    # A run no longer needs the rule that it began with.
    Path("first/rule.safetensors").unlink(missing_ok=True)
    resumed = train(broken, resume=True)
    assert resumed.finished
    assert log_of(tmp_path / "broken") == log_of(tmp_path / "whole")
    assert_same(resumed.rule.state_dict(), whole_rule.state_dict())


def test_training_works_in_a_thread_where_signals_cannot_be_caught(tmp_path):
    results = []
    thread = threading.Thread(target=lambda: results.append(train(circle_config(tmp_path))))
    thread.start()
    thread.join()
    assert results[0].finished


def test_finished_run_resumed_does_nothing_and_more_repeats_go_on(tmp_path):
    config = circle_config(tmp_path)
    result = trainer_of(config).run(progress=False, max_seconds=0.0)
    assert (result.iteration, result.finished) == (0, False)
    train(config, resume=True)
    before = log_of(tmp_path)
    assert train(config, resume=True).iteration == 6
    assert log_of(tmp_path) == before
    assert train(override(config, repeats=2), resume=True).iteration == 12
    assert [record["iteration"] for record in log_of(tmp_path)] == list(range(1, 13))


def test_a_trainer_that_runs_again_goes_on_with_its_time(tmp_path, monkeypatch):
    clock = Clock(tick=1 / 256)
    monkeypatch.setattr("npa_envs.training.trainer.time", clock)
    trainer = trainer_of(circle_config(tmp_path, iterations=40, checkpoint_interval=1000))
    while trainer.iteration < 40:
        trainer.run(progress=False, max_seconds=0.01)
        clock.sleep(1.0)
    trainer.save()
    seconds = [record["seconds"] for record in JsonlLog(tmp_path / "log.jsonl").records()]
    assert seconds == sorted(seconds)
    # Pauses do not count.
    saved = load_checkpoint(tmp_path / "checkpoint.pt")["seconds"]
    assert seconds[-1] <= saved < seconds[-1] + 1.0


def test_runs_with_two_seeds_differ(tmp_path):
    for seed in (1, 2):
        train(circle_config(tmp_path / str(seed), seed=seed))
    assert log_of(tmp_path / "1") != log_of(tmp_path / "2")


def test_log_has_terms_rate_steps_and_time(tmp_path):
    train(circle_config(tmp_path, iterations=5, log_interval=2, milestones=[3]))
    records = JsonlLog(tmp_path / "log.jsonl").records()
    # The last line closes an interval that the run's end cut short.
    assert [record["iteration"] for record in records] == [2, 4, 5]
    assert [record["learning_rate"] for record in records] == [0.01, 0.003, 0.003]
    assert all(4 <= record["steps"] < 9 for record in records)
    assert records[0]["seconds"] <= records[1]["seconds"] <= records[2]["seconds"]
    terms = ["loss", "distance", "state", "motion", "steps", "replaced_worlds"]
    assert list(records[0]) == ["iteration", *terms, "learning_rate", "seconds"]
    for record in records:
        whole = record["distance"] + 0.01 * record["state"] + 0.001 * record["motion"]
        assert record["loss"] == pytest.approx(whole, rel=1e-5)


def watching(note):
    """A rollout that first notes the worlds and steps that it is given."""

    def rollout(rule, worlds, steps, **options):
        note(worlds.x, worlds.s, steps)
        return plain_rollout(rule, worlds, steps, **options)

    return rollout


class WatchedTask(CircleTask):
    """Its seeds' states are all 0.125, which no other world's are."""

    def seed(self, world_count, *, generator, device):
        seeds = super().seed(world_count, generator=generator, device=device)
        return seeds._replace(s=seeds.s + 0.125)


def fresh(s):
    """Tell which worlds of a batch are seeds."""
    return (s == 0.125).flatten(1).all(1).tolist()


def run_watched(config, note):
    trainer = trainer_of(config, WatchedTask(), rollout=watching(note))
    trainer.run(progress=False)


def test_every_fourth_batch_starts_with_a_fresh_seed(tmp_path):
    batches = []
    # Once every world of the pool has been trained on, a seed can only be a fresh one.
    config = circle_config(tmp_path, iterations=40, world_count=2, pool_size=2, milestones=[])
    run_watched(config, lambda x, s, steps: batches.append(fresh(s)))
    assert [first for first, _ in batches[4:]] == [k % 4 == 0 for k in range(4, 40)]
    assert not any(second for _, second in batches[4:])


def test_worlds_that_have_lived_are_replaced_by_seeds_and_all_others_grow_older(tmp_path):
    batches = []
    fields = {"iterations": 60, "world_count": 2, "pool_size": 2, "milestones": []}
    fields |= {"max_age_range": (1, 40), "steps": (4, 8), "damage_share": 0.0}
    config = circle_config(tmp_path, **fields)
    run_watched(config, lambda x, s, steps: batches.append((steps, *fresh(s))))
    age = 0
    for steps, first, second in batches:
        # The first world never lives longer than a rollout.
        assert first
        assert second == (age == 0 or age >= 40)
        age = (0 if second else age) + steps
    assert 5 < sum(second for *_, second in batches) < 12


@pytest.mark.parametrize("damage", [True, False])
def test_worlds_that_are_old_and_never_damaged_are_past_the_minimum_age(tmp_path, damage):
    seen = []

    def rollout(rule, worlds, steps, **options):
        seen.append(trainer._cycle.batch.past_min_age.tolist())
        return plain_rollout(rule, worlds, 2, **options)

    fields = {"iterations": 6, "world_count": 4, "pool_size": 4, "max_age_range": (200, 6000)}
    fields |= {"steps": (256, 257), "damage_share": 0.5 * damage, "stillness_weight": 1.0}
    trainer = trainer_of(circle_config(tmp_path, **fields), rollout=rollout)
    trainer.run(progress=False)
    # Lives of 200, 621, 1931 and 6000 steps; the first two are damaged, where worlds are.
    none, two, all_but_one = [False] * 4, [False, False, True, True], [False, True, True, True]
    again = two if damage else all_but_one
    assert seen == [none, none, again, two, two, again]


@pytest.mark.parametrize("count", [0, 2])
def test_worlds_at_the_first_indices_are_damaged_and_the_others_never(tmp_path, count):
    damaged = {index: [] for index in range(8)}

    def note(x, s, steps):
        blank = (s == 0).all(-1).any(1).tolist()
        for index, is_damaged in zip(trainer._cycle._index.tolist(), blank, strict=True):
            if trainer.iteration > 0:
                damaged[index].append(is_damaged)

    fields = {"iterations": 60, "pool_size": 8, "damage_share": count / 8, "milestones": []}
    config = circle_config(tmp_path, seed_interval=100, **fields)
    trainer = trainer_of(config, WatchedTask(), rollout=watching(note))
    trainer.run(progress=False)
    fractions = [sum(damaged[index]) / len(damaged[index]) for index in range(8)]
    # 12 particles, each blanked with probability 0.2: 7 % of the damaged worlds have none.
    assert min(fractions[:count], default=1.0) > 0.7
    assert not any(fractions[count:])


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_worlds_whose_time_is_over_are_damaged_then_and_live_again(tmp_path, share):
    seen, begun = set(), []

    def note(x, s, steps):
        cycle = trainer._cycle
        indices, ages = cycle._index.tolist(), cycle._age.tolist()
        before = cycle.pool.worlds.x[indices], cycle.pool.worlds.s[indices]
        for k, (index, age) in enumerate(zip(indices, ages, strict=True)):
            is_damaged = not torch.equal(s[k], before[1][k])
            if age == 0 and index in seen:
                begun.append((torch.equal(x[k], before[0][k]), is_damaged))
            elif index > 0:  # the first index is damaged each time
                assert not is_damaged
            seen.add(index)

    fields = {"iterations": 150, "pool_size": 16, "world_count": 4, "max_age_range": (8, 32)}
    fields |= {"milestones": [], "steps": (4, 5), "damage_and_keep_share": share}
    config = circle_config(tmp_path, damage_share=1e-6, **fields)
    trainer = trainer_of(config, WatchedTask(), rollout=watching(note))
    trainer.run(progress=False)
    again = [is_damaged for is_same, is_damaged in begun if is_same]
    assert len(begun) > 80
    assert len(again) == pytest.approx(share * len(begun), abs=0.15 * len(begun) * (share > 0))
    # 12 particles, each blanked with probability 0.2: 7 % of the damaged worlds have none.
    assert sum(again) >= 0.8 * len(again)


def test_an_iteration_follows_the_progress_that_it_is_given(tmp_path):
    config = circle_config(tmp_path, schedule="cosine", log_interval=1)
    trainer = trainer_of(config)
    parameter = next(trainer.rule.parameters())
    first = parameter.detach().clone()
    trainer.iterate(least_progress=1.0)
    # AdamW's first step is as long as the rate.
    rate = 0.01 * config.learning_rate
    assert (parameter.detach() - first).abs().max().item() == pytest.approx(rate, rel=1e-3)
    trainer._update_log()
    assert log_of(tmp_path)[-1]["learning_rate"] == pytest.approx(rate)
    refused(r"least_progress must lie in \[0, 1\], got 1.5", trainer.iterate, least_progress=1.5)


def test_run_leaves_rule_configuration_pictures_and_a_board_with_the_logs_numbers(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = circle_config(tmp_path, picture_interval=3, tensorboard=True)
    result = train(config)
    rule = load_rule(tmp_path / "rule.safetensors")
    assert_same(list(rule.parameters()), list(result.rule.parameters()))
    assert rule_metadata(tmp_path / "rule.safetensors")["iteration"] == "6"
    assert load_config(tmp_path / "config.json", circle_config("x")) == config
    assert sorted(p.name for p in tmp_path.glob("pictures/*")) == ["000003.png", "000006.png"]
    pixels = np.asarray(Image.open(tmp_path / "pictures" / "000006.png"))
    # The target and three worlds of 8 x 8 pixels, enlarged; below them captions.
    target, *worlds = (pixels[8:264, 8 + 264 * k : 264 + 264 * k] for k in range(4))
    assert (target == 255).all()
    assert all(world.min() < world.max() for world in worlds)
    assert all(pixels[264:, 264 * k :].min() < 255 for k in range(4))
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    expected = [(record["iteration"], record["loss"]) for record in log_of(tmp_path)]
    assert losses == [(k, pytest.approx(loss, rel=1e-6)) for k, loss in expected]
    first, last = events.Images("batch")
    assert (first.step, last.step, last.width, last.height) == (3, 6, 4 * 256, 256)
    shown = np.asarray(Image.open(io.BytesIO(last.encoded_image_string)))
    # A JPEG of few pixels: seen 5.6 of 255.
    assert np.abs(shown - np.hstack((target, *worlds)).astype(float)).mean() < 12


class BrokenTask(CircleTask):
    """Its loss becomes NaN in one iteration, through one world."""

    def __init__(self, iteration):
        super().__init__()
        self.bad_call = iteration

    def loss(self, worlds):
        if self.loss_calls == self.bad_call:
            worlds = worlds._replace(s=worlds.s.clone())
            worlds.s[1] = math.nan
        return super().loss(worlds)


def explode_after(iterations):
    """A rollout that spoils the last world of the batch in one iteration."""
    calls = []

    def rollout(rule, worlds, steps, **options):
        calls.append(steps)
        after = plain_rollout(rule, worlds, steps, **options)
        if len(calls) == iterations:
            after = after._replace(x=torch.cat([after.x[:2], after.x[2:] * math.inf]))
        return after

    return rollout


def logging_late(config, **options):
    """A trainer that writes each record an iteration later, as it does on CUDA."""
    trainer = trainer_of(config, **options)
    trainer._defer_records = True
    return trainer


@pytest.mark.parametrize(
    ("make", "checkpoint_interval", "last_iteration"),
    # At the next line of the log or checkpoint, and an iteration later at most.
    [(trainer_of, 1, 5), (trainer_of, 100, 6), (logging_late, 1, 5), (logging_late, 100, 7)],
)
def test_loss_that_is_not_finite_stops_the_run_with_a_report(
    tmp_path, make, checkpoint_interval, last_iteration
):
    fields = {"iterations": 20, "log_interval": 2, "checkpoint_interval": checkpoint_interval}
    trainer = make(circle_config(tmp_path, **fields), rollout=explode_after(5))
    message = r"distance was not in iteration 5 \(. steps, world 2 of the batch\).*diverged.pt"
    with pytest.raises(DivergedError, match=message):
        trainer.run(progress=False)
    assert trainer.iteration == last_iteration
    assert [record["iteration"] for record in log_of(tmp_path)] == [2, 4]
    saved = load_checkpoint(tmp_path / "checkpoint.pt")["iteration"]
    assert saved == (4 if checkpoint_interval == 1 else 0)
    with pytest.raises(DivergedError):
        trainer.save()
    diagnosis = load_checkpoint(tmp_path / "diverged.pt")
    assert diagnosis["iteration"] == 5
    assert torch.isfinite(diagnosis["x0"]).all()
    assert torch.isfinite(diagnosis["x"]).flatten(1).all(1).tolist() == [True, True, False]


def test_late_records_are_the_same(tmp_path):
    fields = {"iterations": 7, "log_interval": 2, "checkpoint_interval": 3, "picture_interval": 4}
    train(circle_config(tmp_path / "prompt", **fields))
    seen = []
    task = KilledTask(iteration=3, end=lambda: seen.extend(log_of(tmp_path / "late")))
    result = logging_late(circle_config(tmp_path / "late", **fields), task=task).run(progress=False)
    # The first record is written while the third iteration is under way.
    assert seen == []
    assert log_of(tmp_path / "late") == log_of(tmp_path / "prompt")
    assert result.record["iteration"] == 7


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_after_the_iteration_saves_and_can_be_resumed(tmp_path, number, late):
    handler = signal.getsignal(number)
    broken = circle_config(tmp_path / "broken", checkpoint_interval=100)
    task = KilledTask(iteration=2, end=lambda: os.kill(os.getpid(), number))
    result = (logging_late if late else trainer_of)(broken, task=task).run(progress=False)
    assert (result.iteration, result.finished, result.record["iteration"]) == (2, False, 2)
    assert signal.getsignal(number) == handler
    assert [record["iteration"] for record in log_of(tmp_path / "broken")] == [1, 2]
    assert train(broken, resume=True).finished
    train(circle_config(tmp_path / "whole", checkpoint_interval=100))
    assert log_of(tmp_path / "broken") == log_of(tmp_path / "whole")


def test_diverged_run_names_the_term_and_is_resumed_from_its_last_good_checkpoint(tmp_path):
    config = circle_config(tmp_path / "broken", checkpoint_interval=2)
    # The worlds are sound: the loss itself is not.
    with pytest.raises(DivergedError, match="state was not in iteration 4"):
        train(config, BrokenTask(iteration=4))
    assert train(config, resume=True).finished
    train(circle_config(tmp_path / "whole", checkpoint_interval=2))
    assert log_of(tmp_path / "broken") == log_of(tmp_path / "whole")


def test_world_that_runs_away_does_not_stay_in_the_pool(tmp_path):
    trainer = trainer_of(circle_config(tmp_path), rollout=runaway)
    trainer.run(progress=False)
    assert trainer.pool.worlds.x.abs().max() < 10
    assert [record["replaced_worlds"] for record in log_of(tmp_path)] == [1] * 6


def test_second_run_in_a_folder_is_refused_unless_it_overwrites(tmp_path):
    config = circle_config(tmp_path, picture_interval=1)
    train(config)
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    for options, message in (
        ({}, r"holds one: resume it .*, choose another folder .*, or overwrite"),
        ({"resume": True, "overwrite": True}, "resume and overwrite exclude each other"),
    ):
        refused(message, trainer_of, config, **options)
    assert [record["iteration"] for record in log_of(tmp_path)][-1] == config.iterations
    result = train(override(config, iterations=2), overwrite=True)
    assert result.iteration == 2
    assert [record["iteration"] for record in log_of(tmp_path)] == [1, 2]
    assert sorted(p.name for p in tmp_path.glob("pictures/*")) == ["000001.png", "000002.png"]
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"


def test_checkpoint_of_another_task_or_configuration_is_refused(tmp_path):
    config = circle_config(tmp_path)
    train(override(config, repeats=2))
    for changes, options, message in (
        ({}, {"task_name": "square"}, "is of task 'circle', not of 'square'"),
        ({"learning_rate": 0.5}, {}, r"learning_rate: 0.01 there, 0.5 here.*with the initial rule"),
        ({"target": "heart"}, {}, r"task.target: 'gecko' there, 'heart' here"),
        ({}, {}, "at iteration 12, beyond the 6 of this run: raise repeats"),
    ):
        refused(message, trainer_of, override(config, **changes), resume=True, **options)


def test_folders_that_do_not_do_are_named_before_training(tmp_path, monkeypatch):
    def refuse(folder, message, **options):
        refused(message, trainer_of, circle_config(tmp_path / folder), **options)

    refuse("none", "there is no checkpoint to resume from", resume=True)
    assert not (tmp_path / "none").exists()
    (tmp_path / "file").write_text("", encoding="utf-8")
    refuse("file/run", r"out must be a folder that can be created .*file/run")
    usage = type("Usage", (), {"free": 100})
    monkeypatch.setattr("npa_envs.training.run_folder.shutil.disk_usage", lambda path: usage)
    refuse("full", "must have room for two checkpoints")
    assert not (tmp_path / "full" / "checkpoint.pt").exists()
    if os.geteuid() != 0:  # Root may write everywhere.
        tmp_path.chmod(0o555)
        refuse("new", "permission")


def test_disk_that_fills_up_leaves_the_last_checkpoint(tmp_path):
    config = circle_config(tmp_path)
    trainer = trainer_of(config)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with full_disk(len(before) // 2), pytest.raises(NPAError, match=r"cannot write .*point\.pt"):
        trainer.run(progress=False)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    assert not list(tmp_path.glob(".*tmp*"))
    assert train(config, resume=True).finished


# Signals.


@pytest.mark.parametrize("patient", [False, True])
def test_signals_of_one_moment_are_one_request_and_a_later_one_ends_the_impatient(
    patient, monkeypatch, capfd
):
    clock, usual = Clock(), signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("npa_envs.training.run_folder.time", clock)
    with stop_flag(patient=patient) as stop:
        assert not stop.is_set()
        # A launcher passes on what its scheduler has sent to all processes.
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
            assert stop.is_set()
        clock.sleep(2 * ONE_REQUEST)
        with contextlib.nullcontext() if patient else pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is usual
    assert patient or capfd.readouterr().err.count("once more to stop at once") == 1
