"""HTML files that run rules in a browser, without a server."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from PIL import Image
from torch import Tensor

from npa_envs.errors import NPAError, shown
from npa_envs.files import atomic_path, checked_path
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule, check_rule
from npa_envs.tasks.damage import CLUMP_FACTOR, DAMAGE_SIZES
from npa_envs.tasks.point_classification import PALETTE, UNDECIDED, PointClassification
from npa_envs.web.live import CLUMP_RATE, INJECT_RATE, checked_seed, colour_ramp
from npa_envs.web.rule_world import MIN_SEED, SEED_FRACTION, RuleWorld, name_of
from npa_envs.world.species import AGREEMENTS

PAGE = Path(__file__).resolve().parent / "page"
"""The folder of the page's files."""

PREVIEW_STEPS = 256
"""Steps of a world before its preview; half of them for textures and clouds."""

PREVIEW_PIXELS = 192
"""Pixels on each side of a preview."""

MAX_WEIGHTS = 2**20
"""Most weights of a rule in a page: 5.6 MB of text, and very slow in a browser."""

POLICY = (
    "default-src 'none'; script-src {scripts} 'wasm-unsafe-eval'; style-src {styles}; "
    "worker-src blob:; img-src data: blob:; media-src blob:; base-uri 'none'; form-action 'none'"
)
"""The page's content security policy: it may load nothing."""

CONSTANTS = {
    "AGREEMENTS": AGREEMENTS,
    "CLUMP_FACTOR": CLUMP_FACTOR,
    "CLUMP_RATE": CLUMP_RATE,
    "DAMAGE_SIZES": DAMAGE_SIZES,
    "INJECT_RATE": INJECT_RATE,
    "MIN_SEED": MIN_SEED,
    "SEED_FRACTION": SEED_FRACTION,
}
"""Numbers and names of the Python worlds that live_world.js also needs."""

