"""Atomic writing of files, and checks of files before they are read.

Files are written to a temporary file in the same folder, synchronised to the disk, and renamed: a
killed program, a full disk or an error leaves the previous file. Only regular files of a limited
size are read: a pipe or a device would block for ever, and a small file may declare gigabytes.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import secrets
import shutil
import stat
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from npa_envs.errors import NPAError, shown

_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NO_PERMISSION = {errno.EACCES, errno.EPERM, errno.EROFS}
_TOKEN_BYTES = 6
_STEM_BYTES = 100
_MIB = 2**20

NEARLY_FULL_BYTES = 64 * 1024
"""A disk with less free space counts as full."""


def checked_path(path: str | Path) -> Path:
    """Return text or a path as a pathlib.Path; raise NPAError for others and null characters."""
    if not isinstance(path, str | os.PathLike):
        raise NPAError(f"a path must be text or a pathlib.Path, got {shown(path)}")
    try:
        encoded = os.fsencode(path)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise NPAError(f"a path must have no null or invalid characters, got {shown(str(path))}")
    return Path(path)


def home_path(path: str | Path) -> Path:
    """Return a path with `~` at the beginning replaced by the user's home."""
    return Path(os.path.expanduser(checked_path(path)))


def open_regular(path: str | Path, *, limit: int, what: str = "the file") -> IO[bytes]:
    """Open a file for reading bytes; raise NPAError unless it is a regular one of <= `limit` bytes.

    `what` and the path name the file in errors, but "it" alone where the caller's errors have both.
    """
    path = checked_path(path)
    named = what if what == "it" else f"{what} {shown(str(path))}"
    try:
        # Without this flag, opening a pipe without a writer would block.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        raise NPAError(_unreadable(named, error)) from error
    status = os.fstat(descriptor)
    rule = ""
    if not stat.S_ISREG(status.st_mode):
        what_it_is = "folder" if stat.S_ISDIR(status.st_mode) else "pipe or a device"
        rule = f"is a {what_it_is}, not a regular file: give the path of a file"
    elif status.st_size > limit:
        rule = f"must have at most {limit / _MIB:.0f} MiB, got {status.st_size / _MIB:.0f} MiB"
    if rule:
        os.close(descriptor)
        raise NPAError(f"{named} {rule}")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: str | Path, *, limit: int, what: str = "the file") -> bytes:
    """Return the bytes of a regular file of at most `limit` bytes, which errors call `what`."""
    with open_regular(path, limit=limit, what=what) as file:
        try:
            # Some system files contain more than their size says.
            return file.read(limit)
        except OSError as error:
            raise NPAError(_unreadable(f"{what} {shown(str(path))}", error)) from error


