"""Starts, joins and watches the processes of a run, by torchrun's launcher."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import sys
import threading
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist

from npa_envs.errors import LostProcessError, NPAError, shown
from npa_envs.measure.process_queue import LOST_CODE
from npa_envs.training.process_group import ProcessGroup
from npa_envs.training.run_folder import RunFolder

if TYPE_CHECKING:
    from torch.distributed.elastic.multiprocessing.errors import ProcessFailure


def launch(count: int, arguments: Sequence[str], out: Path, device: str) -> int:
    """Run `npa-envs` with these arguments in `count` processes; return the exit code at their end.

    If one ends early, the others are terminated, and killed after half a minute. On CUDA each
    process gets one device. `out` is the folder of the run, for errors.
    """
    device_count = torch.cuda.device_count()
    if device != "cpu" and count > device_count:
        raise NPAError(
            f"processes must be at most the {device_count} CUDA devices that torch sees, got "
            f"{count}: take fewer, or --device cpu"
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
            f"{RunFolder(out).checkpoint}; continue from it with --resume"
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
def print_once(processes: ProcessGroup) -> Iterator[None]:
    """Within the block, let only rank 0 raise NPAErrors and tell of targets' files.

    Other processes exit with code 2 after an NPAError.
    """
    if not processes.first:
        logging.getLogger("npa_envs.targets").setLevel(logging.CRITICAL)
    try:
        yield
    except NPAError as error:
        if processes.distributed and not isinstance(error, LostProcessError):
            from torch.distributed.elastic.multiprocessing.errors import get_error_handler

            get_error_handler().record_exception(error)
        if not processes.first:
            raise SystemExit(2) from error
        raise


def _message_of(failure: ProcessFailure) -> str:
    content = failure.error_file_data["message"]
    # Torch writes the error's class before it.
    return str(content["message"]).partition(": ")[2] if isinstance(content, dict) else ""


@contextlib.contextmanager
def joined_processes() -> Iterator[ProcessGroup]:
    """Join the other processes that torchrun has started, within the block.

    Each process sees one CUDA device, by its local rank; call this before anything uses CUDA.
    Within the block, a process that is lost ends all others (see `Heartbeat`), so the process that
    hosts their store must leave last. Without torchrun there is a single process.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched():
        yield ProcessGroup()
        return
    # CUDA builds of torch have NCCL, but it fails on machines without a GPU. device_count asks
    # NVML, which does not initialise CUDA.
    has_gpus = torch.cuda.device_count() >= int(os.environ["LOCAL_WORLD_SIZE"])
    backend = "cpu:gloo,cuda:nccl" if dist.is_nccl_available() and has_gpus else "gloo"
    if torch.cuda.device_count() > 0:
        rank, visible = int(os.environ["LOCAL_RANK"]), os.environ.get("CUDA_VISIBLE_DEVICES")
        devices = [str(rank)] if visible is None else visible.split(",")[rank : rank + 1]
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(devices)
    try:
        dist.init_process_group(backend)
        processes = ProcessGroup.current()
        # A separate connection: that of the group blocks while the group waits.
        address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store: Any = dist.TCPStore(address, port, wait_for_workers=False)  # type: ignore[attr-defined]
        # Torchrun may keep the store when it restarts processes.
        prefix = processes.broadcast(uuid.uuid4().hex)
        store = dist.PrefixStore(prefix, store)  # type: ignore[attr-defined]
        heartbeat = Heartbeat(store, processes.rank, processes.count)
    except (RuntimeError, ValueError) as error:
        raise NPAError(
            f"the processes that torchrun starts must reach each other, but this one cannot "
            f"({shown(error)}): see its options --rdzv-endpoint and --master-addr"
        ) from error
    finished = False
    try:
        yield processes
        finished = True
    finally:
        heartbeat.end(finished=finished)
    # Not after an error: others may be gone. Captured graphs keep references to the group.
    gc.collect()
    dist.destroy_process_group()


BEAT_SECONDS = 5.0
"""Time between two heartbeats [s]."""

SILENT_BEATS = 8
"""Number of missed heartbeats after which a process is lost."""

_FINISHED = -(2**62)


class Heartbeat:
    """Ends this process, with a message, when another one sends no heartbeats.

    Collectives would wait up to NCCL's timeout of 10 minutes for a process that was stopped or
    whose machine is gone. Time is counted in this process's own heartbeats, so that a process that
    was suspended does not blame others. Threads send heartbeats while a process waits or computes.
    """

    def __init__(self, store: Any, rank: int, count: int) -> None:
        self._store, self._rank = store, rank
        self._beats = [0] * count
        self._ended = threading.Event()
        self._finished = False
        # Two threads, as a store that does not answer blocks the one that reads it.
        self._threads = [
            threading.Thread(target=task, daemon=True) for task in (self._beat, self._watch)
        ]
        for thread in self._threads:
            thread.start()

    def end(self, *, finished: bool) -> None:
        """Stop watching; with `finished`, let the others continue without this process."""
        self._finished = finished
        self._ended.set()
        for thread in self._threads:
            thread.join(BEAT_SECONDS)

    def _beat(self) -> None:
        # Without its store, all processes that have not left seem silent.
        with contextlib.suppress(RuntimeError):
            while not self._ended.is_set():
                for other in range(len(self._beats)):
                    self._beats[other] = self._store.add(str(other), int(other == self._rank))
                self._ended.wait(BEAT_SECONDS)
            if self._finished:
                self._store.add(str(self._rank), _FINISHED)

    def _watch(self) -> None:
        last, silent = self._beats.copy(), [0] * len(self._beats)
        while not self._ended.wait(BEAT_SECONDS):
            for other, beats in enumerate(self._beats):
                alive = other == self._rank or beats != last[other] or beats < 0
                silent[other] = 0 if alive else silent[other] + 1
                last[other] = beats
            lost = [str(other) for other, missed in enumerate(silent) if missed >= SILENT_BEATS]
            if lost:
                print(
                    f"npa-envs: error: process {self._rank} of {len(last)} has heard nothing from "
                    f"process {', '.join(lost)} for {SILENT_BEATS * BEAT_SECONDS:.0f} s, "
                    "which was killed or stopped, or cannot be reached: the last checkpoint is "
                    "intact; resume it",
                    file=sys.stderr,
                    flush=True,
                )
                # The main thread may block in a collective for ever.
                os._exit(LOST_CODE)
