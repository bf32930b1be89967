"""Exported pages in a real browser: they live, are touched, heal, and load nothing."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from browser import DESK, PHONE, Page, browser

from npa_envs.web.export import export_web


@pytest.fixture(scope="module")
def new_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], Page]]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def export(folder: Path, *rules: str, count: int = 1024, previews: bool = False) -> str:
    export_web(rules, folder / "page.html", particle_count=count, previews=previews)
    return (folder / "page.html").as_uri()


STEP = "document.page.frame.step"
COUNT = "document.page.frame.positions.length / document.page.world.dimension"
BLANK = """(() => {
  const { colours } = document.page.frame;
  let blank = 0;
  for (let k = 0; k < colours.length; k += 3)
    blank += [0, 1, 2].every((c) => Math.abs(colours[k + c] - 127.5) < 1) ? 1 : 0;
  return blank;
})()"""
"""Particles of state zero, whose colour is grey."""


def alone(page: Page) -> None:
    """Check that the page has loaded nothing and complained of nothing."""
    loaded = page.run("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert [name for name in loaded if not name.startswith(("data:", "blob:"))] == []
    assert page.complaints == []


def test_an_exported_page_lives_and_is_touched(
    tmp_path: Path, new_page: Callable[[], Page]
) -> None:
    page = new_page()
    page.open(export(tmp_path, "gecko", count=512))
    page.wait(f"{STEP} >= 3")
    # The middle of the canvas, where the seed is.
    x, y = page.run(
        "(({ left, top, width, height }) => [left + width / 2, top + height / 2])"
        "(document.getElementById('world').getBoundingClientRect())"
    )
    page.drag([(x, y), (x + 20, y)])
    assert 0 < page.wait(f"{COUNT} < 512 && {COUNT}") < 512
    page.run("document.page.send({ type: 'set', name: 'eps', value: 0.12 })")
    page.wait("document.page.world.settings.eps.value === 0.12")
    page.wait(f"{STEP} > {page.run(STEP)} + 2")
    alone(page)


@pytest.mark.slow
@pytest.mark.parametrize("size", [DESK, PHONE])
def test_an_exported_page_heals(
    tmp_path: Path, new_page: Callable[[], Page], size: tuple[int, int]
) -> None:
    page = new_page()
    page.open(export(tmp_path, "gecko", "heart"), size)
    page.wait(f"{STEP} >= 100", 120)
    page.run("document.page.play(false)")
    assert page.run(BLANK) < 10
    page.run("document.page.send({ type: 'damage', name: 'erase' })")
    assert page.wait(f"{BLANK} > 40 && {BLANK}") > 40
    page.run("document.page.play(true)")
    page.wait(f"{BLANK} < 10", 120)
    page.run("document.page.send({ type: 'set', name: 'rule', value: 'heart' })")
    page.wait("document.page.world.rule === 'heart'")
    page.wait(f"{STEP} >= 5")
    alone(page)


@pytest.mark.slow
def test_a_page_may_not_reach_the_network(tmp_path: Path, new_page: Callable[[], Page]) -> None:
    page = new_page()
    page.open(export(tmp_path, "gecko", count=64))
    page.wait(f"{STEP} >= 1")
    refused = page.run(
        """new Promise((told) => {
          addEventListener("securitypolicyviolation", (event) => told(event.effectiveDirective));
          fetch("http://127.0.0.1:9/").catch(() => null);
        })"""
    )
    assert refused == "connect-src"


@pytest.mark.slow
def test_a_gallery_opens_a_rule_and_goes_back(tmp_path: Path, new_page: Callable[[], Page]) -> None:
    address = export(tmp_path, "gecko", "dots", count=256, previews=True)
    page = new_page()
    page.open(address, PHONE)
    shown = "[...document.querySelectorAll('#gallery img')].filter((image) => image.naturalWidth)"
    page.wait(f"{shown}.length === 2")
    page.run("document.querySelector('#gallery li:nth-child(2) a').click()")
    page.wait(f"document.page.world.rule === 'dots' && {STEP} >= 2")
    page.run("document.getElementById('back').click()")
    page.wait("!document.getElementById('gallery').hidden && !document.page.world.playing")
    page.run("location.hash = 'gecko'")
    page.wait(f"document.page.world.rule === 'gecko' && {STEP} >= 2")
    alone(page)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["duck", "digits"])
def test_solid_and_still_worlds_live_in_a_page(
    tmp_path: Path, new_page: Callable[[], Page], name: str
) -> None:
    if name == "digits":
        pytest.importorskip("sklearn")
    page = new_page()
    export_web([name], tmp_path / "page.html")
    page.open((tmp_path / "page.html").as_uri())
    page.wait(f"{STEP} >= 3", 120)
    count = {"duck": 16384, "digits": 512}[name]
    assert re.match(rf"step \d+ · {count} particles", page.run("document.body.innerText"))
    alone(page)
