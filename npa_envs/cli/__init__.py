"""The command `npa-envs`: one module a sub-command, imported only when it is asked for."""

from __future__ import annotations

import importlib
import io
import os
import sys
from collections.abc import Sequence

from npa_envs.errors import NPAError, suggest

COMMANDS = {
    "demo": "grow, hurt and heal the shipped rule, and train a small one; about a minute on a CPU",
    "train": "train a rule on a task",
    "learn": "learn an environment by reinforcement learning, on one GPU or several",
    "sweep": "train with every combination of some options, over devices and machines",
    "rollout": "grow a rule from its seed, with damage on the way; writes GIF, MP4 and a filmstrip",
    "view": "watch and touch a rule, a training run or an environment in the browser",
    "export-web": "rules as one HTML file that runs in any browser, without a server",
    "evaluate": "measure a rule: loss, PSNR, overflow and extent over thousands of steps",
    "interact": "grow rules next to each other and measure how each changes the other",
    "bench": "run time against error, the paper's table, scaling; a call explained",
    "stress": "hard cases, what is expected of each, and where things break",
    "robustness": "losses of rules under other conditions and recovery times after damage",
    "compare": "reinforcement learning, evolution and the gradient on the same tasks",
    "search": "rules nobody asked for: an archive of what differs and stays alive, as an atlas",
    "record": "episodes of a policy as a dataset of Minari",
    "list": "tasks, presets, environments, built-in targets, losses, shipped rules",
    "warmup": "compile the kernels ahead of time",
    "doctor": "what is broken, slow or missing on this machine, and the cure",
}
"""Every sub-command with its summary."""

USAGE_ERROR = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default the process's words, and return the exit code.

    That is 0, 2 for a mistake in what was asked for, or 130 after Ctrl-C.
    """
    # Read once, when torch is loaded: where other programs want the cores, threads that wait in
    # busy loops make every operation several times as slow.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    words = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        # Terminals without UTF-8 show "?" for letters that they lack.
        if isinstance(stream, io.TextIOWrapper) and stream.encoding.lower() != "utf-8":
            stream.reconfigure(errors="replace")
    try:
        return _dispatch(words)
    except NPAError as error:
        print(f"npa-envs: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("npa-envs: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of a pipe (head, less) has seen enough; the interpreter's own flush at its
        # end must not complain about that either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f" {error.filename!r}" if error.filename else ""
        print(
            f"npa-envs: error: {error.strerror or error}{where}: make room or choose another "
            "folder (that of compiled kernels is WARP_CACHE_PATH)",
            file=sys.stderr,
        )
        return USAGE_ERROR


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in {"-h", "--help", "help"}:
        print(_help())
        return 0 if words else USAGE_ERROR
    if words[0] in {"-V", "--version"}:
        from npa_envs import __version__

        print(f"npa-envs {__version__}")
        return 0
    name, rest = words[0], words[1:]
    if name not in COMMANDS:
        raise NPAError(f"unknown command {name!r}: {suggest(name, COMMANDS)}")
    module = {"list": "listing"}.get(name, name.replace("-", "_"))
    return int(importlib.import_module(f"npa_envs.cli.{module}").main(rest))


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items())
    return (
        "usage: npa-envs COMMAND [options]\n\n"
        "Neural Particle Automata: differentiable particle worlds.\n\n"
        f"{lines}\n\nOptions of a command: npa-envs COMMAND --help"
    )
