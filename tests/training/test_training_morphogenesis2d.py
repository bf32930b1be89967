"""The trainer on the real task: 2D morphogenesis through the engine."""

from __future__ import annotations

import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.measure.quality.evaluation import evaluate
from npa_envs.rule.files import load_rule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import JsonlLog, Trainer, preset, train

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def log_of(folder):
    records = JsonlLog(folder / "log.jsonl").records()
    return [{k: v for k, v in record.items() if k != "seconds"} for record in records]


def mean(records, name):
    return sum(record[name] for record in records) / len(records)


def test_tiny_preset_learns_the_shape_of_its_target(tmp_path):
    config = preset("tiny", out=tmp_path / "run")
    result = train(config, progress=False)
    log = log_of(tmp_path / "run")
    assert result.finished
    assert len(log) == 40
    # Seen over four seeds: density 2.66 to 2.70 at first and 0.32 to 0.35 at last, loss 6.1 to 6.2
    # and 2.2 to 3.2.
    assert mean(log[:4], "density") > 2.0
    assert mean(log[-8:], "density") < 0.5
    assert mean(log[-8:], "loss") < 4.0
    assert len(list(tmp_path.glob("run/pictures/*.png"))) == 2

    rule = load_rule(tmp_path / "run" / "rule.safetensors")
    task = Morphogenesis2D(config.task)
    fresh = task.make_rule(torch.Generator().manual_seed(0))
    trained, untrained = (
        evaluate(r, task, checkpoints=[12], seeds=[101, 102])[0] for r in (rule, fresh)
    )
    assert trained.loss < 0.6 * untrained.loss


def kill_at(iteration, trainer):
    """Run until the log line of an iteration is written, then leave without a word."""
    append = trainer._log.append

    def killed(record):
        append(record)
        if record["iteration"] == iteration:
            raise KeyboardInterrupt

    trainer._log.append = killed
    with pytest.raises(KeyboardInterrupt):
        trainer.run(progress=False)


@pytest.mark.parametrize("memory", ["store", "recompute", "minimal"])
def test_killed_and_resumed_run_is_bit_identical_through_the_engine(tmp_path, memory):
    fields = {"iterations": 4, "checkpoint_interval": 2, "picture_interval": 0, "memory": memory}
    whole = preset("tiny", out=tmp_path / "whole", **fields)
    train(whole, progress=False)
    broken = preset("tiny", out=tmp_path / "broken", **fields)
    kill_at(3, Trainer(Morphogenesis2D(broken.task), broken, task_name="morphogenesis2d"))
    assert len(log_of(tmp_path / "broken")) == 3
    train(broken, resume=True, progress=False)
    assert log_of(tmp_path / "broken") == log_of(tmp_path / "whole")


def test_recomputing_trains_the_same_rule_as_storing(tmp_path):
    logs = []
    for memory in ("store", "recompute", "minimal"):
        config = preset("tiny", out=tmp_path / memory, iterations=3, memory=memory)
        train(config, progress=False)
        logs.append(log_of(tmp_path / memory))
    for stored, *others in zip(*logs, strict=True):
        assert all(other == pytest.approx(stored, rel=1e-5) for other in others)


def test_training_runs_in_double_precision(tmp_path):
    config = preset("tiny", out=tmp_path / "run", iterations=2, dtype="float64")
    result = train(config, progress=False)
    assert {p.dtype for p in result.rule.parameters()} == {torch.float64}
    assert result.record["loss"] > 0


def test_a_target_that_is_not_there_is_named_before_anything_is_written(tmp_path):
    config = preset("tiny", out=tmp_path / "run", target="geko")
    with pytest.raises(NPAError, match="gecko"):
        train(config, progress=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.gpu
@needs_cuda
def test_graphs_train_the_same_rule_as_eager_launches(tmp_path):
    logs = []
    for name, graphed in (("graph", True), ("eager", False)):
        fields = {"iterations": 12, "device": "cuda", "steps": (8, 11), "cuda_graph": graphed}
        train(preset("tiny", out=tmp_path / name, **fields), progress=False)
        logs.append(log_of(tmp_path / name))
    # The same kernels on the same numbers: only AdamW's amplification of rounding is allowed for.
    for replayed, launched in zip(*logs, strict=True):
        assert replayed == pytest.approx(launched, rel=1e-3)


@pytest.mark.gpu
@needs_cuda
def test_killed_and_resumed_run_is_bit_identical_on_cuda(tmp_path):
    fields = {"iterations": 8, "device": "cuda", "steps": (8, 11), "picture_interval": 0}
    train(preset("tiny", out=tmp_path / "whole", **fields), progress=False)
    broken = preset("tiny", out=tmp_path / "broken", **fields, checkpoint_interval=3)
    task = Morphogenesis2D(broken.task, device="cuda")
    kill_at(5, Trainer(task, broken, task_name="morphogenesis2d"))
    train(broken, resume=True, progress=False)
    assert log_of(tmp_path / "broken") == log_of(tmp_path / "whole")


@pytest.mark.gpu
@needs_cuda
def test_iterations_never_wait_for_the_device(tmp_path):
    config = preset("tiny", out=tmp_path / "run", device="cuda", steps=(8, 9))
    task = Morphogenesis2D(config.task, device="cuda")
    trainer = Trainer(task, config, task_name="morphogenesis2d")
    for _ in range(2):
        trainer.iterate()  # Warms up and captures all graphs, which does wait.
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(5):
            trainer.iterate()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    trainer.save()
    assert trainer.iteration == 7
