"""A server for one page: files, a socket to a live world for each reader, films.

It binds the loopback address by default; bound elsewhere it asks for a token. It refuses requests
whose `Host` is another name than its own (DNS rebinding) and sockets of pages of another origin.
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
"""First port that is tried."""

PORTS_TRIED = 20
"""Number of ports from `PORT` on that are tried if the user names none."""

MOST_SESSIONS = 4
"""Most readers at a time; each has a world of their own."""

FRAMES_AHEAD = 2
"""Most frames that a page has not drawn yet."""

FRAME_SECONDS = 1.0 / 60.0
"""Least time from frame to frame [s]."""

LARGEST_MESSAGE = 2**20
"""Most bytes of a message."""

MESSAGES_KEPT = 256
"""Most messages in a queue; more are refused."""

MOST_PICTURES = 500
"""Most pictures of a film, 20 seconds: each takes a megabyte while it is written."""

FILM_RATE = 25.0
"""Pictures of a film per second."""

LARGEST_PICTURE = 1024
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
"""Headers of every answer."""


@dataclass(frozen=True)
class Site:
    """The worlds, the address and the token of a server."""

    make_world: Callable[[], LiveWorld]
    """Makes a reader's world, in the thread that runs it."""
    films: Path
    """Folder of films; created with the first one."""
    host: str = "127.0.0.1"
    """The bound address."""
    token: str | None = None
    """The token that readers must give, or None."""
    one_at_a_time: bool = False
    """Worlds take turns: on CUDA, one thread's work must not be recorded by another."""
    turn: threading.Lock = field(default_factory=threading.Lock)
    open_sessions: list[ViewerSession] = field(default_factory=list)

    def alone(self) -> contextlib.AbstractContextManager[Any]:
        """Return the context in which a world takes its turn."""
        return self.turn if self.one_at_a_time else contextlib.nullcontext()

    def knows(self, host: str) -> bool:
        """Return whether a request's `Host` may name this server."""
        # Without its port and without brackets.
        closed = host.startswith("[")
        name = host[1:].partition("]")[0] if closed else host.partition(":")[0].lower()
        if self.token is not None:
            # The token is proof enough, under any name of this computer.
            return bool(name)
        return name == self.host or name in ("localhost", "127.0.0.1", "::1")

    @property
    def query(self) -> str:
        """The token as the end of an address, or nothing."""
        return "" if self.token is None else f"?token={self.token}"

    def admits(self, token: str | None) -> bool:
        """Return whether a token is right, or none is asked for."""
        own = self.token
        return own is None or secrets.compare_digest((token or "").encode(), own.encode())


def make_site(
    make_world: Callable[[], LiveWorld],
    *,
    films: Path,
    host: str = "127.0.0.1",
    one_at_a_time: bool = False,
) -> Site:
    """Return a site; unless its address is a loopback address, it asks for a fresh token."""
    token = None if is_loopback(host) else secrets.token_urlsafe(24)
    return Site(make_world, films, host, token, one_at_a_time)


