"""Options and fixtures of the whole suite."""

import os
from pathlib import Path

import pytest
import torch

REFERENCE = Path(
    os.environ.get(
        "NPA_ENVS_REFERENCE", Path(__file__).resolve().parents[2] / "shared" / "reference"
    )
)


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="device of the numerical tests: cpu or cuda")


def pytest_collection_modifyitems(items):
    """Skip tests that need CUDA where there is none, and mark those that `--device` changes."""
    skip = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(skip)
        if "device" in getattr(item, "fixturenames", ()):
            item.add_marker("device")


@pytest.fixture(scope="session")
def device(request):
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


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request):
    return request.param


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def space_dim(request):
    return request.param
