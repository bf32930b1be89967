"""What the smooth inverse of moment matrices changes in rules that were trained without it.

Each rule grows worlds from the same seeds with the inverse by the threshold and with the smooth
one, not trained again; then steps of a grown world are timed in turn. See --help.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import date
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import npa_envs
from npa_envs.measure.speed.timing import Sampled, compare
from npa_envs.training.trained_tasks import task_of_rule

INVERSES = ("threshold", "smooth")
SMALL_DETERMINANTS = (1e-3, 1e-2, 1e-1)
QUANTILES = (0.01, 0.05, 0.5)
TIMED_STEPS = 8


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
    result: dict[str, Any] = {
        "rule": name,
        "command": " ".join(["python", *sys.argv]),
        "commit": arguments.commit,
        "date": date.today().isoformat(),
        "torch": torch.__version__,
    }
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


def line(result: dict[str, Any]) -> str:
    """Return a line of the table, in Markdown."""
    cells = [f"`{result['rule']}`"]
    cells += [
        f"{result[inverse]['mean']:.4f} ± {result[inverse]['standard_error']:.4f}"
        for inverse in INVERSES
    ]
    threshold = result["threshold"]
    cells += [f"{threshold[f'quantile_{q:g}']:.2g}" for q in QUANTILES]
    cells += [f"{threshold['share_below_0.01']:.2%}"]
    cells += [*(f"{time / 1e3:.2f}" for time in result["step_us"]), f"{result['step_ratio']:.3f}"]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Study rules, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rules", nargs="+", help="shipped rules")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    parser.add_argument("--seeds", type=int, default=8, help="worlds of each rule")
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--steps", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=15, help="readings of the time")
    parser.add_argument("--commit", default="unknown", help="commit that is measured")
    parser.add_argument("--output", type=Path, help="JSON file; rules there already are kept")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    kept = []
    if arguments.output and arguments.output.exists():
        kept = json.loads(arguments.output.read_text())["rules"]
    print(
        "| rule | threshold | smooth | det M: 1 % | 5 % | median | below 0.01 | ms | ms | ratio |"
    )
    print("|---" * 10 + "|")
    for name in arguments.rules:
        result = study(name, arguments)
        kept = [*(other for other in kept if other["rule"] != name), result]
        print(line(result), flush=True)
        if arguments.output:
            arguments.output.write_text(json.dumps({"rules": kept}, indent=1) + "\n")


if __name__ == "__main__":
    main()
