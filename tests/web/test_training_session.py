"""What a page drops is read within limits and learned in processes that end with the server."""

from __future__ import annotations

import base64
import io
import json
import os
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.browser import DESK
from support.clock import wait_until

from npa_envs import NPAError, load_rule, save_rule
from npa_envs.rule.files import rule_metadata, shipped_rules
from npa_envs.training.task_of_rule import trained_config
from npa_envs.training.task_table import task_entry
from npa_envs.web import dropped_file, training_session
from npa_envs.web.dropped_file import read_dropped, stored_name
from npa_envs.web.training_session import LearningWorld, Training

pytest.importorskip("uvicorn")
testclient = pytest.importorskip("starlette.testclient")

from npa_envs.web import server  # noqa: E402
from npa_envs.web.rule_world import RuleWorld  # noqa: E402

HERE = "http://127.0.0.1:8765"
BAD_NAMES = [
    "../../evil.png", "/etc/passwd", "..\\..\\evil.png", "a\0b.png", "x" * 5000, "", "..", "\n.png",
    "C:\\evil.glb", "picture.png\0.glb", "dropped/../../../mesh.obj", "<img src=x onerror=a(1)>",
]  # fmt: skip
CPU = torch.device("cpu")


def png(*, opaque=False, size=(48, 48), noise=False) -> bytes:
    """A red disk on nothing, or on white; or noise without a plain background."""
    rows, columns = np.mgrid[: size[1], : size[0]]
    inside = np.hypot(rows - size[1] / 2, columns - size[0] / 2) < 0.4 * min(size)
    pixels = np.full((*inside.shape, 4), 255, np.uint8)
    pixels[inside, 1:3] = 40
    pixels[~inside, 3] = 255 if opaque or noise else 0
    if noise:
        pixels[..., :3] = np.random.default_rng(0).integers(0, 255, (*inside.shape, 3))
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


@pytest.fixture
def held(tmp_path, monkeypatch):
    """A training whose files are stored, and neither read nor learned until it is stopped."""

    def wait(self, *_):
        self._stopping.wait(60)
        self._set(state="stopped", has_rule=True)

    monkeypatch.setattr(Training, "_read_and_learn", wait)
    training = Training(tmp_path / "runs")
    yield training
    training.close()


def client_of(training, host="127.0.0.1"):
    site = server.Site(lambda: None, films=training._folder, host=host, training=training)
    return site, testclient.TestClient(server.make_app(site), base_url=HERE)


def ended(training) -> dict:
    """The report of a training at its end."""
    wait_until(lambda: not training.active)
    return training.report


def processes_of(folder: Path) -> list[str]:
    """The processes that have a folder in their arguments."""
    lines = subprocess.check_output(["ps", "-ewwo", "pid=,stat=,args="], text=True).splitlines()
    return [line for line in lines if str(folder) in line and line.split()[1][0] != "Z"]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_a_name_never_becomes_a_path(held, name, tmp_path):
    _, client = client_of(held)
    before = set(tmp_path.parent.iterdir())
    answer = client.post("/training", params={"name": name}, content=b"content")
    assert answer.status_code == 200
    (file,) = (path for path in tmp_path.rglob("*") if path.is_file())
    assert file.relative_to(tmp_path).parts == ("runs", answer.json()["id"], stored_name(name))
    assert file.name in ("dropped", "dropped.glb", "dropped.obj")
    assert set(tmp_path.parent.iterdir()) == before
    assert 0 < len(held.report["name"]) <= 80
    assert held.report["name"].isprintable()


def test_one_file_is_learned_at_a_time_and_the_page_hears_why(held):
    _, client = client_of(held)
    assert client.post("/training", params={"name": "cat.png"}, content=b"1").status_code == 200
    second = client.post("/training", params={"name": "dog.png"}, content=b"2")
    assert second.status_code == 409
    assert "cat.png still is: stop it first" in second.text
    held.close()
    third = client.post("/training", params={"name": "dog.png"}, content=b"2")
    assert third.status_code == 200
    assert held.report["name"] == "dog.png"


@pytest.mark.parametrize("size", [0, 1001, 5000])
def test_a_file_that_is_empty_or_huge_is_refused(held, size, monkeypatch):
    for module in (server, training_session):
        monkeypatch.setattr(module, "MAX_BYTES", 1000)
    _, client = client_of(held)
    answer = client.post("/training", params={"name": "a.png"}, content=b"x" * size)
    assert answer.status_code == 400
    assert "a dropped file must have 1 byte to" in answer.text
    assert not held._folder.exists()


