"""CUDA C++, run on a CPU by the threads of a block in turn."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from support.worlds import relative_error

from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda import equivariance as cuda
from npa_envs.ops.equivariance import VectorSizes, read_rows, steer_rows

HERE = Path(__file__).parent
KERNELS = Path(native.__file__).parent


def text_of(name):
    return (KERNELS / name).read_text(encoding="utf-8")


def function_of(text, name):
    """Return the C++ text of a function's definition, with the template before it."""
    head = rf"(?:template <[^>]*>\s)?__device__ inline \w+ {name}\([^{{]*?\)\s*"
    return re.search(head + r"(?:\{[^\n]*\}\n|\{\n.*?\n\}\n)", text, re.S)[0]


def printed_by(source, folder, includes):
    """Return what a C++ program prints; it is compiled and runs in `folder`."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    options = ["-std=c++20", "-O1", "-w", *(f"-I{path}" for path in (HERE, folder, includes))]
    command = [compiler, *options, "-o", "program", str(HERE / source)]
    subprocess.run(command, cwd=folder, check=True)
    program = [str(folder / "program")]
    result = subprocess.run(
        program, cwd=folder, capture_output=True, timeout=300, encoding="utf-8", check=False
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


def test_tiles_of_pictures_are_ranked_by_their_candidates(tmp_path):
    assert printed_by("ranks_on_cpu.cpp", tmp_path, KERNELS / "pictures") == "0 wrong\n"


def test_tiles_find_all_neighbours_of_all_particles(tmp_path):
    tiles = text_of("cuda/density.cuh")
    fetch, wait = function_of(tiles, "fetch"), function_of(tiles, "await_fetched")
    tiles = tiles.replace(fetch, fetch.split("{")[0] + "{ *to = *from; }\n")
    tiles = tiles.replace(wait, wait.split("{")[0] + "{}\n")
    mathematics = text_of("mathematics.cuh")
    needed = [function_of(mathematics, name) for name in ("falloff_within", "smoothing")]
    needed.append(function_of(text_of("lanes_and_memory.cuh"), "sum_up_to"))
    head = "namespace npa {\n" + "\n".join(needed) + "}\nusing std::fmaf;\n"
    (tmp_path / "native.h").write_text(head + tiles, encoding="utf-8")
    printed = printed_by("tiles_on_cpu.cpp", tmp_path, KERNELS)
    assert printed == "720 worlds, 0 particles wrong\n"


def fourfold(number):
    """The number rounded up to a multiple of four, as widths of rows are."""
    return number + -number % 4


@pytest.mark.parametrize(
    ("form", "count"),
    [
        (VectorSizes(2, 32, 17, 8, chiral=True), 37),
        (VectorSizes(3, 10, 6, 5, chiral=False), 23),
        (VectorSizes(2, 6, 3, 33, chiral=True), 9),
    ],
)
def test_vectors_of_rows_are_what_the_portable_kernels_make_of_them(form, count, tmp_path):
    assert cuda.fits_block(*form)
    gates, channels, rows_of_warp = form.gate_count, 5, cuda.rows_of_warp(form.mixed)
    widths = [form.perception_dim + 1, form.input_dim + 1, gates + channels]
    width, in_width, out_width, up_width = map(fourfold, [*widths, form.space_dim + channels])
    vectors = count, form.mixed, form.space_dim
    generator = torch.Generator().manual_seed(1)
    inputs = [
        torch.randn(*shape, generator=generator)
        for shape in (
            (count, width), (form.perceived, form.mixed), vectors, (count, in_width),
            (count, out_width), (gates,), (count, up_width),
        )
    ]  # fmt: skip
    inputs[5] = inputs[5].sign()
    (tmp_path / "in").write_bytes(b"".join(value.numpy().tobytes() for value in inputs))
    sizes = {
        "COUNT": count,
        "WIDTH": width,
        "IN_WIDTH": in_width,
        "OUT_WIDTH": out_width,
        "UP_WIDTH": up_width,
        "GATES": gates,
        "WEIGHTS": form.perceived * form.mixed,
        "VECTORS": count * form.mixed * form.space_dim,
        "FORM": ", ".join(str(int(size)) for size in form),
        "STEERING": f"{form.space_dim}, {form.mixed}, {int(form.chiral)}",
        "ROWS": rows_of_warp,
        "READ_BLOCKS": -(-count // (rows_of_warp * cuda.READ_WARPS)),
        "STEER_BLOCKS": -(-count // (cuda.STEERED_ROWS * cuda.STEER_WARPS)),
    }
    warps = ("READ_WARPS", "PULL_WARPS", "STEER_WARPS", "MIXING_SUM_WARPS")
    sizes |= {name: getattr(cuda, name) for name in (*warps, "STEERED_ROWS")}
    defined = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    (tmp_path / "sizes.h").write_text(defined, encoding="utf-8")
    adding = function_of(text_of("cuda/network.cuh"), "add_partial_sums")
    (tmp_path / "sums.h").write_text(f"namespace npa {{\n{adding}}}\n", encoding="utf-8")
    printed_by("vectors_on_cpu.cpp", tmp_path, KERNELS / "cuda")

    rows, mixing, mixed_bar, inputs_bar, output, signs, update_bar = (v.double() for v in inputs)
    for leaf in (rows, mixing, output):
        leaf.requires_grad_()
    results = read_rows(rows, mixing, form, in_width)
    pulls = torch.autograd.grad(results, (rows, mixing), (mixed_bar, inputs_bar))
    mixed = results[0].detach().requires_grad_()
    update = steer_rows(output, mixed, signs, up_width)
    steering = torch.autograd.grad(update, (output, mixed), update_bar)
    expected = [*results, *pulls, update, *steering]
    values = torch.from_numpy(np.fromfile(tmp_path / "out", np.float32))
    for value, answer in zip(values.split([a.numel() for a in expected]), expected, strict=True):
        assert relative_error(value.view(answer.shape), answer) < 1e-6
