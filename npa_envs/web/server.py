"""The viewer's server: files of the page, a live world for each WebSocket, films.

It binds the loopback address by default; at another address it requires a token. It refuses
requests with a foreign `Host` (DNS rebinding), and sockets and uploads of pages of another origin.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import io
import ipaddress
import json
import os
import queue
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from npa_envs.atomic_files import made_folder
from npa_envs.errors import MissingDependencyError, NPAError, shown
from npa_envs.render import write_gif, write_mp4
from npa_envs.web.dropped_file import MAX_BYTES
from npa_envs.web.export import PAGE
from npa_envs.web.live_world import LiveWorld
from npa_envs.web.messages import FrameEvent
from npa_envs.web.training_session import LearningWorld, Training

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.middleware import Middleware
    from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
    from starlette.requests import HTTPConnection, Request
    from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
    from starlette.routing import Route, WebSocketRoute
    from starlette.websockets import WebSocket, WebSocketDisconnect
except ImportError as error:
    raise MissingDependencyError(
        f"the viewer needs starlette and uvicorn, which are not installed ({error}): "
        "pip install 'npa-envs[view]'"
    ) from error

PORT = 8765
"""First default port."""

MAX_SESSIONS = 4
"""Maximum number of open pages; each has its own world."""

FRAMES_AHEAD = 2
"""Maximum number of frames that are sent and not drawn yet."""

FRAME_SECONDS = 1.0 / 60.0
"""Minimum time between two frames [s]."""

LEARNING_FRAME_SECONDS = 1.0 / 12.0
"""The same while a training needs the processor [s]."""

MESSAGES_KEPT = 256
"""Maximum number of messages in a queue; further ones are dropped."""

MAX_PICTURES = 500
"""Maximum number of pictures of a film, 20 seconds; writing takes a megabyte for each."""

MAX_PICTURE = 1024
"""Maximum number of pixels on each side of a film's pictures."""

HEADER = struct.Struct("<IIIff")
"""A frame's step, particles, dimension, milliseconds, loss (NaN: not computed)."""

