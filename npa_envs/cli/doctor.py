"""`npa-envs doctor`: what is broken, slow or missing on this machine, and the cure."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

EXTRAS = {
    "envs": "several species, and particles as agents (PettingZoo)",
    "sb3": "Stable-Baselines3",
    "human": 'the window of render_mode="human"',
    "view": "the viewer",
    "bench": "plots of measurements, scores of NPA-Bench",
    "evolution": "evolution strategies",
    "points": "the digits of point_classification",
    "meshes": "mesh files",
    "minari": "episodes as datasets",
}
"""What each extra that `all` holds is for."""

OLDEST_DRIVERS = {12: 525, 13: 580}
"""First version of NVIDIA's driver that serves a version of CUDA (NVIDIA, CUDA Compatibility)."""


@dataclass(frozen=True)
class DoctorOptions:
    """Say what is broken, slow or missing on this machine, and the cure of each; also for bug
    reports."""


def main(arguments: Sequence[str]) -> int:
    """Print the report; return 1 where something is broken."""
    if arguments:
        # Imported late: the report must not be missing where the parser is broken.
        from npa_envs.cli import common

        common.parse_options(DoctorOptions, "doctor", arguments)
    lines = examine()
    width = max(len(line.subject) for line in lines)
    for line in lines:
        print(f"{line.mark} {line.subject:<{width}}  {line.text}")
        if line.cure is not None:
            print(f"  {'':<{width}}  -> {line.cure}")
    broken, optional = (sum(line.mark == mark for line in lines) for mark in "!-")
    print(f"{broken} broken (!)" if broken else "nothing is broken", end="")
    print(f"; {optional} slow, or missing where not everybody needs it (-)" if optional else "")
    return 1 if broken else 0


@dataclass(frozen=True)
class DoctorLine:
    """One line of the report; `optional` cures are of what is slow or not needed by everybody."""

    subject: str
    text: str
    cure: str | None = None
    optional: bool = False

    @property
    def mark(self) -> str:
        """How the line begins: "!" for what is broken, "-" for what is slow or missing."""
        return " " if self.cure is None else "-" if self.optional else "!"


def examine() -> list[DoctorLine]:
    """Return the lines of packages, devices, kernel cache, fonts and programs, in their order."""
    lines = []
    devices = (_torch_devices, _warp_devices, _kernel_cache)
    for check in (_python, _packages, _extras, *devices, _emoji_font, _ffmpeg, _browser, _rules):
        try:
            lines += check()
        except Exception as error:
            # The report must not break where the machine is broken.
            subject = check.__name__[1:].replace("_", " ")
            lines.append(DoctorLine(subject, f"{type(error).__name__}: {error}", "see the message"))
    return lines


def _python() -> list[DoctorLine]:
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    return [
        DoctorLine("python", f"{platform.python_version()} ({sys.executable})"),
        DoctorLine("system", f"{system}, {os.cpu_count()} cores"),
    ]


