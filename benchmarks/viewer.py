"""Frames a second of the viewer, with a headless Chromium on the same machine.

    python benchmarks/viewer.py gecko dots
    python benchmarks/viewer.py gecko dots --device cuda --reader plain

Each rule grows as it was trained for some steps first. A plain reader takes frames and answers at
once, without drawing them: what the server alone can do, at most 60 frames a second.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support.browser import DESK, browser
from websockets.sync.client import connect

from npa_envs.web.server import HEADER

FRAME = "document.page.frame"


@contextlib.contextmanager
def served(rule: str, folder: Path, device: str) -> Iterator[str]:
    """Serve a rule and yield the page's address."""
    command = [sys.executable, "-m", "npa_envs", "view", rule, "--no-browser", "--port", "0"]
    command += ["--out", str(folder / "films"), "--device", device]
    with subprocess.Popen(command, stdout=subprocess.PIPE, encoding="utf-8") as server:
        assert server.stdout is not None
        try:
            yield server.stdout.readline().split()[1]
        finally:
            server.send_signal(signal.SIGINT)


def drawn(address: str, seconds: float, grown: int, folder: Path) -> str:
    """Return the frame rate of a browser that draws the world at an address, as text."""
    with browser(folder / "profile") as new_page:
        page = new_page()
        page.open(address, DESK)
        page.wait(f"{FRAME} && {FRAME}.step > {grown}", 600)
        first, start = page.run(f"{FRAME}.step"), time.monotonic()
        time.sleep(seconds)
        steps, taken = page.run(f"{FRAME}.step") - first, time.monotonic() - start
        count = page.run(f"{FRAME}.positions.length / document.page.world.dimension")
        return (
            f"{steps / taken:.1f} frames a second, {count} particles, "
            f"{page.run(f'{FRAME}.milliseconds'):.1f} ms a step, painter "
            f"{page.run('document.page.painter.kind')}"
        )


def taken(address: str, seconds: float, grown: int) -> str:
    """Return the frame rate of a reader that draws nothing, as text."""
    site = address.partition("?")[0].rstrip("/")
    times, spent, count = [], [], 0
    with connect(site.replace("http", "ws", 1) + "/socket", origin=site, max_size=None) as socket:
        while not times or times[-1] - times[0] < seconds:
            frame = socket.recv()
            if isinstance(frame, str):
                continue
            socket.send(json.dumps({"type": "drawn"}))
            step, count, _, milliseconds, _ = HEADER.unpack_from(frame)
            if step > grown:
                times.append(time.monotonic())
                spent.append(milliseconds)
    pauses = 1e3 * np.diff(times)
    return (
        f"{1e3 / pauses.mean():.1f} frames a second (99 % within {np.quantile(pauses, 0.99):.1f} "
        f"ms), {count} particles, {np.median(spent):.2f} ms a step, plain reader"
    )


def main() -> None:
    """Measure the rules that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rules", nargs="*", default=["gecko"])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--grown", type=int, default=100)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--reader", choices=["browser", "plain"], default="browser")
    told = parser.parse_args()
    for rule in told.rules:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
            folder = Path(name)
            with served(rule, folder, told.device) as address:
                if told.reader == "plain":
                    seen = taken(address, told.seconds, told.grown)
                else:
                    seen = drawn(address, told.seconds, told.grown, folder)
        load = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
        print(f"{rule}: {seen}, {told.device}, {load}", flush=True)


if __name__ == "__main__":
    main()
