"""The command `npa-envs`: each sub-command is a module, imported only when it is called."""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import os
import sys
from collections.abc import Iterator, Sequence

from npa_envs.errors import NPAError, check_known

GROUPS = {
    "make": {
        "demo": "grow a shipped rule, damage it, let it heal; train a small one: a minute on a CPU",
        "train": "with a target (picture, texture, class): train a rule by the loss's gradient",
        "search": "without a target: search for rules that differ from each other and stay alive",
    },
    "look": {
        "view": "watch a rule, a training run or an environment in the browser, with brushes",
        "rollout": "grow a rule from its seed, with damage; writes GIF, MP4 and a filmstrip",
        "export-web": "write an HTML file that runs rules in any browser, without a server",
        "list": "list tasks, presets, environments, targets, losses and shipped rules",
    },
    "learn": {
        "learn": "with an environment's reward: learn a policy by PPO or SHAC, on one or more GPUs",
        "compare": "to choose a method: PPO, SHAC, evolution and the gradient on equal tasks",
        "record-dataset": "write episodes of a policy as a Minari dataset",
    },
    "measure": {
        "evaluate": "quality of one rule: loss, PSNR, overflow and extent over thousands of steps",
        "robustness": "losses of rules under changed conditions, and recovery after damage",
        "rule-interaction": "how rules that grow next to each other change each other",
        "stress": "correctness of the library: hard cases, each with the result that it must have",
        "bench": "speed: the paper's table and scaling; which kernels a step runs, and why",
        "doctor": "what is broken, slow or missing on this machine, and how to fix it",
        "warmup": "compile the kernels ahead of time",
    },
}
"""The sub-commands with their summaries, in the groups of the help."""

COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}

ERROR = 2
"""Exit code after an error with a one-line message: in the arguments, or of the system."""
INTERRUPTED = 130

HINTS = {
    errno.ENOSPC: ": free some space, or choose another disk",
    errno.EDQUOT: ": free some space, or choose another disk",
    errno.EACCES: ": choose another folder (that of compiled kernels is WARP_CACHE_PATH)",
    errno.EPERM: ": choose another folder (that of compiled kernels is WARP_CACHE_PATH)",
}
"""What to do about errors of the system, by `errno`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command in `arguments`, by default those of the process; return the exit code.

    The code is 0; 1 if a check or a run failed; 2 after an error (`ERROR`); 130 after Ctrl-C.
    """
    # Read when torch is loaded. On a busy machine, threads that wait in busy loops make every
    # operation several times as slow.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if not sys.stderr.isatty():
        # Seconds between updates of a bar, each of which a log keeps; read when tqdm is loaded.
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    # Not by `list`, which is the module of a command.
    words = [*(sys.argv[1:] if arguments is None else arguments)]
    for stream in (sys.stdout, sys.stderr):
        # Terminals without UTF-8 show "?" for letters that are missing.
        if isinstance(stream, io.TextIOWrapper) and stream.encoding.lower() != "utf-8":
            stream.reconfigure(errors="replace")
    try:
        with _printed_targets():
            return _dispatch(words)
    except NPAError as error:
        print(f"npa-envs: error: {' '.join(str(error).split())}", file=sys.stderr)
        return ERROR
    except KeyboardInterrupt:
        print("npa-envs: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of a pipe (head, less) has ended. The interpreter's last flush must not raise
        # the same error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f" {error.filename!r}" if error.filename else ""
        hint = HINTS.get(error.errno or 0, "")
        print(f"npa-envs: error: {error.strerror or error}{where}{hint}", file=sys.stderr)
        return ERROR


@contextlib.contextmanager
def _printed_targets() -> Iterator[None]:
    """Within the block, print each line about a target's file once."""
    import logging

    printed: set[str] = set()

    def show(record: logging.LogRecord) -> bool:
        if (line := record.getMessage()) not in printed:
            printed.add(line)
            stream = sys.stderr if record.levelno > logging.INFO else sys.stdout
            print(line, file=stream, flush=True)
        return False

    logger, handler = logging.getLogger("npa_envs.targets"), logging.Handler()
    handler.addFilter(show)
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)


def _dispatch(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in {"-h", "--help", "help"}:
        print(_help())
        return 0 if arguments else ERROR
    if arguments[0] in {"-V", "--version"}:
        from npa_envs import __version__

        print(f"npa-envs {__version__}")
        return 0
    name, rest = arguments[0], arguments[1:]
    check_known("unknown command", name, COMMANDS)
    module = importlib.import_module(f"npa_envs.cli.{name.replace('-', '_')}")
    return int(module.main(rest))


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = "\n".join(
        "\n".join([f"{group}:", *(f"  {name:<{width}}  {text}" for name, text in commands.items())])
        for group, commands in GROUPS.items()
    )
    return (
        "usage: npa-envs COMMAND [options]\n\n"
        "Neural Particle Automata: differentiable particle worlds.\n\n"
        f"{lines}\n\nOptions of a command: npa-envs COMMAND --help"
    )
