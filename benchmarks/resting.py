"""What a rollout saves in worlds that a rule with a dead zone has brought to rest.

    python benchmarks/resting.py RULE [RULE ...] [--device cuda] [--output FILE]

One world of each rule, as trained. At some ages: whether it is at rest, and the time of a rollout
of 512 steps, once as it is called (steps of worlds at rest are left out) and once with
`return_path_length=True`, which runs every step.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from scripts import script_facts, script_parser

import npa_envs
from npa_envs.measure.benchmark_records import write_record
from npa_envs.measure.speed.timing import synchronize
from npa_envs.rule.files import load_rule
from npa_envs.training.task_of_rule import task_of_rule

AGES = (0, 512, 1024, 2048, 4096)
STEPS, READINGS = 512, 3


def measured(source: str, device: torch.device) -> dict[str, Any]:
    """Return the time of a rollout of a rule's world at each age."""
    rule = load_rule(source, device=device).float()
    task = task_of_rule(source, rule, device).task
    generator = torch.Generator(device).manual_seed(0)
    options = {"eps": task.eps, "box": task.box, "update_prob": task.update_prob}

    def seconds(x: torch.Tensor, s: torch.Tensor, whole: bool) -> float:
        readings = []
        for _ in range(READINGS):
            synchronize(device)
            begun = time.perf_counter()
            npa_envs.rollout(
                rule, x, s, STEPS, generator=generator, return_path_length=whole, **options
            )
            synchronize(device)
            readings.append(time.perf_counter() - begun)
        return min(readings)

    rows = []
    with torch.no_grad():
        x, s, *_ = task.seed(1, generator=generator, device=device)
        for age, before in zip(AGES, (0, *AGES), strict=False):
            x, s = npa_envs.rollout(rule, x, s, age - before, generator=generator, **options)
            rests = npa_envs.at_rest(rule, x, s, eps=task.eps, box=task.box)
            row = {
                "age": age,
                "at_rest": bool(rests.all()),
                "every_step_s": seconds(x, s, True),
                "as_called_s": seconds(x, s, False),
            }
            print(source, row, flush=True)
            rows.append(row)
    told = {"rule": Path(source).name, "particles": x.shape[1], "dead_zone": rule.dead_zone}
    return told | {"ages": rows}


def main() -> None:
    """Measure, print, and write a record if requested."""
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("rules", nargs="+", metavar="RULE", help="names or files of rules")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    found = [measured(source, torch.device(given.device)) for source in given.rules]
    if given.output is not None:
        write_record(given.output, {**script_facts(given), "resting": found})


if __name__ == "__main__":
    main()
