"""The CUDA C++ of tiles, run on a CPU by the 32 threads of a warp in turn."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from npa_envs.kernels import native

HERE = Path(__file__).parent
KERNELS = Path(native.__file__).parent


def function_of(text, name):
    """The definition of a function, with the template before it."""
    head = rf"(?:template <[^>]*> )?__device__ inline \w+ {name}\([^{{]*?\)\s*"
    return re.search(head + r"(?:\{[^\n]*\}\n|\{\n.*?\n\}\n)", text, re.S)[0]


def told_by(source, *folders):
    """What a program of this folder says, which must end well."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    program = folders[0] / "program"
    options = ["-std=c++20", "-O2", "-w", *(f"-I{folder}" for folder in (HERE, *folders))]
    subprocess.run([compiler, *options, "-o", str(program), str(HERE / source)], check=True)
    told = subprocess.run(
        [str(program)], capture_output=True, text=True, timeout=300, encoding="utf-8"
    )
    assert told.returncode == 0, told.stdout
    return told.stdout


def test_tiles_of_pictures_are_ranked_by_their_candidates(tmp_path):
    assert told_by("ranks_on_cpu.cpp", tmp_path, KERNELS / "pictures") == "0 wrong\n"


def test_tiles_find_all_neighbours_of_all_particles(tmp_path):
    tiles, mathematics, access = (
        (KERNELS / name).read_text(encoding="utf-8")
        for name in ("cuda/tiles.cuh", "mathematics.cuh", "access.cuh")
    )
    fetch, wait = function_of(tiles, "fetch"), function_of(tiles, "await_fetched")
    tiles = tiles.replace(fetch, fetch.split("{")[0] + "{ *to = *from; }\n")
    tiles = tiles.replace(wait, wait.split("{")[0] + "{}\n")
    needed = [function_of(mathematics, name) for name in ("falloff_within", "smoothing")]
    needed.append(function_of(access, "sum_up_to"))
    head = "namespace npa {\n" + "\n".join(needed) + "}\nusing std::fmaf;\n"
    (tmp_path / "native.h").write_text(head + tiles, encoding="utf-8")
    assert told_by("tiles_on_cpu.cpp", tmp_path) == "720 worlds, 0 particles wrong\n"
