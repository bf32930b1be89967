"""The viewer's server: who may connect, what travels, what it does with bad messages."""

from __future__ import annotations

import contextlib
import io
import json
import socket
import struct
import threading
import time

import numpy as np
import pytest
import torch
from PIL import Image

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.web.messages import FrameEvent
from npa_envs.world.particles import Particles

pytest.importorskip("uvicorn")
testclient = pytest.importorskip("starlette.testclient")

from starlette.websockets import WebSocketDisconnect  # noqa: E402

from npa_envs.web import server  # noqa: E402
from npa_envs.web.training_session import Training  # noqa: E402

HERE = "http://127.0.0.1:8765"
SOCKET = "ws://127.0.0.1:8765/socket"
THERE = "ws://lab.example:8765/socket"


class Counter:
    """A live world of two particles that counts its steps."""

    def __init__(self) -> None:
        self.playing = True
        self.step = 0
        self.closed = threading.Event()

    def describe(self):
        return {"type": "world", "title": "counter", "playing": self.playing}

    def handle(self, message):
        match message.get("type"):
            case "play":
                self.playing = message["on"]
                return True
            case "break":
                raise NPAError("this cannot be done")
        return False

    def advance(self):
        self.step += 1
        if self.step == 13:
            raise NPAError("thirteen")

    def frame(self):
        positions = np.array([[self.step, 0.5], [-1.0, 0.25]], dtype=np.float32)
        colours = np.array([[255, 0, 1], [2, 3, 4]], dtype=np.uint8)
        return FrameEvent(self.step, positions, colours, 1.5, 0.125 if self.step == 2 else None)

    def take_events(self):
        return []

    def close(self):
        self.closed.set()


@pytest.fixture
def worlds():
    return []


@pytest.fixture
def site(tmp_path, worlds):
    def make_world():
        worlds.append(Counter())
        return worlds[-1]

    return server.Site(make_world, films=tmp_path / "films")


def client_of(site, base_url=HERE):
    return testclient.TestClient(server.make_app(site), base_url=base_url)


@pytest.fixture
def client(site):
    return client_of(site)


@contextlib.contextmanager
def meet(client):
    """Open the socket, and take the first event."""
    with client.websocket_connect(SOCKET) as reader:
        assert reader.receive_json() == {"type": "world", "title": "counter", "playing": True}
        yield reader


def refuse(client, address, **headers):
    """Check that a socket is not opened."""
    with (
        pytest.raises(WebSocketDisconnect) as refusal,
        client.websocket_connect(address, headers=headers),
    ):
        pass
    assert refusal.value.code == 1008


def next_event(reader, *types) -> dict:
    """Return the next event of some types; frames are answered."""
    while True:
        message = reader.receive()
        if "bytes" in message:
            reader.send_json({"type": "drawn"})
        elif (event := json.loads(message["text"]))["type"] in types:
            return event


def next_error(reader) -> str:
    return next_event(reader, "error")["message"]


def test_the_page_and_its_files_are_served(client):
    page = client.get("/")
    assert page.status_code == 200
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert "unsafe" not in page.headers["content-security-policy"]
    for name in ("page.js", "drawing.js", "plots.js", "server_connection.js", "page.css"):
        part = client.get(f"/{name}")
        assert part.status_code == 200
        assert name.split(".")[1] in part.headers["content-type"].replace("javascript", "js")


@pytest.mark.parametrize(
    "path",
    [
        "/server.py", "/../server.py", "/%2e%2e/server.py", "/..%2fserver.py", "/page", "/a%00.js",
        "/films/secret.txt", "/films/..%2f..%2fpage.js", "/films/none.mp4", "/nothing.js",
        f"/films/{'a' * 5000}.gif", f"/{'a' * 5000}.js", "/films/a%00.gif", "/index.html",
    ],
)  # fmt: skip
def test_nothing_else_is_served(client, path):
    assert client.get(path).status_code == 404


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8765", "192.168.1.5", ""])
def test_only_names_of_this_computer_are_answered(client, host):
    answer = client.get("/", headers={"host": host})
    assert answer.status_code == 403
    assert "refused" in answer.text
    refuse(client, SOCKET, host=host)
    for own in ("localhost:8765", "127.0.0.1", "[::1]:8765"):
        assert client.get("/", headers={"host": own}).status_code == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "http://localhost:8765"]
)
def test_sockets_of_foreign_pages_are_rejected(client, worlds, origin):
    refuse(client, SOCKET, origin=origin)
    assert worlds == []
    with client.websocket_connect(SOCKET, headers={"origin": HERE}) as reader:
        assert reader.receive_json()["title"] == "counter"