def test_only_the_servers_own_page_with_its_token_may_upload_and_download(held):
    _, client = client_of(held)
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999"):
        foreign = client.post("/training", content=b"1", headers={"origin": origin})
        assert foreign.status_code == 403
    assert client.post("/training", content=b"1", headers={"host": "evil"}).status_code == 403
    site, shared = client_of(held, host="0.0.0.0")
    assert shared.post("/training", content=b"1").status_code == 403
    assert shared.post("/training?token=wrong", content=b"1").status_code == 403
    assert shared.get("/training/x/rule.safetensors").status_code == 403
    assert not held.active
    mine = shared.post("/training", params={"token": site.token}, content=b"1")
    assert mine.status_code == 200
    picture = f"/training/{mine.json()['id']}/picture.png?token={site.token}"
    (held._folder / mine.json()["id"] / "picture.png").write_bytes(png())
    assert shared.get(picture).status_code == 404
    held._set(picture="picture.png")
    assert shared.get(picture).headers["content-type"] == "image/png"
    # Nothing else is offered before there is a rule, and nothing but rule and page after.
    (held._folder / mine.json()["id"] / "rule.safetensors").write_bytes(b"rule")
    for path in ("rule.safetensors", "dropped", "..%2f..%2fsecret", "output.txt"):
        address = f"/training/{mine.json()['id']}/{path}?token={site.token}"
        assert shared.get(address).status_code == 404
        held._set(has_rule=True)
        assert shared.get(address).status_code == (200 if path.startswith("rule") else 404)
        held._set(has_rule=False)
    assert client_of(Training(held._folder))[1].get("/training/x/page.html").status_code == 404


def test_what_is_to_grow_is_written_as_a_picture_of_limited_size(tmp_path):
    (tmp_path / "dropped").write_bytes(png(size=(1600, 800)))
    read_dropped(tmp_path / "dropped")
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.size == (1024, 512)
        assert picture.getpixel((512, 256)) == (255, 40, 40, 255)
        assert picture.getpixel((2, 2))[3] == 0


def test_an_opaque_photograph_is_refused_with_its_cure(tmp_path):
    path = tmp_path / "dropped"
    path.write_bytes(png(noise=True))
    with pytest.raises(NPAError, match="keep_background"):
        read_dropped(path)
    read_dropped(path, whole=True)
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.getextrema()[3] == (255, 255)


@pytest.mark.parametrize(
    ("name", "content", "error"),
    [
        ("dropped", b"no picture", r"must be a 3D file \(\.glb.*\) or a picture \(PNG"),
        ("dropped", png()[:-60], "truncated or damaged"),
        ("dropped", png(size=(8, 8)).replace(b"IHDR", b"IHDX"), "or a picture|truncated"),
        ("emoji.txt", b"gecko", "one picture symbol, got 'gecko'"),
        ("emoji.txt", b"\xff\xfe", "picture symbol|colour-emoji font|an installed font|one emoji"),
        ("emoji.txt", "/\U0001f98a".encode(), "one picture symbol"),
        ("emoji.txt", b"", "one picture symbol"),
    ],
)  # fmt: skip
def test_what_cannot_be_learned_is_refused(tmp_path, name, content, error):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(NPAError, match=error):
        read_dropped(tmp_path / name)


def test_what_cannot_be_read_is_refused_without_the_slow_import_of_torch(tmp_path):
    paths = [tmp_path / f"dropped{end}" for end in ("", ".glb", ".obj", ".ply")]
    for path in (*paths, tmp_path / "emoji.txt"):
        path.write_bytes(b"nothing of use")
    code = (
        "import sys; from npa_envs.web.dropped_file import main\n"
        "print([main([path]) for path in sys.argv[1:]], {'torch', 'warp'} & {*sys.modules})"
    )
    command = [sys.executable, "-c", code, *map(str, paths), str(tmp_path / "emoji.txt")]
    printed = subprocess.check_output(command, text=True)
    assert printed.splitlines()[-1] == "[2, 2, 2, 2, 2] set()"


def test_a_mesh_of_too_many_triangles_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("trimesh")
    path = tmp_path / "dropped.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n", encoding="utf-8")
    read_dropped(path)
    monkeypatch.setattr(dropped_file, "MAX_TRIANGLES", 1)
    with pytest.raises(NPAError, match="at most 1 triangles or points, got 2"):
        read_dropped(path)


def save_heart(rule, path: Path) -> None:
    """Save a rule as if trained like the shipped heart."""
    metadata = rule_metadata(shipped_rules()["heart"])
    save_rule(rule, path, metadata={name: metadata[name] for name in ("task", "config")})


