"""The smooth inverse of moment matrices in rules that were trained without it; run with --help.

Each rule grows worlds from the same seeds with the inverse by the threshold and with the smooth
one, not trained again; then steps of a grown world are timed in turn. Rules that the JSON file has
already are kept there.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import torch
from torch import Tensor

import npa_envs
from npa_envs.measure.record import script_facts, script_parser, write_record
from npa_envs.measure.speed.timing import Sampled, compare
from npa_envs.measure.tables import markdown_table, mean_with_error
from npa_envs.training.trained_tasks import task_of_rule

INVERSES = ("threshold", "smooth")
SMALL_DETERMINANTS = (1e-3, 1e-2, 1e-1)
QUANTILES = (0.01, 0.05, 0.5)
TIMED_STEPS = 8
HEADS = (
    "rule", *INVERSES, "det M: 1 %", "5 %", "median", "below 0.01", "ms", "ms", "ratio"
)  # fmt: skip


def with_inverse(rule: npa_envs.NPARule, inverse: str) -> npa_envs.NPARule:
    """Return the same rule with another choice."""
    twin = npa_envs.NPARule(**{**rule.hyper_parameters(), "moment_inverse": inverse})
    twin.load_state_dict(rule.state_dict())
    return twin.to(rule.hidden.weight)


def grown(rule: npa_envs.NPARule, task: Any, arguments: argparse.Namespace) -> tuple[Tensor, ...]:
    """Return worlds after all steps; the same seeds and masks for every rule."""
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    random = npa_envs.WorldRandom(list(seeds), device=arguments.device)
    x, s = task.seed(len(seeds), generator=random, device=arguments.device)
    options = {"eps": task.eps, "box": task.box, "update_prob": task.update_prob}
    return npa_envs.rollout(rule, x, s, arguments.steps, generator=random, **options)


def determinants_of(x: Tensor, s: Tensor, task: Any) -> dict[str, float]:
    """Return how the determinants of moment matrices of grown worlds are distributed."""
    moment = npa_envs.perception_fields(x, s, task.eps, box=task.box).moment
    determinant = torch.linalg.det(moment.double()).flatten()
    shares = {
        f"share_below_{d:g}": float((determinant < d).double().mean()) for d in SMALL_DETERMINANTS
    }
    ordered = determinant.sort().values
    quantiles = {f"quantile_{q:g}": float(ordered[int(q * (len(ordered) - 1))]) for q in QUANTILES}
    return shares | quantiles


def sampled_steps(rule: npa_envs.NPARule, task: Any, x: Tensor, s: Tensor) -> Sampled:
    """Return some steps of a world as `compare` takes them."""
    generator = torch.Generator(x.device).manual_seed(0)
    options = {"eps": task.eps, "box": task.box, "update_prob": task.update_prob}

    def run() -> tuple[Tensor, Tensor]:
        return npa_envs.rollout(rule, x, s, TIMED_STEPS, generator=generator, **options)

    return run, generator


@torch.no_grad()
def study(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what the choice changes for one shipped rule."""
    device = torch.device(arguments.device)
    loaded = npa_envs.load_rule(name, device=device)
    task = task_of_rule(name, loaded, device).task
    rules = [with_inverse(loaded, inverse) for inverse in INVERSES]
    result: dict[str, Any] = {"rule": name, **script_facts(arguments)}
    for inverse, rule in zip(INVERSES, rules, strict=True):
        x, s = grown(rule, task, arguments)
        losses = task.metric(x, s).double()
        result[inverse] = {
            "losses": losses.tolist(),
            "mean": float(losses.mean()),
            "standard_error": float(losses.std() / len(losses) ** 0.5),
            **determinants_of(x, s, task),
        }
    timed = [sampled_steps(rule, task, x[:1], s[:1]) for rule in rules]
    cost = compare(*timed, device, repeats=arguments.repeats)
    result["step_us"] = [t.divided(TIMED_STEPS).median for t in (cost.first, cost.second)]
    result["step_ratio"] = cost.ratio
    return result


def cells(result: dict[str, Any]) -> list[str]:
    """Return a row of the table."""
    threshold = result["threshold"]
    both = [result[inverse] for inverse in INVERSES]
    return [
        f"`{result['rule']}`",
        *(mean_with_error(found["mean"], found["standard_error"], 4) for found in both),
        *(f"{threshold[f'quantile_{q:g}']:.2g}" for q in QUANTILES),
        f"{threshold['share_below_0.01']:.2%}",
        *(f"{time / 1e3:.2f}" for time in result["step_us"]),
        f"{result['step_ratio']:.3f}",
    ]


def main() -> None:
    """Study rules, print a table and write JSON."""
    parser = script_parser(__doc__)
    parser.set_defaults(device="cpu")
    parser.add_argument("rules", nargs="+", help="shipped rules")
    parser.add_argument("--seeds", type=int, default=8, help="worlds of each rule")
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--steps", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=15, help="readings of the time")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    kept = []
    if arguments.output and arguments.output.exists():
        kept = json.loads(arguments.output.read_text())["rules"]
    results = []
    for name in arguments.rules:
        results.append(study(name, arguments))
        kept = [*(other for other in kept if other["rule"] != name), results[-1]]
        if arguments.output:
            write_record(arguments.output, {"rules": kept})
    print(markdown_table(HEADS, map(cells, results)))


if __name__ == "__main__":
    main()