def test_a_server_that_others_reach_asks_for_a_token(tmp_path):
    site, other = (server.Site(Counter, films=tmp_path, host="0.0.0.0") for _ in range(2))
    assert len(site.token) >= 24
    assert site.token != other.token
    client = client_of(site, "http://lab.example:8765")
    for path in ("/", "/?token=wrong", "/films/film.mp4?token=é"):
        assert client.get(path).status_code == 403
        assert client.get(path, headers={"host": "lab/page.js?"}).status_code == 403
    assert client.get(f"/?token={site.token}").status_code == 200
    for address in (THERE, f"{THERE}?token=", f"{THERE}?token=wrong"):
        refuse(client, address)
    refuse(client, f"{THERE}?token={site.token}", origin="http://evil.example")
    with client.websocket_connect(f"{THERE}?token={site.token}") as reader:
        assert reader.receive_json()["title"] == "counter"


def test_loopback_addresses_need_no_token(tmp_path):
    loopback, others = ("127.0.0.1", "localhost", "::1", "127.8.9.1"), ("0.0.0.0", "::", "", "lab")
    for host in (*loopback, *others):
        assert (server.Site(Counter, films=tmp_path, host=host).token is None) == (host in loopback)


def test_frames_travel_as_they_are(client):
    with meet(client) as reader:
        first, second = reader.receive_bytes(), reader.receive_bytes()
    assert struct.unpack("<IIIff", second[:20]) == (2, 2, 2, 1.5, 0.125)
    np.testing.assert_array_equal(
        np.frombuffer(second[20:36], "<f4"), np.array([2.0, 0.5, -1.0, 0.25], np.float32)
    )
    assert list(second[36:]) == [255, 0, 1, 2, 3, 4]
    assert np.isnan(struct.unpack("<f", first[16:20])[0])


def test_the_world_waits_for_a_page_that_does_not_draw(client, worlds):
    with meet(client) as reader:
        for _ in range(server.FRAMES_AHEAD):
            reader.receive_bytes()
        time.sleep(0.3)
        assert worlds[0].step == server.FRAMES_AHEAD
        reader.send_json({"type": "drawn"})
        reader.receive_bytes()
        time.sleep(0.1)
        assert worlds[0].step == server.FRAMES_AHEAD + 1
        # Messages are applied at once; the next frame shows it.
        reader.send_json({"type": "play", "on": False})
        assert reader.receive_json()["playing"] is False
    assert worlds[0].closed.wait(5)


def test_a_world_that_is_paused_is_shown_after_each_message(client, worlds):
    with meet(client) as reader:
        reader.send_json({"type": "play", "on": False})
        while "text" not in (message := reader.receive()):
            reader.send_json({"type": "drawn"})
        assert json.loads(message["text"])["playing"] is False
        for _ in range(server.FRAMES_AHEAD):
            reader.send_json({"type": "drawn"})
        steps = {struct.unpack_from("<I", reader.receive_bytes())[0]}
        reader.send_json({"type": "brush"})
        steps.add(struct.unpack_from("<I", reader.receive_bytes())[0])
        assert steps == {worlds[0].step}


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("{", "a message must be a JSON object, got '{'"),
        ("[1]", "a message must be a JSON object"),
        ("null", "a message must be a JSON object"),
        ("[" * 100_000, "a message must be a JSON object"),
        ('{"type": "break"}', "this cannot be done"),
        ('{"type": "film", "action": "sing"}', "action must be 'start', then 'stop', got 'sing'"),
        ('{"type": "film", "action": "stop"}', "action must be 'start', then 'stop'"),
    ],
)
def test_bad_messages_are_reported_and_the_world_goes_on(client, text, error):
    with meet(client) as reader:
        reader.send_text(text)
        assert error in next_error(reader)
        reader.send_json({"type": "drawn"})
        assert reader.receive_bytes()


