"""`npa-envs doctor`: what is broken, slow or missing here, and the cure; also for bug reports."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

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

FAST_CAPABILITY = (8, 0)
"""Compute capability from which on the faster kernels run (`npa_envs.ops.backend`)."""


@dataclass(frozen=True)
class DoctorOptions:
    """Say what is broken, slow or missing on this machine, and the cure of each; also for bug
    reports."""


def main(arguments: Sequence[str]) -> int:
    """Print the report; return 1 where something is broken."""
    if arguments:
        # A report that needs the parser would be missing where that is broken.
        from npa_envs.cli.output import parse_options

        parse_options(DoctorOptions, "doctor", arguments)
    findings = examine()
    width = max(len(finding.subject) for finding in findings)
    for finding in findings:
        print(f"{finding.mark} {finding.subject:<{width}}  {finding.text}")
        if finding.cure is not None:
            print(f"  {'':<{width}}  -> {finding.cure}")
    broken = sum(finding.mark == "!" for finding in findings)
    optional = sum(finding.mark == "-" for finding in findings)
    print(f"{broken} broken (!)" if broken else "nothing is broken", end="")
    print(f"; {optional} slow, or missing where not everybody needs it (-)" if optional else "")
    return 1 if broken else 0


@dataclass(frozen=True)
class DoctorLine:
    """One line of the report."""

    subject: str
    text: str
    cure: str | None = None
    """What to do about it; None where all is well."""
    optional: bool = False
    """It works without the cure: something is slower, or what not everybody needs is missing."""

    @property
    def mark(self) -> str:
        """How the line begins: "!" for what is broken, "-" for what is slow or missing."""
        if self.cure is None:
            return " "
        return "-" if self.optional else "!"


def examine() -> list[DoctorLine]:
    """Look at packages, devices, the kernel cache, fonts and programs, in the order to read them.

    Starts Warp and, where there is one, asks CUDA for its devices. A check that fails in an
    unforeseen way is a finding itself.
    """
    checks: dict[str, Callable[[], list[DoctorLine]]] = {
        "python": _python,
        "packages": _packages,
        "extras": _extras,
        "torch devices": _torch_devices,
        "warp devices": _warp_devices,
        "kernel cache": _kernel_cache,
        "emoji font": _emoji_font,
        "ffmpeg": _ffmpeg,
        "browser": _browser,
        "shipped rules": _shipped_rules,
    }
    findings = []
    for subject, check in checks.items():
        try:
            findings += check()
        except Exception as error:
            # A report that breaks where the machine is broken would be of no use.
            findings.append(
                DoctorLine(subject, f"{type(error).__name__}: {error}", "see the message")
            )
    return findings


def _python() -> list[DoctorLine]:
    version = f"{platform.python_version()} ({sys.executable})"
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    return [
        DoctorLine("python", version),
        DoctorLine("system", f"{system}, {os.cpu_count()} cores"),
    ]


@dataclass(frozen=True)
class Requirement:
    """A package that the installation asks for."""

    name: str
    oldest: str
    """The oldest version that will do; empty: any."""
    extra: str | None

    def finding(self) -> str | None:
        """Return what is wrong with the package as it is installed, None: nothing."""
        version = _version(self.name)
        if version is None:
            return "not installed"
        if _numbers(version) < _numbers(self.oldest):
            return f"{version} is older than {self.oldest}"
        return None


def _version(name: str) -> str | None:
    """Return the version of a distribution, None where it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version.partition("+")[0])[:3])


def _requirements() -> list[Requirement]:
    """Return what the installed metadata of npa-envs names; nothing where it is not installed."""
    try:
        lines = importlib.metadata.requires("npa-envs") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    found = []
    for line in lines:
        what, _, marker = line.partition(";")
        name = re.match(r"[\w.-]+", what)
        oldest = re.search(r">=\s*([\d.]+)", what)
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)", marker)
        if name is not None and name[0] != "npa-envs":
            found.append(
                Requirement(name[0], oldest[1] if oldest else "", extra[1] if extra else None)
            )
    return found


def _packages() -> list[DoctorLine]:
    version = _version("npa-envs")
    if version is None:
        text = "not installed, imported from a folder"
        return [DoctorLine("npa-envs", text, "pip install -e . in the clone", optional=True)]
    findings = [DoctorLine("npa-envs", version)]
    for needed in _requirements():
        if needed.extra is None:
            wrong = needed.finding()
            text = wrong or _version(needed.name) or ""
            cure = f"pip install -U '{needed.name}>={needed.oldest}'" if wrong else None
            findings.append(DoctorLine(needed.name, text, cure))
    return findings


