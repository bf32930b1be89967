"""Is what the library computes bit for bit what it was at a commit? Run by `make golden-check`.

The file `commit` beside this one names the reference: it is checked out into a temporary folder,
both trees run their own `wide.py` at the same time, and all arrays are compared. Other words on the
command line: a beginning of scenes' names, to run only those.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]

ACCEPTED: dict[str, str] = {
    r".*(points|PointClassification|digits).*/picture": "class 9 is drawn in lavender",
    r"names/.*": "uniform_ball is public, NumericInfos is gone",
}
"""Patterns, which names of arrays begin with that may differ or be on one side alone, and why."""


def start(tree, folder, only):
    """Run the scenes of a tree; they are written to `out.npz` in a folder."""
    folder.mkdir()
    tests = tree / "tests"
    # In older commits the modules of `support` are in `tests` itself.
    paths = os.pathsep.join(map(str, (tree, tests, tests / "golden")))
    variables = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    script = str(tests / "golden" / "wide.py")
    command = [sys.executable, "-P", "-W", "ignore", script, str(folder / "out.npz"), only]
    return subprocess.Popen(command, cwd=folder, env=variables)


def difference(left, right):
    """Return in what two arrays differ, or None where all bits are the same."""
    # Texts have types by their length.
    if left.shape != right.shape or (left.dtype != right.dtype and left.dtype.kind != "U"):
        return f"{left.dtype} {left.shape}, was {right.dtype} {right.shape}"
    if left.dtype.kind == "U":
        return None if np.array_equal(left, right) else f"{left}, was {right}"[:300]
    if left.tobytes() == right.tobytes():
        return None
    if left.dtype == bool:
        return f"{int((left != right).sum())} of {left.size} flags"
    error = np.abs(left.astype(np.float64) - right.astype(np.float64))
    return f"by up to {np.nanmax(error):.3g}, where the largest is {np.nanmax(np.abs(right)):.3g}"


def read(path):
    """Return the arrays of a tree by name."""
    with np.load(path) as file:
        return {key.replace("|", "/"): file[key] for key in file.files}


def compare(new, old):
    """Return names and differences: of arrays, of which are there, and scenes that failed."""
    found, both = [], (("new", new), ("old", old))
    for name in sorted({*new, *old}):
        if name.endswith("/EXCEPTION"):
            said = [f"{word}: {side[name]}" for word, side in both if name in side]
            found.append((name, "; ".join(said)))
        elif name not in new or name not in old:
            found.append((name, "is not there any more" if name in old else "was not there"))
        elif (change := difference(new[name], old[name])) is not None:
            found.append((name, change))
    return found


def main(only=""):
    """Compare, and print what differs."""
    began = time.perf_counter()
    commit = (HERE / "commit").read_text(encoding="utf-8").strip()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        tree = folder / "reference"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            sides = {"new": ROOT, "old": tree}
            runs = [start(side, folder / name, only) for name, side in sides.items()]
            codes = [run.wait() for run in runs]
            if any(codes):
                return 2
            new, old = (read(folder / name / "out.npz") for name in sides)
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)
    found = compare(new, old)
    accepted = [name for name, _ in found if any(re.match(p, name) for p in ACCEPTED)]
    for name, said in found:
        print(f"{'accepted' if name in accepted else 'DIFFERS '} {name}: {said}")
    wrong = len(found) - len(accepted)
    size, seconds = sum(array.size for array in new.values()), time.perf_counter() - began
    print(f"{len(new)} arrays, {size} numbers, against {commit}:")
    print(f"{wrong} differ, {len(accepted)} accepted; {seconds:.0f} s")
    return 1 if wrong or not new else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