def test_a_world_that_fails_is_paused_and_says_why(client, worlds):
    with meet(client) as reader:
        assert next_error(reader) == "thirteen; the world is paused"
        assert reader.receive_json()["playing"] is False
        worlds[0].step = 20
        reader.send_json({"type": "play", "on": True})
        reader.receive_json()
        assert reader.receive_bytes()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_the_page_learns_why_there_is_no_world(tmp_path, monkeypatch):
    def fail():
        raise NPAError("no such rule")

    site = server.Site(fail, films=tmp_path)
    with client_of(site).websocket_connect(SOCKET) as reader:
        assert next_error(reader) == "no such rule"

    # A training's world that cannot be made leaves the page with its own.
    monkeypatch.setattr(Counter, "particles", Particles(*torch.zeros(2, 1, 2, 2)), raising=False)
    site = server.Site(Counter, films=tmp_path, training=Training(tmp_path))
    site.training._set(id="a", name="a.png", folder=str(tmp_path / "gone"), has_rule=True)
    with meet(client_of(site)) as reader:
        reader.send_json({"type": "training", "action": "show"})
        assert "gone" in next_error(reader)
        assert next_event(reader, "world")["title"] == "counter"

    class Broken(Counter):
        def advance(self):
            raise RuntimeError("out of memory")

    with meet(client_of(server.Site(Broken, films=tmp_path))) as reader:
        assert next_error(reader) == "the world has ended: out of memory"


def test_a_page_that_says_it_has_drawn_more_gets_no_more_ahead(tmp_path):
    begun, released = threading.Event(), threading.Event()

    class Held(Counter):
        def advance(self):
            if self.step == server.FRAMES_AHEAD:
                begun.set()
                assert released.wait(60)
            super().advance()

    with meet(client_of(server.Site(Held, films=tmp_path))) as reader:
        reader.send_json({"type": "drawn"})
        assert begun.wait(60)
        for _ in range(50):
            reader.send_json({"type": "drawn"})
        # It is answered once all before it are read.
        reader.send_text("no JSON")
        frames = 0
        while "text" not in reader.receive():
            frames += 1
        released.set()
        while frames < 1 + 2 * server.FRAMES_AHEAD:
            reader.receive_bytes()
            frames += 1
        # A frame more would come before the answer.
        time.sleep(0.3)
        reader.send_text("no JSON")
        assert "text" in reader.receive()


def test_each_reader_has_a_world_and_there_is_room_for_some(client, worlds):
    with contextlib.ExitStack() as readers:
        for _ in range(server.MAX_SESSIONS):
            readers.enter_context(meet(client))
        assert len(worlds) == server.MAX_SESSIONS
        late = readers.enter_context(client.websocket_connect(SOCKET))
        with pytest.raises(WebSocketDisconnect, match=r".*"):
            late.receive_json()
    assert all(world.closed.wait(60) for world in worlds)
    with meet(client):
        pass


def test_worlds_that_take_turns_are_never_at_work_together(tmp_path):
    busy = threading.Lock()
    clashes = []

    class Jealous(Counter):
        def advance(self):
            if not busy.acquire(blocking=False):
                clashes.append(self.step)
                return
            time.sleep(0.002)
            self.step += self.step != 12
            busy.release()

    client = client_of(server.Site(Jealous, films=tmp_path, one_at_a_time=True))
    with meet(client) as first, meet(client) as second:
        for _ in range(30):
            for reader in (first, second):
                while "bytes" not in reader.receive():
                    pass
                reader.send_json({"type": "drawn"})
    assert clashes == []


def jpeg(size=(32, 24), colour=(200, 30, 40)) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", size, colour).save(file, "JPEG")
    return file.getvalue()


def test_a_recording_is_a_film(client, site):
    with recording(client, [jpeg(colour=(40 * k, 30, 40)) for k in range(5)]) as reader:
        files = [next_event(reader, "file", "error") for _ in range(2)]
    assert {path.suffix for path in site.films.iterdir()} == {".gif", ".mp4"}
    for event in files:
        film = client.get("/" + event["url"])
        assert film.status_code == 200
        assert film.content == (site.films / event["name"]).read_bytes()
    (gif,) = site.films.glob("*.gif")
    with Image.open(gif) as film:
        assert film.n_frames == 5
        assert film.size == (32, 24)


