"""`npa-envs doctor`: a report on the machine and the installation, also for bug reports."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from npa_envs.cli.output import parse_options

PACKAGES = (
    "npa-envs",
    "torch",
    "warp-lang",
    "numpy",
    "safetensors",
    "pillow",
    "imageio",
    "imageio-ffmpeg",
    "tyro",
    "tqdm",
    "pyyaml",
    "tensorboard",
)
OPTIONAL_PACKAGES = ("gymnasium", "pettingzoo", "stable-baselines3")


@dataclass(frozen=True)
class DoctorOptions:
    """Versions, devices, kernel cache, fonts: what to look at first, and for bug reports."""


def main(arguments: Sequence[str]) -> int:
    """Print the report; return 1 where something has to be mended."""
    parse_options(DoctorOptions, "doctor", arguments)
    findings = examine()
    width = max(len(finding.subject) for finding in findings)
    for finding in findings:
        mark = " " if finding.cure is None else "!"
        print(f"{mark} {finding.subject:<{width}}  {finding.text}")
        if finding.cure is not None:
            print(f"  {'':<{width}}  -> {finding.cure}")
    broken = sum(finding.cure is not None for finding in findings)
    print(f"{broken} to mend, marked with !" if broken else "all is well")
    return 1 if broken else 0


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    subject: str
    text: str
    cure: str | None = None
    """What to do about it; None where all is well."""


def examine() -> list[Finding]:
    """Look at versions, devices, the kernel cache, fonts and ffmpeg, in the order to read it.

    Starts Warp and, where there is one, asks CUDA for its devices. A check that fails in an
    unforeseen way is a finding itself.
    """
    checks: dict[str, Callable[[], list[Finding]]] = {
        "python": _python,
        "packages": _packages,
        "torch devices": _torch_devices,
        "warp devices": _warp_devices,
        "kernel cache": _kernel_cache,
        "emoji font": _emoji_font,
        "ffmpeg": _ffmpeg,
        "shipped rules": _shipped_rules,
    }
    findings = []
    for subject, check in checks.items():
        try:
            findings += check()
        except Exception as error:
            # A report that breaks where the machine is broken would be of no use.
            findings.append(Finding(subject, f"{type(error).__name__}: {error}", "see the message"))
    return findings


def _python() -> list[Finding]:
    version = f"{platform.python_version()} ({sys.executable})"
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    return [Finding("python", version), Finding("system", f"{system}, {os.cpu_count()} cores")]


def _packages() -> list[Finding]:
    from npa_envs.measure.record import installed_version

    findings = []
    for name in PACKAGES:
        version = installed_version(name)
        cure = None if version else f"pip install {name}"
        findings.append(Finding(name, version or "not installed", cure))
    for name in OPTIONAL_PACKAGES:
        findings.append(Finding(name, installed_version(name) or "not installed (optional)"))
    return findings


def _torch_devices() -> list[Finding]:
    import torch

    threads = f"cpu, {torch.get_num_threads()} threads"
    if not torch.cuda.is_available():
        built = torch.version.cuda
        reason = f"built for CUDA {built}, no device" if built else "a build without CUDA"
        return [Finding("torch devices", f"{threads}; no CUDA device (torch is {reason})")]
    findings = [Finding("torch devices", f"{threads}; CUDA {torch.version.cuda}")]
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        text = (
            f"{device.name}, {device.total_memory / 2**30:.0f} GiB, {device.major}.{device.minor}"
        )
        findings.append(Finding(f"cuda:{index}", text))
    return findings


def _warp_devices() -> list[Finding]:
    import torch

    from npa_envs.runtime import warp_devices

    lines = warp_devices()
    sees_cuda = any(line.startswith("cuda") for line in lines)
    cure = None
    if torch.cuda.is_available() and not sees_cuda:
        cure = "torch sees a CUDA device and Warp does not: check the driver's version"
    return [Finding("warp devices", "; ".join(lines), cure)]


def _kernel_cache() -> list[Finding]:
    from npa_envs.runtime import kernel_cache_folder

    folder = kernel_cache_folder()
    if not os.access(folder, os.W_OK):
        cure = (
            "kernels would be compiled anew in each run: set WARP_CACHE_PATH to a folder of yours"
        )
        return [Finding("kernel cache", f"{folder} (cannot be written to)", cure)]
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    ours = len(list(folder.glob("wp_npa_envs*")))
    text = f"{folder} ({size / 2**20:.0f} MiB, {ours} modules of npa-envs)"
    return [Finding("kernel cache", text if ours else f"{text}; compile them: npa-envs warmup")]


def _emoji_font() -> list[Finding]:
    from npa_envs.tasks.targets.emoji import find_emoji_fonts

    fonts = find_emoji_fonts()
    if fonts:
        return [Finding("emoji font", str(fonts[0]))]
    return [Finding("emoji font", "none (optional): apt install fonts-noto-color-emoji")]


def _ffmpeg() -> list[Finding]:
    import imageio_ffmpeg

    try:
        program = Path(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        return [Finding("ffmpeg", f"not found ({error})", "pip install imageio-ffmpeg")]
    done = subprocess.run([program, "-version"], capture_output=True, text=True, check=False)
    if done.returncode:
        return [Finding("ffmpeg", f"{program} does not run", "pip install -U imageio-ffmpeg")]
    return [Finding("ffmpeg", f"{done.stdout.splitlines()[0]} ({program})")]


def _shipped_rules() -> list[Finding]:
    from npa_envs.rule.files import load_rule, shipped_rules

    names = list(shipped_rules())
    for name in names:
        load_rule(name)
    if not names:
        return [Finding("shipped rules", "none", "install npa-envs again: its data is missing")]
    return [Finding("shipped rules", ", ".join(names))]
