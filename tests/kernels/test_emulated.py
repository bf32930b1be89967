"""CUDA kernels of equivariant rules, emulated by threads of a CPU, against the portable ones."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from worlds import relative_error

from npa_envs.kernels.cuda import equivariance as cuda
from npa_envs.ops.equivariance import VectorForm, read_rows, steer_rows

KERNELS = Path(cuda.__file__).parent

PROGRAM = """
#include "{emulation}"
#include "{kernels}"
namespace npa {{
{sum}
}}

int main()
{{
    std::FILE* file = std::fopen("in", "rb");
    Table rows({count}, {width}), mixing(1, {weights}), mixed(1, {vectors});
    Table mixed_bar(1, {vectors}), inputs({count}, {in_width}), inputs_bar({count}, {in_width});
    Table rows_bar({count}, {width}), sums({blocks}, {weights}), mixing_bar(1, {weights});
    Table output({count}, {out_width}), signs(1, {gates}), update({count}, {up_width});
    Table update_bar({count}, {up_width}), output_bar({count}, {out_width}), pulled(1, {vectors});
    for (Table* table :
         {{&rows, &mixing, &mixed_bar, &inputs_bar, &output, &signs, &update_bar}}) {{
        table->read(file);
    }}
    std::fclose(file);
    launch({read_blocks}, {read_warps} * 32, [&] {{
        npa::read_vectors<{form}, {read_warps}, {rows}>(
            rows.array, mixing.array, mixed.array, inputs.array);
    }});
    launch({blocks}, {pull_warps} * 32, [&] {{
        npa::pull_back_vectors<{form}, {pull_warps}, {rows}>(
            rows.array, mixing.array, mixed.array, mixed_bar.array, inputs_bar.array,
            rows_bar.array, sums.array);
    }});
    launch(({weights} + 31) / 32, {sum_warps} * 32, [&] {{
        npa::add_partial_sums<{sum_warps}>(sums.array, mixing_bar.array);
    }});
    launch({steer_blocks}, {steer_warps} * 32, [&] {{
        npa::steer_by_gates<{steering}, {steer_warps}, {steered}>(
            output.array, mixed.array, signs.array, update.array);
    }});
    launch({steer_blocks}, {steer_warps} * 32, [&] {{
        npa::pull_back_gates<{steering}, {steer_warps}, {steered}>(
            output.array, mixed.array, signs.array, update_bar.array, output_bar.array,
            pulled.array);
    }});
    file = std::fopen("out", "wb");
    for (const Table* table :
         {{&mixed, &inputs, &rows_bar, &mixing_bar, &update, &output_bar, &pulled}}) {{
        table->write(file);
    }}
    std::fclose(file);
}}
"""


def fourfold(number):
    """The next multiple of four: widths of rows are."""
    return number + -number % 4


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is here")
@pytest.mark.parametrize(
    ("form", "count"),
    [
        (VectorForm(2, 32, 17, 8, chiral=True), 37),
        (VectorForm(3, 10, 6, 5, chiral=False), 23),
        (VectorForm(2, 6, 3, 33, chiral=True), 9),
    ],
)
def test_kernels_of_warps_do_what_the_portable_ones_do(form, count, tmp_path):
    assert cuda.fits_block(*form)
    gates, channels, rows_of_warp = form.gate_count, 5, cuda.rows_of_warp(form.mixed)
    widths = [form.perception_dim + 1, form.input_dim + 1, gates + channels]
    width, in_width, out_width, up_width = map(fourfold, [*widths, form.space_dim + channels])
    vectors = count, form.mixed, form.space_dim
    generator = torch.Generator().manual_seed(1)
    given = [
        torch.randn(*shape, generator=generator)
        for shape in (
            (count, width), (form.perceived, form.mixed), vectors, (count, in_width),
            (count, out_width), (gates,), (count, up_width),
        )
    ]  # fmt: skip
    given[5] = given[5].sign()
    (tmp_path / "in").write_bytes(b"".join(value.numpy().tobytes() for value in given))
    source = (KERNELS / "network.cuh").read_text(encoding="utf-8")
    (adding,) = re.findall(
        r"template <int WARPS>\n__device__ inline void add_partial_sums.*?\n}\n", source, re.DOTALL
    )
    shape = f"{form.space_dim}, {form.scalars}, {form.perceived}, {form.mixed}, {int(form.chiral)}"
    program = PROGRAM.format(
        emulation=Path(__file__).with_name("emulation.hpp"),
        kernels=KERNELS / "equivariance.cuh",
        sum=adding,
        count=count,
        width=width,
        in_width=in_width,
        out_width=out_width,
        up_width=up_width,
        gates=gates,
        weights=form.perceived * form.mixed,
        vectors=count * form.mixed * form.space_dim,
        form=shape,
        steering=f"{form.space_dim}, {form.mixed}, {int(form.chiral)}",
        rows=rows_of_warp,
        # Fewer than have all rows, so that warps come back for more.
        blocks=1,
        read_blocks=-(-count // (rows_of_warp * cuda.READ_WARPS)),
        steer_blocks=-(-count // (cuda.STEERED_ROWS * cuda.STEER_WARPS)),
        read_warps=cuda.READ_WARPS,
        pull_warps=cuda.PULL_WARPS,
        sum_warps=cuda.MIXING_SUM_WARPS,
        steer_warps=cuda.STEER_WARPS,
        steered=cuda.STEERED_ROWS,
    )
    (tmp_path / "program.cpp").write_text(program, encoding="utf-8")
    compiler = ["g++", "-std=c++20", "-O1", "-pthread", "program.cpp", "-o", "program"]
    subprocess.run(compiler, cwd=tmp_path, check=True)
    subprocess.run(["./program"], cwd=tmp_path, check=True, timeout=300)

    rows, mixing, mixed_bar, inputs_bar, output, signs, update_bar = (v.double() for v in given)
    for leaf in (rows, mixing, output):
        leaf.requires_grad_()
    mixed, inputs = read_rows(rows, mixing, form, in_width)
    pulls = torch.autograd.grad((mixed, inputs), (rows, mixing), (mixed_bar, inputs_bar))
    seen = mixed.detach().requires_grad_()
    update = steer_rows(output, seen, signs, up_width)
    steering = torch.autograd.grad(update, (output, seen), update_bar)
    expected = [mixed, inputs, *pulls, update, *steering]
    found = np.fromfile(tmp_path / "out", np.float32)
    assert len(found) == sum(value.numel() for value in expected)
    for theirs in expected:
        ours, found = found[: theirs.numel()], found[theirs.numel() :]
        assert relative_error(torch.from_numpy(ours.copy()).view(theirs.shape), theirs) < 1e-6
