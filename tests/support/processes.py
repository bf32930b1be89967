"""Programs in a process of their own, and forks that share a distributed training run."""

import multiprocessing
import os
import subprocess
import sys
import traceback

import pytest
import torch
import torch.distributed as dist

from npa_envs.errors import NPAError


def run_alone(program, *words, **environment):
    """Return the finished process of a program."""
    return subprocess.run(
        [sys.executable, "-c", program, *words],
        env={**os.environ, **environment},
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )


def on_ranks(count, function, folder):
    """Run a function in each process of a group.

    Returns:
        By process: what it returned, the message of the NPAError that it raised, or its exit code.
    """
    # Forked, they need not load torch again.
    if torch.cuda.is_available():
        # Autograd has a thread for each GPU, and refuses the backward pass in a fork.
        pytest.skip("forks of processes with a GPU cannot train: set CUDA_VISIBLE_DEVICES=''")
    context = multiprocessing.get_context("fork")
    pipes = [context.Pipe(duplex=False) for _ in range(count)]
    store = folder / f"store{len(list(folder.glob('store*')))}"
    made = [
        context.Process(target=_run, args=(rank, count, function, str(store), pipes[rank][1]))
        for rank in range(count)
    ]
    for process in made:
        process.start()
    results = []
    for process, (reader, writer) in zip(made, pipes, strict=True):
        writer.close()
        try:
            results.append(reader.recv())
        except EOFError:
            process.join()
            results.append(process.exitcode)
        process.join()
    return results


def _run(rank, count, function, store, pipe):
    # A fork has none of its parent's threads of OpenMP, and would wait for them.
    torch.set_num_threads(1)
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    try:
        dist.init_process_group(
            "gloo", store=dist.FileStore(store, count), rank=rank, world_size=count
        )
        # One that ends at once would end while another one still connects to it.
        dist.barrier()
        pipe.send(function())
    except NPAError as error:
        pipe.send(str(error))
    except BaseException:
        pipe.send(traceback.format_exc())
    finally:
        # What the fork has inherited is its parent's to clean up.
        os._exit(0)
