"""Files are written whole or not at all, whatever goes wrong in the middle."""

import contextlib
import errno
import io
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.atomic_files import (
    atomic_path,
    made_folder,
    remove_unfinished,
    write_bytes,
    write_text,
)
from npa_envs.cli.common import writable_folder
from npa_envs.errors import NPAError
from npa_envs.rule.rule import NPARule
from npa_envs.training.run_folder import RunFolder


def write_half_and_raise(target: Path, error: BaseException, content: bytes = b"half") -> None:
    with atomic_path(target) as temporary:
        with contextlib.suppress(OSError):
            temporary.write_bytes(content)
        raise error


def test_writes_what_was_given_by_a_temporary_file_beside_it(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "ε = 0.1\n")
    write_bytes(tmp_path / "b.bin", b"\x00\x01")
    write_bytes(tmp_path / "b.bin", b"\x02")
    with atomic_path(tmp_path / "film.mp4") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".mp4"
        temporary.write_bytes(b"new")
        assert not (tmp_path / "film.mp4").exists()
    held = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert held == {"a.txt": "ε = 0.1\n".encode(), "b.bin": b"\x02", "film.mp4": b"new"}


@pytest.mark.parametrize(
    "error",
    [ValueError("bug"), KeyboardInterrupt(), SystemExit(3), FileNotFoundError(2, "", "other.txt")],
)
def test_an_exception_in_the_block_keeps_the_old_file(tmp_path: Path, error: BaseException) -> None:
    target = tmp_path / "rule.safetensors"
    target.write_bytes(b"old")
    with pytest.raises(type(error)) as caught:
        write_half_and_raise(target, error)
    assert caught.value is error
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_killed_process_keeps_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "checkpoint.pt"
    target.write_bytes(b"old")
    program = (
        "import os, signal, sys\n"
        "from npa_envs.atomic_files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as temporary:\n"
        "    temporary.write_bytes(b'half')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(target)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert target.read_bytes() == b"old"
    write_bytes(target, b"new")
    assert target.read_bytes() == b"new"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with a name")
@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("", "that is a folder"),
        ("plain/a.bin", "is a file, not a folder"),
        ("no/a.bin", r"folder '.*no' does not exist: create it first"),
        *(
            (path, f"{Path(path).name}': that is a pipe or a device.*a file$")
            for path in ("pipe", "link", os.devnull)
        ),
    ],
)
def test_what_cannot_be_written_to_is_named_and_stays(tmp_path, path, message):
    (tmp_path / "plain").write_bytes(b"")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(os.devnull)
    with pytest.raises(NPAError, match=message):
        write_bytes(tmp_path / path, b"1")
    assert (tmp_path / "pipe").is_fifo()
    assert Path(os.devnull).is_char_device()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "pipe", "plain"]


@pytest.mark.parametrize("stem", ["中" * 80, "é" * 120, "a" * 250], ids=len)
def test_long_names_are_written_and_their_left_overs_found(tmp_path: Path, stem: str) -> None:
    target = tmp_path / f"{stem}.txt"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"1")
    # As a killed write leaves it behind.
    temporary.write_bytes(b"half")
    remove_unfinished(target)
    assert target.read_bytes() == b"1"
    assert list(tmp_path.iterdir()) == [target]


def _fail_with(number: int) -> Any:
    def reject(path: Any, *_: Any) -> int:
        name = None if isinstance(path, int) else os.fspath(path)
        raise OSError(number, os.strerror(number), name)

    return reject


@pytest.mark.parametrize(
    ("place", "name", "number", "message"),
    [
        (os, "open", errno.EACCES, "no write permission.*ls -ld"),
        (os, "open", errno.EROFS, "no write permission.*ls -ld"),
        (Path, "write_bytes", errno.ENOSPC, "disk is full.*nothing was changed"),
        (os, "fsync", errno.ENOSPC, "disk is full.*nothing was changed"),
        (os, "replace", errno.ENOSPC, "disk is full.*nothing was changed"),
    ],
)
def test_what_the_system_rejects_is_said_and_keeps_the_old_file(
    tmp_path, monkeypatch, place, name, number, message
):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    monkeypatch.setattr(place, name, _fail_with(number))
    with pytest.raises(NPAError, match=rf"cannot write .*a\.bin.*{message}"):
        write_bytes(target, b"new")
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 256 KiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no permission to mount a small tmpfs")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_real_full_disk_is_recognised_whatever_the_writer_raises(disk: Path) -> None:
    target = disk / "a.bin"
    target.write_bytes(b"old")
    with pytest.raises(NPAError, match="disk is full"):
        write_bytes(target, b"x" * 1_000_000)
    with pytest.raises(NPAError, match="disk is full"):
        write_half_and_raise(target, RuntimeError("a writer in C"), content=b"x" * 1_000_000)
    assert target.read_bytes() == b"old"
    assert list(disk.iterdir()) == [target]


def write_rules(folder: Path) -> None:
    # Its interface tells observations and actions, which no file holds.
    interface: Any = None
    RuleSet([NPARule(2, 4, 8, eps0=0.1)], [1], interface).save(folder)


def write_film(folder: Path) -> None:
    server = pytest.importorskip("npa_envs.web.server")
    picture = io.BytesIO()
    Image.new("RGB", (64, 64)).save(picture, "JPEG")
    list(server.write_film([picture.getvalue()], folder))


@pytest.mark.parametrize(
    "write",
    [writable_folder, lambda folder: RunFolder(folder).prepare(2**20), write_rules, write_film],
    ids=["command", "training run", "rules", "film"],
)
def test_a_full_disk_is_left_without_empty_folders(disk: Path, write: Any) -> None:
    with contextlib.suppress(OSError), (disk / "full.bin").open("wb", buffering=0) as full:
        while True:
            full.write(bytes(4096))
    with pytest.raises(NPAError):
        write(disk / "runs" / "mine")
    assert [path.name for path in disk.iterdir()] == ["full.bin"]


def test_a_failed_block_removes_only_empty_folders_that_it_has_made(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()

    def fail_in(folder: Path, kept: Path | None = None) -> None:
        with made_folder(folder):
            if kept is not None:
                kept.write_text("kept", encoding="utf-8")
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        fail_in(tmp_path / "old" / "a" / "b", kept=tmp_path / "old" / "a" / "kept.txt")
    assert not (tmp_path / "old" / "a" / "b").exists()
    with pytest.raises(ValueError, match="broken"):
        fail_in(tmp_path / "old")
    with made_folder(tmp_path / "new" / "c"):
        pass
    kept = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*"))
    assert kept == ["new", "new/c", "old", "old/a", "old/a/kept.txt"]


def test_mode_and_symbolic_links_are_kept(tmp_path: Path) -> None:
    target, link = tmp_path / "a.bin", tmp_path / "link.bin"
    write_bytes(target, b"1")
    umask = os.umask(0)
    os.umask(umask)
    assert target.stat().st_mode & 0o777 == 0o666 & ~umask
    target.chmod(0o640)
    link.symlink_to(target)
    write_bytes(link, b"2")
    assert link.is_symlink()
    assert target.read_bytes() == b"2"
    assert target.stat().st_mode & 0o777 == 0o640
