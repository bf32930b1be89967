"""What several tests of worlds start from."""

import pytest
import torch

from npa_envs.world import capture_cache


@pytest.fixture
def nothing_captured():
    """No captures before and after a test, where there is a CUDA device."""
    for before in (True, False):
        if torch.cuda.is_available():
            capture_cache.release_captures()
        if before:
            yield
