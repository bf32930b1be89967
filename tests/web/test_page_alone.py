"""The page without a browser: the messages that it sends to its engine, and how it takes events."""

from __future__ import annotations

import itertools
import json
import math
import re
import subprocess
from pathlib import Path

import pytest

from npa_envs.web.live_world import shows_of
from npa_envs.web.messages import BRUSHES

SENT_BRUSHES = [{"name": name} | brush._asdict() for name, brush in BRUSHES.items()]
SETUP = """
const rules = { species: ["a"], others: ["a", "b"] };
const world = { type: "world", title: "t", dimension: 2, tools, capabilities: ["film"], ...rules };
const frame = (step, places = [0, 0, 1, 1]) => ({
  type: "frame", step, positions: new Float32Array(places), colours: new Uint8Array(6),
  milliseconds: 1,
});
const ofType = (type) => sent.filter((message) => message.type === type);
listen(world);
tick();
sent.length = 0;
"""


@pytest.fixture
def run(modules):
    """A function that runs a script on the page, and returns what it returns."""

    def script(text):
        program = str(Path(__file__).with_name("run_page.mjs"))
        tools = f"const tools = {json.dumps(SENT_BRUSHES)};"
        command = ["node", program, str(modules), tools + SETUP + text]
        output = subprocess.check_output(command, text=True, timeout=300, encoding="utf-8")
        return json.loads(output)

    return script


def test_each_frame_is_answered_once_it_or_a_later_one_is_drawn(run):
    counts = run("""
        listen(frame(1));
        listen(frame(2));
        const hidden = ofType("drawn").length;
        tick();
        tick();
        const drawn = ofType("drawn").length;
        listen(frame(3));
        listen({ ...world, half_width: 2 });
        return [hidden, drawn, ofType("drawn").length];
    """)
    # A page that is hidden draws nothing, and its world waits.
    assert counts == [0, 2, 3]


def test_each_brush_sends_its_messages_at_its_time(run):
    strokes = run("""
        const strokes = {};
        element("radius").value = 1;
        for (const { name } of tools) {
          page.brushes.choose(name);
          sent.length = 0;
          const event = (type, clientX) =>
            ({ type, clientX, clientY: 40, pointerId: 1, button: 0, pointerType: "mouse" });
          page.brushes.press(event("pointerdown", 40));
          tick();
          page.brushes.move(event("pointermove", 60));
          tick();
          tick();
          page.brushes.release(event("pointerup", 60));
          strokes[name] = ofType("brush").map(({ at, move, source }) =>
            [at[0], move[0], source?.[0] ?? null].map((x) => x && Math.round(x / 0.275)));
        }
        return strokes;
    """)
    # In tens of pixels from the middle: position, movement, and where the stroke began.
    assert strokes == {
        **{
            name: [[-1, 0, None], [-1, 0, None], [1, 2, None], [1, 0, None]]
            for name in ("wipe", "clump", "noise", "remove")
        },
        "inject": [[-1, 0, -1], [-1, 0, -1], [1, 2, -1], [1, 0, -1]],
        "push": [[-1, 0, None], [-1, 2, None]],
        "graft": [[-1, 0, None], [1, 2, None]],
        "add": [[-1, 0, None]],
        "cut": [[-1, 2, None]],
    }


@pytest.mark.parametrize("name", ["wipe", "graft"])
def test_a_quick_stroke_leaves_no_gaps_and_ends_where_the_pointer_is_released(run, name):
    places = run(f"""
        page.brushes.choose("{name}");
        element("radius").value = 0.1;
        const event = (type, clientX) =>
          ({{ type, clientX, clientY: 40, pointerId: 1, button: 0, pointerType: "mouse" }});
        page.brushes.press(event("pointerdown", 20));
        page.brushes.move(event("pointermove", 60));
        page.brushes.release(event("pointerup", 60));
        return ofType("brush").map(({{ at }}) => at[0]);
    """)
    assert places[-1] - places[0] == pytest.approx(40 * 0.0275)
    steps = [after - before for before, after in itertools.pairwise(places)]
    assert 0.05 < min(steps) <= max(steps) < 0.1001


