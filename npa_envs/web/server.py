"""The viewer's server: files of the page, a live world for each WebSocket, films.

It binds the loopback address by default; at another address it requires a token. It refuses
requests with a foreign `Host` (DNS rebinding), and sockets of pages of another origin.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import ipaddress
import json
import queue
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from npa_envs.errors import MissingDependencyError, NPAError, shown
from npa_envs.files import made_folder
from npa_envs.render import write_gif, write_mp4
from npa_envs.web.live import LiveWorld, WorldView

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import FileResponse, PlainTextResponse, Response
    from starlette.routing import Route, WebSocketRoute
    from starlette.websockets import WebSocket, WebSocketDisconnect
except ImportError as error:
    raise MissingDependencyError(
        f"the viewer needs starlette and uvicorn, which are not installed ({error}): "
        "pip install 'npa-envs[view]'"
    ) from error

PAGE = Path(__file__).resolve().parent / "page"
"""The folder of the page's files."""

PORT = 8765
"""First default port."""

PORTS_TRIED = 20
"""Number of default ports from `PORT` on."""

MAX_SESSIONS = 4
"""Most open pages; each has its own world."""

FRAMES_AHEAD = 2
"""Most frames that are sent and not drawn yet."""

FRAME_SECONDS = 1.0 / 60.0
"""Least time between two frames [s]."""

MAX_MESSAGE = 2**20
"""Most bytes of a message."""

MESSAGES_KEPT = 256
"""Most messages in a queue; others are dropped."""

MAX_PICTURES = 500
"""Most pictures of a film, 20 seconds; each takes a megabyte of memory when it is written."""

FILM_RATE = 25.0
"""Pictures of a film per second."""

MAX_PICTURE = 1024
"""Most pixels on each side of a film's pictures."""

KIND = 1
HEADER = struct.Struct("<IIIIff")
"""A frame's kind, step, particles, dimension, milliseconds, loss (NaN: not computed)."""