def parse_json(text: str | bytes) -> Any:
    """Return the Python value of a JSON text; raise NPAError if it is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise NPAError(f"this is no JSON text, or a truncated one ({shown(error)})") from error


def read_json(path: str | Path, *, limit: int = 16 * _MIB) -> Any:
    """Return the Python value of a JSON file of at most `limit` bytes."""
    return parse_json(read_bytes(path, limit=limit))


def check_torch_archive(file: IO[bytes], *, checksums: bool = True) -> None:
    """Check the sizes in a file of `torch.save` before torch unpacks it, and if asked, `checksums`.

    Compressed content, which torch does not write, is rejected: it could take any amount of memory.
    """
    try:
        size = file.seek(0, os.SEEK_END)
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            plain = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
            declared = sum(entry.file_size for entry in entries)
            bad = archive.testzip() if checksums and plain and declared <= size else None
    except Exception as error:
        # zipfile raises exceptions of many kinds.
        raise NPAError(
            f"the file is damaged or truncated ({type(error).__name__}): fetch or save it again"
        ) from error
    if not plain or declared > size:
        raise NPAError(
            f"the file must not be compressed, but {declared} bytes are declared in a file of "
            f"{size}: save it with torch.save"
        )
    if bad is not None:
        raise NPAError(
            f"the file is damaged (wrong checksum of {shown(bad)}): fetch or save it again"
        )


def _unreadable(what: str, error: OSError) -> str:
    if error.errno == errno.ENOENT:
        return f"{what} does not exist: check the path"
    hint = "its permissions" if error.errno in _NO_PERMISSION else "the path"
    return f"{what} cannot be read ({error.strerror or type(error).__name__}): check {hint}"


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and rename it over `path` when the block succeeds.

    The temporary file is in the folder of `path` and has the same suffix, which some writers need.
    It is created before the block, so that a folder without write permission is noticed first. If
    the block raises, it is removed and `path` is unchanged. Symbolic links are followed: the file
    that they point to is replaced.
    """
    path = checked_path(path)
    target = Path(os.path.realpath(path))
    _check_target(path, target)
    temporary = target.with_name(_temporary_name(target, secrets.token_hex(_TOKEN_BYTES)))
    try:
        # os.open respects the umask; files of the tempfile module are private to their owner.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        _sync(temporary)
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
        if os.name == "posix":
            _sync(target.parent)
    except OSError as error:
        ours = {str(temporary), str(target), str(target.parent)}
        if error.filename is not None and os.fsdecode(error.filename) not in ours:
            # The error is about another file.
            raise
        raise NPAError(_explain(path, error)) from error
    except Exception as error:
        # Writers in C report a full disk by other exceptions.
        if not isinstance(error, NPAError) and _disk_is_full(target.parent):
            raise NPAError(_explain(path, OSError(errno.ENOSPC, str(error)))) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Create a folder and missing parents; if the block raises, remove the empty ones again."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def remove_unfinished(path: Path) -> None:
    """Remove the temporary files that interrupted writes of `path` have left in its folder."""
    pattern = _temporary_name(path, "[0-9a-f]" * 2 * _TOKEN_BYTES)
    for unfinished in path.parent.glob(pattern):
        with contextlib.suppress(OSError):
            unfinished.unlink()


def _temporary_name(path: Path, token: str) -> str:
    # File systems limit the bytes of a name, not its letters.
    stem = path.stem.encode(errors="ignore")[:_STEM_BYTES].decode(errors="ignore")
    return f".{stem}.{token}.tmp{path.suffix}"


def write_bytes(path: str | Path, data: bytes | memoryview) -> None:
    """Write `data` to `path`, completely or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 to `path`, completely or not at all; newlines are not changed."""
    write_bytes(path, text.encode("utf-8"))


def _check_target(path: Path, target: Path) -> None:
    folder, fault = shown(str(target.parent)), ""
    try:
        if target.is_dir():
            fault = "that is a folder: give the path of a file inside it"
        # `path`, not `target`: a system link to a pipe resolves to a name that does not exist.
        elif path.exists() and not path.is_file():
            fault = "that is a pipe or a device, which must not be replaced by a file: give the "
            fault += "path of a file"
        elif not target.parent.exists():
            fault = f"the folder {folder} does not exist: create it first (mkdir -p {folder})"
        elif not target.parent.is_dir():
            fault = f"{folder} is a file, not a folder: give a path in a folder"
    except OSError as error:
        raise NPAError(_explain(path, error)) from error
    if fault:
        raise NPAError(f"cannot write {shown(str(path))}: {fault}")


def _sync(path: Path) -> None:
    """Synchronise a file or folder to the disk; delayed write errors are raised here."""
    # Windows requires files to be open for writing; POSIX does not allow that for folders.
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _disk_is_full(folder: Path) -> bool:
    try:
        return shutil.disk_usage(folder).free < NEARLY_FULL_BYTES
    except OSError:
        return False


def _explain(path: Path, error: OSError) -> str:
    folder = str(path.parent)
    if error.errno in _DISK_FULL:
        rule, hint = "the disk is full", "free some space or choose another disk"
    elif error.errno in _NO_PERMISSION:
        rule, hint = "no write permission", f"choose another path, or check: ls -ld {shown(folder)}"
    else:
        rule, hint = (error.strerror or type(error).__name__), "choose another path"
    return f"cannot write {shown(str(path))}: {rule} ({error}): {hint}; nothing was changed"


def plain_numbers(value: Any) -> Any:
    """Return nested values as lists and dicts, with None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: plain_numbers(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain_numbers(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(value: Any) -> str:
    """Return nested values as the text of a JSON file; numbers that are not finite are null."""
    return json.dumps(plain_numbers(value), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
