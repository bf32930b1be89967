"""Pages that run by themselves: their engine steps as Python's, and one file is all they need."""

from __future__ import annotations

import base64
import io
import json
import re
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.page_worlds import SPECIES, TOLERANCE, WORLDS, example, packed, unpacked
from support.slow import slow
from torch import Tensor

from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule, save_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.damage import DAMAGE_SIZES
from npa_envs.tasks.point_classification import PALETTE, class_colours
from npa_envs.tasks.targets.notes import left_out
from npa_envs.web import export, messages
from npa_envs.web.export import check_browser_rule, export_web, joined_modules, page_rule, page_text
from npa_envs.web.live_world import ColouredWorld, Colouring
from npa_envs.web.rule_world import RuleWorld
from npa_envs.world.brushes import nearest_image
from npa_envs.world.particles import Particles

NODE_SECONDS = 300


@pytest.fixture(scope="module")
def run(modules):
    """Run an act of run_engine.mjs on the page's modules; one Node.js serves all tests."""
    command = ["node", str(Path(__file__).with_name("run_engine.mjs")), str(modules)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, encoding="utf-8") as process:

        def act(name, **fields):
            limit = threading.Timer(NODE_SECONDS, process.kill)
            limit.start()
            process.stdin.write(json.dumps({"act": name, **fields}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
            limit.cancel()
            assert line, "Node.js ended, or needed too long"
            answer = json.loads(line)
            assert "failed" not in answer, answer["failed"]
            return answer

        yield act
        process.kill()


def assert_worlds(got, x, s, bound=TOLERANCE):
    for name, want in (("x", x), ("s", s)):
        assert float((unpacked(got[name], want.shape) - want).abs().max()) < bound


@pytest.mark.parametrize("kind", [*WORLDS, *SPECIES])
def test_a_step_with_a_mask_is_that_of_python(run, kind):
    fields, s, mask, after = example(kind)
    # The step is no small one.
    assert float((after[1] - s).abs().max()) > 1000 * TOLERANCE
    for kernels, name in (("plain", "JavaScript"), ("simd", "WebAssembly")):
        got = run("step", kernels=kernels, **fields)
        assert got["kernels"] == name
        assert_worlds(got, *after)
        assert torch.equal(unpacked(got["s"], s.shape)[mask == 0], s[mask == 0])


def test_noise_is_added_to_the_positions_of_a_step(run):
    step = example("two species")
    x, s = step.after
    got = run("step", kernels="simd", noise=packed(torch.full_like(x, 0.25)), **step.fields)
    assert_worlds(got, x + 0.25, s)


@pytest.fixture(scope="module")
def settings():
    """Settings of the page's engine: two rules that agree, a periodic and a 3D one."""
    counts = {"gecko": 300, "heart": 300, "dots": 200, "duck": 300}
    return settings_of(*(page_rule(name, particle_count=n) for name, n in counts.items()))


def settings_of(*rules):
    text = page_text(rules, title="mine")
    return json.loads(re.search(r'id="rules">(.*?)</script>', text)[1])


def live(run, settings, *script):
    return run("live", settings=settings, script=list(script))


ADVANCE = {"type": "advance"}


def last(result, kind):
    return next(event for event in reversed(result["events"]) if event["type"] == kind)


def test_a_live_world_moves_and_the_same_seed_gives_the_same_world(run, settings):
    first, second = (live(run, settings, ADVANCE, ADVANCE) for _ in range(2))
    assert first["x"] == second["x"]
    frame, world = last(first, "frame"), last(first, "world")
    assert (frame["step"], world["rule"], world["settings"]["count"]["value"]) == (2, "gecko", 300)
    assert 0.3 < sum(first["updated"]) / 300 < 0.7
    assert live(run, settings, {"type": "reset", "seed": 1}, ADVANCE, ADVANCE)["x"] != first["x"]
    assert live(run, settings, {"type": "reset", "seed": 0}, ADVANCE, ADVANCE)["x"] == first["x"]


@pytest.fixture(scope="module")
def crowds():
    """Settings of worlds that are large enough to be shared with helpers."""
    rules = ("gecko", "heart", "dots", "duck")
    return settings_of(*(page_rule(name, particle_count=2304) for name in rules)) | {"code": ";"}


@pytest.mark.parametrize("rule", ["gecko", slow("dots"), slow("duck")])
def test_helpers_change_no_bit_of_a_world(run, crowds, rule):
    at = [0.0] * (3 if rule == "duck" else 2)
    graft = {"type": "brush", "tool": "graft", "at": at, "radius": 0.1, "strength": 1.0}
    start = {"type": "set", "name": "rule", "value": rule}
    script = [start, ADVANCE, ADVANCE, graft | {"rule": GRAFTED[rule]}, ADVANCE]
    runs = [
        run("live", settings=crowds, script=script, threads=threads, fail=fail)
        for threads, fail in ((1, False), (4, False), (8, False), (8, True))
    ]
    assert [one["asked"] for one in runs] == [0, 3, 9, 3], "a helper that fails is not asked again"
    assert all(one[field] == runs[0][field] for one in runs for field in ("x", "s", "errors"))


def test_a_page_may_have_as_many_particles_as_it_was_asked_for():
    world = page_rule("gecko", particle_count=20_000)["world"]
    assert world["count"] == world["settings"]["count"]["high"] == 20_000


PAUSE = {"type": "play", "on": False}
BRUSHES = {
    "wipe": {}, "remove": {}, "clump": {},
    "push": {"move": [0.05, -0.1]}, "cut": {"move": [0.1, 0.2]},
    "inject": {"source": [-0.1, 0.1]}, "inject nothing": {"source": [5.0, 5.0]},
    "graft": {},
}  # fmt: skip
"""Fields of their messages; "noise" and "add", which draw numbers, are tested below."""

GRAFTED = {"gecko": "heart", "dots": "dots", "duck": "duck"}
"""A rule that may join the world of each rule; the second one is periodic, the last one 3D."""


@pytest.fixture(scope="module", params=GRAFTED)
def grown(run, settings, request):
    """A rule, how a page's world of it grows, and that world."""
    script = [{"type": "set", "name": "rule", "value": request.param}, *[ADVANCE] * 4, PAUSE]
    return request.param, script, live(run, settings, *script)


@pytest.mark.parametrize("name", BRUSHES)
def test_brushes_of_a_page_are_those_of_the_viewer(run, settings, grown, name):
    rule, script, before = grown
    message = {"type": "brush", "tool": name.split()[0], "at": [0.1, 0.0], "radius": 0.15}
    message |= {"strength": 0.4, "move": [0.0, 0.0], "rule": GRAFTED[rule]} | BRUSHES[name]
    if rule == "dots":
        # Across the edge of the box.
        message["at"] = [0.95, 0.0]
    if rule == "duck":
        vectors = {"at": [0.1, 0.0, 0.0], "move": [0.1, 0.2, -0.1], "source": [-0.1, 0.1, 0.1]}
        message |= vectors | {"view": [0.6, 0.0, 0.8], "radius": 0.5}
    after = live(run, settings, *script, message)
    world = RuleWorld(rule, device=torch.device("cpu"), particle_count=len(before["species"]))
    x, s = (unpacked(before[field], getattr(world.particles, field).shape) for field in "xs")
    world.particles = Particles(x, s)
    world.handle(message)
    assert world.counts == [after["species"].count(k) for k in sorted(set(after["species"]))]
    order = torch.tensor(after["species"]).argsort(stable=True)
    got_x = unpacked(after["x"], (1, -1, x.shape[2]))[:, order]
    got_s = unpacked(after["s"], (1, -1, s.shape[2]))[:, order]
    assert float(nearest_image(got_x - world.particles.x, world.box).abs().max()) < 1e-6
    assert float((got_s - world.particles.s).abs().max()) < 1e-5
    same = torch.equal(world.particles.x, x) and torch.equal(world.particles.s, s)
    unchanged = (("gecko", "inject nothing"), ("dots", "graft"), ("duck", "graft"))
    assert same == ((rule, name) in unchanged)


def test_noise_scatters_the_particles_below_the_brush_as_in_the_viewer(run, settings):
    message = {"type": "brush", "tool": "noise", "at": [0.1, 0.0], "radius": 0.2, "strength": 1.0}
    before, after = (live(run, settings, PAUSE, *more) for more in ((), (message,)))
    x = unpacked(before["x"], (300, 2))
    world = RuleWorld("gecko", device=torch.device("cpu"), particle_count=300)
    world.particles = world.particles._replace(x=x[None])
    world.handle(message)
    square = (x - torch.tensor(message["at"])).square().sum(dim=-1, keepdim=True) / 0.2**2
    weight = (1.0 - square).clamp_min(0.0).square()
    near = weight[:, 0] > 0.1
    assert 30 < int(near.sum()) < 290
    for moved in (unpacked(after["x"], (300, 2)) - x, world.particles.x[0] - x):
        assert float(moved[weight[:, 0] == 0].abs().max()) == 0.0
        # 0.6 radii at the centre; the bound is over six standard errors.
        assert abs(float((moved / weight)[near].std()) - 0.12) < 0.045


@pytest.mark.slow
def test_wounds_heal_in_a_page_as_in_the_viewer(run):
    settings = settings_of(page_rule("gecko", particle_count=1024))
    world = RuleWorld("gecko", device=torch.device("cpu"), particle_count=1024)
    world.speed = 50

    def grown(*script):
        speed = {"type": "set", "name": "speed", "value": world.speed}
        result = live(run, settings, speed, *[ADVANCE] * 10, *script)
        return Particles(*(unpacked(result[n], getattr(world.particles, n).shape) for n in "xs"))

    def loss(particles, where):
        density, colour = world.task.splat_errors(*particles[:2])
        return float((density + world.task.config.colour_weight * colour)[where].mean())

    before = grown()
    for place in ([0.0, 0.5], [-0.4, 0.2], [0.3, -0.3]):
        wipe = {"type": "brush", "tool": "wipe", "at": place, "radius": 0.2, "strength": 1.0}
        wounded = grown(wipe)
        healed = grown(wipe, *[ADVANCE] * 10)
        world.particles = wounded
        for _ in range(10):
            world.advance()
        where = (world.task.picture(*wounded[:2]) - world.task.picture(*before[:2])).abs()
        where = where.amax(dim=-1) > 0.1
        least, most = loss(before, where), loss(wounded, where)
        assert most > 2.0 * least
        # Of what the wound added, at most 0.1 and 0.3 were left.
        for after in (healed, world.particles):
            assert loss(after, where) < least + 0.5 * (most - least)


def test_a_world_without_particles_goes_on(run, settings):
    everything = {"type": "brush", "tool": "remove", "at": [0, 0], "radius": 9, "strength": 1}
    assert last(live(run, settings, everything, ADVANCE, ADVANCE), "frame")["colours"] == []


def test_species_are_grafted_and_added_where_rules_agree(run, settings):
    where = {"type": "brush", "at": [0.1, 0], "radius": 0.1, "strength": 0.5, "rule": "heart"}
    grafted = live(run, settings, {**where, "tool": "graft"}, ADVANCE)
    assert 0 < sum(grafted["species"]) < 300
    assert last(grafted, "world")["species"] == ["gecko", "heart"]
    assert last(grafted, "world")["others"] == ["gecko", "heart"]
    added = live(run, settings, {"type": "play", "on": False}, {**where, "tool": "add"}, ADVANCE)
    assert added["species"] == [0] * 300 + [1] * 75
    seed = unpacked(added["x"], (375, 2))[300:]
    assert float((seed - torch.tensor([0.1, 0.0])).norm(dim=-1).max()) <= 0.1
    wrong = live(run, settings, {**where, "tool": "graft", "rule": "dots"}, ADVANCE)
    error = "dots cannot live in a world of gecko: rules of one world must agree in space_dim, st"
    assert wrong["errors"][0].startswith(error)
    assert sum(wrong["species"]) == 0


def test_settings_reach_the_world_and_wrong_messages_are_reported(run, settings):
    def set_to(name, value):
        return {"type": "set", "name": name, "value": value}

    result = live(run, settings, set_to("eps", 0.15), set_to("speed", 4), ADVANCE)
    ranges = last(result, "world")["settings"]
    assert (ranges["eps"]["value"], ranges["speed"]["value"]) == (0.15, 4)
    assert last(result, "frame")["step"] == 4
    assert result["x"] != live(run, settings, set_to("speed", 4), ADVANCE)["x"]
    counted = live(run, settings, set_to("count", 500), ADVANCE)
    assert len(counted["species"]) == 500
    texture = live(run, settings, set_to("rule", "dots"), ADVANCE)
    assert last(texture, "world")["box"] == [2.0, 2.0]
    assert float(unpacked(texture["x"], (200, 2)).abs().max()) <= 1.0
    wrong = live(
        run, settings, set_to("eps", 9), set_to("rule", "nobody"), set_to("show", "nothing"),
        {"type": "damage", "name": "luck"}, {"type": "brush", "tool": "luck"}, {"type": "fly"}
    )  # fmt: skip
    assert wrong["errors"] == [
        "eps must lie in [0.04, 0.25], got 9", "no rule is called nobody",
        "nothing to show is called nothing", "no damage is called luck", "no brush is called luck",
        "no message is called fly"
    ]  # fmt: skip
    assert {name.split()[0] for name in BRUSHES} | {"noise", "add"} == set(messages.BRUSHES)
    whole = live(run, settings, *[ADVANCE] * 3)
    x = unpacked(whole["x"], (300, 2))
    farthest_moves = {"wipe": 0.0, "cut": 0.05, "clump": 0.18, "noise": 0.25}
    for name, farthest in {name: farthest_moves[name] for name in DAMAGE_SIZES}.items():
        damaged = live(run, settings, *[ADVANCE] * 3, {"type": "damage", "name": name})
        moved = (unpacked(damaged["x"], (300, 2)) - x).norm(dim=-1).max()
        assert 0.5 * farthest <= float(moved) <= farthest + 1e-6
        assert (damaged["s"] != whole["s"]) == (name == "wipe")


def test_damage_of_a_page_continues_across_the_edges_of_a_box(run, settings):
    texture = {"type": "set", "name": "rule", "value": "dots"}
    wipe = [*[ADVANCE] * 20, PAUSE, {"type": "damage", "name": "wipe"}]
    is_disk = []
    for seed in range(8):
        result = live(run, settings, texture, {"type": "reset", "seed": seed}, *wipe)
        x, s = unpacked(result["x"], (200, 2)), unpacked(result["s"], (200, -1))
        away = x[:, None] - x
        disks = [v.norm(dim=-1) <= 0.2 for v in (away, nearest_image(away, (2.0, 2.0)))]
        wiped = (s == 0.0).all(dim=-1)
        is_disk.append(tuple(bool((disk == wiped).all(dim=-1).any()) for disk in disks))
    assert set(is_disk) == {(False, True), (True, True)}


@pytest.mark.parametrize(
    "show", ["colours", "density", "components", "species", "speed", "mask", "state 3"]
)
def test_particles_have_the_colours_of_the_viewer(run, settings, show):
    result = live(
        run, settings, *[ADVANCE] * 8, {"type": "play", "on": False},
        {"type": "set", "name": "show", "value": show}, ADVANCE
    )  # fmt: skip
    frame = last(result, "frame")
    x, s = unpacked(result["x"], (1, 300, 2)), unpacked(result["s"], (1, 300, 16))
    rule = load_rule("gecko")
    coloured = ColouredWorld(
        x, s, rule.colour, 0.1, None, [300], 300, unpacked(result["travelled"], (1, 300)),
        torch.tensor([result["updated"]]).bool()
    )  # fmt: skip
    want = torch.from_numpy(Colouring()(show, coloured)).int()
    got = torch.tensor(frame["colours"]).view(300, 3).int()
    if show == "components":
        # Each of them may have either sign.
        same_sign = (got - want).abs().amax(dim=0) <= (255 - got - want).abs().amax(dim=0)
        got = torch.where(same_sign, got, 255 - got)
    assert float((got - want).abs().max()) <= 1
    assert len(want.unique(dim=0)) > (0 if show == "species" else 1)


def test_particles_that_are_no_number_leave_the_components_of_the_others_alone(run, settings):
    s = torch.randn(40, 4, generator=torch.Generator().manual_seed(2))
    broken = torch.cat((s, s[:2]))
    broken[40, 1], broken[41, 0] = float("nan"), float("inf")
    frames = [packed(states) for states in (broken, torch.full_like(s, float("nan")), s)]
    options = {"channels": 4, "constants": settings["constants"]}
    first, _, last_one = run("components", frames=frames, **options)
    assert first[:120] == run("components", frames=frames[2:], **options)[0]
    assert len(set(last_one)) > 20


@pytest.mark.parametrize("name", ["duck", pytest.param("digits", marks=pytest.mark.slow)])
def test_read_outs_have_the_colours_of_the_viewer(run, name):
    if name == "digits":
        pytest.importorskip("sklearn")
    rule = page_rule(name) if name == "digits" else page_rule(name, particle_count=300)
    if name == "digits":
        # Each class begins as a cloud of its own.
        clouds = rule["world"]["seed"]["clouds"]
        assert (len(clouds), len(set(clouds)), rule["world"]["count"]) == (10, 10, 512)
        assert "count" not in rule["world"]["settings"]
    result = live(run, settings_of(rule), *[ADVANCE] * 6)
    count = len(result["species"])
    s = unpacked(result["s"], (1, count, -1))
    loaded = load_rule(name)
    with torch.no_grad():
        own = class_colours(loaded.read_out(s)) if name == "digits" else loaded.colour(s)
    got = torch.tensor(last(result, "frame")["colours"]).view(count, 3)
    assert float((own[0].clamp(0, 1) * 255.0 - got).abs().max()) <= 1.0
    assert len(got.unique(dim=0)) > 20


# The file.


def test_a_page_is_one_small_file_that_asks_for_nothing(tmp_path):
    page = tmp_path / "page.html"
    export_web(["gecko"], page)
    text = page.read_text(encoding="utf-8")
    assert len(text) < 300_000
    assert "default-src 'none'" in text
    # What a page could load: no element but links names anything but data.
    loads = re.findall(r"""<(?!a )[^<>]*\b(?:src|href|action)\s*=\s*["']?([^"'\s>]+)""", text)
    assert [address for address in loads if not address.startswith(("data:", "#"))] == []
    assert not re.search(r"\bimport\b *[({'\"*]|\bfetch\(|WebSocket|XMLHttpRequest", text)
    assert "<title>gecko</title>" in text
    save_rule(load_rule("gecko"), tmp_path / "<b>.safetensors")
    title = "</title><script>alert(1)</script>"
    options = {"title": title, "particle_count": 64, "previews": True}
    export_web([tmp_path / "<b>.safetensors"], page, **options)
    text = page.read_text(encoding="utf-8")
    assert "<script>alert(1)" not in text
    assert "<b>" not in text
    assert '"name":"\\u003cb>"' in text


def test_the_gallery_shows_another_clear_digit_of_each_rule_that_classifies(
    tmp_path, monkeypatch, capsys, caplog
):
    pytest.importorskip("sklearn")
    monkeypatch.chdir(tmp_path)  # Without MNIST.
    left_out.cache_clear()
    names = ("dots", "digits", "mnist")
    words = ["export-web", *names, "--gallery", "--out", "page.html", "--particle-count"]
    assert main([*words, "512"]) == 0
    said = "mnist: its page shows scikit-learn's digits: its data set is not on this computer\n"
    assert capsys.readouterr().err == said
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    tiles = re.findall(r'<li>.*base64,(.*?)" alt="">\s*<span>(\w+)(.*?)</span>', text)
    assert [tile[1] for tile in tiles] == list(names)
    assert ["classifies digits" in tile[2] for tile in tiles] == [False, True, True]
    for digit, tile in zip((2, 3), tiles[1:], strict=True):
        pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(tile[0]))).convert("RGBA"))
        colour = pixels[pixels[..., 3] > 200][:, :3].mean(axis=0) / 255.0
        assert np.abs(np.array(PALETTE) - colour).sum(axis=1).argmin() == digit
    # Elsewhere one hears how to get the data.
    RuleWorld("mnist", device=torch.device("cpu"), choices={})
    assert "digits instead: MNIST is not in the folder 'data', and nothing is down" in caplog.text


