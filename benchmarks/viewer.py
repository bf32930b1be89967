"""Frames a second of the viewer, with a headless Chromium on the same machine.

    python benchmarks/viewer.py gecko dots

Each rule grows as it was trained for some steps first. Serve with `--device cuda` to see what the
server alone can do there.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from browser import DESK, browser

FRAME = "document.page.frame"


def measure(rule: str, seconds: float, grown: int, words: list[str], folder: Path) -> None:
    """Print how many frames of a rule's world are drawn a second."""
    command = [sys.executable, "-m", "npa_envs.cli", "view", rule, "--no-browser", "--port", "0"]
    command += ["--out", str(folder / "films"), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        address = server.stdout.readline().split()[1]
        with browser(folder / "profile") as new_page:
            page = new_page()
            page.open(address, DESK)
            page.wait(f"{FRAME} && {FRAME}.step > {grown}", 600)
            first, start = page.run(f"{FRAME}.step"), time.monotonic()
            time.sleep(seconds)
            steps, taken = page.run(f"{FRAME}.step") - first, time.monotonic() - start
            count = page.run(f"{FRAME}.positions.length / document.page.world.dimension")
            told = (
                f"{rule}: {steps / taken:.1f} frames a second, {count} particles, "
                f"{page.run(f'{FRAME}.milliseconds'):.1f} ms a step, painter "
                f"{page.run('document.page.painter.kind')}, {os.cpu_count()} cores, load "
                f"{os.getloadavg()[0]:.1f}"
            )
        server.send_signal(signal.SIGINT)
    print(told, flush=True)


def main() -> None:
    """Measure the rules that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rules", nargs="*", default=["gecko"])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--grown", type=int, default=100)
    parser.add_argument("--device", default="cpu")
    told = parser.parse_args()
    for rule in told.rules:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            words = ["--device", told.device]
            measure(rule, told.seconds, told.grown, words, Path(folder))


if __name__ == "__main__":
    main()
