"""`npa-envs influence`: grows rules in one world and measures how each changes the other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from npa_envs.atomic_files import plain_numbers
from npa_envs.cli import common
from npa_envs.errors import NPAError
from npa_envs.measure.benchmark_records import table_text
from npa_envs.measure.plots import write_plots
from npa_envs.measure.rule_interaction import (
    Encounters,
    InteractionRecord,
    InteractionSettings,
    RuleUnderTest,
    heat_map,
)
from npa_envs.render import write_filmstrip
from npa_envs.rule.files import load_rule, rule_digest, shipped_rules
from npa_envs.training.task_of_rule import task_of_rule

TASK = "morphogenesis2d"
"""The task of all rules."""

QUICK: dict[str, Any] = {
    "seed_count": 2,
    "distances": (0.0, 0.5),
    "steps": 32,
    "particle_count": 512,
}
"""Defaults of `--quick`."""


@dataclass(frozen=True, kw_only=True)
class InfluenceOptions(common.RunOptions, InteractionSettings):
    """Grow every rule next to every other one, and measure how that changes it.

    For every ordered pair of rules, distance, ratio and radius it measures: the first rule's task
    loss on its own particles, together and alone; how much the two mix; how far its centroid moves.
    "cooperates": the loss falls by more than the margin; "disrupted": it rises by more; "mixes":
    the mixing index is 0.25 or more. Density gradients of each rule are divided by the number of
    its own particles. The folder gets a JSON file, a heat map, and a filmstrip of each pair. A
    stopped run continues.

    Examples:
      npa-envs influence gecko heart
      npa-envs influence --quick
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULE")] = ()
    """Rules of 2D morphogenesis: shipped ones (`npa-envs list`) or files; default: all shipped."""
    itself: bool = True
    """Also pair each rule with itself."""
    quick: bool = False
    """Two rules, two seeds and distances, few particles and steps: only shows that it runs."""
    out: Path = Path("runs/influence")
    """Folder to write to; created where missing."""


def main(arguments: Sequence[str]) -> int:
    """Grow the pairs of rules that are not measured yet; write results and print their table."""
    options = common.parse_options(InfluenceOptions, "influence", arguments)
    if options.quick:
        defaults = InfluenceOptions(**QUICK)
        options = common.parse_options(InfluenceOptions, "influence", arguments, default=defaults)
    shipped = list(shipped_rules(TASK))[: 2 if options.quick else None]
    rules = _rules(options.rules or shipped, options.checked_device())
    pairs: dict[str, tuple[RuleUnderTest, RuleUnderTest]] = {}
    for first, second in itertools.product(rules, rules):
        if options.itself or first is not second:
            name = f"{first.name}-{second.name}"
            # Different pairs can have the same name if those of rules contain hyphens.
            pairs[f"{name}-2" if name in pairs else name] = first, second
    if not pairs:
        raise NPAError(
            f"rules must be two or more without itself, got {rules[0].name}: name another one, "
            "or leave out --no-itself"
        )
    with common.progress_bar(None, show=options.progress) as advance:
        encounters = Encounters(rules, options, advance)
        folder = common.writable_folder(options.out)
        record = InteractionRecord(_facts(encounters, rules), folder / "interactions.json").read()
        done = {(row.rule, row.beside) for row in record.rows}
        missing = {
            name: pair for name, pair in pairs.items() if tuple(r.name for r in pair) not in done
        }
        if done:
            print(f"{len(pairs) - len(missing)} of {len(pairs)} pairs were measured before")
        for name, pair in missing.items():
            rows, frames = encounters.meet(*pair)
            columns = len(frames) // len(rows)
            strip = folder / f"{name}.png"
            write_filmstrip(strip, list(frames.values()), list(frames), columns=columns)
            record.add(*rows)

    print(table_text(record.rows))
    print(f"wrote {record.path} and a filmstrip of each pair")
    path = folder / "interactions.png"
    print("\n".join(write_plots(lambda: {"": heat_map(record.rows)}, path, "heat map")))
    return 0


def _facts(encounters: Encounters, rules: Sequence[RuleUnderTest]) -> dict[str, Any]:
    """Return the record's facts, which all results depend on: settings and the rules' weights."""
    settings = encounters.settings
    facts = {f.name: getattr(settings, f.name) for f in fields(InteractionSettings)}
    del facts["first_seed"], facts["seed_count"]
    facts |= {"seeds": settings.seeds, "particle_count": encounters.particle_count}
    weights = {rule.name: rule_digest(rule.rule) for rule in rules}
    return {**plain_numbers(facts), "rules": weights}


def _rules(sources: Sequence[str], device: torch.device) -> list[RuleUnderTest]:
    """Load rules with their tasks, and give each a different name."""
    rules: dict[str, RuleUnderTest] = {}
    for source in dict.fromkeys(sources):
        rule = load_rule(source, device=device).float().requires_grad_(False)
        trained = task_of_rule(source, rule, device)
        if trained.task_name != TASK:
            raise NPAError(f"rules must be of the task {TASK}, got {source!r}: leave it out")
        if trained.why_not_measurable is not None:
            raise NPAError(f"cannot measure {source!r}: {trained.why_not_measurable}: leave it out")
        name = source.rpartition("#")[2] if "#" in source else Path(source).stem
        if name in rules:
            name = f"{name}-{len(rules) + 1}"
        rules[name] = RuleUnderTest(name, rule, trained.task)
    return list(rules.values())
