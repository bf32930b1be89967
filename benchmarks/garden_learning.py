"""Learning curves of Stable-Baselines3's PPO and SAC in gardens; run with --help.

    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --steps 50000 --jobs 3
    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --worlds 256 --steps 1000000

One process learns with each seed. During learning its policy is evaluated without exploration in
the episodes of `npa_envs.agents.learning.problem.EVALUATION_SEEDS`: rows have the mean reward of a
step with its standard error over episodes and, for shepherds, the success rate. The rows of a seed
are written to the folder after each evaluation, with `--save` also the policy.

`--last-episodes 128` evaluates the last policies, and the baselines zero, random and scripted, in
128 other episodes. Rows of learned policies then have the difference to the script's reward in the
same episodes, with its standard error.
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
from npa_envs.agents.comparison.single_run import FIRST_TEST_SEED
from npa_envs.agents.garden_policies import (
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning.problem import EVALUATION_SEEDS
from npa_envs.atomic_files import write_text
from npa_envs.measure.benchmark_records import write_record
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
"""Algorithm, its options, and keywords of the environment."""

MANY = {
    "ppo": {
        "n_steps": 32,
        "batch_size": 1024,
        "n_epochs": 5,
        "policy_kwargs": {"log_std_init": -1.0},
    }
}
"""Further options with several worlds."""


def make_envs(name: str, count: int, device: str, keywords: dict[str, Any]) -> Any:
    """Return `count` worlds for evaluation."""
    return gymnasium.make_vec(
        name, count, vectorization_mode="vector_entry_point", device=device, **keywords
    )


def episode_means(envs: Any, act: Callable[[Any], Any], seeds: range) -> dict[str, list[float]]:
    """Return the mean reward of a step, and the success of shepherds, for each episode."""
    limit = envs.spec.max_episode_steps
    reward = np.zeros(len(seeds))
    observation, _ = envs.reset(seed=list(seeds))
    for _ in range(limit):
        observation, rewards, _, _, infos = envs.step(act(observation))
        reward += rewards / limit
    means = {"reward": reward.tolist()}
    if "is_success" in infos["final_info"]:
        means["success"] = np.asarray(infos["final_info"]["is_success"], dtype=float).tolist()
    return means


def mean_and_error(values: Any) -> tuple[float, float]:
    """Return the mean of some numbers with its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values)))


def summary(means: dict[str, list[float]]) -> dict[str, float]:
    """Return the means over the episodes of `episode_means`."""
    mean, error = mean_and_error(means["reward"])
    row = {"reward": mean, "error": error}
    if "success" in means:
        row["success"] = float(np.mean(means["success"]))
    return row


class Evaluation(BaseCallback):
    """Evaluate every `every` steps, write the rows, and stop at the time limit."""

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

    def act(self, observation: Any) -> Any:
        """Return the policy's action without exploration."""
        return self.model.predict(observation, deterministic=True)[0]

    def evaluate(self) -> None:
        """Evaluate the current policy and add a row."""
        learned = time.perf_counter() - self._begun
        means = summary(episode_means(self._envs, self.act, EVALUATION_SEEDS))
        row = {"steps": self.num_timesteps, "seconds": learned, **means}
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
    """Learn with a seed; return its evaluations, and `episode_means` of the last episodes."""
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
    evaluation = Evaluation(envs, every, seconds, out / f"{method}_{seed}.json", saves=saves)
    model.learn(steps, callback=evaluation)
    evaluation.evaluate()
    if not last_episodes:
        return evaluation.rows, {}
    envs = make_envs(name, last_episodes, device, keywords)
    return evaluation.rows, episode_means(envs, evaluation.act, last_seeds(last_episodes))


def last_seeds(count: int) -> range:
    """Return the seeds of the last episodes, which are not used for learning or evaluation."""
    return range(FIRST_TEST_SEED, FIRST_TEST_SEED + count)


def unlearned(name: str, method: str, count: int, device: str) -> dict[str, dict[str, list[float]]]:
    """Return `episode_means` of the baselines in the last episodes."""
    envs = make_envs(name, count, device, METHODS[method][2])
    scripted = ScriptedShepherd if "Shepherd" in name else ScriptedGardener
    makes = {"zero": StillGardener, "random": RandomGardener, "scripted": scripted}
    seeds = last_seeds(count)
    return {policy: episode_means(envs, make(envs), seeds) for policy, make in makes.items()}


def compared(
    seeds: dict[int, dict[str, list[float]]], others: dict[str, dict[str, list[float]]]
) -> dict[str, Any]:
    """Return rows of all policies in the last episodes, with differences to the script."""
    rows: dict[str, Any] = {policy: summary(means) for policy, means in others.items()}
    script = np.array(others["scripted"]["reward"])
    for seed, means in seeds.items():
        more, error = mean_and_error(np.array(means["reward"]) - script)
        rows[f"seed {seed}"] = {**summary(means), "more": more, "more_error": error}
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Learn, print and write."""
    parser = script_parser((__doc__ or "").split("\n")[0])
    parser.add_argument("id", choices=GARDEN_IDS)
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("--steps", type=int, default=50_000, help="steps of all worlds together")
    parser.add_argument("--every", type=int, default=10_000, help="steps between rows")
    parser.add_argument("--worlds", type=int, default=1, help="worlds that are stepped together")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="seeds that learn at the same time")
    parser.add_argument("--folder", type=Path, default=Path("runs/gardens"), help="of the rows")
    parser.add_argument("--seconds", type=float, default=math.inf, help="time limit of learning")
    parser.add_argument("--last-episodes", type=int, default=0, help="to compare policies in")
    parser.add_argument("--save", action="store_true", help="write the policies")
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
    results: dict[str, Any] = {"seeds": {seed: rows for seed, (rows, _) in found.items()}}
    if given.last_episodes:
        others = unlearned(given.id, given.method, given.last_episodes, given.device)
        results["last"] = compared({seed: last for seed, (_, last) in found.items()}, others)
        for policy, row in results["last"].items():
            print(policy, {name: round(value, 3) for name, value in row.items()})
    if given.output is not None:
        write_record(given.output, {**script_facts(given), **results})


if __name__ == "__main__":
    main()
