"""Exported pages in a real browser: they live, are touched, and load nothing."""

from __future__ import annotations

import json
import re

import pytest
import torch
from support.browser import DESK, PHONE, browser
from support.page_worlds import SPECIES, TOLERANCE, WORLDS, example

from npa_envs.web.export import export_web, joined_modules


@pytest.fixture
def exported(new_page, tmp_path):
    """A function that exports rules and opens them, once some steps are done.

    A page must load nothing and complain of nothing until the end of the test.
    """
    opened = []

    def show(*rules, size=DESK, steps=1, make=new_page, query="", **options):
        options = {"particle_count": 1024, "previews": False} | options
        path = tmp_path / f"page-{len(opened)}.html"
        export_web(rules, path, **options)
        opened.append(page := make())
        page.open(path.as_uri() + query, size)
        if steps:
            page.wait(f"{STEP} >= {steps}")
        return page

    yield show
    for page in opened:
        names = "performance.getEntriesByType('resource').map((entry) => entry.name)"
        assert [n for n in page.run(names) if not n.startswith(("data:", "blob:"))] == []
        assert page.complaints == []
        page.open("about:blank")


STEP = "document.page.frame.step"
COUNT = "document.page.frame.positions.length / document.page.world.dimension"


def test_an_exported_page_lives_and_is_touched(exported):
    page = exported("gecko", particle_count=512, steps=3)
    # The middle of the canvas, where the seed is.
    x, y = page.run(
        "(({ left, top, width, height }) => [left + width / 2, top + height / 2])"
        "(document.getElementById('world').getBoundingClientRect())"
    )
    page.run("document.querySelector('[data-brush=remove]').click()")
    page.drag([(x, y), (x + 20, y)])
    assert 0 < page.wait(f"{COUNT} < 512 && {COUNT}") < 512
    page.run("document.page.send({ type: 'set', name: 'eps', value: 0.12 })")
    page.wait("document.page.world.settings.eps.value === 0.12")
    page.run("document.getElementById('trained').click()")
    page.wait("document.page.world.settings.eps.value === 0.1")
    assert page.run("document.getElementById('trained').disabled")
    page.wait(f"{STEP} > {page.run(STEP)} + 2")
    # Another world may come before a frame of the last one was drawn.
    before = page.run(STEP)
    waits = page.run(
        "document.page.undrawn = 1;"
        "document.page.listen({ ...document.page.world, type: 'world', half_width: 2 });"
        "document.page.undrawn"
    )
    assert not waits
    page.wait(f"{STEP} > {before} + 2")


def test_a_phone_hears_what_the_page_is_and_chooses_a_rule_by_its_name(exported):
    page = exported("gecko", "heart", particle_count=64, size=PHONE)
    middle = "(({ x, y, width, height }) => [x + width / 2, y + height / 2])"
    box = f"{middle}(document.querySelector('%s').getBoundingClientRect())"
    page.touch([page.run(box % "#about summary")])
    page.wait("document.getElementById('about').innerText.includes('only its neighbours')")
    links = page.run("[...document.querySelectorAll('#about a')].map((link) => link.href)")
    assert links[0] == "https://arxiv.org/abs/2601.16096"
    x, y = page.run(box % "#title")
    assert page.run(f"document.elementFromPoint({x}, {y}).id") == "choice"
    page.run("(choice.value = 'heart', choice.dispatchEvent(new Event('change')))")
    page.wait("document.getElementById('title').textContent === 'heart'")


@pytest.mark.slow
def test_a_page_records_a_film_and_a_picture(exported):
    page = exported("gecko", particle_count=256, steps=2)
    page.run("document.getElementById('record').click()")
    page.wait(f"{STEP} >= 30")
    page.run("document.getElementById('record').click()")
    page.wait("document.querySelector('#files a').download.startsWith('film.')")
    page.run("document.getElementById('snapshot').click()")
    page.wait("document.querySelectorAll('#files a').length === 2")
    # The page may not fetch, not even its own files: a film that plays has its width.
    width = page.run(
        """new Promise((resolve) => {
          const film = document.createElement("video");
          film.onloadedmetadata = () => resolve(film.videoWidth);
          film.onerror = () => resolve(0);
          film.src = [...document.querySelectorAll("#files a")]
            .find((link) => link.download.startsWith("film.")).href;
        })"""
    )
    assert width == page.run("document.getElementById('world').width")