def is_loopback(host: str) -> bool:
    """Return whether only this computer can reach an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def make_app(site: Site) -> Starlette:
    """Return the application that serves a site."""

    async def page(request: Request) -> Response:
        if not site.admits(request.query_params.get("token")):
            return _refused("open the link that npa-envs view has printed: it holds the token")
        return FileResponse(PAGE / "index.html", headers=SECURITY)

    async def part(request: Request) -> Response:
        name = request.path_params["name"]
        return _file(PAGE, name, {".js": "text/javascript", ".css": "text/css"})

    async def film(request: Request) -> Response:
        if not site.admits(request.query_params.get("token")):
            return _refused("films need the token of the page")
        name = request.path_params["name"]
        return _file(site.films, name, {".gif": "image/gif", ".mp4": "video/mp4"})

    async def meet(reader: WebSocket) -> None:
        host, origin = reader.headers.get("host", ""), reader.headers.get("origin")
        own = {f"http://{host}", f"https://{host}"}
        if not site.knows(host) or (origin is not None and origin not in own):
            return await reader.close(1008, "this server answers its own page alone")
        if not site.admits(reader.query_params.get("token")):
            return await reader.close(1008, "the token is missing or wrong")
        await reader.accept()
        if len(site.open_sessions) >= MOST_SESSIONS:
            return await reader.close(1013, f"{MOST_SESSIONS} worlds are open: close a page")
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
            if not self._site.knows(host):
                name = self._site.host
                return await _refused(f"ask for {name}, got {shown(host)}")(scope, receive, send)
        await self._app(scope, receive, send)


def _file(folder: Path, name: str, kinds: Mapping[str, str]) -> Response:
    """Return a file of a folder, not of one above or below it, with the type of its suffix."""
    path = folder / name
    with contextlib.suppress(OSError, ValueError):  # A name that no file can have.
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
    """One reader's socket, and a thread with their world.

    The world waits for a page that is slow or hidden: at most `FRAMES_AHEAD` frames are on the way.
    """

    def __init__(self, site: Site, reader: WebSocket, loop: asyncio.AbstractEventLoop) -> None:
        self._site, self._reader, self._loop = site, reader, loop
        self._inbox: queue.Queue[dict[str, Any] | bytes] = queue.Queue(MESSAGES_KEPT)
        self._outbox: asyncio.Queue[bytes | str | None] = asyncio.Queue()
        self._room = threading.BoundedSemaphore(FRAMES_AHEAD)
        self._stopped = threading.Event()
        self._film: PageFilm | None = None

    async def serve(self) -> None:
        """Read and write until the reader leaves or the server stops."""
        threading.Thread(target=self._live, name="npa-envs world", daemon=True).start()
        writing = asyncio.create_task(self._write())
        try:
            await self._read()
        finally:
            self.stop()
            writing.cancel()

    def stop(self) -> None:
        """Let the world end after its present frame."""
        self._stopped.set()
        self._give_room()
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
                self._complain(f"a message must be a JSON object, got {shown(text)}")
            elif isinstance(message, dict) and message.get("type") == "drawn":
                self._give_room()
            else:
                self._keep(message)

    def _keep(self, message: dict[str, Any] | bytes) -> None:
        try:
            self._inbox.put_nowait(message)
        except queue.Full:
            self._complain("too many messages: some are lost")

    async def _write(self) -> None:
        while (data := await self._outbox.get()) is not None:
            try:
                if isinstance(data, bytes):
                    await self._reader.send_bytes(data)
                else:
                    await self._reader.send_text(data)
            except (WebSocketDisconnect, RuntimeError):
                return

    def _give_room(self) -> None:
        with contextlib.suppress(ValueError):  # A page reported more frames than it got.
            self._room.release()

    def _tell(self, event: Mapping[str, Any]) -> None:
        self._post(json.dumps(event))

    def _complain(self, message: str) -> None:
        self._tell({"type": "error", "message": message})

    def _post(self, data: bytes | str | None) -> None:
        def put() -> None:
            # A page that does not read gets no more events; None ends the loop of `_write`.
            if data is None or self._outbox.qsize() < MESSAGES_KEPT:
                self._outbox.put_nowait(data)

        with contextlib.suppress(RuntimeError):  # The loop has ended.
            self._loop.call_soon_threadsafe(put)

    def _live(self) -> None:
        try:
            with self._site.alone():
                world = self._site.make_world()
        except NPAError as error:
            return self._complain(str(error))
        try:
            self._go_on(world)
        except Exception as error:
            # A bug or a failed device: shown in the page, and raised for the log.
            self._complain(f"the world has ended: {shown(error)}")
            raise
        finally:
            world.close()

    def _go_on(self, world: LiveWorld) -> None:
        self._tell(world.describe())
        changed = True
        clock = self._loop.time
        due = clock()
        while not self._stopped.is_set():
            changed |= self._take(world, wait=not (world.playing or changed))
            with self._site.alone():
                events = world.news()
            for event in events:
                self._tell(event)
                changed = True
            if not (world.playing or changed):
                continue
            # A hidden page draws nothing; its messages are answered meanwhile.
            if not self._room.acquire(timeout=0.25):
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
                self._give_room()
                self._complain(f"{error}; the world is paused")
                self._tell(world.describe())
            changed = False

    def _take(self, world: LiveWorld, *, wait: bool) -> bool:
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
                    self._direct(message.get("action"))
                else:
                    with self._site.alone():
                        changed = world.handle(message)
                    if changed:
                        self._tell(world.describe())
            except NPAError as error:
                self._complain(str(error))
        return taken

    def _direct(self, action: Any) -> None:
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
                    self._tell({"type": "file", "name": path.name, "url": url})
            except NPAError as error:
                self._complain(str(error))

        self._film = None
        # The world runs meanwhile.
        threading.Thread(target=write, daemon=True).start()

    def _add_picture(self, data: bytes) -> None:
        # Pictures that come after the film's end are ignored.
        if self._film is not None:
            self._film.add(data)
            if len(self._film.pictures) >= MOST_PICTURES:
                self._tell({"type": "film", "action": "stop"})
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
        if max(size) > LARGEST_PICTURE:
            raise NPAError(
                f"a film's picture must have at most {LARGEST_PICTURE} pixels on each side, got "
                f"{size}"
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
            # Several readers may end their films within a second.
            name = f"{time.strftime('film-%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
            with made_folder(folder):
                # A GIF needs no ffmpeg.
                for suffix, write in ((".gif", write_gif), (".mp4", write_mp4)):
                    path = folder / f"{name}{suffix}"
                    write(path, frames, FILM_RATE)
                    yield path
        except NPAError:
            raise
        except (OSError, ValueError) as error:
            raise NPAError(f"the film cannot be written: {error}") from error


def open_port(host: str, port: int | None) -> socket.socket:
    """Return a listening socket on a port, or for None on the first free one from `PORT` on."""
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
            # Allows the port of a server that has just ended, not of one that runs.
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
    """Return the link that opens a site."""
    port = listener.getsockname()[1]
    # The link of a server on all addresses opens the page on this computer.
    name = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}.get(site.host, site.host)
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{port}/{site.query}"


def make_server(site: Site) -> uvicorn.Server:
    """Return a server that runs until its `should_exit` is set."""
    config = uvicorn.Config(
        make_app(site),
        log_level="warning",
        ws_max_size=LARGEST_MESSAGE,
        # Frames hardly compress, and compressing takes longer than sending.
        ws_per_message_deflate=False,
        server_header=False,
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def serve(site: Site, listener: socket.socket) -> None:
    """Serve a site until Ctrl-C."""
    # The server stops in order and then raises it.
    with contextlib.suppress(KeyboardInterrupt):
        make_server(site).run(sockets=[listener])
