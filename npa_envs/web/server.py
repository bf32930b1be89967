"""A server for one page: files, a socket to a live world for each reader, films.

It binds the loopback address unless told otherwise; bound elsewhere it asks for a token. Requests
whose `Host` is another name than the server's are refused, so that no foreign page reaches it under
a name of its own (DNS rebinding), and sockets that a page of another origin opens.
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
"""The first port that is tried."""

PORTS_TRIED = 20
"""How many ports are tried from there on, where none was asked for."""

MOST_SESSIONS = 4
"""Readers at a time; each has a world of their own."""

FRAMES_AHEAD = 2
"""Frames on the way to a page that has not drawn them yet, at most."""

FRAME_SECONDS = 1.0 / 60.0
"""Time from frame to frame, at least [s]."""

LARGEST_MESSAGE = 2**20
"""Bytes of what a page sends at once, at most."""

MESSAGES_KEPT = 256
"""Messages that wait for a world, or for a page, at most: more are refused until it reads them."""

MOST_PICTURES = 500
"""Pictures of a film, 20 seconds, at most: each takes a megabyte while it is written."""

FILM_RATE = 25.0
"""Pictures a second of a film."""

LARGEST_PICTURE = 1024
"""Pixels on each side of a film's pictures, at most."""

KIND = 1
HEADER = struct.Struct("<IIIIff")
"""Of a frame: kind, step, particles, dimension, milliseconds, loss (NaN: not computed)."""

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
    """What a server shows, where, and to whom."""

    make_world: Callable[[], LiveWorld]
    """Makes a world for each reader, in the thread that it then lives in."""
    films: Path
    """Folder that films are written to; created when one is."""
    host: str = "127.0.0.1"
    """The address that is bound."""
    token: str | None = None
    """What readers must name; None: nothing."""
    one_at_a_time: bool = False
    """Worlds take turns: on CUDA, work that one thread records must not meet another's."""
    turn: threading.Lock = field(default_factory=threading.Lock)
    """Held by the world whose turn it is."""
    open_sessions: list[ViewerSession] = field(default_factory=list)
    """Readers that are here."""

    def alone(self) -> contextlib.AbstractContextManager[Any]:
        """Return what a world works within."""
        return self.turn if self.one_at_a_time else contextlib.nullcontext()

    def knows(self, host: str) -> bool:
        """Return whether a request's `Host` may name this server."""
        name = _host_name(host)
        if self.token is not None:
            # Whoever knows the token has come from the link, by whatever name.
            return bool(name)
        return name == self.host or name in ("localhost", "127.0.0.1", "::1")

    def admits(self, token: str | None) -> bool:
        """Return whether a token is right, or none is asked for."""
        if self.token is None:
            return True
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())


def make_site(
    make_world: Callable[[], LiveWorld],
    *,
    films: Path,
    host: str = "127.0.0.1",
    one_at_a_time: bool = False,
) -> Site:
    """Return a site that asks for a token of its own unless it is bound to a loopback address."""
    token = None if is_loopback(host) else secrets.token_urlsafe(24)
    return Site(make_world, films, host, token, one_at_a_time)


def is_loopback(host: str) -> bool:
    """Return whether an address is reached from this computer alone."""
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
        path = PAGE / request.path_params["name"]
        # Of the folder itself: a name holds no slash, and may not lead out by dots.
        if path.parent != PAGE or path.suffix not in (".js", ".css") or not _is_file(path):
            return PlainTextResponse("no such file", 404, SECURITY)
        kind = "text/javascript" if path.suffix == ".js" else "text/css"
        return FileResponse(path, media_type=kind, headers=SECURITY)

    async def film(request: Request) -> Response:
        if not site.admits(request.query_params.get("token")):
            return _refused("films need the token of the page")
        path = site.films / request.path_params["name"]
        if path.parent != site.films or path.suffix not in (".gif", ".mp4") or not _is_file(path):
            return PlainTextResponse("no such film", 404, SECURITY)
        return FileResponse(path, headers=SECURITY)

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
    """Refuses requests that come under another name than the server's."""

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


