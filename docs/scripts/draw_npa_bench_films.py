"""Draw `docs/images/npa_bench_films.webp`: an episode of the best policy of each id of NPA-Bench.

    npa-envs compare --suite npa-bench-v0 --seed-count 1 --methods gradient shac --out bench
    npa-envs compare --suite npa-bench-small-v0 --seed-count 1 --methods gradient shac --out small
    python docs/scripts/draw_npa_bench_films.py bench small

The best method of an id has the largest mean return in the stored rows, of the first suite that has
the id. Its run with seed 0 is in one of the given folders; in gardens `gradient` plans and needs no
run. The episode is the first held-out one.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from build_npa_bench_page import ROWS, plain_name
from films import IMAGES, STILL, Frame
from npa_bench_rows import read_rows
from PIL import Image

from npa_envs.agents.comparison.npa_bench import SUITES, task_name
from npa_envs.agents.comparison.single_run import FIRST_TEST_SEED
from npa_envs.agents.garden_policies import GradientGardener
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.registration import GARDEN_IDS
from npa_envs.render import write_filmstrip, write_webp

SIDE, COLUMNS, FPS = 160, 5, 10.0
"""Pixels on each side of a world, worlds side by side, frames a second."""
METHODS = "gradient", "shac"
"""Methods of which one is the best of every id."""


def best_methods() -> dict[str, tuple[Problem, str]]:
    """Return the problem and the best method of each id."""
    best: dict[str, tuple[Problem, str]] = {}
    for suite in SUITES.values():
        rows = read_rows(suite, ROWS / plain_name(suite))
        for env_id in [name for name in suite.budgets if name not in best]:
            returns = {name: rows[name].returns(env_id) for name in METHODS}
            means = {name: float(found.mean()) for name, found in returns.items() if len(found)}
            best[env_id] = suite.problem_of(task_name(env_id)), max(means, key=means.__getitem__)
    return dict(sorted(best.items(), key=lambda item: item[0] in GARDEN_IDS))


def episode(problem: Problem, policy_of: Any) -> list[Frame]:
    """Return the pictures of the first held-out episode, with one more at the beginning."""
    keywords = {**problem.keywords, "render_mode": "rgb_array", "render_size": SIDE}
    longer = replace(problem, keywords=keywords, episode_steps=problem.episode_steps + 1)
    envs: Any = longer.make_envs(1)
    policy = policy_of(envs)
    observation, _ = envs.reset(seed=[FIRST_TEST_SEED])
    frames = [*envs.render()]
    for _ in range(problem.episode_steps):
        observation, _, terminated, truncated, _ = envs.step(policy(observation))
        if bool(terminated | truncated):
            break
        frames += envs.render()
    envs.close()
    return frames


def main(folders: list[Path]) -> None:
    """Draw the film."""
    films, captions = [], []
    for env_id, (problem, method) in best_methods().items():
        name = task_name(env_id)
        if env_id in GARDEN_IDS:
            films.append(episode(problem, GradientGardener))
        else:
            parts = "particle-steps", name, method, "seed-0"
            run = next((run for f in folders if (run := f.joinpath(*parts)).is_dir()), None)
            if run is None:
                print(f"left out: {name}, of which there is no run by {method}")
                continue
            policy = RuleSet.load(run, problem).policy()
            films.append(episode(problem, lambda envs, policy=policy: policy))
        captions.append(f"{name.removesuffix('-v0').removesuffix('Small')}: {method}")
    moments = [0] * STILL + [*range(max(map(len, films)))] + [-1] * 2 * STILL
    frames = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "frame.png")
        for k in moments:
            tiles = [film[min(k, len(film) - 1)] for film in films]
            write_filmstrip(path, tiles, captions, columns=COLUMNS)
            frames.append(np.asarray(Image.open(path).convert("RGB")))
    write_webp(IMAGES / "npa_bench_films.webp", frames, FPS)


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
