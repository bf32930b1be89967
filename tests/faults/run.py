"""Do the tests find faults? Run by `make faults`; words choose faults by parts of their names.

Each fault of faults.toml is put into a copy of the tree, where its tests then run. A test has to
fail: code that cannot even be imported is no fault that was found. The first line of the table that
is not "found" says what to do: carry the fault along with moved code, or write the missing test.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WANTED = 36
"""Faults of 40 that have to be found."""

JOBS = int(os.environ.get("JOBS", "2"))
"""Faults that are tried at the same time."""

LIMIT = float(os.environ.get("LIMIT", "900"))
"""Time for the tests of a fault [s]; a fault that makes them hang is found."""

OUTCOMES = {0: "MISSED", 1: "found"}
"""By pytest's exit code; all others are errors in tests, such as failing imports."""

NO_COPY = shutil.ignore_patterns(".*", "build", "demo", "runs", "*.egg-info")


def faults() -> list[dict[str, Any]]:
    """Return the table."""
    found: list[dict[str, Any]] = tomllib.loads((HERE / "faults.toml").read_text("utf-8"))["fault"]
    return found


def stale(fault: dict[str, Any]) -> str | None:
    """Return why a fault does not fit the tree any more, or None."""
    path = ROOT / fault["file"]
    count = path.read_text("utf-8").count(fault["old"]) if path.is_file() else 0
    missing = [name for name in fault["tests"] if not (ROOT / name).exists()]
    if count != 1:
        return f"{fault['file']} has its text {count} times, not once"
    if fault["old"] == fault["new"]:
        return "it changes nothing"
    return f"there are no tests {', '.join(missing)}" if missing else None


def run_tests(tree: Path, tests: list[str], again: bool = False) -> tuple[str, str]:
    """Run tests of a tree; return the outcome and what failed first."""
    variables = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(tree)}
    plain = ["-x", "-q", "--no-header", "--tb=line", "-p", "no:cacheprovider", "-W", "ignore"]
    command = [sys.executable, "-m", "pytest", *plain, "-m", "not slow", *tests]
    try:
        done = subprocess.run(
            command,
            cwd=tree,
            env=variables,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            encoding="utf-8",
        )
    except subprocess.TimeoutExpired:
        return "found", f"no end within {LIMIT:.0f} s"
    lines = done.stdout.splitlines()
    failed = [line for line in lines if line.startswith("FAILED")]
    if done.returncode == 1 and failed and not again:
        # A test of time may fail because the machine is busy, and then not a second time.
        name = failed[0].removeprefix("FAILED ").split(" - ")[0]
        outcome, _ = run_tests(tree, [name], again=True)
        return ("found" if outcome == "found" else "FLAKY"), name
    said = failed[0] if failed else " ".join(lines[-1:])
    return OUTCOMES.get(done.returncode, f"ERROR {done.returncode}"), said[:150]


def try_fault(fault: dict[str, Any], trees: "SimpleQueue[Path]") -> bool:
    """Try a fault in a tree that nobody uses, and print whether it was found."""
    began, said, outcome = time.perf_counter(), stale(fault), "STALE"
    if said is None:
        tree = trees.get()
        path = tree / fault["file"]
        whole, times = path.read_text("utf-8"), path.stat()
        path.write_text(whole.replace(fault["old"], fault["new"]), "utf-8")
        try:
            outcome, said = run_tests(tree, fault["tests"])
        finally:
            path.write_text(whole, "utf-8")
            # So that Python takes what it compiled of the whole file, and not of the fault.
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            trees.put(tree)
    print(f"{outcome:8} {fault['name']} ({time.perf_counter() - began:.0f} s): {said}", flush=True)
    return outcome == "found"


def main(*words: str) -> int:
    """Try all faults, or those whose names have one of the words in them."""
    chosen = [f for f in faults() if not words or any(word in f["name"] for word in words)]
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(JOBS) as pool:
        trees: SimpleQueue[Path] = SimpleQueue()
        for job in range(JOBS):
            trees.put(Path(shutil.copytree(ROOT, Path(place) / str(job), ignore=NO_COPY)))
        found = sum(pool.map(lambda fault: try_fault(fault, trees), chosen))
    left = [said for fault in faults() if (said := stale(fault)) is not None]
    print(f"{found} of {len(chosen)} found; {len(left)} do not fit the tree any more")
    wanted = min(WANTED, len(chosen))
    return 1 if left or found < wanted else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
