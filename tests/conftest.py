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


@pytest.fixture(scope="session")
def device(request):
    """Device of the numerical tests."""
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
