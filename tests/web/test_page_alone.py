"""The page without a browser: what it tells its engine, and what it makes of events."""

from __future__ import annotations

import json
import math
import subprocess
from pathlib import Path

import pytest

SETUP = """
const world = {
  type: "world", title: "t", dimension: 2,
  tools: [{ name: "remove", label: "Remove", takes: "", icon: "M0 0" }],
  capabilities: ["film", "step", "reset"],
};
const frame = (step, places = [0, 0, 1, 1]) => ({
  type: "frame", step, positions: new Float32Array(places), colours: new Uint8Array(6),
  milliseconds: 1,
});
const told = (type) => sent.filter((message) => message.type === type);
listen(world);
tick();
sent.length = 0;
"""


@pytest.fixture
def run(modules):
    """A function that runs a script on the page, and returns what it returns."""

    def script(text):
        program = str(Path(__file__).with_name("run_page.mjs"))
        command = ["node", program, str(modules), SETUP + text]
        said = subprocess.check_output(command, text=True, timeout=300, encoding="utf-8")
        return json.loads(said)

    return script


def test_each_frame_is_answered_once_it_or_a_later_one_is_drawn(run):
    answered = run("""
        listen(frame(1));
        listen(frame(2));
        const hidden = told("drawn").length;
        tick();
        tick();
        const drawn = told("drawn").length;
        listen(frame(3));
        listen({ ...world, half_width: 2 });
        return [hidden, drawn, told("drawn").length];
    """)
    # A page that is hidden draws nothing, and holds the world.
    assert answered == [0, 2, 3]


def test_a_film_that_is_ready_leaves_the_next_recording_alone(run):
    recording, button, pressed = run("""
        page.record(true);
        page.record(false);
        page.record(true);
        listen({ type: "file", name: "film-1.gif", url: "films/film-1.gif" });
        const going = page.recording !== null, button = element("record").textContent;
        page.record(!page.recording);
        return [going, button, told("film").map(({ action }) => action)];
    """)
    assert recording
    assert button == "Stop"
    assert pressed == ["start", "stop", "start", "stop"]


def test_a_recording_ends_where_the_engine_ends_it(run):
    told = run("""
        page.record(true);
        listen({ type: "film", action: "stop" });
        return [page.recording, element("record").textContent, told("film").length];
    """)
    assert told == [None, "Record", 1]


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [
        (0.4 * 0.1, 0.25, "log"),
        (0.4 * 0.0667, 2.5 * 0.0667, "log"),
        (0.05, 1.0, None),
        (0.0, 0.2 * 0.0333333, None),
    ],
)
def test_the_ends_of_a_slider_lie_within_its_range(run, low, high, scale):
    setting = json.dumps({"value": high, "low": low, "high": high, "scale": scale})
    first, last = run(f"""
        const input = element("slider");
        page.slider(input, "eps", {setting});
        for (const end of ["min", "max"]) {{
          input.value = String(input[end]);
          input.oninput();
        }}
        return told("set").map(({{ value }}) => value);
    """)
    assert low <= first <= last <= high
    assert math.isclose(first, low, rel_tol=5e-3, abs_tol=1e-9)
    assert math.isclose(last, high, rel_tol=5e-3)


def test_tracers_draw_no_line_between_particles_that_have_changed_places(run):
    before, after = run("""
        element("tracers").checked = true;
        listen(frame(1, [0, 0, 1, 1]));
        tick();
        listen(frame(2, [0, 0, 1, 1]));
        tick();
        const lines = page.tracers.lines(null).fades.length;
        listen({ type: "reordered" });
        listen(frame(3, [1, 1, 0, 0]));
        tick();
        return [lines, page.tracers.lines(null).fades.length];
    """)
    assert before == 4
    assert after == 0
