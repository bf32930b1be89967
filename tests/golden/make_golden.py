"""Write the golden files anew: only at a commit whose results are known to be right.

Run by hand with the library importable: `OMP_NUM_THREADS=1 python tests/golden/make_golden.py`.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import names
import numpy as np
import scenes
import torch

import npa_envs
from npa_envs.training.task_of_rule import task_of_rule

FOLDER = Path(__file__).resolve().parent

WORLDS = {"gecko": (192, 32, 1), "dots": (288, 32, 5), "duck": (160, 24, 6), "digits": (160, 12, 3)}
"""Particles of the stored worlds, their steps, and seeds with which rounding stays small: no
particle is near a jump of the dynamics."""

CHECKPOINT_INTERVAL, ITERATIONS = 6, 12
"""Of the runs that are killed."""

OPTIONS = [
    *("--preset", "tiny", "--iterations", str(ITERATIONS), "--no-progress"),
    *("--checkpoint-interval", str(CHECKPOINT_INTERVAL)),
    *("--picture-interval", str(CHECKPOINT_INTERVAL)),
]
"""Options of these runs."""

RUNS = {"morphogenesis2d": "unfinished_run", "co_morphogenesis2d": "unfinished_joint_run"}
"""Their folders by task."""


def grow(name):
    """Return two worlds of a shipped rule after some steps from the seed of its task."""
    rule = scenes.rule_named(name)
    # As many particles as are stored fill a smaller ball.
    fields = {"seed_radius": 0.25} if rule.space_dim == 3 else {}
    count, steps, seed = WORLDS[name]
    source = str(scenes.FORMER_RULES.get(name, name))
    task = task_of_rule(source, rule, torch.device("cpu"), particle_count=count, **fields).task
    used = {"eps": task.eps, "box": task.box}
    assert used == scenes.RULES[name], f"{name} is run with {used}"
    generator = torch.Generator().manual_seed(seed)
    x, s, *_ = task.seed(2, generator=generator, device=torch.device("cpu"))
    with torch.no_grad():
        x, s = npa_envs.rollout(rule, x, s, steps, generator=generator, **used)
    return {f"world/{name}/x": x.numpy(), f"world/{name}/s": s.numpy()}


def run_and_kill(task, folder):
    """Write the folder of a run that was killed between two checkpoints."""
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, "-m", "npa_envs", "train", task, *OPTIONS]
        process = subprocess.Popen([*command, "--out", "run"], cwd=place)
        log = Path(place) / "run" / "log.jsonl"
        while process.poll() is None:
            time.sleep(0.002)
            lines = log.read_text(encoding="utf-8").splitlines() if log.is_file() else []
            if len(lines) > CHECKPOINT_INTERVAL:
                break
        process.kill()
        process.wait()
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(Path(place) / "run", folder)
        whole = [*command, "--out", "whole"]
        subprocess.run(whole, cwd=place, check=True, stdout=subprocess.DEVNULL)
        shutil.copy(Path(place) / "whole" / "log.jsonl", folder / "whole_log.jsonl")


def main():
    """Write all of it."""
    torch.set_num_threads(1)
    # Helps of commands are wrapped no narrower than the test reads them.
    os.environ["COLUMNS"] = "200"
    arrays = {key: array for name in scenes.RULES for key, array in grow(name).items()}
    # Scenes read the worlds from the file.
    np.savez_compressed(scenes.GOLDEN, **arrays)
    for name in scenes.SCENES:
        began = time.perf_counter()
        arrays |= scenes.compute(name)
        print(f"{name}: {time.perf_counter() - began:.2f} s")
    np.savez_compressed(scenes.GOLDEN, **arrays)
    content = names.everything() | {"documented": names.documented(FOLDER.parents[1])}
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    (FOLDER / "golden.json").write_text(text, encoding="utf-8")
    for task, folder in RUNS.items():
        run_and_kill(task, FOLDER / folder)


if __name__ == "__main__":
    main()