def _is_file(path: Path) -> bool:
    """Return whether there is a file; a name that no file can have is that of none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _refused(reason: str) -> Response:
    return PlainTextResponse(f"refused: {reason}", 403, SECURITY)


def _host_name(host: str) -> str:
    """Return the name in a `Host` header, without its port and without brackets."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0].lower()


def frame_bytes(frame: WorldView) -> bytes:
    """Return a frame as it is sent: header, positions, colours."""
    count, dimension = frame.positions.shape
    loss = float("nan") if frame.loss is None else frame.loss
    header = HEADER.pack(KIND, frame.step, count, dimension, frame.milliseconds, loss)
    positions = np.ascontiguousarray(frame.positions, dtype="<f4").tobytes()
    return header + positions + np.ascontiguousarray(frame.colours).tobytes()


class ViewerSession:
    """One reader and their world, which lives in a thread of its own.

    The world waits for the page: at most `FRAMES_AHEAD` frames are on the way, so that a page that
    is slow, or hidden, is never behind what it does to the world.

    Args:
        site: What is shown.
        reader: The reader's socket, accepted.
        loop: The loop that sends.
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
        """Let the world end after what it is doing."""
        self._stopped.set()
        self._give_room()
        self._post(None)

    async def _read(self) -> None:
        while True:
            received = await self._reader.receive()
            if received["type"] == "websocket.disconnect":
                return
            data = received.get("bytes")
            message = data if data is not None else _parsed(received.get("text") or "")
            if isinstance(message, str):
                self._tell({"type": "error", "message": message})
            elif isinstance(message, dict) and message.get("type") == "drawn":
                self._give_room()
            else:
                self._keep(message)

    def _keep(self, message: dict[str, Any] | bytes) -> None:
        try:
            self._inbox.put_nowait(message)
        except queue.Full:
            self._tell({"type": "error", "message": "too many messages: some are lost"})

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
        with contextlib.suppress(ValueError):  # A page that says more than it has drawn.
            self._room.release()

    def _tell(self, event: Mapping[str, Any]) -> None:
        self._post(json.dumps(event))

    def _post(self, data: bytes | str | None) -> None:
        with contextlib.suppress(RuntimeError):  # The loop has ended.
            self._loop.call_soon_threadsafe(self._put, data)

    def _put(self, data: bytes | str | None) -> None:
        # A page that does not read is told no more; the end always.
        if data is None or self._outbox.qsize() < MESSAGES_KEPT:
            self._outbox.put_nowait(data)

    # In the world's own thread.

    def _live(self) -> None:
        try:
            with self._site.alone():
                world = self._site.make_world()
        except NPAError as error:
            self._tell({"type": "error", "message": str(error)})
            return
        try:
            self._go_on(world)
        except Exception as error:
            # A mistake of ours, or a device that has failed: told here, and raised for the log.
            self._tell({"type": "error", "message": f"the world has ended: {shown(error)}"})
            raise
        finally:
            world.close()

    def _go_on(self, world: LiveWorld) -> None:
        self._tell(world.describe())
        changed = True
        due = self._clock()
        while not self._stopped.is_set():
            changed |= self._take(world, wait=not (world.playing or changed))
            with self._site.alone():
                events = world.news()
            for event in events:
                self._tell(event)
                changed = True
            if not (world.playing or changed):
                continue
            # A page that is hidden draws nothing: its messages are answered meanwhile.
            if not self._room.acquire(timeout=0.25):
                continue
            pause = due - self._clock()
            if pause > 0.0:
                self._stopped.wait(pause)
            due = max(due, self._clock() - FRAME_SECONDS) + FRAME_SECONDS
            try:
                with self._site.alone():
                    if world.playing:
                        world.advance()
                    frame = world.frame()
                self._post(frame_bytes(frame))
            except NPAError as error:
                world.playing = False
                self._give_room()
                self._tell({"type": "error", "message": f"{error}; the world is paused"})
                self._tell(world.describe())
            changed = False

    def _clock(self) -> float:
        return self._loop.time()

    def _take(self, world: LiveWorld, *, wait: bool) -> bool:
        """Do what messages say; return whether there were any."""
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
                self._tell({"type": "error", "message": str(error)})
        return taken

    def _direct(self, action: Any) -> None:
        if action == "start":
            self._film = PageFilm()
        elif action == "stop" and self._film is not None:
            self._end_film()
        else:
            raise NPAError(f"a film's action must be 'start', then 'stop', got {shown(action)}")

    def _end_film(self) -> None:
        film, self._film = self._film, None
        # The world goes on meanwhile.
        threading.Thread(target=self._write_film, args=(film,), daemon=True).start()

    def _write_film(self, film: PageFilm) -> None:
        token = "" if self._site.token is None else f"?token={self._site.token}"
        try:
            for path in film.write(self._site.films):
                self._tell({"type": "file", "name": path.name, "url": f"films/{path.name}{token}"})
        except NPAError as error:
            self._tell({"type": "error", "message": str(error)})

    def _add_picture(self, data: bytes) -> None:
        # Pictures that were on the way when the film ended are left out.
        if self._film is not None:
            self._film.add(data)
            if self._film.is_full:
                self._tell({"type": "film", "action": "stop"})
                self._end_film()


class PageFilm:
    """Pictures that a page has drawn, as a film."""

    def __init__(self) -> None:
        self._pictures: list[bytes] = []

    @property
    def is_full(self) -> bool:
        """Whether it has as many pictures as it may have."""
        return len(self._pictures) >= MOST_PICTURES

    def add(self, data: bytes) -> None:
        """Add a picture, a JPEG file.

        Raises:
            NPAError: It is no picture, or too large.
        """
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
        self._pictures.append(data)

    def write(self, folder: Path) -> Iterator[Path]:
        """Write the film as GIF and as MP4; each file is given as soon as it is there.

        Raises:
            NPAError: It has no pictures, one is damaged, or a file cannot be written.
        """
        if not self._pictures:
            raise NPAError("the film has no pictures: let the world move while it records")
        try:
            frames = [
                np.asarray(Image.open(io.BytesIO(data), formats=["JPEG"]).convert("RGB"))
                for data in self._pictures
            ]
            # Readers may stop their films in one second.
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


def _parsed(text: str) -> dict[str, Any] | str:
    """Return a message's object, or what is wrong with it."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return f"a message must be a JSON object, got {shown(text)}"
    return (
        message
        if isinstance(message, dict)
        else f"a message must be a JSON object, got {shown(text)}"
    )


