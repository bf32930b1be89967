"""What is public besides numbers: names, signatures, ids, commands with their options."""

import contextlib
import importlib
import inspect
import io
import pkgutil
import re

import gymnasium
import pettingzoo

import npa_envs
from npa_envs.cli import COMMANDS, main
from npa_envs.training import TASKS

OF_PACKAGE = ("agents", "agents.learning", "envs", "envs.multi", "ops", "render", "training")
PACKAGES = ("npa_envs", *(f"npa_envs.{name}" for name in (*OF_PACKAGE, "wrappers")))
"""Packages that list their public names."""


def public_names():
    """Return each package's public names."""
    return {name: sorted(importlib.import_module(name).__all__) for name in PACKAGES}


def signatures():
    """Return what each public callable of the library takes: names, kinds, whether optional."""
    found = {}
    for name in npa_envs.__all__:
        value = getattr(npa_envs, name)
        if not (isinstance(value, type) and issubclass(value, Exception | tuple)):
            parameters = inspect.signature(value).parameters.values()
            found[name] = [
                f"{p.name} {p.kind.name}" + ("" if p.default is p.empty else f" = {p.default!r}")
                for p in parameters
            ]
    return found


def ids():
    """Return the ids that Gymnasium and PettingZoo know of ours."""
    for module in ("multispecies_v0", "particles_v0"):
        importlib.import_module(f"npa_envs.envs.{module}")
    # PettingZoo before 1.27 has no registries.
    tables = {
        "gymnasium": gymnasium.registry,
        "parallel": getattr(pettingzoo, "parallel_registry", {}),
        "aec": getattr(pettingzoo, "aec_registry", {}),
    }
    return {
        kind: sorted(name for name in table if name.startswith("npa/"))
        for kind, table in tables.items()
    }


def options(*words):
    """Return the options that a command's help names."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*words, "--help-all" if words[0] == "train" else "--help"])
    return sorted(set(re.findall(r"--[a-z][a-z0-9-]*[a-z0-9]", text.getvalue())))


def is_there(name):
    """Return whether a dotted name can be imported."""
    with contextlib.suppress(ImportError, AttributeError):
        pkgutil.resolve_name(name)
        return True
    return False


def everything():
    """Return all of it."""
    commands = {name: options(name) for name in COMMANDS if name != "train"}
    commands |= {f"train {task}": options("train", task) for task in TASKS}
    return {
        "packages": public_names(),
        "signatures": signatures(),
        "ids": ids(),
        "commands": commands,
        "presets": {name: sorted(entry.presets) for name, entry in TASKS.items()},
        "rules": sorted(npa_envs.shipped_rules()),
    }
