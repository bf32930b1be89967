"""HTML files that run rules in a browser, without a server."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import html
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import torch
from PIL import Image
from torch import Tensor

from npa_envs.atomic_files import atomic_path, checked_path
from npa_envs.errors import NPAError, shown
from npa_envs.render.colours import STATE_GAIN
from npa_envs.rule.files import load_rule, rule_name
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule, check_rule
from npa_envs.tasks.damage import CLUMP_FACTOR, DAMAGE_SIZES
from npa_envs.tasks.point_classification import PALETTE, UNDECIDED, PointClassification
from npa_envs.web.live_world import BALANCE, colour_tables
from npa_envs.web.messages import SEEDS
from npa_envs.web.rule_world import MIN_SEED, RuleWorld
from npa_envs.world.species import AGREEMENTS

PAGE = Path(__file__).resolve().parent / "page"
"""The folder of the page's files."""

CONSTANTS = {
    "AGREEMENTS": AGREEMENTS, "BALANCE": BALANCE, "CLUMP_FACTOR": CLUMP_FACTOR,
    "COLOUR_OFFSET": COLOUR_OFFSET, "DAMAGE_SIZES": DAMAGE_SIZES, "MIN_SEED": MIN_SEED,
    "STATE_GAIN": STATE_GAIN,
}  # fmt: skip
"""Python's constants that the page's modules read."""

MAX_WEIGHTS = 2**20
"""Maximum number of weights of a page's rule: 5.6 MB of text, and very slow in a browser."""

POLICY = (
    "default-src 'none'; script-src {scripts} 'wasm-unsafe-eval'; style-src {styles}; "
    "worker-src blob:; img-src data: blob:; media-src blob:; base-uri 'none'; form-action 'none'"
)
"""The page's content security policy: it may load nothing."""