def open_port(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens, on the port asked for, or on the first one that is free.

    Args:
        host: The address to bind.
        port: The port; None: `PORT` or one of those after it.

    Raises:
        NPAError: The address is none of this computer, or the port is in use.
    """
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
            # The port of a server that has just ended may be taken at once, one that serves not.
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
    # Whoever binds all addresses opens the page on this computer first.
    name = (
        "127.0.0.1" if site.host in ("0.0.0.0", "") else "::1" if site.host == "::" else site.host
    )
    name = f"[{name}]" if ":" in name else name
    token = "" if site.token is None else f"?token={site.token}"
    return f"http://{name}:{port}/{token}"


def make_server(site: Site) -> uvicorn.Server:
    """Return what serves a site until its `should_exit` is set."""
    config = uvicorn.Config(
        make_app(site),
        log_level="warning",
        ws_max_size=LARGEST_MESSAGE,
        # Frames of random numbers hardly shrink, and packing them takes longer than sending.
        ws_per_message_deflate=False,
        server_header=False,
        timeout_graceful_shutdown=2,
    )
    return uvicorn.Server(config)


def serve(site: Site, listener: socket.socket) -> None:
    """Serve a site until Ctrl-C."""
    # The server ends its work in order and then raises it.
    with contextlib.suppress(KeyboardInterrupt):
        make_server(site).run(sockets=[listener])
