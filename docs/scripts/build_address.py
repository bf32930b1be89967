"""Write the lines that need the repository's address, or take them out where it is not set.

    python docs/scripts/build_address.py [--check]

The address is `Repository` under `[project.urls]` of pyproject.toml, the only place to write it:
badges, the site, "Open in Colab", citation and CONTRIBUTING follow from it.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from page_parts import write_or_check

ROOT = Path(__file__).resolve().parents[2]

ADDRESS = re.compile(r"https://github\.com/([\w-]+)/([\w.-]+?)(?:\.git)?/?")
TAG, HIDDEN = "address", "remove-cell"
"""Tags of notebook cells: made here, and left out of the site."""


class Place(NamedTuple):
    """Lines that need the address, and where they stand."""

    file: str
    after: str
    """What stands before it, once in the file."""
    text: str
    """With names in angle brackets, which `names_of` gives."""


PLACES = (
    Place(
        "README.md",
        "# npa-envs\n",
        "\n[![tests](<address>/actions/workflows/ci.yml/badge.svg)]"
        "(<address>/actions/workflows/ci.yml)\n"
        "[![documentation](https://img.shields.io/badge/documentation-site-blue)](<site>)\n"
        "[![license](https://img.shields.io/badge/license-Apache--2.0-blue)]"
        "(<address>/blob/main/LICENSE)\n",
    ),
    Place(
        "README.md",
        "`make docs` builds a site of all pages: `build/docs/index.html`\n",
        "\n**[Play in your browser](<site>gallery.html)**: all 2D rules, nothing to install.\n",
    ),
    Place("README.md", "## Two commands\n\n```sh\n", "git clone <address> && cd <name>\n"),
    Place(
        "README.md",
        "## You want to watch and play\n\n```sh\n",
        "git clone <address> && cd <name>  # if you have no clone yet\n",
    ),
    Place(
        "docs/index.md",
        "[All pages](pages.md)\n",
        "\n**[Play in your browser](<site>gallery.html)**: all 2D rules, nothing to install. "
        "[Source](<address>).\n",
    ),
    Place(
        "docs/index.md",
        "after choosing [torch's CPU build](install.md)):\n\n```sh\n",
        "git clone <address> && cd <name>\n",
    ),
    Place(
        "docs/install.md",
        "## Extras\n",
        "\nWithout a clone: `pip install 'npa-envs[view] @ git+<address>'`.\n",
    ),
    Place(
        "docs/faq.md",
        "For a training run add `config.json` from its folder.\n",
        "Open [an issue](<address>/issues).\n",
    ),
    Place("docs/cite.md", "{{The npa-envs contributors}},\n", "  url     = {<address>},\n"),
    Place("CITATION.cff", "license: Apache-2.0\n", 'repository-code: "<address>"\n'),
    Place(
        "CONTRIBUTING.md",
        "# Contributing\n",
        "\n[Issues](<address>/issues) and [pull requests](<address>/pulls) are welcome.\n",
    ),
    Place(
        "CONTRIBUTING.md",
        "announce them in Farama's Discord, then add them to each list by a pull request.\n",
        """
```markdown
- [npa-envs: Neural Particle Automata](<address>)

  ![Gymnasium version dependency](https://img.shields.io/badge/Gymnasium-v<gymnasium>-blue)
  ![GitHub stars](https://img.shields.io/github/stars/<path>)

  Thousands of particles that see only their neighbours learn to grow into pictures, textures and 3D shapes, to heal, and to classify digits. The physics (smoothed particle hydrodynamics) is differentiable and runs batched on CPU and CUDA. Trained rules, which are policies, come along. Implements [Neural Particle Automata](https://arxiv.org/abs/2601.16096).
```

