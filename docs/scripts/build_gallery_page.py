"""Write the gallery of shipped rules, `docs/gallery.md`, from their names.

python docs/scripts/build_gallery_page.py          write the page
python docs/scripts/build_gallery_page.py --check  fail where it is not current
"""

from __future__ import annotations

import sys
from pathlib import Path

from page_parts import NOTE, write_or_check

from npa_envs.rule.files import shipped_rules

DOCS = Path(__file__).resolve().parents[1]
OPENING = """\
# Gallery

The rules that come with the library. Each film is made by one rule: particles start as a blank
disk, ball or random cloud, and know nothing of their places. A rule's name stands for its file in
commands and in `npa_envs.load_rule`. `npa-envs view NAME` opens a rule in the browser, and
`npa-envs export-web --gallery --out gallery.html` writes one page that runs all 2D rules.

A card says how the rule was trained, and all that was measured."""
HEADINGS = {
    "morphogenesis2d": "Pictures",
    "morphogenesis3d": "Things in 3D",
    "texture": "Textures",
    "point_classification": "Classifiers",
}
SHOWN = {
    "morphogenesis2d": "{name} grows from a grey disk, is cut in two, and heals.",
    "morphogenesis3d": "{name} grows from a ball while the camera goes once around it.",
    "texture": "{name} arises from particles at random places.",
    "point_classification": "Four clouds agree on what they are; the colour is the class.",
}
COMMANDS = {
    "morphogenesis2d": "npa-envs rollout NAME --steps 700 --damage 512:cut --out runs/NAME",
    "morphogenesis3d": "npa-envs rollout NAME --steps 128 --out runs/NAME",
    "texture": "npa-envs rollout NAME --steps 512 --out runs/NAME",
    "point_classification": "npa-envs evaluate digits",
}
"""How to make films or figures of the rules of a task, by the task's name."""


def entry(task: str, name: str) -> str:
    """Return what the page says of a rule, Markdown."""
    caption = SHOWN[task].format(name=name.capitalize())
    card = f"../npa_envs/rule/shipped/{name}.md"
    return "\n\n".join(
        (
            f"### {name}",
            f"[![{caption}](images/gallery/{name}.webp)]({card})",
            f"- [card]({card})",
        )
    )


def page() -> str:
    """Return the page, Markdown."""
    parts = [
        NOTE.format(script="build_gallery_page.py", source="shipped rules and its own texts"),
        OPENING,
    ]
    for task, heading in HEADINGS.items():
        parts += [f"## {heading}", f"```sh\n{COMMANDS[task]}\n```"]
        parts += [entry(task, name) for name in shipped_rules(task)]
    return "\n\n".join(parts) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Write or check the page; return the exit status."""
    return write_or_check(DOCS, {"gallery.md": page()}, ["gallery.md"], __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
