"""The trainer on the real task: 2D morphogenesis through the engine."""

from __future__ import annotations

import pytest
import torch
from training_runs import log_of

from npa_envs.errors import NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import Trainer, preset, train

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


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


def test_a_target_that_is_not_there_is_named_before_anything_is_written(tmp_path):
    config = preset("tiny", out=tmp_path / "run", target="geko")
    with pytest.raises(NPAError, match="gecko"):
        train(config, progress=False)
    assert not (tmp_path / "run").exists()


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
