"""Reads a file that was dropped on a page, in a process of its own with limits.

`python -m npa_envs.web.dropped_file FILE [whole]` writes what is to grow of a picture or an emoji
as picture.png beside it, or checks a mesh. It prints what the readers print, or the error. It
imports torch, which takes seconds, for point clouds alone: files are refused at once.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from npa_envs.errors import NPAError, shown
from npa_envs.measure.process_queue import end_with_parent
from npa_envs.tasks.targets.images import (
    is_emoji,
    looks_like_path,
    read_image,
    render_emoji,
    resample,
    with_background,
)
from npa_envs.tasks.targets.mesh_files import read_mesh
from npa_envs.tasks.targets.meshes import MESH_SUFFIXES

MAX_BYTES = 64 * 2**20
"""Maximum size of a dropped file [bytes]."""

MAX_TRIANGLES = 2**20
"""Maximum number of triangles, points or Gaussians of a dropped 3D file."""

MAX_SIDE = 1024
"""Maximum side of the picture that is learned [pixels]; larger ones are reduced."""

READ_SECONDS = 60
"""Maximum time of reading a file [s], and of the processor while it does."""

MEMORY = 3 * 2**30
"""Memory that reading may take, where the system counts it (Linux) [bytes]."""

PICTURE = "picture.png"
"""Name of the picture that is learned."""

EMOJI = "emoji.txt"
"""Name of a file with an emoji in UTF-8."""


def stored_name(name: str) -> str:
    """Return the name under which a file is stored: one of few, whatever it is called."""
    suffix = Path(name.replace("\\", "/")).suffix.lower() if "\0" not in name else ""
    return f"dropped{suffix}" if suffix in MESH_SUFFIXES else "dropped"


def read_dropped(path: Path, *, whole: bool = False) -> None:
    """Read a dropped file; raise NPAError if it cannot be learned.

    A mesh is checked. Of a picture, or of an emoji in a file `EMOJI`, the part to grow is written
    as `PICTURE` to the file's folder. With `whole` a picture keeps its background.
    """
    if path.suffix in MESH_SUFFIXES:
        count = _element_count(path)
        if count > MAX_TRIANGLES:
            raise NPAError(
                f"a dropped 3D file must have at most {MAX_TRIANGLES} triangles or points, got "
                f"{count}: simplify it"
            )
        return
    if path.name == EMOJI:
        text = path.read_text(encoding="utf-8", errors="replace")
        if not is_emoji(text) or looks_like_path(text):
            raise NPAError(
                f"an emoji must be one picture symbol, got {shown(text)}: try \U0001f98a"
            )
        image = render_emoji(text)
    else:
        kind = f"3D file ({', '.join(MESH_SUFFIXES)}) or a picture"
        image, line = read_image(path, keep_background=whole, kind=kind)
        print(line)
        image = with_background(image) if whole else image
    image.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
    # Raises if the picture is too thin to be sampled.
    resample(image, 512, label=str(path))
    image.save(path.with_name(PICTURE))


def _is_ply(path: Path) -> bool:
    return path.suffix == ".ply" and path.read_bytes()[:3] == b"ply"


def _element_count(path: Path) -> int:
    """Return the number of triangles, points or Gaussians in a file."""
    if _is_ply(path):
        from npa_envs.tasks.targets.splat_files import ply_kind, read_splats

        if ply_kind(path) != "triangles":
            return len(read_splats(path).means)
    return len(read_mesh(path).faces)


def limit_resources() -> None:
    """Limit time and memory of this process, where the system can."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (READ_SECONDS, READ_SECONDS))
        # Only Linux counts mapped memory by this limit; what the libraries take is added.
        mapped = int(Path("/proc/self/statm").read_text("ascii").split()[0])
        most = mapped * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def main(arguments: Sequence[str]) -> int:
    """Read a file within the limits; return 0, or 2 after an error that is printed."""
    end_with_parent()
    path = Path(arguments[0])
    if _is_ply(path):
        # First, as the memory of torch is not counted.
        import npa_envs.tasks.targets.splat_files  # noqa: F401
    limit_resources()
    try:
        read_dropped(path, whole="whole" in arguments[1:])
    except (NPAError, MemoryError) as error:
        message = str(error) or f"reading it takes more than {MEMORY >> 30} GiB: reduce it"
        print(f"npa-envs: error: {' '.join(message.split())}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