def test_an_import_or_export_of_another_form_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("npa_envs.web.export.PAGE", tmp_path)
    (tmp_path / "b.js").write_text("// To import and export.\nexport const b = 2;\n")
    known = 'import {\n  b,\n} from "./b.js";\nexport const a = b; // export it\n'
    (tmp_path / "a.js").write_text(known)
    assert 'modules["a.js"] = (() => {\nconst {\n  b,\n} = modules[' in joined_modules("a.js")
    for line in (
        'import * as c from "./b.js";', 'import "./b.js";', 'await import("./b.js");',
        'import { b } from "./b.js"', "export { b };", "export default 1;", "  export const c = 1;",
    ):  # fmt: skip
        (tmp_path / "a.js").write_text(f"{known}{line}\n")
        with pytest.raises(ValueError, match=r"in line 5 of .*a\.js"):
            joined_modules("a.js")


class OwnNetwork(NPARule):
    def forward(self, perception: Tensor) -> Tensor:
        return super().forward(perception).tanh()


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (OwnNetwork(), "two plain layers only, 'mine' is a OwnNetwork with a network of its own"),
        (NPARule(code_dim=2, code_names=["a"]), "without codes only, 'mine' has code_dim=2"),
        (NPARule(species_count=2), "perceive all species alike, 'mine' has species_count=2"),
        (NPARule(hidden_dim=13000), "at most 1048576 weights, 'mine' has 1105000"),
    ],
)
def test_rules_that_a_browser_cannot_run_are_rejected(rule, message):
    with pytest.raises(NPAError, match=message):
        check_browser_rule(rule, "mine")