IMPORT = re.compile(r'^import (\{\s*\w+(?:,\s*\w+)*,?\s*\}) from "\./([\w.]+)";$', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
OTHER_FORM = re.compile(r"^(?:(?!//).)*\b(?:import|export)\b.*", re.MULTILINE)
"""The only forms of imports and exports in the page's modules, and lines that have another form."""


def joined_modules(name: str) -> str:
    """Return one script with a module of the page and all that it imports.

    Each module becomes a function that runs once, after those that it imports, so that its names
    stay local. The script's constant `modules` has their exports by file name. Raises ValueError
    for an import or export of another form than `IMPORT` and `EXPORT`.
    """
    functions: dict[str, str] = {}

    def add(name: str) -> None:
        text = (PAGE / name).read_text(encoding="utf-8")
        for _, imported in IMPORT.findall(text):
            if imported not in functions:
                add(imported)
        exports = ", ".join(EXPORT.findall(text))
        body = EXPORT.sub("", IMPORT.sub(r'const \1 = modules["\2"];', text))
        if other := OTHER_FORM.search(body):
            line = body.count("\n", 0, other.start()) + 1
            raise ValueError(
                "a page's modules may only import { names } from another one, and export a named "
                f"function, class or const, got {shown(other[0])} in line {line} of {PAGE / name}"
            )
        functions[name] = f'modules["{name}"] = (() => {{\n{body}return {{ {exports} }};\n}})();'

    add(name)
    return "\n".join(('"use strict";', "const modules = {};", *functions.values(), ""))


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
        previews: Begin with pictures of the rules' worlds after some steps, to choose from.
        seed: Seed of the first world, 0 to 2^53 - 1.
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
    texts = [str(source) for source in sources]
    names = distinct_names(texts, "a page")
    seed = int(SEEDS.checked("seed", seed))
    # Opened first: an error in the path is reported before the slow growth of previews.
    with atomic_path(path) as temporary:
        rules = [page_rule(source, particle_count=particle_count) for source in texts]
        # From 2 on: these are clear among scikit-learn's.
        digits = {name: k for k, name in enumerate((r["name"] for r in rules if r["classes"]), 2)}
        pictures = {
            name: preview(source, particle_count=particle_count, digit=digits.get(name))
            for name, source in zip(names, texts, strict=True)
            if previews
        }
        text = page_text(rules, title=title or names[0], seed=seed, previews=pictures)
        temporary.write_bytes(text.encode())


def distinct_names(sources: Sequence[str], what: str) -> list[str]:
    """Return the names of rules; raise NPAError, which begins with `what`, if two are equal."""
    names = [rule_name(source) for source in sources]
    twice = [name for name in names if names.count(name) > 1]
    if not names or twice:
        got = f"but {twice[0]} is named twice" if twice else "got none"
        raise NPAError(
            f"{what} needs rules of different names, {got}: leave one out, or rename its file"
        )
    return names


def page_rule(source: str, *, particle_count: int | None = None) -> dict[str, Any]:
    """Return a rule and its world as JSON for rule_world.js; arrays are float32 in base64.

    `source` is a rule as for `load_rule`; `particle_count` None: as trained.
    """
    check_browser_rule(load_rule(source), rule_name(source))
    live = RuleWorld(source, device=torch.device("cpu"), particle_count=particle_count, alone=True)
    rule, task = live.main.rule, live.task
    seed: dict[str, Any]
    if task.classifies:
        clouds = cast(PointClassification, task).clouds
        label = clouds.label.tolist()
        # One cloud of each class, the first.
        chosen = torch.tensor([label.index(kind) for kind in sorted(set(label))])
        packed = [_packed(cloud) for cloud in clouds.points(chosen)]
        seed = {"kind": "clouds", "clouds": packed}
    elif task.box is not None:
        seed = {"kind": "box"}
    elif hasattr(task.config, "seed_radius"):
        seed = {"kind": "ball", "radius": task.config.seed_radius}
    else:
        raise NPAError(
            f"a page grows rules from a ball, a box or a point cloud, {shown(source)} begins with "
            f"a {type(task).__name__}: watch it with npa-envs view"
        )
    # rule_world.js adds these itself.
    added = ("type", "rules", "rule", "others", "species", "show", "playing", "seed", "note")
    world = {name: value for name, value in live.describe().items() if name not in added}
    classes = {"palette": PALETTE, "undecided": UNDECIDED}
    return {
        **rule.hyper_parameters(),
        "name": live.main.name,
        "classes": classes if task.classifies else None,
        "weights": {name: _packed(tensor) for name, tensor in rule.state_dict().items()},
        "world": world | {"capabilities": [], "count": live.count, "seed": seed},
    }


def check_browser_rule(rule: NPARule, name: str) -> None:
    """Raise NPAError if the page's JavaScript cannot run a rule."""
    check_rule(rule)
    view = "watch it with npa-envs view"
    cls, species, size = type(rule).__name__, rule.species_count, rule.weight_count
    for fails, condition, actual, hint in (
        (rule.equivariant, "that know directions only", "is equivariant", view),
        (rule.code_dim, "without codes only", f"has code_dim={rule.code_dim}", view),
        (rule.divides, "with a fixed number of particles only", "divides", view),
        (
            not rule.is_plain(), "of two plain layers only",
            f"is a {cls} with a network of its own", "run it in Python",
        ),
        (
            species, "that perceive all species alike", f"has species_count={species}",
            "run it with npa_envs.rollout_species",
        ),
        (size > MAX_WEIGHTS, f"of at most {MAX_WEIGHTS} weights", f"has {size}", view),
    ):  # fmt: skip
        if fails:
            raise NPAError(f"a page runs rules {condition}, {shown(name)} {actual}: {hint}")


def preview(source: str, *, particle_count: int | None = None, digit: int | None = None) -> str:
    """Return a picture of a world, if possible of `digit`, after some steps: a WebP's data URL."""
    live = RuleWorld(source, device=torch.device("cpu"), particle_count=particle_count, alone=True)
    while digit is not None and live.goal != digit and live.seed < 99:
        live.reset(None)
    live.speed = 256 if live.task.aligned else 128
    live.advance()
    with torch.no_grad():
        fields = live.task.picture(*live.particles[:2])[0].flip(0)
    colour = fields[..., :3] / fields[..., 3:].clamp_min(1e-6)
    pixels = torch.cat((colour, fields[..., 3:]), dim=-1).clamp(0.0, 1.0)
    picture = Image.fromarray((pixels * 255.0).round().to(torch.uint8).numpy(), "RGBA")
    shrunk = picture.resize((192, 192), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    shrunk.save(file, "WEBP", quality=80)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"


def page_text(
    rules: Sequence[Mapping[str, Any]],
    *,
    title: str,
    seed: int = 0,
    previews: Mapping[str, str] | None = None,
) -> str:
    """Return the HTML of a page that runs rules, each as `page_rule` returns it.

    `previews` are data URLs of pictures to choose from, by the names of the rules.
    """
    settings = {
        "seed": seed,
        "colours": {
            name: base64.b64encode(table.tobytes()).decode()
            for name, table in colour_tables(len(rules)).items()
        },
        "constants": CONSTANTS,
        "rules": rules,
    }
    # With "<" a rule's text could end the script element.
    data = json.dumps(settings, separators=(",", ":")).replace("<", "\\u003c")
    code = joined_modules("worker_connection.js") + 'modules["worker_connection.js"].begin();\n'
    worker = joined_modules("rule_world.js") + 'modules["rule_world.js"].serve(self);\n'
    style = (PAGE / "page.css").read_text(encoding="utf-8")
    policy = POLICY.format(scripts=_digest(code), styles=_digest(style))
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    for before, after in (
        (
            '<meta charset="utf-8">',
            '<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        ),
        ("<title>npa-envs</title>", f"<title>{html.escape(title)}</title>"),
        ('<p id="note" role="status"></p>', f'<p id="note" role="status"></p>\n{_about()}'),
        ('<link rel="stylesheet" href="page.css">', f"<style>{style}</style>"),
        (
            '<script type="module" src="server_connection.js"></script>',
            f"{_gallery(title, previews, rules) if previews else ''}"
            f'<script type="application/json" id="rules">{data}</script>\n'
            f'<script type="text/plain" id="worker">{worker}</script>\n'
            f'<script type="module">{code}</script>',
        ),
    ):
        if page.count(before) != 1:
            raise ValueError(f"index.html must hold {before!r} once, found {page.count(before)}")
        page = page.replace(before, after)
    return page


def _about() -> str:
    """Return what the page is and where it comes from, with the repository if that is known."""
    links = [("https://arxiv.org/abs/2601.16096", "Neural Particle Automata, arXiv 2601.16096")]
    with contextlib.suppress(PackageNotFoundError):  # The package is on the path, not installed.
        urls = metadata("npa-envs").get_all("Project-URL") or []
        found = dict(line.split(", ", 1) for line in urls)
        links += [(found["Repository"], "npa-envs")] if "Repository" in found else []
    anchors = " · ".join(
        f'<a href="{html.escape(address)}" target="_blank" rel="noopener">{text}</a>'
        for address, text in links
    )
    return f"""<details id="about">
<summary aria-label="What is this?" title="What is this?">?</summary>
<p>Every particle runs the same small neural network and perceives only its neighbours.
Wipe a part and watch.</p>
<p>{anchors}</p>
</details>"""


def _gallery(title: str, previews: Mapping[str, str], rules: Sequence[Mapping[str, Any]]) -> str:
    captions = {r["name"]: "<br><small>classifies digits</small>" for r in rules if r["classes"]}
    links = "\n".join(
        f'<li><a href="#{quote(name, safe="")}"><img src="{picture}" alt="">'
        f"<span>{html.escape(name)}{captions.get(name, '')}</span></a></li>"
        for name, picture in previews.items()
    )
    return f"""<section id="gallery">
<h1>{html.escape(title)}</h1>
<p>Small neural networks, one in every particle.
Choose one and watch it. Wipe a part of what has grown: it heals.</p>
<ul>
{links}
</ul>
</section>
<a id="back" href="#" hidden>All rules</a>
"""


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _packed(tensor: Tensor) -> str:
    data = tensor.detach().cpu().contiguous().numpy().astype("<f4")
    return base64.b64encode(data.tobytes()).decode()
