"""Runs one command in several processes on this machine, by torchrun's launcher."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.distributed as dist

from npa_envs.errors import LostProcessError, NPAError, shown
from npa_envs.training.ranks import Ranks
from npa_envs.training.run_folder import RunFolder

if TYPE_CHECKING:
    from torch.distributed.elastic.multiprocessing.errors import ProcessFailure


def launch(count: int, arguments: Sequence[str], out: Path, device: str) -> int:
    """Run a command in several processes, and return the exit code once all have ended.

    If one ends early, the others are terminated, and killed after half a minute. On CUDA each
    process gets one device. `out` is the folder of the run, for errors.
    """
    device_count = torch.cuda.device_count()
    if device != "cpu" and count > device_count:
        raise NPAError(
            f"processes must be at most the {device_count} CUDA devices that torch sees, got "
            f"{count}: take fewer, or --device cpu"
        )
    if not dist.is_available():
        raise NPAError(
            f"processes must be 1 with a torch that has no torch.distributed, got {count}"
        )
    # These imports are slow, and only runs of several processes need them.
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.elastic.rendezvous.api import RendezvousError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    # It logs each step and each signal.
    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)
    # As in torchrun: the processes would otherwise wait for each other's cores.
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
        # Works even if the machine cannot resolve its own name.
        local_addr="localhost",
    )
    try:
        elastic_launch(config, sys.executable)("-m", "npa_envs", *arguments)
    except SignalException:
        return 128 + signal.SIGINT
    except RendezvousError as error:
        raise NPAError(
            f"processes must reach each other at localhost, but they cannot ({shown(error)}): "
            "take --processes 1"
        ) from error
    except ChildFailedError as error:
        messages = {rank: _message_of(failure) for rank, failure in error.failures.items()}
        for message in messages.values():
            # The first process prints its own.
            if message not in ("", messages.get(0)):
                raise NPAError(message) from error
        # First a killed process, then those that report it, then those terminated afterwards.
        rank, failure = min(
            error.failures.items(),
            key=lambda item: (item[1].exitcode == -signal.SIGTERM, item[1].exitcode > 0),
        )
        if failure.exitcode > 0:
            return int(failure.exitcode)  # It has printed why.
        name = signal.Signals(-failure.exitcode).name
        raise NPAError(
            f"process {rank} of {count} was ended by {name}, and the others with it (SIGKILL is "
            "often a lack of memory): the last checkpoint is intact, "
            f"{RunFolder(out).checkpoint}; go on from it with --resume"
        ) from error
    return 0


def requested_processes(gpus: int | None, processes: int | None, device: str) -> int | None:
    """Return the number of processes of `--gpus` or `--processes`; None if neither is given."""
    if gpus is not None and processes is not None:
        raise NPAError(
            f"gpus sets the number of processes, got gpus {gpus} and processes {processes}: "
            "give one of them"
        )
    if gpus is not None and device == "cpu":
        raise NPAError("gpus goes with device 'cuda', got 'cpu': take --processes instead")
    for name, count in (("gpus", gpus), ("processes", processes)):
        if count is not None and count < 1:
            raise NPAError(f"{name} must be at least 1, got {count}")
    return gpus if processes is None else processes


@contextlib.contextmanager
def print_once(ranks: Ranks) -> Iterator[None]:
    """Print an error on the first rank; pass those of others to the launcher."""
    try:
        yield
    except NPAError as error:
        if ranks.together and not isinstance(error, LostProcessError):
            from torch.distributed.elastic.multiprocessing.errors import get_error_handler

            get_error_handler().record_exception(error)
        if not ranks.first:
            raise SystemExit(2) from error
        raise


def _message_of(failure: ProcessFailure) -> str:
    """Return the message of the error that ended a process, or an empty string."""
    content = failure.error_file_data["message"]
    # Torch writes the error's class before it.
    return str(content["message"]).partition(": ")[2] if isinstance(content, dict) else ""
