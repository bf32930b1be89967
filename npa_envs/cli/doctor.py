"""`npa-envs doctor`: what is broken, slow or missing on this machine, and how to fix it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

EXTRAS = (
    "envs", "sb3", "human", "view", "bench", "evolution", "points", "meshes", "heic", "minari",
)  # fmt: skip
"""The extras of `all`."""


@dataclass(frozen=True)
class DoctorOptions:
    """Print what is broken, slow or missing on this machine and how to fix it; for bug reports."""


class DoctorLine(NamedTuple):
    """A line of the report of `npa-envs doctor`."""

    subject: str
    text: str
    fix: str | None = None
    """How to repair it; None: nothing is wrong."""
    optional: bool = False
    """Whether it is only slow, or not needed by everybody."""

    @property
    def mark(self) -> str:
        """First character of the line: "!" for broken, "-" for slow or missing."""
        return " " if self.fix is None else "-" if self.optional else "!"


def main(arguments: Sequence[str]) -> int:
    """Print the report on this machine; return 1 if something is broken."""
    if arguments:
        # Imported late: the report must also appear if the parser's package is missing.
        from npa_envs.cli import common

        common.parse_options(DoctorOptions, "doctor", arguments)
    lines = examine()
    width = max(len(line.subject) for line in lines)
    for line in lines:
        print(f"{line.mark} {line.subject:<{width}}  {line.text}")
        if line.fix is not None:
            print(f"  {'':<{width}}  -> {line.fix}")
    marks = [line.mark for line in lines]
    print(f"{marks.count('!')} broken (!), {marks.count('-')} slow or missing but optional (-)")
    return 1 if "!" in marks else 0


def examine() -> list[DoctorLine]:
    """Check this machine and return the report's lines."""
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    lines = [
        DoctorLine("python", f"{platform.python_version()} ({sys.executable})"),
        DoctorLine("system", f"{system}, {os.cpu_count()} cores"),
    ]
    for check in (_packages, _torch_devices, _warp_devices, _kernel_cache, _films_and_screen):
        try:
            lines += check()
        except Exception as error:
            # The report must also appear on a machine where the check itself fails.
            subject = check.__name__[1:].replace("_", " ")
            lines.append(DoctorLine(subject, f"{type(error).__name__}: {error}", "see the message"))
    return lines


def _packages() -> Iterator[DoctorLine]:
    """Yield lines on this package, each package that it requires, and each of its extras."""
    try:
        yield DoctorLine("npa-envs", importlib.metadata.version("npa-envs"))
    except importlib.metadata.PackageNotFoundError:
        text = "not installed, imported from a folder"
        yield DoctorLine("npa-envs", text, "pip install -e . in the clone", optional=True)
        return

    def numbers(version: str) -> list[int]:
        return [int(part) for part in re.findall(r"\d+", version.partition("+")[0])[:3]]

    extras: dict[str, list[str]] = {}
    for line in importlib.metadata.requires("npa-envs") or []:
        name, oldest, extra = (
            match[1] if (match := re.search(pattern, line)) else ""
            for pattern in (r"^([\w.-]+)", r">=\s*([\d.]+)", r"extra\s*==\s*['\"]([\w-]+)")
        )
        try:
            version = importlib.metadata.version(name)
            old = numbers(version) < numbers(oldest)
            fault = f"{version} is older than {oldest}" if old else ""
        except importlib.metadata.PackageNotFoundError:
            version, fault = "", "not installed"
        if extra in EXTRAS:
            extras.setdefault(extra, []).extend([f"{name} {fault}"] if fault else [])
        elif not extra:
            fix = f"pip install -U '{name}>={oldest}'" if fault else None
            yield DoctorLine(name, fault or version, fix)
    for extra, faults in extras.items():
        fix = f"pip install 'npa-envs[{extra}]', in a clone '.[{extra}]'" if faults else None
        yield DoctorLine(f"[{extra}]", ", ".join(faults) or "installed", fix, True)


