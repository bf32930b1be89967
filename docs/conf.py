"""The site: Sphinx reads the pages as they lie in the repository. `make docs` builds it.

Pages are plain Markdown that reads as well on a code host. Two things are made here: menus, from
the lists of links that pages hold anyway, and the help of each command, from the command itself.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import sys
from itertools import zip_longest
from pathlib import Path
from textwrap import dedent, fill, indent
from typing import Any
from unittest.mock import patch

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective

import npa_envs

sys.path.append(str(Path(__file__).parent / "scripts"))

from build_address import names_of, repository_address

ROOT = Path(__file__).resolve().parents[1]

project = "npa-envs"
author = "the npa-envs contributors"
project_copyright = author
version = release = npa_envs.__version__

# The source folder is the repository's root, so that links lead where they lead on a code host.
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "docs/**.ipynb",
    "benchmarks/results/**.md",
    "npa_envs/rule/shipped/*.md",
    "agents/shipped/*.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
]
exclude_patterns = [".*", "build", "demo", "dist", "runs", "tests"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
nb_execution_mode = "off"
copybutton_exclude = ".linenos, .gp, .go"

# Docstrings write code as Markdown does, between single backticks.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_mock_imports = ["rsl_rl", "tensordict", "torchrl"]
napoleon_google_docstring = True
napoleon_numpy_docstring = False
# Groups of arguments in the docstring of NPARule.
_GROUPS = ("Perception", "Outputs", "Equivariance", "Codes")
napoleon_custom_sections = [(name, "params_style") for name in _GROUPS]

html_theme = "furo"
# Browsers draw MathML themselves: the site needs no script for formulas, and no network.
html_math_renderer = "mathml"
html_title = "npa-envs"
html_static_path = ["static/site.css", "static/site.js"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_extra_path = ["static/index.html"]
html_show_sphinx = False
html_favicon = "static/icon.svg"
html_search_scorer = str(Path(__file__).parent / "static/search.js")
if (address := repository_address()) is not None:
    html_baseurl = names_of(address)["site"]
    html_theme_options = {
        "source_repository": address,
        "source_branch": "main",
        "source_directory": "",
    }
html_copy_source = False

LISTS = ("docs/pages", "docs/environments/README", "docs/api/README", "docs/gallery")
"""Pages whose lists of links are the site's menu; its parts are those of the first one."""

LINK = re.compile(r"^(?:- |\| |### )\[[^\]]+\]\(([\w./-]+)\.(?:md|ipynb)\)", re.MULTILINE)


def add_menus(_: Sphinx, name: str, source: list[str]) -> None:
    """Add what a page lists to the menu: one part of it for each of the page's sections."""
    if name.startswith(("benchmarks/", "agents/")):
        source[0] = f"---\norphan: true\n---\n{source[0]}"
    text = source[0]
    if name == root_doc:
        text = (ROOT / f"{LISTS[0]}.md").read_text(encoding="utf-8")
        source[0] += "\n```{toctree}\n:hidden:\n\npages\n```\n"
    elif name not in LISTS[1:]:
        return
    parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    for heading, text in zip(["", *parts[1::2]], parts[::2], strict=True):
        names = LINK.findall(text)
        if names:
            caption = f":caption: {heading}\n" if heading and name == root_doc else ""
            listed = "\n".join(names)
            source[0] += f"\n```{{toctree}}\n:hidden:\n{caption}\n{listed}\n```\n"


SUMMARY = re.compile(r"^(?:- |\| )\[[^\]]+\]\(([\w./-]+)\.\w+\)(?:: | \| )?([^|\n]*)", re.MULTILINE)


def add_summaries(app: Sphinx, name: str, *_: Any) -> None:
    """Give the page of the search what the lists of pages say of each, in their order."""
    if name != "search":
        return
    said = {}
    for listing in LISTS[:2]:
        for page, text in SUMMARY.findall((ROOT / f"{listing}.md").read_text(encoding="utf-8")):
            plain = re.sub(r"[`]|\[([^\]]+)\]\([^)]+\)", r"\1", text).strip(" .")
            said[os.path.normpath(Path(listing).parent / page)] = plain
    glossary = (ROOT / "docs/glossary.md").read_text(encoding="utf-8").lower()
    rows = re.findall(r"^\| ([^|\\]+) \|", glossary, re.MULTILINE)
    words = [re.sub("[`_]", " ", word).strip() for row in rows for word in row.split(", ")]
    body = f"const SUMMARIES = {json.dumps(said)}, WORDS = {json.dumps(words)};"
    app.add_js_file(None, body=body)


