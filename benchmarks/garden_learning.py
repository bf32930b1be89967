"""How Stable-Baselines3's PPO and SAC learn to garden and to shepherd; run with --help.

    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --steps 50000 --jobs 3
    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --worlds 256 --steps 1000000

One process learns with each seed. As it learns, its policy without exploration is paid for the
episodes of `npa_envs.agents.learning.problem.EVALUATION_SEEDS`: told are the mean reward of a step
with its standard error over episodes and, of shepherds, how many creatures were at their goal and
whole in the last step. Rows of a seed are written to the folder after each evaluation, with
`--save` beside the policy.

With `--last-episodes 128` the policies that were learned last are paid for so many other episodes,
and so are nobody, random actions and the script. What is told of the learned ones besides is how
much more they earn than the script in the same episodes, with the standard error over episodes.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from scripts import script_facts, script_parser
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.agents.comparison.run import FIRST_TEST_SEED
from npa_envs.agents.gardening import (
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning.problem import EVALUATION_SEEDS
from npa_envs.files import write_text
from npa_envs.measure.record import write_record
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


def make_envs(name: str, count: int, device: str, keywords: dict[str, Any]) -> Any:
    """Return so many worlds to be paid in."""
    return gymnasium.make_vec(
        name, count, vectorization_mode="vector_entry_point", device=device, **keywords
    )


def paid(envs: Any, act: Callable[[Any], Any], seeds: range) -> dict[str, list[float]]:
    """Return the mean reward of a step, and the success of shepherds, for each episode."""
    limit = envs.spec.max_episode_steps
    earned = np.zeros(len(seeds))
    seen, _ = envs.reset(seed=list(seeds))
    for _ in range(limit):
        seen, rewards, _, _, infos = envs.step(act(seen))
        earned += rewards / limit
    told = {"reward": earned.tolist()}
    if "is_success" in infos["final_info"]:
        told["success"] = np.asarray(infos["final_info"]["is_success"], dtype=float).tolist()
    return told


def mean_and_error(values: Any) -> tuple[float, float]:
    """Return the mean of some numbers with its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values)))


def summary(told: dict[str, list[float]]) -> dict[str, float]:
    """Return the means of what `paid` returns."""
    mean, error = mean_and_error(told["reward"])
    row = {"reward": mean, "error": error}
    if "success" in told:
        row["success"] = float(np.mean(told["success"]))
    return row


class Evaluation(BaseCallback):
    """Evaluate every so many steps, write what came of it, and stop when the time is over."""

    def __init__(self, envs: Any, every: int, seconds: float, path: Path, *, saves: bool) -> None:
        super().__init__()
        self._envs = envs
        self._every, self._path, self._saves = every, path, saves
        self._begun, self._next = time.perf_counter(), 0
        self._end = self._begun + seconds
        self.rows: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            self.evaluate()
        return time.perf_counter() < self._end

    def act(self, seen: Any) -> Any:
        """Return what the policy does without exploration."""
        return self.model.predict(seen, deterministic=True)[0]

    def evaluate(self) -> None:
        """Add a row about the policy as it is."""
        learned = time.perf_counter() - self._begun
        told = summary(paid(self._envs, self.act, EVALUATION_SEEDS))
        row = {"steps": self.num_timesteps, "seconds": learned, **told}
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
    seconds: float,
    worlds: int,
    last_episodes: int,
    device: str,
    out: Path,
    saves: bool,
) -> tuple[list[dict[str, Any]], dict[str, list[float]]]:
    """Return the evaluations of one seed, and what it is paid for the last episodes."""
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
    envs = make_envs(name, len(EVALUATION_SEEDS), device, keywords)
    told = Evaluation(envs, every, seconds, out / f"{method}_{seed}.json", saves=saves)
    model.learn(steps, callback=told)
    told.evaluate()
    if not last_episodes:
        return told.rows, {}
    envs = make_envs(name, last_episodes, device, keywords)
    return told.rows, paid(envs, told.act, last_seeds(last_episodes))


def last_seeds(count: int) -> range:
    """Return the seeds of the last episodes, in which nothing is learned or chosen."""
    return range(FIRST_TEST_SEED, FIRST_TEST_SEED + count)


def unlearned(name: str, method: str, count: int, device: str) -> dict[str, dict[str, list[float]]]:
    """Return what policies that learn nothing are paid for the last episodes."""
    envs = make_envs(name, count, device, METHODS[method][2])
    scripted = ScriptedShepherd if "Shepherd" in name else ScriptedGardener
    makes = {"zero": StillGardener, "random": RandomGardener, "scripted": scripted}
    return {policy: paid(envs, make(envs), last_seeds(count)) for policy, make in makes.items()}


def compared(
    seeds: dict[int, dict[str, list[float]]], others: dict[str, dict[str, list[float]]]
) -> dict[str, Any]:
    """Return what all earn in the last episodes, and by how much the learned exceed the script."""
    rows: dict[str, Any] = {policy: summary(told) for policy, told in others.items()}
    script = np.array(others["scripted"]["reward"])
    for seed, told in seeds.items():
        more, error = mean_and_error(np.array(told["reward"]) - script)
        rows[f"seed {seed}"] = {**summary(told), "more": more, "more_error": error}
    return rows


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
    parser.add_argument("--seconds", type=float, default=math.inf, help="to learn for, at most")
    parser.add_argument("--last-episodes", type=int, default=0, help="to compare all policies in")
    parser.add_argument("--save", action="store_true", help="the policies too")
    given = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    one = partial(
        learned,
        name=given.id,
        method=given.method,
        steps=given.steps,
        every=given.every,
        seconds=given.seconds,
        last_episodes=given.last_episodes,
        worlds=given.worlds,
        device=given.device,
        out=given.folder,
        saves=given.save,
    )
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=context) as pool:
        found = dict(zip(given.seeds, pool.map(one, given.seeds), strict=True))
    told: dict[str, Any] = {"seeds": {seed: rows for seed, (rows, _) in found.items()}}
    if given.last_episodes:
        others = unlearned(given.id, given.method, given.last_episodes, given.device)
        told["last"] = compared({seed: last for seed, (_, last) in found.items()}, others)
        for policy, row in told["last"].items():
            print(policy, {name: round(value, 3) for name, value in row.items()})
    if given.output is not None:
        write_record(given.output, {**script_facts(given), **told})


if __name__ == "__main__":
    main()
