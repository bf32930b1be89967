"""How Stable-Baselines3's PPO and SAC learn to garden and to shepherd; run with --help.

    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --steps 50000 --jobs 3
    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --worlds 256 --steps 1000000

One process learns with each seed. As it learns, its policy without exploration is paid for the
episodes of `npa_envs.agents.learning.problem.EVALUATION_SEEDS`: told are the mean reward of a step
with its standard error over episodes and, of shepherds, how many creatures were at their goal and
whole in the last step. Rows of a seed are written to the folder after each evaluation, with
`--save` beside the policy.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.agents.learning.problem import EVALUATION_SEEDS
from npa_envs.files import write_text
from npa_envs.measure.record import script_facts, script_parser, write_record
from npa_envs.registration import GARDEN_IDS
from npa_envs.wrappers import WorldVecEnv

METHODS: dict[str, tuple[type[Any], dict[str, Any], dict[str, Any]]] = {
    "ppo": (PPO, {"gamma": 0.9}, {}),
    "sac": (SAC, {"gamma": 0.9}, {}),
    "her": (
        SAC,
        {"gamma": 0.95, "replay_buffer_class": HerReplayBuffer, "learning_starts": 1_000},
        {"reward": "sparse"},
    ),
}
"""Algorithm, what of its defaults is changed, and keywords of the environment."""

MANY = {
    "ppo": {
        "n_steps": 32,
        "batch_size": 1024,
        "n_epochs": 5,
        "policy_kwargs": {"log_std_init": -1.0},
    }
}
"""What is changed besides where many worlds are stepped together."""


class Evaluation(BaseCallback):
    """Evaluate every so many steps, and write what came of it."""

    def __init__(
        self, name: str, keywords: dict[str, Any], device: str, every: int, path: Path, saves: bool
    ) -> None:
        super().__init__()
        self._envs = gymnasium.make_vec(
            name,
            len(EVALUATION_SEEDS),
            vectorization_mode="vector_entry_point",
            device=device,
            **keywords,
        )
        self._every, self._path, self._saves = every, path, saves
        self._begun, self._next = time.perf_counter(), 0
        self.rows: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            self.evaluate()
        return True

    def evaluate(self) -> None:
        """Add a row about the policy as it is."""
        learned = time.perf_counter() - self._begun
        count, limit = len(EVALUATION_SEEDS), self._envs.spec.max_episode_steps
        earned = np.zeros(count)
        seen, _ = self._envs.reset(seed=list(EVALUATION_SEEDS))
        for _ in range(limit):
            action, _ = self.model.predict(seen, deterministic=True)
            seen, rewards, _, _, infos = self._envs.step(action)
            earned += rewards / limit
        row = {
            "steps": self.num_timesteps,
            "seconds": learned,
            "reward": float(earned.mean()),
            "error": float(earned.std(ddof=1) / math.sqrt(count)),
        }
        if "is_success" in infos["final_info"]:
            row["success"] = float(np.mean(infos["final_info"]["is_success"]))
        self.rows.append(row)
        write_text(self._path, json.dumps(self.rows))
        if self._saves:
            self.model.save(self._path.with_suffix(".zip"))
        print(self._path.stem, {name: round(value, 3) for name, value in row.items()}, flush=True)


def learned(
    seed: int,
    *,
    name: str,
    method: str,
    steps: int,
    every: int,
    worlds: int,
    device: str,
    out: Path,
    saves: bool,
) -> list[dict[str, Any]]:
    """Return the evaluations of one seed."""
    torch.set_num_threads(1)
    algorithm, settings, keywords = METHODS[method]
    policy = "MultiInputPolicy" if "Shepherd" in name else "MlpPolicy"
    if worlds == 1:
        env: Any = gymnasium.make(name, device=device, **keywords)
    else:
        settings = settings | MANY.get(method, {})
        env = WorldVecEnv(
            gymnasium.make_vec(
                name,
                worlds,
                vectorization_mode="vector_entry_point",
                device=device,
                output="torch",
                **keywords,
            )
        )
    model = algorithm(policy, env, seed=seed, device="cpu", **settings)
    told = Evaluation(name, keywords, device, every, out / f"{method}_{seed}.json", saves)
    model.learn(steps, callback=told)
    told.evaluate()
    return told.rows


def main(arguments: list[str] | None = None) -> None:
    """Learn, print and write."""
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("id", choices=GARDEN_IDS)
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("--steps", type=int, default=50_000, help="of all worlds together")
    parser.add_argument("--every", type=int, default=10_000, help="steps from one to the next row")
    parser.add_argument("--worlds", type=int, default=1, help="stepped together; 1: a single one")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="seeds that learn at the same time")
    parser.add_argument("--folder", type=Path, default=Path("runs/gardens"), help="rows of seeds")
    parser.add_argument("--save", action="store_true", help="the policies too")
    given = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    one = partial(
        learned,
        name=given.id,
        method=given.method,
        steps=given.steps,
        every=given.every,
        worlds=given.worlds,
        device=given.device,
        out=given.folder,
        saves=given.save,
    )
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=context) as pool:
        seeds = dict(zip(given.seeds, pool.map(one, given.seeds), strict=True))
    if given.output is not None:
        write_record(given.output, {**script_facts(given), "seeds": seeds})


if __name__ == "__main__":
    main()
