"""Whatever the public API is given, it works or says what is wrong: an `NPAError`, nothing else."""

import os
import random
import reprlib
import time
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from support.fuzz_targets import TARGETS
from support.fuzz_values import wrong

from npa_envs import NPAError

FIRST_SEED = int(os.environ.get("NPA_ENVS_FUZZ_SEED", "0"))
"""Seed of the first call; each further one has one more."""

QUICK, THOROUGH = 150, 10_000

PATIENCE = 30.0
"""No call takes more of the processor's time [s]; other programs' does not count."""


def call(seed: int) -> tuple[str, dict[str, Any]]:
    """Return the name of a target and arguments of which one to three are wrong."""
    draw = random.Random(seed)
    torch.manual_seed(seed)
    names = list(TARGETS)
    (name,) = draw.choices(names, [TARGETS[n].weight for n in names])
    arguments = TARGETS[name].legal(draw)
    free = [argument for argument in arguments if argument not in TARGETS[name].constant]
    for argument in draw.sample(free, min(len(free), draw.choice((0, 1, 1, 1, 2, 3)))):
        arguments[argument] = wrong(draw, argument, arguments[argument])
    if arguments.get("rule", "") is None:
        arguments["rule"] = "picture"  # None is legal, and grows a world for seconds.
    if name == "environments" and arguments.get("render_mode") is not None:
        arguments["render_mode"] = str(arguments["render_mode"])  # Gymnasium reads it itself.
    return name, arguments


def refusal(seed: int) -> str | None:
    """Make a call; return what it did that no documentation names, or None."""
    name, arguments = call(seed)
    target = TARGETS[name]
    began = time.process_time()
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            target.function(**arguments)
    except (NPAError, *target.documented) as error:
        if 10_000 * "x" in str(error):
            return f"seed {seed}: {name}({shown(arguments)}) echoes all of what came"
    except Exception as error:
        return f"seed {seed}: {name}({shown(arguments)}) raised {type(error).__name__}: {error}"
    seconds = time.process_time() - began
    if seconds > PATIENCE:
        return f"seed {seed}: {name}({shown(arguments)}) took {seconds:.0f} s"
    return None


def shown(arguments: dict[str, object]) -> str:
    """Return arguments as a reader needs them."""
    return ", ".join(f"{name}={described(value)}" for name, value in arguments.items())


def described(value: object) -> str:
    if isinstance(value, torch.Tensor) and value.numel() > 4:
        return f"<{value.dtype} {tuple(value.shape)} on {value.device}>"
    try:
        return reprlib.repr(value)
    except ValueError:
        return "a number of more digits than Python writes"


@pytest.mark.parametrize("count", [QUICK, pytest.param(THOROUGH, marks=pytest.mark.slow)])
def test_only_documented_errors_come_out_of_the_public_api(count: int, capsys) -> None:
    found = [refusal(seed) for seed in range(FIRST_SEED, FIRST_SEED + count)]
    capsys.readouterr()
    wrong = [line for line in found if line]
    assert not wrong, f"{len(wrong)} of {count} calls:\n" + "\n".join(wrong[:50])