@pytest.fixture
def learning(tmp_path):
    """The world of a training that learns the shipped heart, the training, its configuration."""
    save_heart(load_rule("heart"), path := tmp_path / "rule.safetensors")
    training = Training(tmp_path)
    training._set(state="learning", id="x", name="heart.png", folder=str(tmp_path), has_rule=True)
    world = LearningWorld(training, device=CPU)
    config = trained_config(path, rule_metadata(path))
    # Without steps of the rule, which would take long.
    world._rollout = lambda *_: torch.zeros(world.particles.x.shape[:2])
    return world, training, config


def age_at_which_it_begins_again(world, ages) -> int | None:
    for age in ages:
        world.step = age - 1
        world._run(1)
        if world.step == 0:
            return age
    return None


def test_a_world_of_an_early_rule_begins_again_after_four_rollouts_and_a_later_ones_lives_longer(
    learning,
):
    world, training, config = learning
    early, longest = 4 * config.steps[1], config.max_age_range[1]
    assert age_at_which_it_begins_again(world, [early - 1, early, early + 1]) == early
    training._set(iteration=500, total=1000)
    ages = [early, longest // 2 - 1, longest // 2]
    assert age_at_which_it_begins_again(world, ages) == longest // 2
    training._set(state="done")
    assert age_at_which_it_begins_again(world, [longest, 10 * longest]) is None


def test_what_a_brush_has_done_is_seen_for_another_life(learning):
    world, _, config = learning
    life = 4 * config.steps[1]
    world.step = life - 10
    wipe = {"type": "brush", "tool": "wipe", "at": [0.0, 0.0], "move": [0.0, 0.0], "radius": 0.1}
    world.handle(wipe)
    ages = [life, 2 * life - 11, 2 * life - 10]
    assert age_at_which_it_begins_again(world, ages) == 2 * life - 10
    assert age_at_which_it_begins_again(world, [life - 1, life]) == life


def test_a_world_that_leaves_the_view_begins_again_while_it_learns(learning):
    world, training, _ = learning
    for share, state, step in ((0.01, "learning", 1), (0.1, "learning", 0), (0.1, "done", 1)):
        training._set(state=state)
        world.reset(0)
        strays = round(share * world.count)
        world.particles.x[0, :strays, 1] = -1.01 * world.task.frame.half_width
        world._run(1)
        assert world.step == step


def test_a_world_takes_later_rules_and_begins_once_more_at_the_end(learning):
    world, training, _ = learning
    rule = load_rule("heart")
    with torch.no_grad():
        rule.hidden.bias += 0.01
    save_heart(rule, world._run_folder.rule)
    world.step = 5
    world._poll()
    assert world.step == 5
    assert torch.equal(world.main.rule.hidden.bias, rule.hidden.bias)
    training._set(state="done")
    world._poll()
    assert world.step == 0
    world.step = 5
    world._poll()
    assert world.step == 5


def test_a_world_is_called_by_its_picture_and_has_a_loss_once_it_has_learned(learning):
    world, training, _ = learning
    shown, name = world.describe(), "heart.png"
    assert (shown["title"], shown["others"], shown["species"]) == (name, [name], [name])
    assert shown["capabilities"] == ["film"]
    add = {"type": "brush", "tool": "add", "at": [0.5, 0.0], "radius": 0.1, "rule": name}
    world.handle(add)
    assert len(world.particles.x[0]) > world.count
    world.take_events()
    training._set(state="done")
    world._poll_due = 0.0
    shown = [event for event in world.take_events() if event["type"] == "world"][-1]
    assert shown["capabilities"] == ["film", "loss"]


def test_a_learned_rule_stays_where_the_next_file_comes_at_once(tmp_path, monkeypatch):
    def learn(self, stored, whole):
        (stored.parent / "rule.safetensors").write_bytes(b"rule")
        # The next run's report is there before the thread of this one has ended.
        self._set(state="reading", has_rule=False)

    monkeypatch.setattr(Training, "_read_and_learn", learn)
    training = Training(tmp_path)
    run_id = training.begin("a.png", b"1")
    training.close()
    assert (tmp_path / run_id / "rule.safetensors").exists()


@pytest.mark.parametrize("learned_before", [False, True])
def test_stopped_before_there_is_a_rule_the_page_hears_that_nothing_was_learned(
    tmp_path, monkeypatch, learned_before
):
    training = Training(tmp_path)
    if learned_before:
        training._set(id="x", name="a.png", has_rule=True)
        training._end("done")
    monkeypatch.setattr(Training, "_call", lambda self, *_, **__: self._stopping.wait(60) and "")
    training.begin("b.obj", b"1")
    training.stop()
    report = ended(training)
    assert report["message"] == "Stopped before anything was learned."
    assert report["has_rule"] == learned_before
    end = (report["state"], report["name"], report.get("refused"))
    assert end == (("done", "a.png", "b.obj") if learned_before else ("stopped", "b.obj", None))


# With processes.


@pytest.mark.parametrize(("device", "known"), [("cpu", True), ("cuda", False)])
def test_the_page_hears_before_the_start_how_long_a_run_takes(tmp_path, monkeypatch, device, known):
    monkeypatch.setattr(Training, "_call", lambda *_, **__: "")
    training = Training(tmp_path, device=device, preset="fast")
    training.begin("a.obj", b"1")
    assert ended(training)["state"] == "done"
    seconds = task_entry("morphogenesis3d").fast_seconds
    assert training.report["expected"] == (seconds if known else None)


def test_the_page_hears_in_words_what_the_child_refuses(tmp_path):
    training = Training(tmp_path)
    training.begin("holiday.jpg", png(noise=True))
    report = ended(training)
    assert (report["state"], report["cure"]) == ("failed", "whole")
    assert "holiday.jpg" in report["message"]
    assert str(tmp_path) not in report["message"]
    # Nothing is left of it.
    wait_until(lambda: list(tmp_path.iterdir()) == [])


def test_what_is_refused_leaves_the_last_learned_rule_to_the_pages(tmp_path, monkeypatch):
    def learn(self, stored, whole):
        (stored.parent / "rule.safetensors").write_bytes(b"rule")
        self._set(has_rule=True)
        self._end("done")

    training = Training(tmp_path)
    _, client = client_of(training)
    with monkeypatch.context() as patched:
        patched.setattr(Training, "_read_and_learn", learn)
        run_id = training.begin("a.png", b"1")
        learned = ended(training)
    for name, content, part in (
        ("holiday.jpg", png(noise=True), "keep_background"), ("hello", b"hello", "one picture sym"),
    ):  # fmt: skip
        training.begin(name, content, emoji=name == "hello")
        assert not training.report["has_rule"]
        report = ended(training)
        assert part in report["message"]
        cure = {"cure": "whole"} if name == "holiday.jpg" else {}
        added = {"refused": name, "message": report["message"]} | cure
        assert report == learned | added
        assert client.get(f"/training/{run_id}/rule.safetensors").content == b"rule"
    with monkeypatch.context() as patched:
        patched.setattr(Training, "_read_and_learn", learn)
        training.begin("b.png", b"1")
        report = ended(training)
    assert (report["name"], report["state"]) == ("b.png", "done")
    assert not {"refused", "message", "cure"} & set(report)


@pytest.mark.slow
def test_a_file_whose_reading_takes_too_long_or_too_much_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(training_session, "READ_SECONDS", 0.1)
    training = Training(tmp_path)
    training.begin("a.png", png())
    assert "must take at most 0.1 s" in ended(training)["message"]
    wait_until(lambda: processes_of(tmp_path) == [])
    if sys.platform == "linux":
        code = (
            "from npa_envs.web.dropped_file import limit_resources; limit_resources()\n"
            "try: bytearray(2**32)\nexcept MemoryError: print('limited')"
        )
        assert subprocess.check_output([sys.executable, "-c", code], text=True) == "limited\n"


@pytest.mark.slow
def test_a_dropped_picture_is_learned_and_offered(tmp_path):
    training = Training(tmp_path, preset="tiny")
    run_id = training.begin("red <disk>.png", png())
    report = ended(training)
    assert (report["state"], report["iteration"], report["total"]) == ("done", 40, 40)
    assert report["loss"] > 0
    rule = load_rule(training.file(run_id, "rule.safetensors"))
    assert rule.hidden_dim == 32
    page = training.file(run_id, "page.html").read_text(encoding="utf-8")
    assert "<title>red &lt;disk&gt;.png</title>" in page
    assert "<disk>" not in page
    with pytest.raises(NPAError):
        training.begin("a.png", b"")
    # Another one can be learned afterwards; the first keeps its folder.
    other = training.begin("b.png", png(opaque=True))
    assert training.file(run_id, "rule.safetensors") is None
    training.close()
    assert training.report["refused"] == "b.png"
    assert training.file(run_id, "rule.safetensors").exists()
    assert (tmp_path / run_id / "rule.safetensors").exists()
    assert other != run_id


@pytest.mark.slow
def test_a_stopped_training_keeps_its_rule_and_no_process(tmp_path):
    training = Training(tmp_path)
    training.begin("a.png", png())
    wait_until(lambda: training.report.get("iteration", 0) >= 10)
    assert processes_of(tmp_path)
    training.stop()
    assert ended(training)["state"] == "stopped"
    wait_until(lambda: processes_of(tmp_path) == [], 60)
    assert load_rule(training.file(training.report["id"], "rule.safetensors")).state_dim == 16


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["reading", "learning"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_process_outlives_the_server(tmp_path, moment, number):
    command = [sys.executable, "-m", "npa_envs", "view", "heart", "--particle-count", "64"]
    command += ["--no-browser", "--port", "0", "--out", str(tmp_path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, encoding="utf-8", start_new_session=True
    ) as run:
        address = run.stdout.readline().split()[1]
        request = urllib.request.Request(f"{address}training?name=a.png", data=png(), method="POST")
        with urllib.request.urlopen(request, timeout=60) as answer:
            folder = tmp_path / json.load(answer)["id"]
        if moment == "learning":
            log = folder / "log.jsonl"
            wait_until(lambda: log.exists() and log.stat().st_size > 0)
        wait_until(lambda: processes_of(folder))
        os.kill(run.pid, number)
        run.wait(timeout=60)
        wait_until(lambda: processes_of(folder) == [], 60)


# In a browser.


@pytest.mark.slow
def test_a_drop_is_watched_in_its_tab_and_offered_in_another(new_page, tmp_path):
    def make_world():
        torch.set_num_threads(1)
        return RuleWorld("heart", device=CPU, particle_count=64)

    training = Training(tmp_path / "runs", preset="tiny")
    site = server.Site(make_world, films=tmp_path, training=training)
    listener = server.open_port(site.host, 0)
    viewer = server.make_server(site)
    thread = threading.Thread(target=viewer.run, kwargs={"sockets": [listener]})
    thread.start()
    first, second = new_page(), new_page()

    def drop(page, content, name):
        data = base64.b64encode(content).decode()
        page.run(
            f"(() => {{ const bytes = Uint8Array.from(atob('{data}'), (c) => c.charCodeAt()); "
            f"const moved = new DataTransfer(); moved.items.add(new File([bytes], '{name}')); "
            "dispatchEvent(new DragEvent('drop', { dataTransfer: moved })); })()"
        )

    says = "document.getElementById('training').innerText"
    escape = "dispatchEvent(new KeyboardEvent('keydown', { key: 'Escape', bubbles: true }))"
    try:
        for page in (first, second):
            page.open(server.address_of(site, listener), DESK)
            page.wait("document.page.frame.step > 1")
            page.wait(f"{says}.includes('Grow your own picture')")
        drop(first, png(noise=True), "photo.jpg")
        first.wait(f"{says}.includes('Grow the whole picture')")
        assert "photo.jpg" in first.run(says)
        drop(first, png(), "disk.png")
        second.wait(f"{says}.includes('Learning disk.png')")
        drop(second, png(), "late.png")
        second.wait(f"{says}.includes('disk.png still is')")
        first.wait("document.page.world.title === 'disk.png'")
        first.wait(f"{says}.includes('Learned in')")
        assert second.run("document.page.world.title") == "heart"
        second.run("[...document.querySelectorAll('#training button')]"
                   ".find((one) => one.textContent === 'Watch').click()")  # fmt: skip
        second.wait("document.page.world.title === 'disk.png'")
        links = second.run("[...document.querySelectorAll('#training a')].map((a) => a.href)")
        for link, part in zip(links, (b"iteration", b"<title>disk.png</title>"), strict=True):
            with urllib.request.urlopen(link, timeout=120) as answer:
                assert part in answer.read()
        # A page that is loaded again goes on with what it has begun.
        first.run("location.reload()")
        first.wait("document.page.world.title === 'disk.png'")
        first.run("(sessionStorage.clear(), location.reload())")
        entries = "[...document.querySelectorAll('#training button')].map((b) => b.textContent)"
        first.wait(f"document.page.frame.step > 1 && {entries}.length === 2")
        assert first.run(entries) == ["Grow your own picture", "Watch disk.png"]
        first.run("document.querySelector('#training button:last-of-type').click()")
        first.wait(f"document.page.world.title === 'disk.png' && {says}.includes('Learned in')")
        first.run(f"document.body.{escape}")
        assert first.run(says) == "Grow your own picture"
        assert not first.complaints
        assert all("409" in complaint for complaint in second.complaints)
    finally:
        for page in (first, second):
            page.open("about:blank")
        viewer.should_exit = True
        thread.join(60)
        training.close()
