"""Calls of the public API with arguments that are mostly wrong, each made from one number."""

import random
from typing import Any

import torch
from fuzz_engine import ENGINE
from fuzz_outer import OUTER
from fuzz_values import wrong

TARGETS = ENGINE | OUTER
"""What is called, by name."""

FIXED = ("method", "kind", "maker", "field", "id")
"""Arguments that belong to the test, not to what is tested."""


def call(seed: int) -> tuple[str, dict[str, Any]]:
    """Return the name of a target and arguments of which one to three are wrong."""
    draw = random.Random(seed)
    torch.manual_seed(seed)
    names = list(TARGETS)
    (name,) = draw.choices(names, [TARGETS[n].weight for n in names])
    arguments = TARGETS[name].legal(draw)
    own = {"name"} if name in ("wrappers", "agents", "TrainConfig") else set()
    own |= {"task"} if name == "TrainConfig" else set()
    free = [a for a in arguments if a not in FIXED and a not in own and a != "words"]
    if name in ("load_rule of a file", "load_config", "damaged files", "npa-envs"):
        free = []
    for argument in draw.sample(free, min(len(free), draw.choice((0, 1, 1, 1, 2, 3)))):
        arguments[argument] = wrong(draw, argument, arguments[argument])
    if arguments.get("rule", "") is None:
        arguments["rule"] = "picture"  # None is legal, and grows a world for seconds.
    if name == "gymnasium.make" and arguments.get("render_mode") is not None:
        arguments["render_mode"] = str(arguments["render_mode"])  # Gymnasium reads it itself.
    return name, arguments
