"""Parts of pages that are made by scripts: sections of docstrings, tables, files kept current."""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import re
import sys
import textwrap
import typing
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

NOTE = "<!-- Made by docs/scripts/{script} from the {source}: edit those. -->"


def sections(env_class: type) -> dict[str, str]:
    """Return the sections of a class's docstring by their headings; the first has none."""
    parts = re.split(r"^## (.+)\n", inspect.cleandoc(env_class.__doc__ or ""), flags=re.MULTILINE)
    return {"": parts[0].strip()} | {
        heading: text.strip() for heading, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def field_meanings(config_type: type) -> dict[str, str]:
    """Return the docstring of each field of a configuration, as its source has it.

    Args:
        config_type: A dataclass; what a subclass says goes before what its bases say, and what they
            say before what the configuration of the task says that is shared with training.
    """
    meanings: dict[str, str] = {}
    of_task = getattr(config_type, "task_config_type", None) or object
    for cls in (*reversed(of_task.__mro__[:-1]), *reversed(config_type.__mro__[:-1])):
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
        for field, text in pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                meanings[field.target.id] = inspect.cleandoc(text.value.value)
    return meanings


def kind_text(annotation: Any) -> str:
    """Return a type in words: Literals are the strings that they hold."""
    if typing.get_origin(annotation) is Literal:
        return "str"
    if typing.get_origin(annotation) is tuple:
        return str(annotation)
    parts = typing.get_args(annotation) or (annotation,)
    return " or ".join("None" if part is type(None) else part.__name__ for part in parts)


def default_text(default: Any) -> str:
    """Return a default as code; strings in double quotes."""
    return f"`{json.dumps(default) if isinstance(default, str) else default}`"


def table(heading: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    lines = [heading, ("---",) * len(heading), *rows]
    cells = ((re.sub(r"\s+", " ", cell).replace("|", "\\|") for cell in line) for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def film_and_strip(caption: str, film: str, strip: str) -> str:
    """Return a film and a strip of moments of `docs/images/` with their caption, Markdown."""
    return "\n\n".join(
        (
            f"![{caption}](../images/{film})",
            f"*{caption}*",
            f"![The same, moment by moment.](../images/{strip})",
        )
    )


def stale_pages(folder: Path, made: Mapping[str, str], there: Iterable[str]) -> list[str]:
    """Return the names of pages in a folder that are missing, not current, or nobody's."""
    found = {name: folder / name for name in there}
    texts = {n: path.read_text(encoding="utf-8") for n, path in found.items() if path.exists()}
    return sorted(name for name in made | texts if made.get(name) != texts.get(name))


def write_or_check(
    folder: Path,
    made: Mapping[str, str],
    there: Iterable[str],
    about: str | None,
    arguments: list[str] | None,
) -> int:
    """Write pages, or with `--check` compare them with those that are there.

    Args:
        folder: Where they belong.
        made: Texts by file name.
        there: Names of the files that the script answers for.
        about: The script's docstring.
        arguments: Words of the command line; None takes them from the process.

    Returns:
        The exit status.
    """
    parser = argparse.ArgumentParser(description=(about or "").split("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail if not current")
    if parser.parse_args(arguments).check:
        stale = stale_pages(folder, made, there)
        if stale:
            cure = (about or "").split("    ")[1].split("  ")[0].strip()
            print(f"not current: {', '.join(stale)}: run {cure}", file=sys.stderr)
        return int(bool(stale))
    folder.mkdir(exist_ok=True)
    for name, text in made.items():
        (folder / name).write_text(text, encoding="utf-8")
    return 0
