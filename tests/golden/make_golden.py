"""Write the golden files anew: only at a commit whose results are known to be right.

Run by hand with the library importable: `OMP_NUM_THREADS=1 python tests/golden/make_golden.py`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import names
import numpy as np
import runs
import scenes
import torch

import npa_envs
from npa_envs.trained_tasks import task_of_rule

FOLDER = Path(__file__).resolve().parent

PARTICLES = {"gecko": 192, "dots": 288, "duck": 160, "digits": 160}
"""Particles of the stored worlds."""

STEPS = {"gecko": 32, "dots": 32, "duck": 24, "digits": 12}
"""Steps of the stored worlds from the seed."""

SEEDS = {"gecko": 1, "dots": 5, "duck": 6, "digits": 3}
"""Seeds of worlds in which rounding stays small: no particle is near a jump of the dynamics."""


def grow(name: str) -> dict[str, np.ndarray]:
    """Return two worlds of a shipped rule after some steps from the seed of its task."""
    rule = scenes.rule_named(name)
    # As many particles as are stored fill a smaller ball.
    fields = {"seed_radius": 0.25} if rule.space_dim == 3 else {}
    count = PARTICLES[name]
    source = str(scenes.KEPT_RULES.get(name, name))
    task = task_of_rule(source, rule, torch.device("cpu"), particle_count=count, **fields).task
    used = {"eps": task.eps, "box": task.box}
    assert used == scenes.RULES[name], f"{name} is run with {used}"
    generator = torch.Generator().manual_seed(SEEDS[name])
    x, s, _ = task.seed(2, generator=generator, device=torch.device("cpu"))
    with torch.no_grad():
        x, s = npa_envs.rollout(rule, x, s, STEPS[name], generator=generator, **used)
    return {f"world/{name}/x": x.numpy(), f"world/{name}/s": s.numpy()}


def run_and_kill(task: str, folder: Path) -> None:
    """Write the folder of a run that was killed between two checkpoints."""
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, "-m", "npa_envs.cli", "train", task, *runs.OPTIONS]
        process = subprocess.Popen([*command, "--out", "run"], cwd=place)
        log = Path(place) / "run" / "log.jsonl"
        while process.poll() is None:
            time.sleep(0.002)
            if (
                log.is_file()
                and len(log.read_text(encoding="utf-8").splitlines()) > runs.CHECKPOINT_INTERVAL
            ):
                break
        process.kill()
        process.wait()
        runs.keep(Path(place) / "run", folder)
        subprocess.run(
            [*command, "--out", "whole"], cwd=place, check=True, stdout=subprocess.DEVNULL
        )
        whole = (Path(place) / "whole" / "log.jsonl").read_text(encoding="utf-8")
        (folder / "whole_log.jsonl").write_text(whole, encoding="utf-8")


def main() -> None:
    """Write all of it."""
    torch.set_num_threads(1)
    # Helps of commands are wrapped no narrower than the test reads them.
    os.environ["COLUMNS"] = "200"
    arrays: dict[str, np.ndarray] = {}
    for name in scenes.RULES:
        arrays |= grow(name)
    # Scenes read the worlds from the file.
    np.savez_compressed(scenes.GOLDEN, **arrays)
    for name in scenes.SCENES:
        began = time.perf_counter()
        arrays |= scenes.compute(name)
        print(f"{name}: {time.perf_counter() - began:.2f} s")
    np.savez_compressed(scenes.GOLDEN, **arrays)
    content = names.everything() | {"documented": names.documented(FOLDER.parents[1])}
    (FOLDER / "golden.json").write_text(
        json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8"
    )
    for task, folder in runs.FOLDERS.items():
        run_and_kill(task, FOLDER / folder)


if __name__ == "__main__":
    main()
