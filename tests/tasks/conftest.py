"""Data that several files of this folder share."""

import pytest
from support.small_digits import write_idx


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a folder of small pictures of three classes in MNIST's format."""
    return write_idx(tmp_path_factory.mktemp("idx"))
