"""Tests of methods whose libraries are not installed are skipped."""

import pytest

from npa_envs.errors import MissingDependencyError


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call():
    try:
        return (yield)
    except MissingDependencyError as error:
        pytest.skip(str(error))
