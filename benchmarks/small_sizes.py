"""What PPO learns in small worlds within minutes, beside random, zero and scripted policies.

    python benchmarks/small_sizes.py --output benchmarks/results/small_sizes_cpu.json

Runs every method from three seeds on every small id of `npa_envs.registration`, each within the
same budget of particle-steps. `ppo_world` is Stable-Baselines3's PPO with a row for each world, and
`ppo_particles` the same with a row for each particle, which is paid its marginal reward, and with
Stable-Baselines3's own policy; it is run on the digits alone. Returns are means of 32 episodes that
no run has seen. The file is written after each run, and a run that is in it is not done again.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import torch

from npa_envs.agents.evaluation import evaluate_policy
from npa_envs.agents.learning import Budget, Problem, train
from npa_envs.agents.learning.problem import FIRST_EVALUATION_SEED, world_seeds
from npa_envs.errors import NPAError
from npa_envs.files import read_json
from npa_envs.measure.record import script_facts, script_parser, write_record
from npa_envs.measure.tables import markdown_table
from npa_envs.registration import SIZES, SPECIES_SIZES

STEPS = {row.id: row.max_episode_steps for row in (*SIZES, *SPECIES_SIZES) if "Small" in row.id}
"""Steps of an episode by id."""

METHODS = ("zero", "random", "scripted", "ppo", "ppo_world", "ppo_particles", "gradient")

BUDGETS = {
    "npa/InvasionSmall-v0": 1_000_000,
    "npa/Morphogenesis2DSmall-v0": 1_000_000,
    "npa/PointClassificationSmall-v0": 1_000_000,
    "npa/SymbiosisSmall-v0": 1_500_000,
    # Its loss takes most of the time.
    "npa/TextureSmall-v0": 300_000,
}
"""Particle-steps of a run, where they are not `USUAL`."""

USUAL = 500_000

OPTIONS: dict[tuple[str, str], dict[str, Any]] = {
    ("npa/PointClassificationSmall-v0", "ppo"): {"credit": "marginal"}
}
"""Options of methods that are not their defaults."""

EPISODES = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 32)


LEFT_OUT = {("npa/PointClassificationSmall-v0", "scripted")} | {
    (env_id, "ppo_particles") for env_id in STEPS if env_id != "npa/PointClassificationSmall-v0"
}
"""Pairs of an id and a method that are not run."""


def ppo_particles(problem: Problem, steps: int, seed: int) -> tuple[float, int, float]:
    """Learn by Stable-Baselines3's PPO, a row for each particle.

    Returns:
        The mean return of `EPISODES` without noise, the particle-steps and the seconds of learning.
    """
    from stable_baselines3 import PPO

    from npa_envs.wrappers.sb3 import ParticleVecEnv

    rows = ParticleVecEnv(problem.make_envs(row_rewards="marginal"), bootstrap=False)
    model = PPO(
        "MlpPolicy", rows, learning_rate=lambda left: 2e-3 * left, n_steps=16, batch_size=4096,
        n_epochs=8, gamma=0.0, seed=seed, device="cpu",
        policy_kwargs={"log_std_init": -2.0, "net_arch": [64], "activation_fn": torch.nn.ReLU},
    )  # fmt: skip
    rows.seed(world_seeds(seed, problem.num_envs)[0])
    begun = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - begun

    def policy(observation: Any) -> torch.Tensor:
        flat = torch.as_tensor(observation).flatten(0, -2)
        with torch.no_grad():
            actions = model.policy.get_distribution(flat).mode()
        return actions.unflatten(0, observation.shape[:-1]).clamp(-1.0, 1.0)

    episodes = evaluate_policy(problem.make_envs(), policy, EPISODES)
    return episodes.mean_return, model.num_timesteps, seconds


def measured(env_id: str, method: str, seed: int, device: str) -> dict[str, Any]:
    """Return what one run came to; a run without a result says why."""
    problem = Problem(env_id=env_id, episode_steps=STEPS[env_id], hidden_dim=64)
    steps = BUDGETS.get(env_id, USUAL)
    options = OPTIONS.get((env_id, method), {})
    row: dict[str, Any] = {"id": env_id, "method": method, "seed": seed, "options": options}
    begun = time.perf_counter()
    try:
        if method == "ppo_particles":
            mean, learned_from, seconds = ppo_particles(problem, steps, seed)
        else:
            last = train(
                method, problem, Budget(particle_steps=steps), seed,
                device=device, evaluation_seeds=EPISODES, entries=1, **options,
            ).log[-1]  # fmt: skip
            mean, learned_from, seconds = last.mean_return, last.particle_steps, last.seconds
    except NPAError as error:
        return row | {"failed": str(error)}
    return row | {
        "return": mean,
        "particle_steps": learned_from,
        "seconds": round(seconds, 1),
        "whole_seconds": round(time.perf_counter() - begun, 1),
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """Return mean and standard error over seeds, a line for each id, Markdown."""
    lines = []
    for env_id in dict.fromkeys(row["id"] for row in rows):
        cells = [f"`{env_id}`"]
        for method in METHODS:
            some = [
                r["return"]
                for r in rows
                if (r["id"], r["method"]) == (env_id, method) and "return" in r
            ]
            if not some:
                cells.append("")
                continue
            values = torch.tensor(some, dtype=torch.float64)
            error = float(values.std() / len(some) ** 0.5) if len(some) > 1 else 0.0
            cells.append(f"{float(values.mean()):.3f}" + (f" ± {error:.3f}" if error else ""))
        lines.append(tuple(cells))
    return markdown_table(("Id", *METHODS), lines)


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing, and print the table."""
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("--ids", nargs="+", default=list(STEPS), choices=list(STEPS))
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    path: Path | None = given.output
    rows = read_json(path)["rows"] if path is not None and path.exists() else []
    for env_id in given.ids:
        for method in (name for name in given.methods if (env_id, name) not in LEFT_OUT):
            for seed in range(1 if method == "zero" else given.seeds):
                if any((r["id"], r["method"], r["seed"]) == (env_id, method, seed) for r in rows):
                    continue
                facts = script_facts(given)
                row = measured(env_id, method, seed, given.device)
                rows.append(row | {"commit": facts["commit"]})
                print(rows[-1], flush=True)
                if path is not None:
                    write_record(path, facts | {"rows": rows})
    print(summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
