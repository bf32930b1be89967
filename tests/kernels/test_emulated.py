"""CUDA C++, run on a CPU by the threads of a block in turn."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from support.slow import slow
from support.worlds import relative_error

import npa_envs
from npa_envs import reference
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda import equivariance as cuda
from npa_envs.kernels.cuda.whole_rollout import world_size
from npa_envs.ops.equivariance import VectorSizes, read_rows, steer_rows

HERE = Path(__file__).parent
KERNELS = Path(native.__file__).parent


def text_of(name):
    return (KERNELS / name).read_text(encoding="utf-8")


def function_of(text, name):
    """Return the C++ text of a function's definition, with the template before it."""
    head = rf"(?:template <[^>]*>\s)?__device__ inline \w+ {name}\([^{{]*?\)\s*"
    return re.search(head + r"(?:\{[^\n]*\}\n|\{\n.*?\n\}\n)", text, re.S)[0]


def printed_by(source, folder, includes, optimise="-O1"):
    """Return what a C++ program prints; it is compiled and runs in `folder`."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    options = ["-std=c++20", optimise, "-w", *(f"-I{path}" for path in (HERE, folder, includes))]
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
        slow(VectorSizes(2, 32, 17, 8, chiral=True), 37),
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


def without(text, *names):
    """The C++ text without the definitions of some functions, which the test replaces."""
    for name in names:
        text = text.replace(function_of(text, name), "")
    return text


def rounded_exactly(text):
    """The C++ text with inverses and inverse roots in place of their approximations."""
    for word, inverse in (("rsqrt", "1.0f / sqrtf"), ("rcp", "1.0f / ")):
        call = rf'asm\("{word}\.approx\.ftz\.f32 %0, %1;" : "=f"\((\w+)\) : "f"\((.*?)\)\);'
        text = re.sub(call, rf"\1 = {inverse}(\2);", text)
    return text


def exact_rollout(x, s, rule, masks, noise, side):
    """The rollout in float64, by the reference; `side`: of a box with walls, or None."""
    weights = rule.hidden.weight, rule.hidden.bias, rule.output.weight
    hidden, bias, output, x, s = (value.detach().double() for value in (*weights, x, s))
    for mask, moved in zip(masks, noise, strict=True):
        z = reference.perceive(x, s, rule.eps0, rule.eps0, moment_inverse=rule.moment_inverse)
        update = torch.relu(z @ hidden.T + bias) @ output.T * mask[..., None]
        delta = update[..., :2]
        step = rule.alpha * rule.eps0 / (1.0 + delta.norm(dim=-1, keepdim=True))
        x, s = x + moved + step * delta, s + update[..., 2:]
        x = x if side is None else reference.reflected(x, (side, side))
    return x, s


@pytest.mark.parametrize(
    ("particles", "channels", "warps", "groups", "moment_inverse", "side"),
    [
        slow(60, 16, 1, 3, "threshold", None),
        slow(100, 5, 2, 1, "smooth", None),
        (200, 16, 4, 1, "threshold", 0.3),
        slow(128, 16, 8, 1, "threshold", None),
        slow(400, 8, 8, 1, "threshold", None),
    ],
)
def test_whole_rollouts_are_those_of_the_reference(
    particles, channels, warps, groups, moment_inverse, side, tmp_path
):
    worlds, steps, eps = 4 if groups > 1 else 1, 3, 0.1
    torch.manual_seed(0)
    rule = npa_envs.NPARule(2, channels, 40, eps0=eps, moment_inverse=moment_inverse)
    for parameter in rule.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    x = (torch.rand(worlds, particles, 2) - 0.5) * (1.4 * (particles / 4096) ** 0.5)
    s, masks = torch.randn(worlds, particles, channels), torch.rand(steps, worlds, particles) < 0.5
    noise = 0.01 * torch.randn(steps, *x.shape)
    weights = rule.hidden.weight, rule.hidden.bias, rule.output.weight
    floats = torch.cat([value.detach().flatten() for value in (*weights, x, s, noise)])
    (tmp_path / "in").write_bytes(floats.numpy().tobytes() + masks.numpy().tobytes())
    scales = 7.5 / eps, 30.0 / np.pi / eps**3 / particles, side or 1.0, side or 1.0
    inverse, walls = 1 + (moment_inverse == "smooth"), int(side is not None)
    sizes = {
        "WORLDS": worlds, "COUNT": particles, "CHANNELS": channels, "HIDDEN": 40,
        "WIDTH": rule.perception_dim, "STEPS": steps, "SIZE": world_size(particles),
        "WARPS": warps, "GROUPS": groups,
        "NUMBERS": ", ".join(f"{value}f" for value in (1.0 / eps, 0.5 * eps, 1.0, *scales)),
        "CHOICES": f"{steps}, 2, {inverse}, {walls}, {2 * channels}, {4 * channels}",
    }  # fmt: skip
    defined = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    (tmp_path / "sizes.h").write_text(defined, encoding="utf-8")
    named = {
        "mathematics.cuh": ("falloff_within", "log_above_one", "log_scale_of_square"),
        "cuda/network.cuh": ("scale_exponent", "scale_to"),
    }
    needed = [function_of(text_of(file), name) for file in named for name in named[file]]
    needed.insert(1, function_of(text_of("mathematics.cuh"), "smoothing"))
    replaced = "multiply_half8", "load_transposed", "rsqrt_fast", "sync_threads"
    rollouts = without(text_of("cuda/whole_rollout.cuh"), *replaced)
    head = "namespace npa {\n" + rounded_exactly("\n".join(needed)) + "}\n"
    (tmp_path / "native.h").write_text(head + rollouts, encoding="utf-8")
    printed_by("worlds_on_cpu.cpp", tmp_path, KERNELS, "-O0")

    values = torch.from_numpy(np.fromfile(tmp_path / "out", np.float32))
    new_x, new_s = values.split([x.numel(), s.numel()])
    exact_x, exact_s = exact_rollout(x, s, rule, masks, noise, side)
    assert relative_error(new_x.view_as(x) - x, exact_x - x.double()) < 1e-5
    assert relative_error(new_s.view_as(s) - s, exact_s - s.double()) < 1e-5
