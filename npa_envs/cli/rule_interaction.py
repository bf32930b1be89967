"""`npa-envs rule-interaction`: grows rules in one world and measures how each changes the other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError
from npa_envs.measure.benchmark_records import table_text
from npa_envs.measure.plots import write_plots
from npa_envs.measure.rule_interaction import (
    Encounters,
    InteractionRecord,
    InteractionSettings,
    RuleUnderTest,
    interaction_map,
)
from npa_envs.render import write_filmstrip
from npa_envs.rule.files import load_rule, rule_digest, shipped_rules
from npa_envs.training.task_of_rule import task_of_rule

TASK = "morphogenesis2d"
"""The task of all rules."""


@dataclass(frozen=True, kw_only=True)
class RuleInteractionOptions(common.RunOptions, InteractionSettings):
    """Grow every rule next to every other one, and measure how that changes it.

    For every ordered pair of rules, distance, ratio and radius it measures: the first rule's task
    loss on its own particles, together and alone; how much the two mix; how far its centroid moves.
    "cooperates": the loss falls by more than the margin; "disrupted": it rises by more; "mixes":
    the mixing index is 0.25 or more. Density gradients of each rule are divided by the number of
    its own particles. The folder gets a JSON file, a heat map, and a filmstrip of each pair. A
    stopped run continues.

    Examples:
      npa-envs rule-interaction gecko heart
      npa-envs rule-interaction --particle-count 512 --steps 32
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULE")] = ()
    """Rules of 2D morphogenesis: shipped ones (`npa-envs list`) or files; default: all shipped."""
    itself: bool = True
    """Also pair each rule with itself."""
    out: Path = Path("runs/rule-interaction")
    """Folder to write to; created where missing."""


def main(arguments: Sequence[str]) -> int:
    """Grow the pairs of rules that are not measured yet; write results and print their table."""
    options = common.parse_options(RuleInteractionOptions, "rule-interaction", arguments)
    device = options.checked_device()
    sources = common.named_rules(options.rules or shipped_rules(TASK))
    rules = []
    for name, source in sources.items():
        rule = load_rule(source, device=device).float().requires_grad_(False)
        trained = task_of_rule(source, rule, device)
        if trained.task_name != TASK:
            raise NPAError(f"rules must be of the task {TASK}, got {source!r}: leave it out")
        if trained.why_not_measurable is not None:
            raise NPAError(f"cannot measure {source!r}: {trained.why_not_measurable}: leave it out")
        rules.append(RuleUnderTest(name, rule, trained.task))
    pairs = [
        (first, second)
        for first, second in itertools.product(rules, rules)
        if options.itself or first is not second
    ]
    if not pairs:
        raise NPAError(
            f"rules must be two or more without itself, got {rules[0].name}: name another one, "
            "or leave out --no-itself"
        )
    encounters = Encounters(rules, options)
    folder = common.writable_folder(options.out)
    settings = {f.name: getattr(options, f.name) for f in fields(InteractionSettings)}
    settings["particle_count"] = encounters.particle_count
    settings["rules"] = {rule.name: rule_digest(rule.rule) for rule in rules}
    record = InteractionRecord(settings, folder / "interactions.json").read()
    done = {(row.rule, row.beside) for row in record.rows}
    missing = [pair for pair in pairs if tuple(rule.name for rule in pair) not in done]
    if done:
        print(f"{len(pairs) - len(missing)} of {len(pairs)} pairs were measured before")
    with common.progress_bar(len(missing), show=options.progress, unit="pair") as advance:
        for first, second in missing:
            rows, frames = encounters.meet(first, second)
            strip = folder / f"{first.name}+{second.name}.png"
            columns = len(frames) // len(rows)
            write_filmstrip(strip, list(frames.values()), list(frames), columns=columns)
            record.add(*rows)
            advance(1)

    print(table_text(record.rows))
    print(f"wrote {record.path} and a filmstrip of each pair")
    path = folder / "interactions.png"
    print("\n".join(write_plots(lambda: {"": interaction_map(record.rows)}, path, "heat map")))
    return 0
