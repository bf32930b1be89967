"""Options and fixtures of the whole suite."""

import gc
import os
from pathlib import Path

import pytest

REFERENCE = Path(
    os.environ.get(
        "NPA_ENVS_REFERENCE", Path(__file__).resolve().parents[2] / "shared" / "reference"
    )
)


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="device of the numerical tests: cpu or cuda")


def pytest_collection_modifyitems(items):
    """Skip tests that need CUDA where there is none, and mark those that `--device` changes."""
    # The process that only hands out tests does without its slow import.
    import torch

    # What is imported stays, and need not be looked at in each collection.
    gc.freeze()
    skip = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(skip)
        if "device" in getattr(item, "fixturenames", ()):
            item.add_marker("device")


@pytest.fixture(scope="session")
def device(request):
    import torch

    chosen = torch.device(request.config.getoption("--device"))
    if chosen.type == "cuda" and not torch.cuda.is_available():
        pytest.fail("--device cuda was asked for, and this machine has no CUDA device")
    return chosen


@pytest.fixture(scope="session")
def reference():
    """Folder of float64 answers and of a rule that the paper's authors trained."""
    if not REFERENCE.is_dir():
        pytest.skip("the folder of reference answers is not here")
    return REFERENCE


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    import torch

    return getattr(torch, request.param)


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def space_dim(request):
    return request.param
