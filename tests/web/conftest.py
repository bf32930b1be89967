"""What the tests of pages share: one browser, and the page's modules for Node.js."""

import shutil

import pytest
from support.browser import browser

from npa_envs.web.export import PAGE


@pytest.fixture(scope="session")
def new_page(tmp_path_factory):
    """A function that returns a new page of a headless Chromium."""
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="session")
def modules(tmp_path_factory):
    """A folder with the page's modules, which Node.js runs without a browser."""
    if shutil.which("node") is None:
        pytest.skip("needs Node.js")
    folder = tmp_path_factory.mktemp("page")
    for module in PAGE.glob("*.js"):
        shutil.copy(module, folder)
    (folder / "package.json").write_text('{"type": "module"}', encoding="utf-8")
    return folder