def test_a_film_that_is_long_enough_ends_by_itself(client, site, monkeypatch):
    monkeypatch.setattr(server, "MAX_PICTURES", 3)
    with meet(client) as reader:
        reader.send_json({"type": "film", "action": "start"})
        for _ in range(5):
            reader.send_bytes(jpeg())
        events = [next_event(reader, "film", "file") for _ in range(2)]
    # The page stops sending at once; the files may take long.
    assert events[0] == {"type": "film", "action": "stop"}
    assert events[1]["type"] == "file"
    (film,) = site.films.glob("*.gif")
    with Image.open(film) as frames:
        assert frames.info["duration"] * getattr(frames, "n_frames", 1) <= 120


@contextlib.contextmanager
def recording(client, pictures):
    """Send pictures of a film, and end it."""
    with meet(client) as reader:
        reader.send_json({"type": "play", "on": False})
        reader.send_json({"type": "film", "action": "start"})
        for picture in pictures:
            reader.send_bytes(picture)
        reader.send_json({"type": "film", "action": "stop"})
        yield reader


def test_films_of_one_moment_are_different_files(tmp_path, monkeypatch):
    monkeypatch.setattr(server.time, "strftime", lambda pattern: "film-20260101-120000")
    names = [path.name for _ in range(2) for path in server.write_film([jpeg()], tmp_path)]
    assert len(set(names)) == len(list(tmp_path.iterdir())) == 4


def test_without_ffmpeg_there_is_a_gif(client, site, monkeypatch):
    def refuse(*_):
        raise MissingDependencyError("an MP4 file needs imageio with ffmpeg")

    monkeypatch.setattr(server, "write_mp4", refuse)
    with recording(client, [jpeg()]) as reader:
        error, file = (next_event(reader, "file", "error") for _ in range(2))
    assert error["message"] == "an MP4 file needs imageio with ffmpeg"
    (gif,) = site.films.iterdir()
    assert (file["name"], gif.suffix) == (gif.name, ".gif")


@pytest.mark.parametrize(
    ("pictures", "error"),
    [
        ([b"no picture"], "a film's picture must be a whole JPEG"),
        ([jpeg((2000, 8))], r"at most 1024 pixels on each side, got (2000, 8)"),
        ([], "the film has no pictures"),
        ([jpeg()[:-8]], "a film's picture must be a whole JPEG"),
        ([jpeg(), jpeg((16, 16))], "frames must all have one size"),
    ],
)
def test_wrong_pictures_of_a_film_are_reported(client, pictures, error):
    with recording(client, pictures) as reader:
        assert error in next_error(reader)


def test_a_port_in_use_is_passed_over_or_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(NPAError, match=rf"port {port} of 127\.0\.0\.1 cannot be bound"):
            server.open_port("127.0.0.1", port)
    with server.open_port("127.0.0.1", None) as first, server.open_port("127.0.0.1", None) as next_:
        assert first.getsockname()[1] != next_.getsockname()[1]


@pytest.mark.parametrize(
    ("host", "port", "error"),
    [
        ("127.0.0.1", 70000, r"port must be in \[0, 65535\], got 70000"),
        ("no.such.host.invalid", 0, "host must be an address of this computer"),
        ("203.0.113.7", 0, "cannot be bound"),
        # What no name may be, and Python does not even ask the system about.
        ("..", 0, r"host must be an address of this computer, got '\.\.'"),
        ("a" * 70, 0, "host must be an address of this computer"),
        ("a\0b", 0, "host must be an address of this computer"),
    ],
)
def test_wrong_addresses_are_named(host, port, error):
    with pytest.raises(NPAError, match=error):
        server.open_port(host, port)


def test_more_messages_than_there_is_room_for_are_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "MESSAGES_KEPT", 4)
    released = threading.Event()

    class Held(Counter):
        def handle(self, message):
            return not released.wait(60)

    with meet(client_of(server.Site(Held, films=tmp_path))) as reader:
        for _ in range(8):
            reader.send_json({"type": "brush"})
        assert next_error(reader) == "too many messages: some are lost"
        released.set()