def _extras() -> list[DoctorLine]:
    requirements = _requirements()
    findings = []
    for extra, purpose in EXTRAS.items():
        needed = [one for one in requirements if one.extra == extra]
        if not needed:
            continue
        wrong = [f"{one.name} {text}" for one in needed if (text := one.finding()) is not None]
        have = ", ".join(f"{one.name} {_version(one.name)}" for one in needed)
        findings.append(
            DoctorLine(
                f"[{extra}]",
                f"{purpose}: {', '.join(wrong) if wrong else have}",
                f"pip install 'npa-envs[{extra}]'" if wrong else None,
                optional=True,
            )
        )
    return findings


def _torch_devices() -> list[DoctorLine]:
    import torch

    cores, threads = os.cpu_count() or 1, torch.get_num_threads()
    idle = cores >= 4 and threads < cores // 2
    cure = "more is faster for large worlds: set OMP_NUM_THREADS, or leave it out" if idle else None
    findings = [DoctorLine("cpu", f"{threads} threads of {cores} cores", cure, optional=True)]
    if not torch.cuda.is_available():
        return [*findings, _no_cuda(torch.version.cuda, _cards())]
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        text = (
            f"{device.name}, {device.total_memory / 2**30:.0f} GiB, "
            f"compute capability {device.major}.{device.minor}, CUDA {torch.version.cuda}"
        )
        slow = (device.major, device.minor) < FAST_CAPABILITY
        cure = "slow: the faster kernels need a card from 8.0 on (Ampere and newer)"
        findings.append(DoctorLine(f"cuda:{index}", text, cure if slow else None, optional=True))
    return findings


def _cards() -> list[tuple[str, str]]:
    """Return name and driver version of each card that NVIDIA's own program lists."""
    command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(
            command, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return []
    rows = [line.rpartition(", ") for line in done.stdout.splitlines()]
    return [(name, version) for name, _, version in rows if name]


def _no_cuda(built: str | None, cards: list[tuple[str, str]]) -> DoctorLine:
    """Return why torch, built for a version of CUDA or for none, uses none of these cards."""
    if not cards:
        cure = (
            "slow for large worlds: use the presets fast and tiny, which are made for CPUs, or a "
            "machine with an NVIDIA card"
        )
        return DoctorLine("cuda", "no NVIDIA card, or no driver for it", cure, optional=True)
    name, driver = cards[0]
    if built is None:
        cure = "pip uninstall torch, then install its CUDA build: https://pytorch.org/get-started"
        return DoctorLine("cuda", f"{name} is idle: this torch is a build for CPUs alone", cure)
    oldest = OLDEST_DRIVERS.get(int(built.partition(".")[0]))
    if oldest is not None and _numbers(driver) < (oldest,):
        cure = f"install NVIDIA's driver {oldest} or newer, or a torch for an older CUDA"
        return DoctorLine(
            "cuda", f"{name} is idle: driver {driver} is too old for CUDA {built}", cure
        )
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
    if hidden is not None:
        cure = "unset CUDA_VISIBLE_DEVICES, or name the card there"
        return DoctorLine("cuda", f"{name} is idle: CUDA_VISIBLE_DEVICES is '{hidden}'", cure)
    cure = 'see what python -c "import torch; torch.zeros(1).cuda()" says; often a reboot helps'
    return DoctorLine("cuda", f"{name} is idle: torch cannot use it (driver {driver})", cure)


def _warp_devices() -> list[DoctorLine]:
    import torch

    from npa_envs.runtime import warp_devices

    lines = warp_devices()
    sees_cuda = any(line.startswith("cuda") for line in lines)
    cure = None
    if torch.cuda.is_available() and not sees_cuda:
        cure = "torch sees a CUDA device and Warp does not: install a newer NVIDIA driver"
    return [DoctorLine("warp devices", "; ".join(lines), cure)]


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
    if fonts:
        return [DoctorLine("emoji font", str(fonts[0]))]
    cure = "for emoji as targets: apt install fonts-noto-color-emoji"
    return [DoctorLine("emoji font", "none", cure, optional=True)]


def _ffmpeg() -> list[DoctorLine]:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        return [DoctorLine("ffmpeg", f"not found ({error})", "pip install 'imageio[ffmpeg]'")]
    try:
        program = Path(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        return [DoctorLine("ffmpeg", f"not found ({error})", "pip install -U imageio-ffmpeg")]
    done = subprocess.run(
        [program, "-version"], capture_output=True, encoding="utf-8", errors="replace", check=False
    )
    if done.returncode:
        return [DoctorLine("ffmpeg", f"{program} does not run", "pip install -U imageio-ffmpeg")]
    return [DoctorLine("ffmpeg", f"{done.stdout.splitlines()[0]} ({program})")]


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


def _shipped_rules() -> list[DoctorLine]:
    from npa_envs.rule.files import load_rule, shipped_rules

    names = list(shipped_rules())
    for name in names:
        load_rule(name)
    if not names:
        return [DoctorLine("shipped rules", "none", "install npa-envs again: its data is missing")]
    return [DoctorLine("shipped rules", ", ".join(names))]