def test_bad_pages_are_rejected_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr("npa_envs.web.export.page_rule", lambda *_, **__: pytest.fail("worked"))
    for sources, path, message in (
        (["gecko"], "page.htm", r"must end in \.html"),
        (["gecko"], "nowhere/page.html", "does not exist"),
        ([], "page.html", "rules of different names"),
        (["gecko", "gecko"], "page.html", "different names, but gecko is named twice"),
    ):
        with pytest.raises(NPAError, match=message):
            export_web(sources, tmp_path / path)
    monkeypatch.undo()
    with pytest.raises(NPAError, match="did you mean 'gecko'"):
        export_web(["geko"], tmp_path / "page.html")
    assert not any(tmp_path.iterdir())


def test_the_command_writes_pages_and_collections(tmp_path, capsys):
    page, collection = tmp_path / "page.html", tmp_path / "models.json"
    (tmp_path / "run").mkdir()
    save_rule(NPARule(), tmp_path / "run" / "rule.safetensors")
    run_folder = str(tmp_path / "run")
    assert main(["export-web", "gecko", run_folder, "--out", str(page)]) == 0
    assert f"wrote {page}" in capsys.readouterr().out
    written = re.search(r'id="rules">(.*?)</script>', page.read_text(encoding="utf-8"))[1]
    assert [rule["name"] for rule in json.loads(written)["rules"]] == ["gecko", "run"]
    words = ["export-web", "gecko-v0", "--out", str(collection), "--particle-count", "77"]
    assert main(words) == 0
    assert '"N0": 77' in collection.read_text(encoding="utf-8")
    rules = [load_rule(source) for source in (f"{collection}#gecko-v0", "gecko-v0")]
    assert torch.equal(rules[0].output.weight, rules[1].output.weight)
    (tmp_path / "unfinished").mkdir()
    capsys.readouterr()
    for words, error in (
        ([], "RULE"),
        (["duck"], "runs rules with space_dim=2 only, 'duck' has 3"),
        (["gecko", "heart", "gecko"], "a collection needs rules of different names"),
        (["gecko", "--title", "mine"], "title is for pages, got --title with a collection"),
        (["gecko", "--gallery"], "gallery is for pages, got --gallery with"),
        (["--gallery"], "gallery is for pages, got --gallery with"),
        (["gecko", "--particle-count", "0"], "--particle-count must be at least 1"),
        ([str(tmp_path / "unfinished")], "must hold the rule.safetensors of a run"),
    ):
        assert main(["export-web", *words, "--out", str(collection)]) == 2
        assert error in capsys.readouterr().err


@pytest.mark.parametrize(
    ("urls", "links"),
    [(None, 1), (["Repository, https://github.com/us/npa?a&b", "Home, https://x.example"], 2)],
)
def test_a_page_names_the_repository_only_where_it_is_known(monkeypatch, urls, links):
    class Known:
        def get_all(self, name):
            return urls if name == "Project-URL" else None

    monkeypatch.setattr(export, "metadata", lambda name: Known())
    addresses = re.findall(r'<a href="([^"]*)"', page_text([], title="mine"))
    ours = ["https://arxiv.org/abs/2601.16096", "https://github.com/us/npa?a&amp;b"]
    assert addresses == ours[:links]
