"""Data that several files of this folder share, and notes of files that each test gets anew."""

import pytest
from support.small_digits import write_idx

from npa_envs.tasks.targets.notes import left_out


@pytest.fixture(autouse=True)
def _told_again():
    left_out.cache_clear()


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a folder of small pictures of three classes in MNIST's format."""
    return write_idx(tmp_path_factory.mktemp("idx"))