SECURITY = {
    "Content-Security-Policy": "default-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Headers of every response."""


class Site:
    """What a server serves: its worlds, address and token.

    `make_world` makes the world of a page, in the thread that runs it. `films` is the folder for
    films. With `one_at_a_time` worlds do not run at the same time: a CUDA graph of one thread must
    not capture another's work. `training` learns files that are dropped on pages; None: no page
    offers it.
    """

    def __init__(
        self,
        make_world: Callable[[], LiveWorld],
        *,
        films: Path,
        host: str = "127.0.0.1",
        one_at_a_time: bool = False,
        training: Training | None = None,
    ) -> None:
        self.make_world, self.films, self.host = make_world, films, host
        self.training = training
        self.token = None if is_loopback(host) else secrets.token_urlsafe(24)
        """The required token, or None."""
        self.query = "" if self.token is None else f"?token={self.token}"
        self.exclusive: contextlib.AbstractContextManager[Any] = (
            threading.Lock() if one_at_a_time else contextlib.nullcontext()
        )
        """The context in which a world runs."""
        self.session_count = 0

    def refusal(self, asked: HTTPConnection) -> str | None:
        """Return why a request, or the socket of a page, is refused; None: it is answered."""
        host = asked.headers.get("host", "")
        # The name without port and brackets.
        in_brackets = host.startswith("[")
        name = host[1:].partition("]")[0] if in_brackets else host.partition(":")[0].lower()
        # With a token, any name is allowed: the token protects enough.
        named = self.token is not None or name in (self.host, "localhost", "127.0.0.1", "::1")
        if not name or not named:
            return f"ask for {self.host}, got {shown(host)}"
        # Without an origin it is no page; a form of another page always has one.
        own = (None, f"http://{host}", f"https://{host}")
        if asked.scope.get("method") != "GET" and asked.headers.get("origin") not in own:
            return "this server takes messages and files only from its own page"
        given = asked.query_params.get("token", "").encode()
        # Not the path of `asked.url`, which a forged host can change.
        public = self.token is None or asked.scope["path"].endswith((".js", ".css"))
        if not public and not secrets.compare_digest(given, str(self.token).encode()):
            return "open the link that npa-envs view has printed: it holds the token"
        return None


def is_loopback(host: str) -> bool:
    """Return whether only this computer can connect to an address."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def make_app(site: Site) -> Starlette:
    """Return the application that serves a site."""

    async def connect(page: WebSocket) -> None:
        if (reason := site.refusal(page)) is not None:
            return await page.close(1008, reason)
        await page.accept()
        if site.session_count >= MAX_SESSIONS:
            return await page.close(1013, f"{MAX_SESSIONS} worlds are open: close a page")
        site.session_count += 1
        try:
            await ViewerSession(site, page, asyncio.get_running_loop()).serve()
        finally:
            site.session_count -= 1

    async def guard(request: Request, call_next: RequestResponseEndpoint) -> Response:
        if (reason := site.refusal(request)) is None:
            response = await call_next(request)
        else:
            response = PlainTextResponse(f"refused: {reason}", 403)
        response.headers.update(SECURITY)
        return response

    films = {".gif": "image/gif", ".mp4": "video/mp4"}
    parts = {".js": "text/javascript", ".css": "text/css"}
    routes = [
        Route("/", lambda request: FileResponse(PAGE / "index.html")),
        WebSocketRoute("/socket", connect),
        Route("/films/{name}", functools.partial(_file_response, site.films, films)),
        *([] if site.training is None else training_routes(site.training)),
        Route("/{name}", functools.partial(_file_response, PAGE, parts)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(BaseHTTPMiddleware, dispatch=guard)])


def _file_response(folder: Path, media_types: Mapping[str, str], request: Request) -> Response:
    path = folder / request.path_params["name"]
    with contextlib.suppress(OSError, ValueError):  # Invalid file names.
        if path.parent == folder and path.suffix in media_types and path.is_file():
            return FileResponse(path, media_type=media_types[path.suffix])
    return PlainTextResponse("no such file", 404)


def training_routes(training: Training) -> list[Route]:
    """Return the routes by which pages give what is to be learned, and get what was."""

    async def upload(request: Request) -> Response:
        """Begin a training of the body; keywords are those of `Training.begin`."""
        query, content = request.query_params, bytearray()
        async for part in request.stream():
            content += part
            if len(content) > MAX_BYTES:
                break
        options = {word: word in query for word in ("emoji", "whole")}
        name = query.get("name", "")
        try:
            begun = await run_in_threadpool(training.begin, name, bytes(content), **options)
        except (NPAError, OSError) as error:
            return PlainTextResponse(str(error), 409 if training.active else 400)
        return JSONResponse({"id": begun})

    def download(request: Request) -> Response:
        try:
            path = training.file(request.path_params["id"], request.path_params["name"])
        except NPAError as error:
            return PlainTextResponse(str(error), 400)
        if path is None:
            return PlainTextResponse("no such file", 404)
        kind = "image/png" if path.suffix == ".png" else "application/octet-stream"
        return FileResponse(path, media_type=kind, filename=path.name)

    return [
        Route("/training", upload, methods=["POST"]),
        Route("/training/{id}/{name}", download),
    ]


def frame_bytes(frame: FrameEvent) -> bytes:
    """Return a frame as the bytes that server_connection.js reads: header, positions, colours."""
    count, dimension = frame.positions.shape
    loss = float("nan") if frame.loss is None else frame.loss
    header = HEADER.pack(frame.step, count, dimension, frame.milliseconds, loss)
    positions = np.ascontiguousarray(frame.positions, dtype="<f4").tobytes()
    return header + positions + np.ascontiguousarray(frame.colours).tobytes()


class ViewerSession:
    """The connection with one page, and a thread that runs its world.

    The world waits for a slow or hidden page: at most `FRAMES_AHEAD` frames are not drawn yet.
    """

    def __init__(self, site: Site, page: WebSocket, loop: asyncio.AbstractEventLoop) -> None:
        self._site, self._page, self._loop = site, page, loop
        self._inbox: queue.Queue[dict[str, Any] | bytes] = queue.Queue(MESSAGES_KEPT)
        self._outbox: asyncio.Queue[bytes | str] = asyncio.Queue(MESSAGES_KEPT)
        self._free_frames = threading.BoundedSemaphore(FRAMES_AHEAD)
        self._stopped = threading.Event()
        self._next_world: Callable[[], LiveWorld] | None = site.make_world
        self._pictures: list[bytes] | None = None
        """The pictures of the film, while one is made."""
        self._reported: Any = None
        """The last event "training" that was sent."""

    async def serve(self) -> None:
        """Read and write until the page disconnects or the server stops."""
        threading.Thread(target=self._world_thread, name="npa-envs world", daemon=True).start()
        writing = asyncio.create_task(self._write())
        try:
            await self._read()
        finally:
            # The world ends after its present frame.
            self._stopped.set()
            self._frame_drawn()
            writing.cancel()

    async def _read(self) -> None:
        while True:
            received = await self._page.receive()
            if received["type"] == "websocket.disconnect":
                return
            text, message = received.get("text") or "", received.get("bytes")
            if message is None:
                with contextlib.suppress(ValueError, RecursionError):
                    message = json.loads(text)
            if not isinstance(message, dict | bytes):
                self._send_error(f"a message must be a JSON object, got {shown(text)}")
            elif isinstance(message, dict) and message.get("type") == "drawn":
                self._frame_drawn()
            else:
                try:
                    self._inbox.put_nowait(message)
                except queue.Full:
                    self._send_error("too many messages: some are lost")

    async def _write(self) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                data = await self._outbox.get()
                if isinstance(data, bytes):
                    await self._page.send_bytes(data)
                else:
                    await self._page.send_text(data)

    def _frame_drawn(self) -> None:
        with contextlib.suppress(ValueError):  # The page reported more frames than were sent.
            self._free_frames.release()

    def _send_event(self, event: Mapping[str, Any]) -> None:
        self._post(json.dumps(event))

    def _send_error(self, message: str) -> None:
        self._send_event({"type": "error", "message": message})

    def _post(self, data: bytes | str) -> None:
        def put() -> None:
            with contextlib.suppress(asyncio.QueueFull):  # The page does not read.
                self._outbox.put_nowait(data)

        with contextlib.suppress(RuntimeError):  # The loop has ended.
            self._loop.call_soon_threadsafe(put)

    def _world_thread(self) -> None:
        while (make := self._next_world) is not None and not self._stopped.is_set():
            self._next_world = None
            try:
                with self._site.exclusive:
                    world = make()
            except NPAError as error:
                self._send_error(str(error))
                if make is not self._site.make_world:
                    self._next_world = self._site.make_world
                continue
            try:
                self._run_world(world)
            except Exception as error:
                # A bug or a failed device: shown on the page, and raised for the log.
                self._send_error(f"the world has ended: {shown(error)}")
                raise
            finally:
                world.close()

    def _run_world(self, world: LiveWorld) -> None:
        """Run a world until another one is wanted, or to the end."""
        self._send_event(world.describe())
        changed = True
        clock = self._loop.time
        due = clock()
        while not self._stopped.is_set() and self._next_world is None:
            changed |= self._apply_messages(world, wait=not (world.playing or changed))
            training = self._site.training
            if training is not None and training.report is not self._reported:
                self._reported = training.report
                self._send_event(self._reported)
            with self._site.exclusive:
                events = world.take_events()
            for event in events:
                self._send_event(event)
                changed = True
            if not (world.playing or changed):
                continue
            # A hidden page draws nothing; the loop still applies its messages.
            if not self._free_frames.acquire(timeout=0.25):
                continue
            self._stopped.wait(max(0.0, due - clock()))
            slow = training is not None and training.slows_worlds
            seconds = LEARNING_FRAME_SECONDS if slow else FRAME_SECONDS
            due = max(due, clock() - seconds) + seconds
            try:
                with self._site.exclusive:
                    if world.playing:
                        world.advance()
                    frame = world.frame()
                self._post(frame_bytes(frame))
            except NPAError as error:
                world.playing = False
                self._frame_drawn()
                self._send_error(f"{error}; the world is paused")
                self._send_event(world.describe())
            changed = False

    def _training_action(self, action: Any, world: LiveWorld) -> None:
        training = self._site.training
        if training is None:
            raise NPAError("this server learns no files: start it by npa-envs view")
        match action:
            case "stop":
                training.stop()
            case "show" if training.report.get("has_rule"):
                device = world.particles.x.device
                self._next_world = functools.partial(LearningWorld, training, device=device)
            case "leave":
                self._next_world = self._site.make_world
            case _:
                raise NPAError(
                    "a training's action must be 'stop', 'leave', or 'show' once there is a rule, "
                    f"got {shown(action)}"
                )

    def _apply_messages(self, world: LiveWorld, *, wait: bool) -> bool:
        """Apply the page's messages; return whether there were any. `wait`: for the first one."""
        taken = False
        while not self._stopped.is_set():
            try:
                message = self._inbox.get(block=wait and not taken, timeout=0.25)
            except queue.Empty:
                break
            taken = True
            try:
                if isinstance(message, bytes):
                    self._add_picture(message)
                elif message.get("type") == "film":
                    self._film_action(message.get("action"))
                elif message.get("type") == "training":
                    self._training_action(message.get("action"), world)
                else:
                    with self._site.exclusive:
                        changed = world.handle(message)
                    if changed:
                        self._send_event(world.describe())
            except NPAError as error:
                self._send_error(str(error))
        return taken

    def _film_action(self, action: Any) -> None:
        if action == "start":
            self._pictures = []
        elif action == "stop" and self._pictures is not None:
            self._end_film(self._pictures)
        else:
            raise NPAError(f"a film's action must be 'start', then 'stop', got {shown(action)}")

    def _end_film(self, pictures: list[bytes]) -> None:
        def write() -> None:
            written: list[Path] = []
            try:
                written += write_film(pictures, self._site.films)
            except NPAError as error:
                self._send_error(str(error))
            for path in written:
                url = f"films/{path.name}{self._site.query}"
                self._send_event({"type": "file", "name": path.name, "url": url})

        self._pictures = None
        # In a thread, so that the world keeps running.
        threading.Thread(target=write, daemon=True).start()

    def _add_picture(self, data: bytes) -> None:
        # Pictures that arrive after the film's end are ignored.
        if self._pictures is not None:
            self._pictures.append(data)
            if len(self._pictures) >= MAX_PICTURES:
                self._send_event({"type": "film", "action": "stop"})
                self._end_film(self._pictures)


def picture_of(data: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a film's picture, a JPEG file, uint8, shape [H, W, 3]."""
    try:
        picture = Image.open(io.BytesIO(data), formats=["JPEG"])
        if max(picture.size) > MAX_PICTURE:
            raise NPAError(
                f"a film's picture must have at most {MAX_PICTURE} pixels on each side, "
                f"got {picture.size}"
            )
        return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise NPAError(f"a film's picture must be a whole JPEG, got {shown(error)}") from error


def write_film(pictures: Sequence[bytes], folder: Path) -> Iterator[Path]:
    """Write JPEG pictures as a GIF and as an MP4; yield each file when it is written."""
    if not pictures:
        raise NPAError("the film has no pictures: let the world move while it records")
    # Random, as several films may end within the same second.
    name = f"{time.strftime('film-%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
    frames = [picture_of(data) for data in pictures]
    try:
        with made_folder(folder):
            # The GIF comes first, as it needs no ffmpeg.
            for suffix, write in ((".gif", write_gif), (".mp4", write_mp4)):
                path = folder / f"{name}{suffix}"
                write(path, frames, 25.0)
                yield path
    except NPAError:
        raise
    except (OSError, ValueError) as error:
        raise NPAError(f"the film cannot be written: {error}") from error


def open_port(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens on a port; None: the first free one from `PORT` on."""
    if port is not None and not 0 <= port <= 65535:
        raise NPAError(f"port must be in [0, 65535], got {port}: leave it out for a free one")
    ports = [port] if port is not None else [*range(PORT, PORT + 20), 0]
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise NPAError(
            f"host must be an address of this computer, got {shown(host)} ({shown(why)}): try "
            "127.0.0.1"
        ) from error
    reason = ""
    for number in ports:
        try:
            return socket.create_server(
                (address[0], number, *address[2:]), family=family, backlog=128
            )
        except OSError as error:
            reason = os.strerror(error.errno or 0)
    raise NPAError(
        f"port {ports[0]} of {host} cannot be bound ({reason}): it is in use, or not allowed; "
        "leave --port out for a free one"
    )


def address_of(site: Site, listener: socket.socket) -> str:
    """Return the URL of the page, with the token if one is required."""
    port = listener.getsockname()[1]
    # For a server on all addresses, the link names this computer.
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(site.host, site.host)
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{port}/{site.query}"


def make_server(site: Site) -> uvicorn.Server:
    """Return a server that runs until its `should_exit` is set."""
    config = uvicorn.Config(
        make_app(site),
        log_level="warning",
        ws_max_size=2**20,
        # Compressing frames takes longer than sending them, and gains little.
        ws_per_message_deflate=False,
        server_header=False,
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def serve(site: Site, listener: socket.socket) -> None:
    """Serve a site until Ctrl-C."""
    # The server shuts down first, then raises this.
    try:
        with contextlib.suppress(KeyboardInterrupt):
            make_server(site).run(sockets=[listener])
    finally:
        if site.training is not None:
            site.training.close()