SET_ASIDE: dict[str, list[str]] = {}
"""Docstrings of attributes by their names, while Napoleon is at work."""


def put_back(
    _: Sphinx, _kind: str, name: str, _object: Any, _options: Any, lines: list[str]
) -> None:
    """Return an attribute its docstring."""
    lines += SET_ASIDE.pop(name, [])


def as_restructured_text(
    _: Sphinx, kind: str, name: str, _object: Any, _options: Any, lines: list[str]
) -> None:
    """Turn a docstring from Markdown to what Sphinx reads, and leave out what its page shows."""
    text = "\n".join(lines).split("\n## ")[0]
    blocks = re.split(r"^ *```(\w+)\n(.*?)^ *```$", text, flags=re.MULTILINE | re.DOTALL)
    parts = []
    for plain, language, code in zip_longest(blocks[::3], blocks[1::3], blocks[2::3]):
        # Bars and stars mean nothing in Markdown's code, and sizes or products in formulas.
        spans = re.split(r"(`[^`]+`)", plain)
        spans[::2] = [re.sub(r"(?<=\S)\*|(?<=\S )\*|\|", r"\\\g<0>", span) for span in spans[::2]]
        parts.append("".join(spans))
        if code:
            parts.append(f".. code-block:: {language}\n\n{indent(dedent(code), '   ')}")
    lines[:] = "".join(parts).split("\n")
    if kind in {"attribute", "data", "property"}:
        # Napoleon would take what stands before a colon in the first line for a type.
        SET_ASIDE[name] = lines[:]
        lines.clear()


class CommandHelp(SphinxDirective):
    """What `npa-envs COMMAND --help` prints: `{command-help} COMMAND`."""

    required_arguments = 0
    optional_arguments = 2

    def run(self) -> list[nodes.Node]:
        """Return the text as a block."""
        from npa_envs.cli import main

        printed = io.StringIO()
        terminal = {"COLUMNS": "76", "NO_COLOR": "1"}
        with (
            patch.dict(os.environ, terminal),
            patch.object(sys, "argv", ["npa-envs"]),
            contextlib.redirect_stdout(printed),
            contextlib.suppress(SystemExit),
        ):
            main([*self.arguments, "--help"])
        # Descriptions come as one line each, whatever the terminal's width.
        lines = printed.getvalue().strip().splitlines()
        text = "\n".join(wrapped(line) if len(line) > 76 else line for line in lines)
        if not text:
            raise self.error(f"npa-envs {' '.join(self.arguments)} --help prints nothing")
        return [nodes.literal_block(text, text, language="text")]


def wrapped(line: str) -> str:
    """Return a line of a help cut at 76 letters, the rest below the text of its second column."""
    columns = re.match(r" +\S+ {2,}", line)
    return fill(line, 76, subsequent_indent=" " * (columns.end() if columns else 0))


def write_formula(translator: Any, node: nodes.Element) -> None:
    """Write a formula, in the text or on a line of its own, as MathML."""
    inline = isinstance(node, nodes.math)
    formula = convert(node.astext(), display="inline" if inline else "block")
    if "\\" in formula:
        raise ExtensionError(f"latex2mathml does not know all of {node.astext()!r}")
    # Bars without the room of an operator, and a hat that does not grow.
    formula = formula.replace('<mo stretchy="false">&#x0007C;</mo>', "<mi>|</mi>")
    formula = formula.replace("<mo>&#x0005E;</mo>", '<mo stretchy="false">&#x002C6;</mo>')
    translator.body.append(formula if inline else f'<div class="math">{formula}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Tell Sphinx of what is made here."""
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))
    app.add_directive("command-help", CommandHelp)
    app.connect("source-read", add_menus)
    app.connect("html-page-context", add_summaries)
    # Napoleon's own priority is 500.
    app.connect("autodoc-process-docstring", as_restructured_text, priority=100)
    app.connect("autodoc-process-docstring", put_back, priority=900)