@pytest.mark.slow
def test_helpers_of_a_page_run_in_a_browser(new_page, tmp_path):
    positions = []
    for threads in (1, 8):
        path = tmp_path / f"{threads}.html"
        export_web(["gecko"], path, particle_count=2304)
        text = path.read_text("utf-8").replace("navigator.hardwareConcurrency", str(threads))
        path.write_text(text, encoding="utf-8")
        page = new_page()
        page.open(path.as_uri() + "?engine=processor")
        page.wait(f"document.page?.frame && {STEP} >= 1")
        reset, step = "{ type: 'reset', seed: 3 }", "{ type: 'step' }"
        for message in ("{ type: 'play', on: false }", reset, step, step, step):
            page.run(f"document.page.send({message})")
        page.wait(f"document.page.world.seed === 3 && {STEP} === 3", 60)
        workers = page.call("Target.getTargets")["targetInfos"]
        assert sum(target["type"] == "worker" for target in workers) == (4 if threads > 1 else 1)
        positions.append(page.run("[...document.page.frame.positions]"))
        page.open("about:blank")
    assert positions[0] == positions[1]


@pytest.mark.slow
def test_a_gallery_opens_a_rule_and_goes_back(exported):
    page = exported("gecko", "dots", particle_count=256, previews=True, size=PHONE, steps=0)
    shown = "[...document.querySelectorAll('#gallery img')].filter((image) => image.naturalWidth)"
    page.wait(f"{shown}.length === 2")
    page.run("document.querySelector('#gallery li:nth-child(2) a').click()")
    page.wait(f"document.page.world.rule === 'dots' && {STEP} >= 2")
    page.run("document.getElementById('back').click()")
    page.wait("!document.getElementById('gallery').hidden && !document.page.world.playing")
    page.run("location.hash = 'gecko'")
    page.wait(f"document.page.world.rule === 'gecko' && {STEP} >= 2")
    assert page.run("document.page.world.playing")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["duck", "digits"])
def test_solid_and_still_worlds_live_in_a_page(exported, name):
    if name == "digits":
        pytest.importorskip("sklearn")
    page = exported(name, particle_count=None, previews=True, query=f"#{name}", steps=3)
    count = {"duck": 8192, "digits": 512}[name]
    # It is written four times a second.
    text = page.wait("document.getElementById('step').textContent")
    assert re.fullmatch(rf"step \d+ · {count} particles", text)


# A GPU in software: slow, but the shaders are those that any GPU runs.
FLAGS = ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan")

ENGINE_STEP = """(async (engine, { rules, x, s, species, mask, eps, box, densityCounts }) => {
  const floats = (text) =>
    new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
  const { Physics, padded, plainKernels, prepareRule } = modules["physics.js"];
  const { simdKernels } = modules["kernels_simd.js"];
  const { GpuPhysics, openDevice } = modules["physics_gpu.js"];
  const { state_dim, space_dim } = rules[0];
  const kernels = engine === "simd" ? simdKernels(padded(state_dim), space_dim) : plainKernels();
  const prepared = rules.map((rule) => {
    const named = Object.entries(rule.weights).map(([name, text]) => [name, floats(text)]);
    return prepareRule({ ...rule, weights: Object.fromEntries(named) }, kernels);
  });
  const world = { count: species.length, x: floats(x), s: floats(s) };
  world.species = Uint8Array.from(species);
  let physics = new Physics(prepared, world.count, kernels);
  if (engine === "gpu") physics = await GpuPhysics.make(await openDevice(), physics);
  await physics.step(world, { eps, box, densityCounts, mask: Uint8Array.from(mask) });
  return { x: [...world.x], s: [...world.s] };
})"""


@pytest.fixture(scope="module")
def gpu_page(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("gpu"), *FLAGS) as opened:
        yield opened


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*WORLDS, *SPECIES])
def test_a_step_of_each_engine_is_that_of_python(tmp_path, gpu_page, kind):
    text = f"<!doctype html><script>{joined_modules('rule_world.js')}</script>"
    (tmp_path / "engines.html").write_text(text, encoding="utf-8")
    page = gpu_page()
    page.open((tmp_path / "engines.html").as_uri())
    page.wait("typeof modules === 'object'")
    step = example(kind)
    for engine in ("plain", "simd", "gpu"):
        got = page.run(f"{ENGINE_STEP}('{engine}', {json.dumps(step.fields)})")
        for name, want in zip("xs", step.after, strict=True):
            assert float((torch.tensor(got[name]).view_as(want) - want).abs().max()) < TOLERANCE
    assert page.complaints == []


@pytest.mark.slow
def test_a_page_lives_on_a_gpu(exported, gpu_page):
    for engine, name in (("gpu", "WebGPU"), ("auto", ""), ("processor", "WebAssembly")):
        kind = {"make": gpu_page, "query": f"?engine={engine}"}
        page = exported("gecko", "heart", particle_count=256, steps=8, **kind)
        page.run(
            "document.page.send({ type: 'brush', tool: 'graft', rule: 'heart', "
            "at: [0.1, 0], move: [0, 0], radius: 0.1, strength: 1 })"
        )
        page.wait("document.page.world.species.length === 2")
        assert page.run("document.page.frame.engine") == name or not name
        page.wait(f"{STEP} >= {page.run(STEP)} + 8", 60)