def _version(name: str) -> str | None:
    """Return the version of a distribution, None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version.partition("+")[0])[:3])


def _requirements(extra: str) -> Iterator[tuple[str, str, str | None]]:
    """Yield name, oldest version and fault of what an extra, or "" the installation, asks for."""
    for line in importlib.metadata.requires("npa-envs") or []:
        name, oldest, own = (
            match[1] if (match := re.search(pattern, line)) else ""
            for pattern in (r"^([\w.-]+)", r">=\s*([\d.]+)", r"extra\s*==\s*['\"]([\w-]+)")
        )
        if own == extra and name != "npa-envs":
            version = _version(name)
            old = version is not None and _numbers(version) < _numbers(oldest)
            fault = f"{version} is older than {oldest}" if old else None
            yield name, oldest, fault if version else "not installed"


def _packages() -> list[DoctorLine]:
    version = _version("npa-envs")
    if version is None:
        text = "not installed, imported from a folder"
        return [DoctorLine("npa-envs", text, "pip install -e . in the clone", optional=True)]
    lines = [DoctorLine("npa-envs", version)]
    for name, oldest, fault in _requirements(""):
        cure = f"pip install -U '{name}>={oldest}'" if fault else None
        lines.append(DoctorLine(name, fault or _version(name) or "", cure))
    return lines


def _extras() -> list[DoctorLine]:
    lines: list[DoctorLine] = []
    if _version("npa-envs") is None:
        return lines
    for extra, purpose in EXTRAS.items():
        needed = list(_requirements(extra))
        faults = [f"{name} {fault}" for name, _, fault in needed if fault]
        have = [f"{name} {_version(name)}" for name, *_ in needed]
        text = f"{purpose}: {', '.join(faults or have)}"
        cure = f"pip install 'npa-envs[{extra}]'" if faults else None
        lines += [DoctorLine(f"[{extra}]", text, cure, optional=True)] if needed else []
    return lines


def _torch_devices() -> list[DoctorLine]:
    import torch

    cores, threads = os.cpu_count() or 1, torch.get_num_threads()
    idle = cores >= 4 and threads < cores // 2
    cure = "more is faster for large worlds: set OMP_NUM_THREADS, or leave it out" if idle else None
    lines = [DoctorLine("cpu", f"{threads} threads of {cores} cores", cure, optional=True)]
    if not torch.cuda.is_available():
        return [*lines, _no_cuda(torch.version.cuda)]
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        text = (
            f"{device.name}, {device.total_memory / 2**30:.0f} GiB, "
            f"compute capability {device.major}.{device.minor}, CUDA {torch.version.cuda}"
        )
        slow = (device.major, device.minor) < (8, 0)
        cure = "slow: the faster kernels need a card from 8.0 on (Ampere and newer)"
        lines.append(DoctorLine(f"cuda:{index}", text, cure if slow else None, optional=True))
    return lines


def _run(*command: str) -> list[str] | None:
    """Return what a program prints, in lines; None where it cannot run."""
    try:
        done = subprocess.run(
            command, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.splitlines()


def _no_cuda(built: str | None) -> DoctorLine:
    """Return why torch, built for a version of CUDA or for none, uses no card."""
    listed = _run("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")
    cards = [line.rpartition(", ") for line in listed or [] if ", " in line]
    if not cards:
        cure = (
            "slow for large worlds: use the presets fast and tiny, which are made for CPUs, or a "
            "machine with an NVIDIA card"
        )
        return DoctorLine("cuda", "no NVIDIA card, or no driver for it", cure, optional=True)
    name, _, driver = cards[0]
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
    oldest = OLDEST_DRIVERS.get(int((built or "0").partition(".")[0]), 0)
    if built is None:
        why = "this torch is a build for CPUs alone"
        cure = "pip uninstall torch, then install its CUDA build: https://pytorch.org/get-started"
    elif _numbers(driver) < (oldest,):
        why = f"driver {driver} is too old for CUDA {built}"
        cure = f"install NVIDIA's driver {oldest} or newer, or a torch for an older CUDA"
    elif hidden is not None:
        why = f"CUDA_VISIBLE_DEVICES is '{hidden}'"
        cure = "unset CUDA_VISIBLE_DEVICES, or name the card there"
    else:
        why = f"torch cannot use it (driver {driver})"
        cure = 'see what python -c "import torch; torch.zeros(1).cuda()" says; often a reboot helps'
    return DoctorLine("cuda", f"{name} is idle: {why}", cure)


def _warp_devices() -> list[DoctorLine]:
    import torch

    from npa_envs.runtime import warp_devices

    devices = warp_devices()
    missing = torch.cuda.is_available() and not any(name.startswith("cuda") for name in devices)
    cure = "torch sees a CUDA device and Warp does not: install a newer NVIDIA driver"
    return [DoctorLine("warp devices", "; ".join(devices), cure if missing else None)]


def _kernel_cache() -> list[DoctorLine]:
    from npa_envs.runtime import kernel_cache_folder

    folder = kernel_cache_folder()
    if not os.access(folder, os.W_OK):
        cure = (
            "kernels would be compiled anew in each run: set WARP_CACHE_PATH to a folder of yours"
        )
        return [DoctorLine("kernel cache", f"{folder} (cannot be written to)", cure)]
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    ours = len(list(folder.glob("wp_npa_envs*")))
    text = f"{folder} ({size / 2**20:.0f} MiB, {ours} modules of npa-envs)"
    cure = "the first use of each kernel compiles it; npa-envs warmup does so now"
    return [DoctorLine("kernel cache", text, None if ours else cure, optional=True)]


def _emoji_font() -> list[DoctorLine]:
    from npa_envs.tasks.targets.emoji import find_emoji_fonts

    fonts = find_emoji_fonts()
    cure = None if fonts else "for emoji as targets: apt install fonts-noto-color-emoji"
    return [DoctorLine("emoji font", str(fonts[0]) if fonts else "none", cure, optional=True)]


def _ffmpeg() -> list[DoctorLine]:
    again = "pip install -U imageio-ffmpeg"
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        cure = "pip install 'imageio[ffmpeg]'" if isinstance(error, ImportError) else again
        return [DoctorLine("ffmpeg", f"not found ({error})", cure)]
    said = _run(program, "-version")
    if said is None:
        return [DoctorLine("ffmpeg", f"{program} does not run", again)]
    return [DoctorLine("ffmpeg", f"{said[0]} ({program})")]


def has_screen() -> bool:
    """Return whether a browser can be shown on this computer."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(map(os.environ.get, screens))


def _browser() -> list[DoctorLine]:
    if has_screen():
        return [DoctorLine("browser", "there is a screen")]
    cure = (
        "for npa-envs view: run ssh -L 8765:127.0.0.1:8765 THIS-COMPUTER on a computer that has "
        "one, and open the printed link there"
    )
    return [DoctorLine("browser", "no screen", cure, optional=True)]


def _rules() -> list[DoctorLine]:
    from npa_envs.rule.files import load_rule, shipped_rules

    names = list(shipped_rules())
    for name in names:
        load_rule(name)
    cure = None if names else "install npa-envs again: its data is missing"
    return [DoctorLine("shipped rules", ", ".join(names) or "none", cure)]
