"""The page in a real browser: it shows the world, and hands reach into it."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from PIL import Image
from support.browser import DESK, PHONE
from support.clock import wait_until

pytest.importorskip("uvicorn")

from npa_envs.web import server
from npa_envs.web.rule_world import RuleWorld

FRAME = "document.page.frame"


@pytest.fixture
def shown(new_page, tmp_path):
    """A function that serves a rule and opens it; gives the page and the world behind it.

    No page may complain in the console until the end of the test.
    """
    opened = []
    with contextlib.ExitStack() as stack:

        def show(rule="gecko", count=256, size=DESK, query="", **options):
            worlds = []

            def make_world():
                torch.set_num_threads(1)
                worlds.append(RuleWorld(rule, device=torch.device("cpu"), particle_count=count))
                return worlds[-1]

            site = server.Site(make_world, films=tmp_path / "films")
            listener = server.open_port(site.host, 0)
            viewer = server.make_server(site)
            thread = threading.Thread(target=viewer.run, kwargs={"sockets": [listener]})
            thread.start()
            stack.callback(thread.join, timeout=60)
            stack.callback(setattr, viewer, "should_exit", True)
            opened.append(page := new_page())
            stack.callback(page.open, "about:blank")
            page.open(server.address_of(site, listener) + query, size, **options)
            page.wait(f"{FRAME}.step > 2")
            return page, worlds[0]

        yield show
        complaints = [list(page.complaints) for page in opened]
    assert not any(complaints), complaints


def click(page, name: str) -> None:
    page.run(f"document.getElementById('{name}').click()")


def pause(page) -> None:
    click(page, "play")
    page.wait("!document.page.world.playing")


def take(page, brush: str) -> None:
    page.run(f"document.querySelector('[data-brush={brush}]').click()")


def positions(page) -> np.ndarray:
    return np.array(page.run(f"Array.from({FRAME}.positions)")).reshape(-1, 2)


def choose(page, name: str, value: str) -> None:
    page.run(
        f"(() => {{ const chosen = document.getElementById('{name}'); "
        f"chosen.value = {json.dumps(value)}; "
        "chosen.dispatchEvent(new Event(chosen.type === 'range' ? 'input' : 'change')); })()"
    )


def nearest(page, x: float, y: float) -> float:
    return float(np.linalg.norm(positions(page) - [x, y], axis=1).min())


def picture_of(page, path) -> np.ndarray:
    page.picture(path)
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def pixel_of(page, x: float, y: float) -> tuple[float, float]:
    """Where a position is on the page [pixels]."""
    place = page.run(
        "(() => { const { camera, canvas } = document.page; return camera.project("
        f"[{x}, {y}, 0], canvas.clientWidth, canvas.clientHeight); }})()"
    )
    return place[0], place[1]


def test_the_world_moves_the_brush_removes_and_a_slider_changes_eps(shown, tmp_path):
    page, world = shown()
    assert page.run("document.title") == "gecko · npa-envs"
    page.wait(f"{FRAME}.step > 5")
    pause(page)
    middle = positions(page).mean(axis=0)
    assert nearest(page, *middle) < 0.1
    place = [pixel_of(page, *middle)] * 3
    # The first brush wipes: no particle is lost.
    page.drag(place)
    click(page, "one")
    page.wait(f"!document.page.world.playing && {FRAME}.positions.length === 512")
    take(page, "remove")
    page.drag(place)
    page.wait(f"{FRAME}.positions.length < 512")
    # The brush of 0.1 was there.
    assert nearest(page, *middle) > 0.1
    choose(page, "eps", str(np.log(0.2)))
    # The slider has 200 places.
    page.wait("Math.abs(document.page.world.settings.eps.value - 0.2) < 0.004")
    assert world.eps == page.run("document.page.world.settings.eps.value")
    click(page, "one")
    step = page.run(f"{FRAME}.step")
    page.wait(f"{FRAME}.step >= {step} && !document.page.world.playing")
    picture = picture_of(page, tmp_path / "page.png")
    assert picture.shape == (800, 1280, 3)
    # Something green is in the middle of the canvas, and nothing in its corner.
    assert (picture[100:700, 100:900, 1] > 120).sum() > 1000
    assert np.ptp(picture[300:500, 5:60].reshape(-1, 3), axis=0).max() == 0


@pytest.mark.slow
def test_every_brush_and_every_show_works(shown):
    page, _ = shown(count=512)
    page.wait(f"{FRAME}.step > 20")
    for brush in ("wipe", "cut", "push", "clump", "noise", "inject", "graft", "add"):
        take(page, brush)
        page.drag([pixel_of(page, x, 0.0) for x in (-0.2, -0.1, 0.0, 0.1, 0.2)])
        time.sleep(0.3)
    page.wait("document.page.world.species.length === 2")
    for show in page.run("document.page.world.shows"):
        choose(page, "show", show)
        page.wait(f"document.page.world.show === {json.dumps(show)}")
    for name in ("wipe", "cut", "clump", "noise"):
        page.run(f"document.querySelector('#damages [title$={name}]').click()")
    page.run("document.getElementById('plots').open = true")
    click(page, "tracers")
    click(page, "reset")
    page.wait("document.page.world.seed === 1")
    page.wait("document.page.plots.loss.points.length > 1", 60)
    choose(page, "rule", "dots")
    page.wait("document.page.world.rule === 'dots'")
    page.wait(f"{FRAME} && {FRAME}.step > 3", 60)
    assert page.run("document.getElementById('message').hidden")


@pytest.mark.slow
def test_a_recording_yields_a_film_and_a_snapshot_a_picture(shown, tmp_path):
    page, _ = shown()
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    click(page, "record")
    step = page.run(f"{FRAME}.step")
    page.wait(f"{FRAME}.step > {step + 24}")
    click(page, "record")
    page.wait("document.querySelectorAll('#files a').length === 2", 60)
    (film,) = (tmp_path / "films").glob("*.gif")
    with Image.open(film) as frames:
        assert frames.size == (640, 640)
        assert frames.n_frames >= 4
        frames.seek(frames.n_frames - 1)
        assert len(np.unique(np.asarray(frames.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    click(page, "snapshot")
    page.wait("document.querySelectorAll('#files a').length === 3")
    (path,) = wait_until(lambda: list(tmp_path.glob("gecko-*.png")), 60)
    with Image.open(path) as picture:
        assert picture.size == (992, 800)


@pytest.mark.slow
def test_on_a_phone_fingers_brush_and_the_settings_fold(shown):
    page, _ = shown(size=PHONE, light=True)
    assert page.run("document.page.background.map((c) => Math.round(255 * c))") == [247, 246, 242]
    assert page.run("document.getElementById('panel').hidden")
    assert page.run("document.documentElement.scrollWidth") == PHONE[0]
    for left, right, bottom, size in page.run(
        "[...document.querySelectorAll('.bar button')].map((b) => { "
        "const r = b.getBoundingClientRect(); return [r.left, r.right, r.bottom, r.width]; })"
    ):
        assert (left >= 0, right <= PHONE[0], bottom <= PHONE[1], size >= 40) == (True,) * 4
    pause(page)
    middle = positions(page).mean(axis=0)
    take(page, "remove")
    page.touch([pixel_of(page, *middle)] * 2)
    page.wait(f"{FRAME}.positions.length < 512")
    click(page, "fold")
    assert page.run("document.getElementById('panel').getBoundingClientRect().width") > 300
    # The settings leave no room for more than the world.
    assert page.run("document.querySelector('header').getBoundingClientRect().width") == 0


@pytest.mark.slow
def test_in_a_low_window_the_buttons_are_one_row_that_scrolls(shown):
    page, _ = shown(size=(780, 437))
    assert page.run("document.getElementById('panel').hidden")
    click(page, "fold")
    take(page, "remove")
    buttons = "[...document.querySelectorAll('.bar button')].map((b) => b.getBoundingClientRect())"
    assert len(page.run(f"[...new Set({buttons}.map(({{ top }}) => top))]")) == 1
    chosen = "document.querySelector('[aria-checked=true]')"
    assert page.run(f"{chosen}.getBoundingClientRect().right") < 440


@pytest.mark.slow
@pytest.mark.parametrize("painter", ["canvas", "webgl2"])
def test_the_world_lies_beside_the_open_card_and_reaches_below_it(shown, painter, tmp_path):
    page, _ = shown(query=f"?painter={painter}")
    pause(page)
    page.run("document.querySelector('.stage').append(Object.assign("
             "document.createElement('section'), { id: 'training' }))")  # fmt: skip
    ends = []
    for zoom in (1, 4):
        page.run(f"(document.page.camera.zoom = {zoom}, document.page.dirty = true)")
        time.sleep(0.5)
        picture = picture_of(page, tmp_path / "page.png")[200:600, :990]
        ends.append((np.ptp(picture, axis=2).max(axis=0) > 60).nonzero()[0][-1])
    # Free are 684 of 992 columns; the right end of the magnified world lies below the card.
    assert pixel_of(page, 0.0, 0.0)[0] == pytest.approx(342)
    assert (ends[1] - 342) / 4 == pytest.approx(ends[0] - 342, abs=8)
    assert ends[1] > 700


@pytest.mark.slow
def test_the_card_stops_a_training_once(shown):
    page, _ = shown()
    before, after, sent = page.run("""(async () => {
        const { TrainingCard } = await import("./training.js");
        const sent = [], card = new TrainingCard((message) => sent.push(message));
        const event = { type: "training", state: "learning", id: "1", name: "a.png", total: 9 };
        const buttons = () => [...card.card.querySelectorAll("button")];
        const words = () => buttons().map((button) => button.textContent);
        card.listen({ ...event, iteration: 1 });
        const before = words();
        buttons().find((button) => button.textContent === "Stop").click();
        card.listen({ ...event, iteration: 2 });
        return [before, words(), sent];
    })()""")
    assert (before, after) == (["×", "Stop"], ["×"])
    assert sent == [{"type": "training", "action": "stop"}]


@pytest.mark.slow
def test_the_card_shows_the_estimated_time_until_it_is_measured(shown):
    page, _ = shown()
    first, second, third = page.run("""(async () => {
        const { TrainingCard } = await import("./training.js");
        const card = new TrainingCard(() => {});
        const event = { type: "training", id: "1", name: "a.png", expected: 220, total: 2400 };
        return [
            { state: "starting" }, { state: "learning", iteration: 10 },
            { state: "learning", iteration: 50, seconds_left: 400 },
        ].map((fields) => { card.listen({ ...event, ...fields }); return card.card.textContent; });
    })()""")
    assert "Starting the training, about 4 minutes on an idle CPU" in first
    assert "Iteration 10 of 2400, about 4 minutes on an idle CPU" in second
    assert "Iteration 50 of 2400, 7 minutes left" in third
    assert ["next to nothing" in words for words in (first, second, third)] == [False, True, False]


@pytest.mark.slow
def test_the_card_says_what_was_refused_below_the_rule_that_was_learned(shown):
    page, _ = shown()
    learned, cut, stopped = page.run("""(async () => {
        const { TrainingCard } = await import("./training.js");
        const card = new TrainingCard(() => {}), last = { name: "a.png", folder: "runs", id: "1" };
        const done = { ...last, state: "done", seconds: 9, preset: "fast", has_rule: true };
        card.open = true;
        return [
            { ...done, refused: "hello", message: "give one emoji" },
            { ...done, refused: "b.png", message: "keep_background", cure: "whole" },
            { ...last, state: "stopped", message: "Nothing was learned.", has_rule: false },
        ].map((event) => {
            card.listen({ type: "training", ...event });
            return card.card.innerText.split("\\n");
        });
    })()""")
    for lines in (learned, cut):
        assert {"Your a.png", "Save rule", "Save page", "Watch"} <= set(lines)
    assert "give one emoji" in learned
    assert cut[-1].startswith("b.png is opaque")
    assert "Nothing was learned." in stopped
    assert "Choose a file" in stopped


@pytest.mark.slow
@pytest.mark.parametrize("painter", ["canvas", "webgl2"])
def test_a_3d_world_turns_under_the_pointer(shown, painter, tmp_path):
    page, _ = shown("duck", 1024, query=f"?painter={painter}")
    assert page.run("document.page.brushes.chosen.name") == "look"
    page.drag([(400, 400), (450, 400), (500, 400)])
    assert page.run("document.page.camera.azimuth") == pytest.approx(-40.0)
    take(page, "remove")
    page.drag([pixel_of(page, 0.0, 0.0)] * 3)
    page.wait(f"{FRAME}.positions.length < 3072")
    picture = picture_of(page, tmp_path / "page.png")
    assert (np.abs(picture[100:650, 100:900] - picture[60, 950]).sum(axis=-1) > 60).mean() > 0.05


@pytest.mark.slow
def test_the_command_prints_its_link_and_ends_by_ctrl_c(new_page, tmp_path):
    command = [sys.executable, "-m", "npa_envs", "view", "heart", "--particle-count", "128"]
    command += ["--no-browser", "--port", "0", "--out", str(tmp_path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8"
    ) as run:
        line = run.stdout.readline()
        address = line.split()[1]
        assert address.startswith("http://127.0.0.1:")
        page = new_page()
        page.open(address)
        page.wait(f"{FRAME}.step > 3")
        run.send_signal(signal.SIGINT)
        start = time.monotonic()
        _, errors = run.communicate(timeout=30)
    assert run.returncode == 0
    assert "Traceback" not in errors
    assert time.monotonic() - start < 10
    page.wait("!document.getElementById('message').hidden")
    assert "start npa-envs view again" in page.run("document.getElementById('message').textContent")
