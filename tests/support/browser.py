"""A headless Chromium for tests, spoken to by its own DevTools protocol.

No driver is installed for it: the protocol is JSON over a WebSocket, and `websockets` is here with
the viewer's server.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

DISABLED = ("gpu", "quic", "dev-shm-usage", "background-networking", "component-update", "sync")
FLAGS = (
    *("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--no-first-run"),
    *(f"--disable-{name}" for name in DISABLED),
    *("--hide-scrollbars", "--remote-debugging-port=0"),
)
DESK, PHONE = (1280, 800), (390, 844)


def chromium() -> str:
    """Return where Chromium is; skip the test where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    return path


class Page:
    """One page of a running Chromium."""

    def __init__(self, address: str) -> None:
        connect = pytest.importorskip("websockets.sync.client").connect
        self._open = contextlib.ExitStack()
        self._socket = self._open.enter_context(
            connect(address, max_size=2**28, max_queue=None, open_timeout=120)
        )
        self._numbers = itertools.count(1)
        self.complaints: list[str] = []
        """What the page wrote to the console as warnings and errors, and what it failed to load;
        not what the browser itself warns of, such as slow drivers."""
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """Return the result of a command of the protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]
            self._collect_complaints(message)

    def _collect_complaints(self, message: dict[str, Any]) -> None:
        params = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                details = params["exceptionDetails"]
                text = details.get("exception", {}).get("description", details["text"])
                self.complaints.append(text)
            case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning"):
                self.complaints.append(" ".join(str(a.get("value")) for a in params["args"]))
            case "Log.entryAdded" if params["entry"]["level"] == "error":
                self.complaints.append(
                    params["entry"]["text"] + " " + params["entry"].get("url", "")
                )
            case "Network.loadingFailed" if not params.get("canceled"):
                self.complaints.append(f"not loaded: {params['errorText']}")

    def open(self, address: str, size: tuple[int, int] = DESK, *, light: bool = False) -> None:
        """Show an address on a screen of some size [pixels]; the smaller one is a phone's."""
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=size == PHONE,
        )  # fmt: skip
        self.call("Emulation.setTouchEmulationEnabled", enabled=size == PHONE)
        scheme = {"name": "prefers-color-scheme", "value": "light" if light else "dark"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page; promises are waited for."""
        done = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait(self, script: str, seconds: float = 120.0) -> Any:
        """Return the value of an expression as soon as it is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = self.run(f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()")
            if value:
                return value
            time.sleep(0.05)
        raise AssertionError(f"never true: {script}; the page says {self.complaints}")

    def drag(self, points: list[tuple[float, float]]) -> None:
        """Press the mouse at the first point on the page [pixels], move on, and let go."""
        button = {"button": "left", "buttons": 1, "clickCount": 1}
        kinds = ["mousePressed", *["mouseMoved"] * (len(points) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, [*points, points[-1]], strict=True):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)
            time.sleep(0.03)

    def touch(self, points: list[tuple[float, float]]) -> None:
        """Touch the first point on the page [pixels], move on, and let go."""
        for k, (x, y) in enumerate(points):
            kind = "touchStart" if k == 0 else "touchMove"
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y}])
            time.sleep(0.03)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def picture(self, path: Path) -> None:
        """Write what is on the screen to a PNG file."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def close(self) -> None:
        """Let go of the page."""
        self._open.close()


@contextlib.contextmanager
def browser(folder: Path, *flags: str) -> Iterator[Callable[[], Page]]:
    """Run a Chromium with its profile in a folder; gives a function that returns a new page."""
    command = [chromium(), *FLAGS, *flags, f"--user-data-dir={folder}", "about:blank"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            port_file = folder / "DevToolsActivePort"
            end = time.monotonic() + 60
            while not (port_file.is_file() and port_file.read_text(encoding="utf-8").count("\n")):
                assert process.poll() is None, "Chromium did not start"
                assert time.monotonic() < end, "Chromium does not answer"
                time.sleep(0.05)
            base = f"http://127.0.0.1:{port_file.read_text('utf-8').split()[0]}"
            pages = []

            def new_page() -> Page:
                request = urllib.request.Request(f"{base}/json/new?about:blank", method="PUT")
                with urllib.request.urlopen(request, timeout=30) as answer:
                    pages.append(Page(json.load(answer)["webSocketDebuggerUrl"]))
                return pages[-1]

            yield new_page
            for page in pages:
                page.close()
        finally:
            process.terminate()
            process.wait(timeout=30)