def _torch_devices() -> Iterator[DoctorLine]:
    import torch

    cores, threads = os.cpu_count() or 1, torch.get_num_threads()
    idle = cores >= 4 and threads < cores // 2
    fix = "more is faster for large worlds: set OMP_NUM_THREADS, or leave it out" if idle else None
    yield DoctorLine("cpu", f"threads: {threads}, cores: {cores}", fix, optional=True)
    if not torch.cuda.is_available():
        yield _no_cuda(torch.version.cuda)
        return
    for index in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(index)
        text = (
            f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB, compute capability "
            f"{gpu.major}.{gpu.minor}, CUDA {torch.version.cuda}"
        )
        fix = "slow: the faster kernels need compute capability 8.0 (Ampere) or newer"
        slow = (gpu.major, gpu.minor) < (8, 0)
        yield DoctorLine(f"cuda:{index}", text, fix if slow else None, optional=True)


def _no_cuda(built: str | None) -> DoctorLine:
    """Return the line that says why torch uses no GPU; `built` is its CUDA version or None."""
    query = ("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")
    try:
        listed = subprocess.run(
            query, capture_output=True, encoding="utf-8", check=True, timeout=20
        )
        name, _, driver = listed.stdout.splitlines()[0].rpartition(", ")
    except (OSError, subprocess.SubprocessError, IndexError):
        fix = "slow for large worlds: use the presets fast and tiny, which are made for CPUs"
        return DoctorLine("cuda", "no NVIDIA GPU, or no driver for it", fix, optional=True)
    if built is None:
        why = "this torch is a build for CPUs only"
        fix = "pip uninstall torch, then install its CUDA build: https://pytorch.org/get-started"
    elif (hidden := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        why = f"CUDA_VISIBLE_DEVICES is '{hidden}'"
        fix = "unset CUDA_VISIBLE_DEVICES, or name the GPU there"
    else:
        why = f"torch, built for CUDA {built}, cannot use it (driver {driver})"
        fix = (
            'see what python -c "import torch; torch.zeros(1).cuda()" says; often a newer driver '
            "or a reboot helps"
        )
    return DoctorLine("cuda", f"{name} is idle: {why}", fix)


def _warp_devices() -> Iterator[DoctorLine]:
    import torch

    from npa_envs.runtime import warp_devices

    devices = warp_devices()
    missing = torch.cuda.is_available() and not any(name.startswith("cuda") for name in devices)
    fix = "torch finds a CUDA device and Warp does not: install a newer NVIDIA driver"
    yield DoctorLine("warp devices", "; ".join(devices), fix if missing else None)


def _kernel_cache() -> Iterator[DoctorLine]:
    from npa_envs.runtime import kernel_cache_folder

    folder = kernel_cache_folder()
    if not os.access(folder, os.W_OK):
        fix = "each run would compile all kernels: set WARP_CACHE_PATH to a folder of yours"
        yield DoctorLine("kernel cache", f"{folder} (cannot be written to)", fix)
        return
    count = len(list(folder.glob("wp_npa_envs*")))
    compiled = f"{folder} ({count} modules of npa-envs)"
    fix = "the first use of each kernel compiles it; npa-envs warmup does so now"
    yield DoctorLine("kernel cache", compiled, None if count else fix, optional=True)


def _films_and_screen() -> Iterator[DoctorLine]:
    try:
        import imageio_ffmpeg

        yield DoctorLine("ffmpeg", imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        yield DoctorLine("ffmpeg", f"not found ({error})", "pip install -U 'imageio[ffmpeg]'")
    screen = has_screen()
    fix = (
        "for npa-envs view: run ssh -L 8765:127.0.0.1:8765 THIS-COMPUTER on a computer that has "
        "one, and open the printed link there"
    )
    yield DoctorLine("screen", "found" if screen else "none", None if screen else fix, True)


def has_screen() -> bool:
    """Return whether a browser can be shown on this computer."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(map(os.environ.get, screens))
