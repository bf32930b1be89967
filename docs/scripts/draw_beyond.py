"""Draw what rules do that go beyond the paper, `docs/images/beyond_*.webp`.

    python docs/scripts/draw_beyond.py directions PLAIN EQUIVARIANT  # files of rules
    python docs/scripts/draw_beyond.py directions_upright RULE ...  # --seed-across 0.5 --angles 0
    python docs/scripts/draw_beyond.py sizes TRAINED VARIED
    python docs/scripts/draw_beyond.py division RULE
    python docs/scripts/draw_beyond.py pictures MANY
    python docs/scripts/draw_beyond.py sixty MANY               # whose pictures lie where they lay

It takes a minute or two on a CPU.
"""

from __future__ import annotations

import math
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

import npa_envs
from npa_envs.render import to_uint8, write_filmstrip
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, turned, turns
from npa_envs.training.task_of_rule import task_of_rule, tasks_of_codes
from npa_envs.world.division import living

IMAGES = Path(__file__).resolve().parents[1] / "images"
SEEDS = (1_000_000, 1_000_001, 1_000_002)
CPU = torch.device("cpu")
GROWN, AFTER, AGES = 128, 128, (512, 2048)
SIDE = 128
"""Pixels on each side of a picture, at least."""

COUNTS, RADII = (0.125, 0.25, 1.0, 4.0, 8.0), (0.5, 0.7, 1.0, 1.4, 2.0)

GROWTH = (4, 8, 12, 16, 24, 32, 64, 128)
"""Steps at which worlds that grow from one particle are drawn."""

HEALING = (16, 128)
"""Steps after half of their particles are gone."""

COLUMNS = 5
"""Pictures in a row."""

ABREAST, LATER = 20, (64, 256)
"""Targets abreast of a rule of many, and steps at which their worlds are drawn below them."""

BECOMES, AFTER_SWITCH, BLENDS = "butterfly", (0, 16, 32, 64, 128), (0.0, 0.25, 0.5, 0.75, 1.0)

Shots = list[tuple[str, NDArray[np.uint8]]]


@torch.no_grad()
def run(
    rule: npa_envs.NPARule, task: Morphogenesis2D, x: Tensor, s: Tensor, steps: int, *, seed: int
) -> tuple[Tensor, Tensor]:
    """Return worlds of a task some steps later."""
    generator = torch.Generator().manual_seed(seed)
    return npa_envs.rollout(
        rule, x, s, steps, eps=task.eps, update_prob=task.update_prob, generator=generator
    )


def task_of(
    path: str, rule: npa_envs.NPARule, particle_count: int | None = None
) -> Morphogenesis2D:
    """Return the task that a rule was trained on."""
    task = task_of_rule(path, rule, CPU, particle_count=particle_count).task
    assert isinstance(task, Morphogenesis2D), "these rules grow pictures"
    return task


def as_it_lies(task: Morphogenesis2D, x: Tensor, s: Tensor) -> NDArray[np.uint8]:
    """Return a picture of a world that is neither moved nor turned."""
    return enlarged(task.picture(x, s, centred=False)[0])


