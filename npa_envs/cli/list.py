"""`npa-envs list`: prints the names of presets, targets, environments and rules, with a legend."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from npa_envs.cli import common

SCORES: Mapping[str, tuple[str, str, str, str]] = {
    "morphogenesis2d": (
        "growth", "loss", ".3f", "difference of the drawn picture from the target's, 0 if equal",
    ),
    "morphogenesis3d": (
        "growth", "psnr", ".1f", "PSNR [dB] of views that training never saw, higher is better",
    ),
    "texture": (
        "judge", "ratio", ".2f", "distance from the target, lower is better",
    ),
    "point_classification": ("accuracy", "majority", ".1%", "share of digits that are recognised"),
}  # fmt: skip
"""Task -> the table, the column and the form of its rules' scores, and what these mean."""

STEPS = (32, 128, 512, 4096)
"""Steps whose scores are shown, where they were measured."""


@dataclass(frozen=True)
class ListOptions:
    """List presets of tasks, targets, ids of environments and shipped rules with their scores.

    Examples:
      npa-envs list
      npa-envs list rules
    """

    part: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PART")] = ""
    """`rules`, `targets`, `ids` or `presets`; default: all four."""


def main(arguments: Sequence[str]) -> int:
    """Print one or all parts of the list; return 0."""
    options = common.parse_options(ListOptions, "list", arguments)
    chosen = common.chosen_names("part", [options.part] if options.part else [], PARTS)
    hint = [] if options.part else [f"one part: npa-envs list {'|'.join(PARTS)}"]
    print("\n\n".join([*hint, *("\n".join(PARTS[part]()) for part in chosen), *hint]))
    return 0


def presets() -> Iterator[str]:
    """Yield a line for each preset of each task."""
    from npa_envs.training import TASKS

    yield "PRESETS of tasks: npa-envs train TASK --preset PRESET"
    yield "  iterations × worlds, and about how long they take on one CPU core; `best`, `detail` and"
    yield "  `paper` are for a GPU, where `best` and `detail` take minutes"
    for name, entry in TASKS.items():
        yield f"  {name}: {entry.summary}"
        for preset, config in entry.presets.items():
            seconds = entry.expected_seconds(config) or 0.0
            work = f"{config.total_iterations:>6} × {config.world_count}"
            yield f"    {preset:<7}{work:<12} {common.duration(seconds)}"


def targets() -> Iterator[str]:
    """Yield a line for each task's targets, for each texture loss, and for the data sets."""
    from npa_envs.tasks.losses.texture import TEXTURE_LOSSES
    from npa_envs.tasks.targets.digit_clouds import BUILT_IN
    from npa_envs.training import TASKS

    yield "TARGETS: npa-envs train TASK --target NAME"
    yield "  or the path of a picture, for morphogenesis2d also one emoji, for 3D a mesh or views"
    for name, entry in TASKS.items():
        if entry.targets():
            yield f"  {name}: {', '.join(entry.targets())}"
    yield f"  point_classification, by --data: {', '.join(BUILT_IN)}, or a folder of IDX files"
    yield "  losses of textures, by --loss:"
    for name, loss in TEXTURE_LOSSES.items():
        yield f"    {name:<11} {loss.summary}"


def ids() -> Iterator[str]:
    """Yield a line for each environment: its id, the length of an episode, and what is done."""
    from npa_envs.envs.multi.shipped_tasks import TASKS
    from npa_envs.registration import ALL, SPECIES, SPECIES_SIZES

    yield "IDS of environments, the steps of an episode, and what is to do"
    yield "  import npa_envs, then gymnasium.make(ID) or gymnasium.make_vec(ID, num_envs=8)"
    yield '  without the import: gymnasium.make("npa_envs:npa/Texture-v0")'
    yield "  Small: few particles, learned in minutes on a laptop; Large: many, for a GPU"

    def line(env_id: str, steps: int | None, counts: object, cls: type) -> str:
        """Return the line of a small or large variant with these particles, else of `cls`."""
        same = "one controller for all" if "Central" in env_id else "the same"
        text = f"{same}, {counts} particles" if counts else inspect.getdoc(cls) or ""
        return f"  {env_id:<38} {steps:>3}  {text.partition(chr(10))[0]}"

    order = [entry.name for entry in ALL]
    for entry in sorted(ALL, key=lambda entry: order.index(entry.name)):
        count = entry.size and entry.keywords.get("particle_count")
        cls = pkgutil.resolve_name(entry.entry_point)
        yield line(entry.id, entry.max_episode_steps, count, cls)
    yield "  several species: npa_envs.envs.multispecies_v0.parallel_env(ID), with PettingZoo"
    for environment, task in SPECIES.items():
        cls = TASKS[task]
        yield line(environment, cls.config_type.max_cycles, None, cls)
        for size in (size for size in SPECIES_SIZES if size.task == task):
            counts = size.keywords.get("particle_counts") or [size.keywords["particle_count"]]
            yield line(size.id, size.max_episode_steps, " and ".join(map(str, counts)), cls)


def rules() -> Iterator[str]:
    """Yield a line for each shipped rule: its size, and its scores after some steps."""
    from npa_envs.measure.quality import scores
    from npa_envs.rule.files import load_rule, preset_rules, shipped_rules

    yield "RULES that are shipped: npa-envs view NAME, npa-envs rollout NAME"
    yield "  their weights, and a score of worlds that training never saw, at steps of their lives"
    for task, (table, column, form, meaning) in SCORES.items():
        yield f"  {task}: {meaning}"
        for name in shipped_rules(task):
            values = {row["step"]: format(row[column], form) for row in scores(name)[table]}
            text = ", ".join(f"{values[step]} at {step}" for step in STEPS if step in values)
            yield f"    {name:<10} {load_rule(name).weight_count:>6} weights  {text}"
    yield "  presets and environments start from:"
    yield f"    {', '.join(preset_rules())}"


PARTS = {"rules": rules, "targets": targets, "ids": ids, "presets": presets}
