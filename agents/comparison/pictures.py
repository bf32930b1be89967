"""What each method grew: the last picture of a held-out episode, a column for each method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from npa_envs.agents.comparison.plan import AXES, Axis
from npa_envs.agents.comparison.record import RunRecord
from npa_envs.agents.learning.problem import Problem
from npa_envs.render import write_filmstrip

PICTURE = "picture.png"
"""Name of a run's picture within its folder."""

SIZE = 192
"""Pixels on each side of a picture."""


def final_picture(
    problem: Problem, policy: Callable[[Any], Any], seed: int, *, device: str
) -> NDArray[np.uint8]:
    """Return a picture of the world at the end of an episode, uint8, shape [SIZE, SIZE, 3].

    Args:
        problem: Where.
        policy: Maps observations, [1, N, P], to actions, [1, N, A].
        seed: Of the episode.
        device: Where the world lives.
    """
    seen = {"render_mode": "rgb_array", "render_size": SIZE}
    # One step more, as a world that is over shows the next episode's start.
    longer = replace(
        problem,
        keywords={**problem.keywords, **seen},
        episode_steps=problem.episode_steps + 1,
    )
    envs = longer.make_envs(1, device=device)
    observation, _ = envs.reset(seed=[seed])
    picture = _rendered(envs)
    for _ in range(problem.episode_steps):
        observation, _, terminated, truncated, _ = envs.step(policy(observation))
        if bool(terminated | truncated):
            break
        picture = _rendered(envs)
    envs.close()
    return picture


def write_strips(records: Sequence[RunRecord], folder: Path) -> list[Path]:
    """Write a filmstrip for each task and axis: a column for each method, a row for each seed.

    Args:
        records: Those of the runs.
        folder: The comparison's folder, where the runs' pictures are.

    Returns:
        The files.

    Raises:
        NPAError: A file cannot be written.
    """
    written = []
    for axis in AXES:
        for task in dict.fromkeys(r.job.task for r in records if r.job.axis == axis):
            some = [r for r in records if (r.job.axis, r.job.task) == (axis, task)]
            path = folder / strip_name(task, axis)
            _write_strip(some, folder, path)
            written.append(path)
    return written


def strip_name(task: str, axis: Axis) -> str:
    """Return the name of the file that shows what was grown."""
    return f"grown_{task}_{axis}.png"


def _write_strip(records: Sequence[RunRecord], folder: Path, path: Path) -> None:
    found = {(record.job.method, record.job.seed): record for record in records}
    methods = list(dict.fromkeys(method for method, _ in found))
    seeds = sorted({seed for _, seed in found})
    frames, captions = [], []
    for seed in seeds:
        for method in methods:
            record = found.get((method, seed))
            frames.append(_frame(record, folder))
            captions.append(_caption(method, seed, record))
    write_filmstrip(path, frames, captions, columns=len(methods))


def _frame(record: RunRecord | None, folder: Path) -> NDArray[np.uint8]:
    """Return a run's picture, or an empty one where it has none."""
    path = None if record is None else folder / record.job.folder / PICTURE
    if path is None or not path.exists():
        return np.full((SIZE, SIZE, 3), 255, np.uint8)
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def _caption(method: str, seed: int, record: RunRecord | None) -> str:
    if record is None:
        return f"{method}, seed {seed}: not run"
    if record.status != "done":
        return f"{method}, seed {seed}: {record.status}"
    return f"{method}, seed {seed}: loss {record.mean_loss:.3f}"


def _rendered(envs: Any) -> NDArray[np.uint8]:
    """Return a picture of the only world."""
    (picture,) = getattr(envs, "species_env", envs).render()
    frame: NDArray[np.uint8] = picture
    return frame
