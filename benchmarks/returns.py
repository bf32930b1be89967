"""Returns of untrained, scripted and gradient-trained policies on every environment; see --help.

Each policy plays one episode from each of the seeds 0, 1, ...; the loss at an episode's start and
end say the same in the task's own unit. The rule is the shipped one that grows the gecko.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import gymnasium
import torch

import npa_envs
from npa_envs.agents import (
    Episodes,
    MendPolicy,
    PaintPolicy,
    RandomPolicy,
    RulePolicy,
    SpreadPolicy,
    ZeroPolicy,
    evaluate_policy,
)
from npa_envs.measure.record import script_facts, script_parser, write_record
from npa_envs.registration import ENVIRONMENTS

TARGET = "gecko"
"""What pictures are of; the shipped rule of that name plays where there are pictures."""

NO_RULE = ("npa/Texture-v0", "npa/PointClassification-v0", "npa/Morphogenesis3D-v0")
"""Environments with targets of their own, for which no rule is shipped."""

POLICIES: dict[str, Callable[[Any], Any]] = {
    "random": RandomPolicy,
    "zero": ZeroPolicy,
    "spread": SpreadPolicy,
    "paint": PaintPolicy,
    "mend": MendPolicy,
    "rule": lambda env: RulePolicy(
        npa_envs.load_rule(TARGET, device=env.unwrapped.config.device), env
    ),
}


def row_of(name: str, policy: str, episodes: Episodes) -> dict[str, Any]:
    """Return what one policy achieved in one environment, for the table and for JSON."""
    return {
        "environment": name,
        "policy": policy,
        "episodes": len(episodes.returns),
        "mean_return": episodes.mean_return,
        "standard_error": episodes.standard_error,
        "start_loss": float(episodes.start_losses.mean()),
        "final_loss": float(episodes.final_losses.mean()),
        "mean_steps": float(episodes.steps.mean()),
        "endings": dict(Counter(episodes.endings)),
        "returns": episodes.returns.tolist(),
    }


def print_row(row: dict[str, Any]) -> None:
    """Print one line of the table."""
    endings = ", ".join(f"{count} {name}" for name, count in sorted(row["endings"].items()))
    print(
        f"{row['environment']:24} {row['policy']:8} "
        f"{row['mean_return']:8.3f} ± {row['standard_error']:.3f} "
        f"{row['start_loss']:8.3f} {row['final_loss']:8.3f} {row['mean_steps']:6.0f}   {endings}",
        flush=True,
    )


def main() -> None:
    """Let every policy play in every environment, print a table and write JSON."""
    parser = script_parser(__doc__)
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--particle-count", type=int, default=1024)
    parser.add_argument("--max-episode-steps", type=int, help="default: the environment's own")
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    keywords: dict[str, Any] = {}
    if arguments.max_episode_steps:
        keywords["max_episode_steps"] = arguments.max_episode_steps
    print(f"{'environment':24} {'policy':8} {'return':>15} {'start':>9} {'final':>8} {'steps':>6}")
    rows = []
    for registration in ENVIRONMENTS:
        other = registration.id in NO_RULE
        env = gymnasium.make_vec(
            registration.id,
            num_envs=arguments.episodes,
            vectorization_mode="vector_entry_point",
            particle_count=arguments.particle_count,
            device=arguments.device,
            output="torch",
            **({} if other else {"target": TARGET}),
            **keywords,
        )
        for name in arguments.policies:
            if other and name == "rule":
                continue
            episodes = evaluate_policy(env, POLICIES[name](env), range(arguments.episodes))
            rows.append(row_of(registration.id, name, episodes))
            print_row(rows[-1])
        env.close()
    if arguments.output:
        report = {"particle_count": arguments.particle_count, "rows": rows}
        write_record(arguments.output, {**script_facts(arguments), **report})


if __name__ == "__main__":
    main()
