"""Several processes of one command on this machine, started and watched by torchrun's launcher."""

from __future__ import annotations

import logging
import os
import signal
import sys
import uuid
from collections.abc import Sequence
from pathlib import Path

import torch
import torch.distributed as dist

from npa_envs.cli import INTERRUPTED
from npa_envs.errors import NPAError
from npa_envs.training import RunFolder


def launch(count: int, words: Sequence[str], out: Path, device: str) -> int:
    """Run a command in several processes, and return the exit code once all have ended.

    If one ends early, the others are asked to end, and are killed after half a minute.

    Args:
        count: Number of processes.
        words: The words after `npa-envs`.
        out: The folder that the run is written to, for what is said of a lost process.
        device: Where it runs: each process has a CUDA device of its own, or all share the CPU.

    Raises:
        NPAError: There are not as many devices, a process was ended from outside, or torch has no
            launcher here.
    """
    seen = torch.cuda.device_count()
    if device != "cpu" and count > seen:
        raise NPAError(
            f"gpus must be at most the {seen} CUDA devices that torch sees, got {count}: take "
            "fewer, or try it with --device cpu"
        )
    if not dist.is_available():
        raise NPAError(f"gpus must be 1 with a torch that has no torch.distributed, got {count}")
    # Only runs of several processes need it, and it takes a while.
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    # It tells of each step that it takes, and of each signal.
    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)
    # As torchrun has it: the processes would otherwise wait for each other's cores.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=count,
        run_id=str(uuid.uuid4()),
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        monitor_interval=0.5,
    )
    try:
        elastic_launch(config, sys.executable)("-m", "npa_envs", *words)
    except SignalException:
        return INTERRUPTED
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode > 0:
            return int(failure.exitcode)  # It has said why.
        name = signal.Signals(-failure.exitcode).name
        raise NPAError(
            f"process {rank} of {count} was ended by {name}, and the others with it (SIGKILL is "
            "often a lack of memory): the last checkpoint is intact, "
            f"{RunFolder(out).checkpoint}; go on from it with --resume"
        ) from error
    return 0