def enlarged(fields: Tensor) -> NDArray[np.uint8]:
    """Return a picture, of rgb sums and density [R, R, 4], with pixels that can be seen."""
    picture = to_uint8(fields)
    times = -(-SIDE // len(picture))
    return picture.repeat(times, axis=0).repeat(times, axis=1)


def directions(paths: list[str]) -> Shots:
    """Return grown worlds, and one turned by 90 degrees, of a plain rule and an equivariant one."""
    shots: Shots = []
    for kind, path in zip(("plain", "equivariant"), paths, strict=True):
        rule = npa_envs.load_rule(path)
        task = task_of(path, rule)
        for seed in SEEDS:
            generator = torch.Generator().manual_seed(seed)
            x, s = run(rule, task, *task.seed(1, generator=generator)[:2], GROWN, seed=seed)
            shots.append((f"{kind}, step {GROWN}", as_it_lies(task, x, s)))
        quarter = turns(torch.tensor([0.5 * math.pi]), torch.ones(1))
        x = turned(x, quarter)
        shots.append(("turned", as_it_lies(task, x, s)))
        x, s = run(rule, task, x, s, AFTER, seed=SEEDS[0])
        shots.append((f"{AFTER} steps later", as_it_lies(task, x, s)))
    return shots


def directions_upright(paths: list[str]) -> Shots:
    """Return targets, and what equivariant rules grow of them.

    After each the same world, turned by 90 degrees and some steps later, and left alone; moved as
    the loss does, half as large as it is compared.
    """
    shots: Shots = []
    quarter = turns(torch.tensor([0.5 * math.pi]), torch.ones(1))
    for path in paths:
        rule = npa_envs.load_rule(path)
        task = task_of(path, rule)
        shots.append(("target", enlarged(task.target_picture)[::2, ::2]))
        generator = torch.Generator().manual_seed(SEEDS[0])
        x, s = run(rule, task, *task.seed(1, generator=generator)[:2], GROWN, seed=SEEDS[0])
        shots.append((f"step {GROWN}", as_it_lies(task, x, s)[::2, ::2]))
        y, u = run(rule, task, turned(x, quarter), s, AFTER, seed=SEEDS[1])
        shots.append((f"turned, {AFTER} later", as_it_lies(task, y, u)[::2, ::2]))
        for before, after in pairwise((GROWN, *AGES)):
            x, s = run(rule, task, x, s, after - before, seed=SEEDS[0] + after)
            shots.append((f"step {after}", as_it_lies(task, x, s)[::2, ::2]))
    return shots


def sizes(paths: list[str]) -> Shots:
    """Return worlds of other numbers of particles and of other radii, of two rules."""
    shots: Shots = []
    for path in paths:
        rule = npa_envs.load_rule(path)
        trained = task_of(path, rule)
        for share in COUNTS:
            count = round(share * trained.config.particle_count)
            task = task_of(path, rule, count)
            generator = torch.Generator().manual_seed(SEEDS[0])
            x, s = run(rule, task, *task.seed(1, generator=generator)[:2], GROWN, seed=SEEDS[0])
            shots.append((f"N = {count}", as_it_lies(task, x, s)))
        for share in RADII:
            # A larger radius is a smaller disk: scaling both is a symmetry.
            generator = torch.Generator().manual_seed(SEEDS[0])
            x, s, *_ = trained.seed(1, generator=generator)
            x, s = run(rule, trained, x / share, s, GROWN, seed=SEEDS[0])
            shots.append((f"{share:g} x radius", as_it_lies(trained, x, s)))
    return shots


def division(paths: list[str]) -> Shots:
    """Return a world that grows from one particle, loses a half, and grows it again."""
    rule = npa_envs.load_rule(paths[0])
    task = task_of(paths[0], rule)
    x, s, *_ = task.seed(1, generator=torch.Generator())
    shots: Shots = [("step 0: 1 lives", as_it_lies(task, x, s))]
    step = 0
    for steps in GROWTH:
        x, s = run(rule, task, x, s, steps - step, seed=SEEDS[0] + steps)
        step = steps
        shots.append((f"step {step}: {int(living(s).sum())}", as_it_lies(task, x, s)))
    alive = living(s)
    second = alive.cumsum(dim=1) % 2 == 0
    side = x[..., 0] > x[alive][:, 0].median()
    for name, gone in (("each second gone", second), ("one side gone", side)):
        y, u = x, torch.where(gone[..., None], 0.0, s)
        shots.append((f"{name}: {int(living(u).sum())}", as_it_lies(task, y, u)))
        for before, later in pairwise((0, *HEALING)):
            y, u = run(rule, task, y, u, later - before, seed=SEEDS[1] + later)
            shots.append((f"{later} later: {int(living(u).sum())}", as_it_lies(task, y, u)))
    return shots


def pictures(paths: list[str]) -> Shots:
    """Return targets, what their codes grow, a world whose code is switched, and blended codes."""
    (path,) = paths
    rule = npa_envs.load_rule(path)
    assert rule.codes is not None, "a rule of many pictures"
    names = rule.codes.names[:COLUMNS]
    found = [task_of_rule(path, rule, CPU, target=name).task for name in names]
    tasks = [task for task in found if isinstance(task, Morphogenesis2D)]
    blank = tasks[0].seed(1, generator=torch.Generator().manual_seed(SEEDS[0]))[:2]
    shots = [(f"{task.target.name}, target", enlarged(task.target_picture)) for task in tasks]
    for task in tasks:
        x, s = run(rule, task, blank[0], task.with_target_code(blank[1]), GROWN, seed=SEEDS[0])
        shots.append((f"grown, step {GROWN}", as_it_lies(task, x, s)))
    first, task = names[0], tasks[0]
    x, s = run(rule, task, *blank, GROWN, seed=SEEDS[0])
    s = rule.with_code(s, rule.codes[BECOMES])
    shots.append((f"{first} told {BECOMES}", as_it_lies(task, x, s)))
    for before, after in pairwise(AFTER_SWITCH):
        x, s = run(rule, task, x, s, after - before, seed=SEEDS[0] + after)
        shots.append((f"{after} steps later", as_it_lies(task, x, s)))
    for share in BLENDS:
        code = rule.codes.blend({first: 1.0 - share, BECOMES: share})
        x, s = run(rule, task, blank[0], rule.with_code(blank[1], code), GROWN, seed=SEEDS[0])
        shots.append((f"{1.0 - share:g} {first} + {share:g} {BECOMES}", as_it_lies(task, x, s)))
    return shots


@torch.no_grad()
def sixty(path: str) -> Image.Image:
    """Return targets of a rule's codes, and below each what it grows after 64 and 256 steps."""
    rule = npa_envs.load_rule(path)
    tiles = []
    for task in tasks_of_codes(path, rule, CPU):
        x, s, *_ = task.seed(1, generator=torch.Generator().manual_seed(SEEDS[0]))
        tile = [to_uint8(task.target_picture)]
        for before, after in pairwise((0, *LATER)):
            x, s = run(rule, task, x, s, after - before, seed=SEEDS[0] + after)
            tile.append(to_uint8(task.picture(x, s)[0]))
        tiles.append(np.concatenate(tile))
    rows = [np.concatenate(tiles[k : k + ABREAST], axis=1) for k in range(0, len(tiles), ABREAST)]
    return Image.fromarray(np.concatenate(rows))


def main() -> None:
    """Draw what the command line asks for."""
    what, *rest = sys.argv[1:]
    if what == "sixty":
        sixty(rest[0]).save(IMAGES / "beyond_sixty.webp", quality=88, method=6)
        return
    kinds = {
        "directions": directions,
        "directions_upright": directions_upright,
        "sizes": sizes,
        "division": division,
        "pictures": pictures,
    }
    draw = kinds[what]
    captions, frames = zip(*draw(rest), strict=True)
    write_filmstrip(IMAGES / f"beyond_{what}.webp", frames, captions, columns=COLUMNS)


if __name__ == "__main__":
    main()