def test_a_page_begins_with_a_brush_that_heals_and_says_what_it_does(run):
    shown = run("""
        const first = [page.brushes.chosen.name, element("hint").textContent];
        const keys = element("brushes").children;
        const press = (key) =>
          page.controls.key({ key, target: { matches: () => false }, preventDefault() {} });
        press("0");
        const last = [page.brushes.chosen.name, element("hint").textContent];
        listen({ ...world, dimension: 3 });
        return [first, keys.length, last, page.brushes.chosen.name];
    """)
    removing = "Remove: takes particles away, for good"
    wiping = "Wipe: sets states to zero; see what grows back"
    assert shown == [["wipe", wiping], 10, ["remove", removing], "look"]


def test_another_world_begins_with_wipe_or_the_chosen_brush_and_is_asked_for_its_loss(run):
    brushes, losses, curves = run("""
        const mine = { ...world, title: "mine", capabilities: ["film"] };
        const learned = { ...mine, capabilities: ["film", "loss"] };
        element("plots").open = true;
        const brushes = ["look", "cut"].map((first) => {
          listen(world);
          page.brushes.choose(first);
          listen({ ...world, seed: 1 });
          const names = [page.brushes.chosen.name];
          listen(mine);
          names.push(page.brushes.chosen.name);
          if (first === "look") page.brushes.choose("look");
          listen({ ...mine, seed: 2 });
          names.push(page.brushes.chosen.name);
          listen(learned);
          return [...names, page.brushes.chosen.name];
        });
        sent.length = 0;
        const losses = [world, { ...world, seed: 3 }, mine, learned].map((event) => {
          sent.length = 0;
          listen(event);
          return ofType("set").map(({ name, value }) => [name, value].join());
        });
        listen({ type: "curve", name: "Training loss", points: [[0, 1]] });
        const curves = [learned, world].map((event) => {
          listen(event);
          return Object.keys(page.curves);
        });
        return [brushes, losses, curves];
    """)
    assert brushes == [["look", "wipe", "look", "wipe"], ["cut"] * 4]
    assert losses == [["loss,true"], [], ["loss,true"], ["loss,true"]]
    assert curves == [["Training loss"], []]


def test_a_plot_of_the_loss_is_shown_where_there_is_one(run):
    hidden = run("""
        return [[["film"], ["a"]], [["loss"], ["a"]], [["loss"], ["a", "b"]]].map(
          ([capabilities, species]) => {
            listen({ ...world, capabilities, species });
            return page.plots.loss.figure.hidden;
          });
    """)
    assert hidden == [True, False, True]


def test_the_physics_is_put_back_as_trained_where_it_differs(run):
    sent, disabled, hints = run("""
        const setting = (value, trained) => ({ value, trained, low: 0.01, high: 99, scale: null });
        const settings = { speed: setting(4, 1), eps: setting(0.1, 0.1), count: setting(9, 9) };
        const event = { ...world, settings };
        const states = [event, { ...event, settings: {
          ...settings, eps: setting(0.2, 0.1), count: setting(5, 9) } }].map((one) => {
          listen(one);
          return element("trained").disabled;
        });
        sent.length = 0;
        element("trained").onclick();
        const hints = [{}, { seed: 1 }].map((fields) => {
          listen({ ...event, ...fields });
          return element("hint").textContent;
        });
        return [ofType("set").map(({ name, value }) => [name, value]), states, hints];
    """)
    assert hints == ["Physics as trained. New grows a fresh world", BRUSHES["wipe"].label]
    assert disabled == [True, False]
    assert sent == [["eps", 0.1], ["count", 9]]


def test_graft_is_offered_where_another_rule_fits_and_species_shown_where_there_are_two(run):
    offered = run("""
        return [["a"], ["a", "b"]].map((others) => {
          listen({ ...world, others, species: others, shows: ["colours", "species"] });
          const brushes = element("brushes").children.map((one) => one.dataset.brush);
          const shows = element("show").dataset.names, { hidden } = element("other-field");
          return [brushes.includes("graft"), hidden, shows];
        });
    """)
    assert offered == [[False, True, "colours"], [True, False, "colours\nspecies"]]


