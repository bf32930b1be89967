"""Kernels that are launched early wait for those before them; nothing is run, no GPU is needed."""

import ast
import re
from pathlib import Path

import pytest
import warp as wp

import npa_envs
from npa_envs.kernels.cuda.network import two_layer_kernel

WAIT = "wait_for_previous_kernel()"

KERNELS = Path(npa_envs.__file__).parent / "kernels"

GLOBAL_ACCESS = re.compile(r"\b(?:ld|st|atom|red|cp|prefetch)\.(?!param|shared|local)\S+")
"""An instruction of PTX that may touch the device's memory."""


def kernel_bodies():
    """Yield each kernel's name and its statements after the docstring."""
    for path in sorted(KERNELS.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            marks = [ast.unparse(mark) for mark in getattr(node, "decorator_list", ())]
            if isinstance(node, ast.FunctionDef) and any("wp.kernel" in mark for mark in marks):
                yield f"{path.stem}.{node.name}", node.body[1:]


def test_kernels_that_wait_do_so_first():
    for name, body in kernel_bodies():
        first, *others = map(ast.unparse, body)
        assert WAIT not in "".join(others), name
        assert WAIT not in first or first == WAIT, name


def test_no_load_may_be_moved_ahead_of_the_wait():
    for path in KERNELS.rglob("*.cuh"):
        code = re.sub(r"//.*", "", path.read_text(encoding="utf-8"))
        # Both promise that nobody writes what is read while the kernel is there.
        assert not re.search(r"__ldg|ld\.global\.nc|__restrict__", code), path.name


@pytest.mark.parametrize(("capability", "waits"), [(80, False), (90, True)])
def test_memory_is_touched_after_the_wait(capability, waits, tmp_path):
    module = two_layer_kernel(1, 1, "relu_store_mask").module
    wp.compile_aot_module(module, arch=capability, module_dir=tmp_path, use_ptx=True)
    (file,) = tmp_path.glob("*.ptx")
    assert "ld.global.nc" not in file.read_text(encoding="utf-8")
    entries = re.findall(r"\.entry \w+\(.*?\n\}\n", file.read_text(encoding="utf-8"), re.DOTALL)
    assert entries
    for entry in entries:
        # Blocks of instructions, of which the first is entered first.
        first, *blocks = re.split(r"\n\$L\w+:\n", entry)
        waiting = [block for block in (first, *blocks) if "griddepcontrol.wait;" in block]
        assert len(waiting) == waits
        assert any(map(GLOBAL_ACCESS.search, blocks))
        for block in {first, *waiting}:
            assert not (waits and GLOBAL_ACCESS.search(block.partition("griddepcontrol.wait;")[0]))