SECURITY = {
    "Content-Security-Policy": "default-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Headers of every response."""


@dataclass(frozen=True)
class Site:
    """Worlds, address and token of a server."""

    make_world: Callable[[], LiveWorld]
    """Makes the world of a page, in the thread that runs it."""
    films: Path
    """Folder of films; created with the first one."""
    host: str = "127.0.0.1"
    """The bound address."""
    token: str | None = None
    """The required token, or None."""
    one_at_a_time: bool = False
    """Worlds run one at a time: a CUDA graph of one thread must not record another's work."""
    turn: threading.Lock = field(default_factory=threading.Lock)
    open_sessions: list[ViewerSession] = field(default_factory=list)

    def alone(self) -> contextlib.AbstractContextManager[Any]:
        """Return the context in which a world runs alone."""
        return self.turn if self.one_at_a_time else contextlib.nullcontext()

    def allows_host(self, host: str) -> bool:
        """Return whether a request's `Host` is a name of this server."""
        # The name without port and brackets.
        closed = host.startswith("[")
        name = host[1:].partition("]")[0] if closed else host.partition(":")[0].lower()
        if self.token is not None:
            # With a token, any name is allowed: the token protects enough.
            return bool(name)
        return name == self.host or name in ("localhost", "127.0.0.1", "::1")

    @property
    def query(self) -> str:
        """The query string with the token, or an empty string."""
        return "" if self.token is None else f"?token={self.token}"

    def allows_token(self, token: str | None) -> bool:
        """Return whether the token is right, or none is required."""
        own = self.token
        return own is None or secrets.compare_digest((token or "").encode(), own.encode())


def make_site(
    make_world: Callable[[], LiveWorld],
    *,
    films: Path,
    host: str = "127.0.0.1",
    one_at_a_time: bool = False,
) -> Site:
    """Return a site; if `host` is no loopback address, it requires a new random token."""
    token = None if is_loopback(host) else secrets.token_urlsafe(24)
    return Site(make_world, films, host, token, one_at_a_time)


def is_loopback(host: str) -> bool:
    """Return whether only this computer can connect to an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def make_app(site: Site) -> Starlette:
    """Return the application that serves a site."""

    async def page(request: Request) -> Response:
        if not site.allows_token(request.query_params.get("token")):
            return _refused("open the link that npa-envs view has printed: it holds the token")
        return FileResponse(PAGE / "index.html", headers=SECURITY)

    async def part(request: Request) -> Response:
        name = request.path_params["name"]
        return _file(PAGE, name, {".js": "text/javascript", ".css": "text/css"})

    async def film(request: Request) -> Response:
        if not site.allows_token(request.query_params.get("token")):
            return _refused("films need the token of the page")
        name = request.path_params["name"]
        return _file(site.films, name, {".gif": "image/gif", ".mp4": "video/mp4"})

    async def meet(reader: WebSocket) -> None:
        host, origin = reader.headers.get("host", ""), reader.headers.get("origin")
        own = {f"http://{host}", f"https://{host}"}
        if not site.allows_host(host) or (origin is not None and origin not in own):
            return await reader.close(1008, "this server answers its own page alone")
        if not site.allows_token(reader.query_params.get("token")):
            return await reader.close(1008, "the token is missing or wrong")
        await reader.accept()
        if len(site.open_sessions) >= MAX_SESSIONS:
            return await reader.close(1013, f"{MAX_SESSIONS} worlds are open: close a page")
        session = ViewerSession(site, reader, asyncio.get_running_loop())
        site.open_sessions.append(session)
        try:
            await session.serve()
        finally:
            site.open_sessions.remove(session)

    app = Starlette(
        routes=[
            Route("/", page),
            WebSocketRoute("/socket", meet),
            Route("/films/{name}", film),
            Route("/{name}", part),
        ],
    )
    app.add_middleware(HostCheck, site=site)
    return app


class HostCheck:
    """Refuses requests whose `Host` is not the server's."""

    def __init__(self, app: Any, site: Site) -> None:
        self._app, self._site = app, site

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request."""
        if scope["type"] == "http":
            host = dict(scope["headers"]).get(b"host", b"").decode("latin-1")
            if not self._site.allows_host(host):
                name = self._site.host
                return await _refused(f"ask for {name}, got {shown(host)}")(scope, receive, send)
        await self._app(scope, receive, send)


def _file(folder: Path, name: str, kinds: Mapping[str, str]) -> Response:
    """Return the response with a file directly in a folder, or 404."""
    path = folder / name
    with contextlib.suppress(OSError, ValueError):  # Invalid file names.
        if path.parent == folder and path.suffix in kinds and path.is_file():
            return FileResponse(path, media_type=kinds[path.suffix], headers=SECURITY)
    return PlainTextResponse("no such file", 404, SECURITY)


def _refused(reason: str) -> Response:
    return PlainTextResponse(f"refused: {reason}", 403, SECURITY)


def frame_bytes(frame: WorldView) -> bytes:
    """Return the bytes of a frame: header, positions, colours."""
    count, dimension = frame.positions.shape
    loss = float("nan") if frame.loss is None else frame.loss
    header = HEADER.pack(KIND, frame.step, count, dimension, frame.milliseconds, loss)
    positions = np.ascontiguousarray(frame.positions, dtype="<f4").tobytes()
    return header + positions + np.ascontiguousarray(frame.colours).tobytes()


class ViewerSession:
    """One page's socket, and a thread with its world.

    The world waits for a slow or hidden page: at most `FRAMES_AHEAD` frames are not drawn yet.
    """

    def __init__(self, site: Site, reader: WebSocket, loop: asyncio.AbstractEventLoop) -> None:
        self._site, self._reader, self._loop = site, reader, loop
        self._inbox: queue.Queue[dict[str, Any] | bytes] = queue.Queue(MESSAGES_KEPT)
        self._outbox: asyncio.Queue[bytes | str | None] = asyncio.Queue()
        self._free_frames = threading.BoundedSemaphore(FRAMES_AHEAD)
        self._stopped = threading.Event()
        self._film: PageFilm | None = None

    async def serve(self) -> None:
        """Read and write until the page disconnects or the server stops."""
        threading.Thread(target=self._world_thread, name="npa-envs world", daemon=True).start()
        writing = asyncio.create_task(self._write())
        try:
            await self._read()
        finally:
            self.stop()
            writing.cancel()

    def stop(self) -> None:
        """End the world after its present frame."""
        self._stopped.set()
        self._frame_drawn()
        self._post(None)

    async def _read(self) -> None:
        while True:
            received = await self._reader.receive()
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
                self._enqueue(message)

    def _enqueue(self, message: dict[str, Any] | bytes) -> None:
        try:
            self._inbox.put_nowait(message)
        except queue.Full:
            self._send_error("too many messages: some are lost")

    async def _write(self) -> None:
        while (data := await self._outbox.get()) is not None:
            try:
                if isinstance(data, bytes):
                    await self._reader.send_bytes(data)
                else:
                    await self._reader.send_text(data)
            except (WebSocketDisconnect, RuntimeError):
                return

    def _frame_drawn(self) -> None:
        with contextlib.suppress(ValueError):  # The page reported more frames than were sent.
            self._free_frames.release()

    def _send_event(self, event: Mapping[str, Any]) -> None:
        self._post(json.dumps(event))

    def _send_error(self, message: str) -> None:
        self._send_event({"type": "error", "message": message})

    def _post(self, data: bytes | str | None) -> None:
        def put() -> None:
            # Events are dropped if the page does not read them; None ends the loop of `_write`.
            if data is None or self._outbox.qsize() < MESSAGES_KEPT:
                self._outbox.put_nowait(data)

        with contextlib.suppress(RuntimeError):  # The loop has ended.
            self._loop.call_soon_threadsafe(put)

    def _world_thread(self) -> None:
        try:
            with self._site.alone():
                world = self._site.make_world()
        except NPAError as error:
            return self._send_error(str(error))
        try:
            self._run_world(world)
        except Exception as error:
            # A bug or a failed device: shown on the page, and raised for the log.
            self._send_error(f"the world has ended: {shown(error)}")
            raise
        finally:
            world.close()

    def _run_world(self, world: LiveWorld) -> None:
        self._send_event(world.describe())
        changed = True
        clock = self._loop.time
        due = clock()
        while not self._stopped.is_set():
            changed |= self._apply_messages(world, wait=not (world.playing or changed))
            with self._site.alone():
                events = world.news()
            for event in events:
                self._send_event(event)
                changed = True
            if not (world.playing or changed):
                continue
            # A hidden page draws nothing; the loop still applies its messages.
            if not self._free_frames.acquire(timeout=0.25):
                continue
            self._stopped.wait(max(0.0, due - clock()))
            due = max(due, clock() - FRAME_SECONDS) + FRAME_SECONDS
            try:
                with self._site.alone():
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

    def _apply_messages(self, world: LiveWorld, *, wait: bool) -> bool:
        """Apply messages; return whether there were any."""
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
                else:
                    with self._site.alone():
                        changed = world.handle(message)
                    if changed:
                        self._send_event(world.describe())
            except NPAError as error:
                self._send_error(str(error))
        return taken

    def _film_action(self, action: Any) -> None:
        if action == "start":
            self._film = PageFilm()
        elif action == "stop" and self._film is not None:
            self._end_film(self._film)
        else:
            raise NPAError(f"a film's action must be 'start', then 'stop', got {shown(action)}")

    def _end_film(self, film: PageFilm) -> None:
        def write() -> None:
            try:
                for path in film.write(self._site.films):
                    url = f"films/{path.name}{self._site.query}"
                    self._send_event({"type": "file", "name": path.name, "url": url})
            except NPAError as error:
                self._send_error(str(error))

        self._film = None
        # In a thread, so that the world keeps running.
        threading.Thread(target=write, daemon=True).start()

    def _add_picture(self, data: bytes) -> None:
        # Pictures that come after the film's end are ignored.
        if self._film is not None:
            self._film.add(data)
            if len(self._film.pictures) >= MAX_PICTURES:
                self._send_event({"type": "film", "action": "stop"})
                self._end_film(self._film)


class PageFilm:
    """A film of pictures that a page has drawn."""

    def __init__(self) -> None:
        self.pictures: list[bytes] = []

    def add(self, data: bytes) -> None:
        """Add a picture, a JPEG file."""
        try:
            with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:
                size = picture.size
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            raise NPAError(f"a film's picture must be a JPEG, got {shown(error)}") from error
        if max(size) > MAX_PICTURE:
            raise NPAError(
                f"a film's picture must have at most {MAX_PICTURE} pixels on each side, got {size}"
            )
        self.pictures.append(data)

    def write(self, folder: Path) -> Iterator[Path]:
        """Write the film as GIF and as MP4; yield each file once it is written."""
        if not self.pictures:
            raise NPAError("the film has no pictures: let the world move while it records")
        try:
            frames = [
                np.asarray(Image.open(io.BytesIO(data), formats=["JPEG"]).convert("RGB"))
                for data in self.pictures
            ]
            # Random, as several films may end within the same second.
            name = f"{time.strftime('film-%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
            with made_folder(folder):
                # The GIF comes first, as it needs no ffmpeg.
                for suffix, write in ((".gif", write_gif), (".mp4", write_mp4)):
                    path = folder / f"{name}{suffix}"
                    write(path, frames, FILM_RATE)
                    yield path
        except NPAError:
            raise
        except (OSError, ValueError) as error:
            raise NPAError(f"the film cannot be written: {error}") from error


def open_port(host: str, port: int | None) -> socket.socket:
    """Return a listening socket on a port; None: the first free one from `PORT` on."""
    if port is not None and not 0 <= port <= 65535:
        raise NPAError(f"port must be in [0, 65535], got {port}: leave it out for a free one")
    tried = [port] if port is not None else [*range(PORT, PORT + PORTS_TRIED), 0]
    reason: OSError | None = None
    for number in tried:
        try:
            family, *_, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            listener = socket.socket(family, socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise NPAError(
                f"host must be an address of this computer, got {shown(host)} ({shown(why)}): try "
                "127.0.0.1"
            ) from error
        try:
            # The port of a server that has just ended can be used at once.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
        except OSError as error:
            listener.close()
            reason = error
            continue
        return listener
    raise NPAError(
        f"port {tried[0]} of {host} cannot be bound ({reason.strerror if reason else None}): it is "
        "in use, or not allowed; leave --port out for a free one"
    )


def address_of(site: Site, listener: socket.socket) -> str:
    """Return the link to the page."""
    port = listener.getsockname()[1]
    # For a server on all addresses, the link names this computer.
    name = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}.get(site.host, site.host)
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{port}/{site.query}"


def make_server(site: Site) -> uvicorn.Server:
    """Return a server that runs until its `should_exit` is set."""
    config = uvicorn.Config(
        make_app(site),
        log_level="warning",
        ws_max_size=MAX_MESSAGE,
        # Compressing frames takes longer than sending them, and gains little.
        ws_per_message_deflate=False,
        server_header=False,
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def serve(site: Site, listener: socket.socket) -> None:
    """Serve a site until Ctrl-C."""
    # The server shuts down first, then raises this.
    with contextlib.suppress(KeyboardInterrupt):
        make_server(site).run(sockets=[listener])