def test_all_that_a_page_shows_has_a_meaning(run):
    shows = [*shows_of(3, coloured=True), "state 15"]
    meanings = run(f"""
        return {json.dumps(shows)}.map((show) => {{
          listen({{ ...world, show }});
          return element("meaning").textContent;
        }});
    """)
    assert min(map(len, meanings)) > 20
    assert len(set(meanings)) == len(shows) - 3
    classes = run("""
        listen({ ...world, class_count: 11 });
        return element("meaning").textContent;
    """)
    assert re.search("0 red, 1 green, .*, 9 lavender, 10 red; grey", classes)


def test_loading_is_shown_until_the_first_frame_and_the_key_f_shows_the_whole_world(run):
    states, centre, zoom = run("""
        const hidden = () => element("loading").hidden;
        const states = [hidden()];
        listen(frame(1, [4, 0, 6, 2]));
        tick();
        states.push(hidden());
        page.camera.zoom = 9;
        page.controls.key({ key: "f", target: { matches: () => false }, preventDefault() {} });
        const { centre, zoom } = page.camera;
        listen({ ...world, half_width: 2 });
        return [[...states, hidden()], centre, zoom];
    """)
    assert states == [False, True, False]
    assert centre == [5, 1, 0]
    assert math.isclose(zoom, 1.1 / 1.15)


def test_a_recording_ends_by_its_button_or_the_engine_and_not_by_the_film_before(run):
    states = run("""
        const { film } = page, button = element("record");
        const state = () => [film.recording !== null, button.textContent, ofType("film").length,
          element("writing").hidden];
        film.record(true);
        film.record(false);
        film.record(true);
        listen({ type: "file", name: "film-1.gif", url: "films/film-1.gif" });
        const states = [state()];
        film.record(!film.recording);
        states.push(state());
        film.record(true);
        listen({ type: "film", action: "stop" });
        return [...states, state()];
    """)
    assert states == [
        [True, "Stop", 3, True], [False, "Record", 4, False], [False, "Record", 5, False]
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [
        (0.4 * 0.1, 0.25, "log"), (0.4 * 0.0667, 2.5 * 0.0667, "log"),
        (0.05, 1.0, None), (0.0, 0.2 * 0.0333333, None),
    ],
)  # fmt: skip
def test_the_ends_of_a_slider_lie_within_its_range(run, low, high, scale):
    setting = json.dumps({"value": high, "low": low, "high": high, "scale": scale})
    first, last = run(f"""
        const input = element("slider");
        page.controls.slider(input, "eps", {setting});
        for (const end of ["min", "max"]) {{
          input.value = String(input[end]);
          input.oninput();
        }}
        return ofType("set").map(({{ value }}) => value);
    """)
    assert low <= first <= last <= high
    assert math.isclose(first, low, rel_tol=5e-3, abs_tol=1e-9)
    assert math.isclose(last, high, rel_tol=5e-3)


def test_what_an_agent_does_is_drawn_over_the_world_and_its_reward_written(run):
    lines, words = run("""
        let drawn;
        page.painter = { draw: (scene) => (drawn = [...scene.trails.positions]) };
        listen({ ...world, outline: [[0, 1, 0.5, 0]] });
        listen({ type: "acted", middle: [2, 0], pushes: [[0, 0, 0, 1]], reward: 0.5, total: 3 });
        listen(frame(1));
        tick();
        return [drawn, element("step").textContent];
    """)
    # The push is twice as long, with the two sides of its head; then the outline.
    assert lines[:6] == [0, 0, 0, 0, 2, 0]
    assert lines[-6:] == [2, 1, 0, 2.5, 1, 0]
    assert len(lines) == 4 * 6
    assert words == "step 1 · 2 particles · reward 0.5, so far 3"


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
