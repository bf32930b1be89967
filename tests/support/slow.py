"""Parameters of a test that `make test` leaves out, as others take the same way."""

import pytest


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def partly_slow(values, left_out):
    return [slow(value) if value in left_out else value for value in values]