```markdown
### [npa-envs: Neural Particle Automata](<address>)

[![PettingZoo version dependency](https://img.shields.io/badge/PettingZoo-v<pettingzoo>-blue)](<address>)
[![GitHub stars](https://img.shields.io/github/stars/<path>)](<address>)

Species of particles that share a world and perceive each other: they mix, segregate, invade each other, live in symbiosis, or grow a picture each. An agent is a species, or a single particle (up to 512). Worlds are batched on CPU and CUDA.
```
""",  # noqa: E501
    ),
)

COLAB = (
    "[![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)]"
    "(https://colab.research.google.com/github/<path>/blob/main/docs/notebooks/<notebook>.ipynb)"
)
INSTALL = """import sys

if "google.colab" in sys.modules:
    %pip install --quiet "npa-envs<extras> @ git+<address>\""""


def repository_address(root: Path = ROOT) -> str | None:
    """Return the address in pyproject.toml, without a slash at its end; None: it is not set."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address: str | None = project.get("urls", {}).get("Repository")
    if address is None:
        return None
    found = ADDRESS.fullmatch(address)
    if found is None:
        raise SystemExit(
            "Repository under [project.urls] of pyproject.toml must be the address of a repository "
            f"on GitHub, got {address!r}: for example 'https://github.com/you/npa-envs'"
        )
    return "https://github.com/{}/{}".format(*found.groups())


def names_of(address: str) -> dict[str, str]:
    """Return what the names in angle brackets stand for."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if "==" in line)
    owner, name = address.split("/")[-2:]
    names = {library: pins[library] for library in ("gymnasium", "pettingzoo")}
    names |= {"address": address, "path": f"{owner}/{name}", "name": name}
    return names | {"site": f"https://{owner.lower()}.github.io/{name}/"}


def filled(text: str, names: dict[str, str]) -> str:
    """Return a text with names in angle brackets replaced."""
    return re.sub(r"<(\w+)>", lambda found: names[found[1]], text)


def placed(content: str, place: Place, names: dict[str, str] | None) -> str:
    """Return a file's content with a place's text, whatever address it has now, or without it."""
    anything = re.sub(r"<\w+>", lambda _: r"""[^\s"'()}]+""", re.escape(place.text))
    content = re.sub(anything, "", content)
    if names is None:
        return content
    if content.count(place.after) != 1:
        raise SystemExit(f"{place.file} must have {place.after!r} once: see PLACES in {__file__}")
    return content.replace(place.after, place.after + filled(place.text, names))


def with_colab(content: str, name: str, names: dict[str, str] | None) -> str:
    """Return a notebook with its badge and its installation on Colab, or without them."""
    notebook: Any = json.loads(content)
    cells = notebook["cells"]
    cells[:] = [cell for cell in cells if TAG not in cell["metadata"].get("tags", ())]
    if names is not None:
        # The notebook says itself which extras it needs.
        extras = re.findall(r"pip install 'npa-envs(\[[\w,]+\])'", "".join(cells[0]["source"]))
        names = names | {"notebook": name, "extras": "".join(extras)}
        badge, install = (filled(text, names).splitlines(True) for text in (COLAB, INSTALL))
        code = {"cell_type": "code", "execution_count": None, "outputs": []}
        cells[1:1] = [
            {"cell_type": "markdown", "id": "badge", "metadata": {"tags": [TAG]}, "source": badge},
            # Only Colab needs it: the site leaves it out.
            code | {"id": "install", "metadata": {"tags": [TAG, HIDDEN]}, "source": install},
        ]
    return json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def texts(root: Path = ROOT) -> dict[str, str]:
    """Return the contents of all files that depend on the address, by their paths."""
    address = repository_address(root)
    names = None if address is None else names_of(address)
    made: dict[str, str] = {}
    for place in PLACES:
        content = made.get(place.file) or (root / place.file).read_text(encoding="utf-8")
        made[place.file] = placed(content, place, names)
    for path in sorted((root / "docs/notebooks").glob("*.ipynb")):
        content = path.read_text(encoding="utf-8")
        made[path.relative_to(root).as_posix()] = with_colab(content, path.stem, names)
    return made


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    """Write or check the files below a folder; return the exit status."""
    made = texts(root)
    return write_or_check(root, made, made, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
