"""How much of healing (docs/stability.md) worlds reach that were not wounded at all.

    python benchmarks/healing_bounds.py --device cuda --output OUT

The bound of each wound is compared with the loss near the same place 500 and 1000 steps later: of
the same world without the wound, and of other worlds of the rule, which have grown from other
seeds. The first share is what drift leaves; the second is what a place would have that grew again
as well as it grew at first, without any trace of what was there.
"""

from __future__ import annotations

from typing import Any

import torch
from scripts import script_facts, script_parser

from npa_envs.measure.benchmark_records import write_record
from npa_envs.measure.quality import GROW_STEPS, HEAL_STEPS, RuleRunner
from npa_envs.measure.wounds import LocalLoss, wounded
from npa_envs.rule.files import load_rule, shipped_rules
from npa_envs.tasks.damage import Wound
from npa_envs.training.task_of_rule import task_of_rule, trained_task_name
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import normal_draws

PLACES, OTHERS = 32, 4
"""Wounds of each world; worlds that each is compared with."""


@torch.no_grad()
def measured(source: str, given: Any) -> dict[str, Any]:
    """Return the shares of wounds whose places are within the bound without having been wounded."""
    rule = load_rule(source, device=given.device).float()
    task: Any = task_of_rule(source, rule, torch.device(given.device)).task
    draws = torch.Generator(given.device).manual_seed(given.seeds)
    seeds = task.seed(given.seeds, generator=draws, device=given.device)
    runner = RuleRunner(rule, task, draws)
    steps = GROW_STEPS, GROW_STEPS + HEAL_STEPS // 2, GROW_STEPS + HEAL_STEPS
    grown, *later = (worlds for _, worlds in runner.at(steps, Particles(*seeds[:2])))
    centre = task.spread_places(PLACES, grown).flatten(0, 1)

    def at_places(worlds: Particles, shift: int = 0) -> Particles:
        return worlds.map(lambda value: value.roll(shift, 0).repeat_interleave(PLACES, dim=0))

    row: dict[str, Any] = {"rule": source}
    for kind, size in (("wipe", 0.2), ("cut", 0.1)):
        normal = normal_draws(draws, centre.shape, centre) if kind == "cut" else None
        wound = Wound(kind, centre, size, normal)
        loss = LocalLoss(task, at_places(grown), wound)
        changed = loss(wounded(task, at_places(grown), wound)) > loss.bound

        def share(shift: int, loss: LocalLoss = loss, changed: torch.Tensor = changed) -> float:
            held = [loss(at_places(worlds, shift)) <= loss.bound for worlds in later]
            return float(torch.stack(held).all(0)[changed].float().mean())

        others = [share(shift) for shift in range(1, 1 + min(OTHERS, given.seeds - 1))]
        row[kind] = {"same": share(0), "other": sum(others) / len(others)}
    return row


if __name__ == "__main__":
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("rules", nargs="*", metavar="RULE", help="names or files of rules")
    parser.add_argument("--seeds", type=int, default=8, help="worlds of each rule")
    given = parser.parse_args()
    grow = [name for name in shipped_rules() if trained_task_name(name) == "morphogenesis2d"]
    rows: list[dict[str, Any]] = []
    for source in given.rules or grow:
        rows.append(measured(source, given))
        print(rows[-1], flush=True)
        if given.output is not None:
            write_record(given.output, {**script_facts(given), "rows": rows})