_IMPORT = re.compile(r'^import \{ ([\w, ]+) \} from "\./(\w+\.js)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async function|function|class|const) (\w+))", re.MULTILINE)
_MODULE_LINE = re.compile(r"^(?:import|export)\b.*$", re.MULTILINE)


def joined_modules(names: Sequence[str], folder: Path = PAGE) -> str:
    """Return JavaScript modules, with those that they import, as one script.

    Each module becomes a function scope; the exports of `page.js` become members of `page`.
    """
    order: list[str] = []
    texts: dict[str, str] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in path:
            raise ValueError(f"modules import each other: {' -> '.join((*path, name))}")
        if name in texts:
            return
        source = (folder / name).read_text(encoding="utf-8")
        for _, other in _IMPORT.findall(source):
            visit(other, (*path, name))
        exported = ", ".join(_EXPORT.findall(source))
        source = _EXPORT.sub("", source)
        source = _IMPORT.sub(lambda found: f"const {{ {found[1]} }} = {_scope(found[2])};", source)
        left = _MODULE_LINE.search(source)
        if left is not None:
            raise ValueError(f"{name} must import and export as the others do, got {left[0]!r}")
        texts[name] = (
            f"const {_scope(name)} = (() => {{\n{source}\nreturn {{ {exported} }};\n}})();"
        )
        order.append(name)

    for name in names:
        visit(name, ())
    return "\n".join(('"use strict";', *(texts[name] for name in order)))


def _scope(module: str) -> str:
    return module.removesuffix(".js")


def export_web(
    sources: Sequence[str | Path],
    path: str | Path,
    *,
    title: str | None = None,
    particle_count: int | None = None,
    previews: bool = False,
    seed: int = 0,
) -> None:
    """Write one HTML file that runs rules in a browser; after an error no file is left.

    Weights, code and page are in the file, and its policy forbids any connection.

    Args:
        sources: Rules, as for `load_rule`; the first one is shown first.
        path: The file to write, ending in `.html`; an existing one is replaced.
        title: Title of the page; None: the first rule's name.
        particle_count: Particles of each world; None: as trained.
        previews: Begin with pictures of the rules' grown worlds to choose from.
        seed: Seed of the first world, 0 to 2^53 - 1.

    Raises:
        NPAError: The suffix is not .html, a rule cannot be loaded or run in a browser, two have the
            same name, or the file cannot be written.
    """
    path = checked_path(path)
    if path.suffix != ".html":
        raise NPAError(
            f"a page must end in .html, got {shown(str(path))}: "
            f"use {shown(str(path.with_suffix('.html')))}"
        )
    if isinstance(sources, str | Path) or not isinstance(sources, Iterable):
        raise NPAError(
            f"sources must be a list of rules, got {shown(sources)}: give it in square brackets"
        )
    sources = list(sources)
    for source in sources:
        if not isinstance(source, str | Path):
            raise NPAError(
                f"sources must be names or files of rules, got a {type(source).__name__}: write it "
                "to a file with npa_envs.save_rule, and give that"
            )
    if title is not None and not isinstance(title, str):
        raise NPAError(f"title must be text, or None for the first rule's name, got {shown(title)}")
    words = [str(source) for source in sources]
    names = distinct_names(words, "a page")
    seed = checked_seed(seed)
    # Opened first: an error in the path is reported before the slow growth of previews.
    with atomic_path(path) as temporary:
        rules = [page_rule(source, particle_count=particle_count) for source in words]
        if previews:
            for source, rule in zip(words, rules, strict=True):
                rule["preview"] = preview(source, particle_count=particle_count)
        text = page_text(rules, title=title or names[0], seed=seed)
        temporary.write_bytes(text.encode())


def distinct_names(sources: Sequence[str], what: str) -> list[str]:
    """Return the names of rules, which must differ; `what` is their file, for errors."""
    names = [name_of(source) for source in sources]
    if not names or len(set(names)) < len(names):
        raise NPAError(
            f"{what} needs rules of different names, got {shown(names)}: leave one out, or give "
            "its file another name"
        )
    return names


def page_rule(source: str, *, particle_count: int | None = None) -> dict[str, Any]:
    """Return a rule and its world for live_world.js, as JSON; arrays are float32 in base64."""
    check_browser_rule(load_rule(source), name_of(source))
    live = RuleWorld(source, device=torch.device("cpu"), particle_count=particle_count, choices={})
    rule, task = live.main.rule, live.task
    seed: dict[str, Any]
    if task.classifies:
        clouds = cast(PointClassification, task).clouds
        label = clouds.label.tolist()
        # One cloud of each class, the first.
        chosen = [clouds.x[label.index(kind)] for kind in sorted(set(label))]
        seed = {"kind": "clouds", "clouds": [_packed(cloud) for cloud in chosen]}
    elif task.box is not None:
        seed = {"kind": "box"}
    elif hasattr(task.config, "seed_radius"):
        seed = {"kind": "ball", "radius": task.config.seed_radius}
    else:
        raise NPAError(
            f"a page grows rules from a ball, a box or a point cloud, {shown(source)} begins with "
            f"a {type(task).__name__}: watch it with npa-envs view"
        )
    # Fields that live_world.js adds itself.
    own = {"type", "rules", "rule", "others", "species", "show", "capabilities", "playing", "seed"}
    world = {name: value for name, value in live.describe().items() if name not in own}
    classes = {"palette": PALETTE, "undecided": UNDECIDED}
    return {
        **rule.hyper_parameters(),
        "name": live.main.name,
        "classes": classes if task.classifies else None,
        "weights": {name: _packed(tensor) for name, tensor in rule.state_dict().items()},
        "world": world | {"count": live.full, "seed": seed},
    }


def check_browser_rule(rule: NPARule, name: str) -> None:
    """Raise an `NPAError` if the JavaScript of the page cannot run a rule."""
    check_rule(rule)
    view = "watch it with npa-envs view"
    kind, species, size = type(rule).__name__, rule.species_count, rule.weight_count
    for fails, rule_of_page, given, cure in (
        (rule.equivariant, "that know directions only", "is equivariant", view),
        (rule.code_dim, "without codes only", f"has code_dim={rule.code_dim}", view),
        (rule.divides, "with a fixed number of particles only", "divides", view),
        (
            not rule.is_plain(), "of two plain layers only",
            f"is a {kind} with a network of its own", "run it in Python",
        ),
        (
            species, "that perceive all species alike", f"has species_count={species}",
            "run it with npa_envs.rollout_species",
        ),
        (size > MAX_WEIGHTS, f"of at most {MAX_WEIGHTS} weights", f"has {size}", view),
    ):  # fmt: skip
        if fails:
            raise NPAError(f"a page runs rules {rule_of_page}, {shown(name)} {given}: {cure}")


def preview(source: str, *, particle_count: int | None = None, seed: int = 0) -> str:
    """Return a picture of a rule's grown world as a data URL: WebP with transparency."""
    live = RuleWorld(
        source, device=torch.device("cpu"), seed=seed, particle_count=particle_count, choices={}
    )
    live.speed = PREVIEW_STEPS if live.task.aligned else PREVIEW_STEPS // 2
    live.advance()
    with torch.no_grad():
        fields = live.task.picture(live.x, live.s)[0].flip(0)
    colour = fields[..., :3] / fields[..., 3:].clamp_min(1e-6)
    pixels = torch.cat((colour, fields[..., 3:]), dim=-1).clamp(0.0, 1.0)
    picture = Image.fromarray((pixels * 255.0).round().to(torch.uint8).numpy(), "RGBA")
    shrunk = picture.resize((PREVIEW_PIXELS, PREVIEW_PIXELS), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    shrunk.save(file, "WEBP", quality=80)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"


def page_text(rules: Sequence[Mapping[str, Any]], *, title: str, seed: int = 0) -> str:
    """Return the HTML of a page of rules, each as `page_rule` returns it."""
    settings = {
        "worker": "worker",
        "seed": seed,
        "ramp": base64.b64encode(colour_ramp().tobytes()).decode(),
        "constants": CONSTANTS,
        "rules": rules,
    }
    # With "<" a rule's text could end the script element.
    data = json.dumps(settings, separators=(",", ":")).replace("<", "\\u003c")
    worker = f"{joined_modules(['live_world.js'])}\nlive_world.serve(self);\n"
    code = f"{joined_modules(['exported.js'])}\nexported.begin();\n"
    style = (PAGE / "page.css").read_text(encoding="utf-8")
    policy = POLICY.format(scripts=_digest(code), styles=_digest(style))
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    limits = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    for before, after in (
        ('<meta charset="utf-8">', f'<meta charset="utf-8">\n{limits}'),
        ("<title>npa-envs</title>", f"<title>{html.escape(title)}</title>"),
        ('<link rel="stylesheet" href="page.css">', f"<style>{style}</style>"),
        (
            '<script type="module" src="viewer.js"></script>',
            f'<script type="application/json" id="rules">{data}</script>\n'
            f'<script type="text/plain" id="worker">{worker}</script>\n'
            f'<script type="module">{code}</script>',
        ),
    ):
        if page.count(before) != 1:
            raise ValueError(f"index.html must hold {before!r} once, found {page.count(before)}")
        page = page.replace(before, after)
    return page


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _packed(tensor: Tensor) -> str:
    data = tensor.detach().cpu().contiguous().numpy().astype("<f4")
    return base64.b64encode(data.tobytes()).decode()
