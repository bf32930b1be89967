"""Parameters of a test that `make test` leaves out, as others take the same way."""

import pytest


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)
