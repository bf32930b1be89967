"""`npa-envs export-web RULE...`: one HTML file that runs rules in any browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Write one HTML file that runs rules in a browser, also on a phone, with brushes and sliders.

    It needs no server and no network. If the name ends in .json, it writes a collection of rules
    for the web demo of the paper's authors instead, without title or gallery.

    Examples:
      npa-envs export-web gecko heart --out page.html
      npa-envs export-web --gallery --out gallery.html
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULE")] = ()
    """Shipped rules (`npa-envs list`), folders of runs, or files of rules."""
    out: Path = Path("page.html")
    """The file to write; its folder is created where missing."""
    gallery: bool = False
    """Begin with pictures to choose from; without RULE: of all shipped 2D rules."""
    title: str | None = None
    """Title of the page; default: the first rule's name."""
    particle_count: int | None = None
    """Particles N of each world; default: as trained, and 4096 in a collection."""


def main(arguments: Sequence[str]) -> int:
    """Write the HTML page, or the JSON collection of rules; return 0."""
    options = common.parse_options(ExportOptions, "export-web", arguments)
    common.check_numbers(options, particle_count=1)
    from npa_envs.rule.files import load_rule, shipped_rules
    from npa_envs.rule.paper_formats import save_demo_json
    from npa_envs.web.export import distinct_names, export_web

    collection = options.out.suffix == ".json"
    for name in ("gallery", "title"):
        if collection and getattr(options, name):
            raise NPAError(
                f"{name} is for pages, got --{name} with a collection, {str(options.out)!r}: "
                "leave it out, or write an .html file"
            )
    sources = list(options.rules)
    title = options.title
    if options.gallery and not sources:
        sources = [name for name in shipped_rules() if load_rule(name).space_dim == 2]
        title = title or "Neural Particle Automata"
    if not sources:
        raise NPAError("name at least one RULE, or --gallery for all shipped 2D rules")
    common.writable_folder(options.out.parent)
    count = options.particle_count
    if collection:
        names = distinct_names(sources, "a collection")
        rules = dict(zip(names, map(load_rule, sources), strict=True))
        counts = None if count is None else dict.fromkeys(names, count)
        save_demo_json(rules, options.out, particle_counts=counts)
    else:
        previews = options.gallery
        export_web(sources, options.out, title=title, particle_count=count, previews=previews)
    size = options.out.stat().st_size
    print(f"wrote {options.out} ({size / 1000:.0f} kB)")
    return 0
