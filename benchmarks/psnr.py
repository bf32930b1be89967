"""PSNR of rules that grow a picture or a thing, all by one measure: on white, 256 pixels in 2D.

    python benchmarks/psnr.py --device cuda --output OUT --authors authors_demo_aubergine.json 🍆

Without names or files of rules, all shipped ones are measured, on unseen seeds. The file of a rule
of the paper's authors does not say its target: it is given as an emoji, or a picture without a
margin, and drawn as by Noto: its longer side is 124 of the 128 pixels that span [-1, 1].
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from scripts import script_facts, script_parser

from npa_envs.measure.benchmark_records import write_record
from npa_envs.measure.quality import FIRST_SEED, evaluate, psnr_on_white
from npa_envs.rule.files import load_rule, shipped_rules
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.tasks.targets.picture_points import load_target
from npa_envs.training.task_of_rule import task_of_rule, trained_task_name


def measured(source: str, given: Any) -> dict[str, Any]:
    """Return the mean and the tenth percentile of the worlds' PSNR [dB] by step."""
    rule = load_rule(source, device=given.device).float()
    task = task_of_rule(source, rule, torch.device(given.device)).task
    if source == given.authors[0]:
        emoji = load_target(given.authors[1], point_count=task.config.particle_count)
        side = float((emoji.points.amax(0) - emoji.points.amin(0)).max()) + emoji.pixel_size
        k = 2.0 * 124 / 128 / side
        target = replace(emoji, points=k * emoji.points, pixel_size=k * emoji.pixel_size)
        task = Morphogenesis2D(task.config, target=target, device=given.device)
    found: dict[int, torch.Tensor] = {}
    evaluate(
        rule, task, checkpoints=given.steps, device=given.device,
        seeds=range(FIRST_SEED, FIRST_SEED + given.seeds),
        watch=lambda x, s, step: found.update({step: psnr_on_white(task, x, s).cpu()}),
    )  # fmt: skip
    by_step = {str(k): [float(v.mean()), float(v.quantile(0.1))] for k, v in found.items()}
    return {"rule": Path(source).stem, "psnr": by_step}


if __name__ == "__main__":
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("rules", nargs="*", metavar="RULE", help="names or files of rules")
    parser.add_argument("--authors", nargs=2, metavar=("RULE", "TARGET"), default=[""])
    parser.add_argument("--steps", nargs="+", type=int, default=[96, 256, 512, 1024, 4096])
    parser.add_argument("--seeds", type=int, default=16, help="worlds of each rule")
    given = parser.parse_args()
    grow = [name for name in shipped_rules() if "morphogenesis" in trained_task_name(name)]
    rows: list[dict[str, Any]] = []
    for source in [*(given.rules or grow), *filter(None, given.authors[:1])]:
        rows.append(measured(source, given))
        print(rows[-1], flush=True)
        if given.output is not None:
            write_record(given.output, {**script_facts(given), "rows": rows})
