"""How large the project may be: no measure exceeds its limit, which falls towards its goal.

`python tests/project/test_budgets.py` prints the table. Limits are only ever lowered: to what is
measured, once it has become less.
"""

import ast
import contextlib
import functools
import io
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar
from unittest import mock

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("npa_envs", "envs", "wrappers", "agents")
SOURCES = (".py", ".cuh", ".js", ".css", ".html")
Node = TypeVar("Node", bound=ast.AST)
IMAGES = (".png", ".gif", ".webp", ".jpg", ".svg", ".mp4")


def files(*folders: str, suffixes: tuple[str, ...] = (".py",)) -> list[Path]:
    """Return files below folders."""
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*")]
    return sorted(path for path in paths if path.suffix in suffixes and path.is_file())


def lines(paths: list[Path]) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in paths)


def words(paths: list[Path]) -> int:
    return sum(len(path.read_text("utf-8").split()) for path in paths)


@functools.cache
def trees() -> dict[Path, ast.Module]:
    """Return the parsed modules of the library."""
    return {path: ast.parse(path.read_text("utf-8")) for path in files(*PACKAGES)}


@functools.cache
def walked() -> list[tuple[Path, ast.AST]]:
    return [(path, node) for path, tree in trees().items() for node in ast.walk(tree)]


def nodes(cls: type[Node]) -> Iterator[tuple[Path, Node]]:
    """Yield all nodes of a class, with their files."""
    return ((path, node) for path, node in walked() if isinstance(node, cls))


def functions_of_x_and_s() -> int:
    """Count functions that take positions and states side by side."""
    all_arguments = (function.args for _, function in nodes(ast.FunctionDef))
    return sum(
        {"x", "s"} <= {arg.arg for arg in (*args.posonlyargs, *args.args, *args.kwonlyargs)}
        for args in all_arguments
    )


def files_of_path_length() -> int:
    return sum("path_length" in path.read_text("utf-8") for path in trees())


def task_classes() -> set[str]:
    """Return the names of tasks, of their configurations and of protocols that some tasks have."""
    names: set[str] = set()
    classes = [
        node for path, node in nodes(ast.ClassDef) if path.parent == ROOT / "npa_envs" / "tasks"
    ]
    for _ in range(4):
        names |= {
            node.name
            for node in classes
            if node.name.endswith(("Task", "Config")) or names_of(node.bases) & names
        }
    return names


def names_of(expressions: list[ast.expr]) -> set[str]:
    """Return all names in expressions."""
    nodes = (node for expression in expressions for node in ast.walk(expression))
    return {node.id for node in nodes if isinstance(node, ast.Name)}


def isinstance_on_tasks() -> int:
    """Count places outside of tasks that ask which task one is."""
    classes, count = task_classes(), 0
    for path, call in nodes(ast.Call):
        inside = path.is_relative_to(ROOT / "npa_envs" / "tasks")
        if not inside and getattr(call.func, "id", "") in ("isinstance", "issubclass"):
            count += bool(names_of(call.args[1:]) & classes)
    return count


def classes_named_twice() -> int:
    """Count names that several classes of modules have."""
    bodies = (node for tree in trees().values() for node in tree.body)
    counts = Counter(node.name for node in bodies if isinstance(node, ast.ClassDef))
    return sum(count > 1 for count in counts.values())


def places_that_draw_masks() -> int:
    """Count functions that draw update masks: ones with a probability."""
    home = {"randomness.py", "random_numbers.py"}
    drawing = {path for path in trees() if "bernoulli" in path.read_text("utf-8")}
    return sum(
        any(
            isinstance(n, ast.Attribute) and n.attr in ("bernoulli", "bernoulli_")
            for n in ast.walk(function)
        )
        for path, function in nodes(ast.FunctionDef)
        if path in drawing and path.name not in home
    )


def options_of_train() -> int:
    """Count the options of `npa-envs train morphogenesis2d`, each once."""
    from npa_envs.cli import main

    text = io.StringIO()
    # So narrow that options stand below each other, at the begin of a line.
    with (
        mock.patch.dict(os.environ, COLUMNS="60"),
        contextlib.redirect_stdout(text),
        contextlib.suppress(SystemExit),
    ):
        main(["train", "morphogenesis2d", "--help-all"])
    options = re.findall(r"(?m)^. (--[a-z][a-z0-9-]*)", text.getvalue())
    return len(set(options) - {"--help"})


class Budget(NamedTuple):
    measure: Callable[[], int]
    limit: int
    goal: int


BUDGETS = {
    "functions that take x and s": Budget(functions_of_x_and_s, 150, 150),
    "files with path_length": Budget(files_of_path_length, 10, 10),
    "isinstance on tasks outside of tasks/": Budget(isinstance_on_tasks, 3, 3),
    "names of classes used twice": Budget(classes_named_twice, 0, 0),
    "places that draw masks": Budget(places_that_draw_masks, 1, 1),
    "options of npa-envs train": Budget(options_of_train, 76, 76),
    "source files": Budget(lambda: len(files(*PACKAGES, suffixes=SOURCES)), 283, 277),
    "source lines": Budget(lambda: lines(files(*PACKAGES, suffixes=SOURCES)), 67_590, 64_230),
    "test lines": Budget(lambda: lines(files("tests")), 36_902, 34_500),
    "words of docs": Budget(
        lambda: words([p for p in files("docs", suffixes=(".md",)) if p.parent.name == "docs"]),
        48_000,
        48_000,
    ),
    "words of docs/environments": Budget(
        lambda: words(files("docs/environments", suffixes=(".md",))), 18_000, 18_000
    ),
    "lines of CHANGELOG": Budget(lambda: lines([ROOT / "CHANGELOG.md"]), 60, 60),
    "bytes of images": Budget(
        lambda: sum(p.stat().st_size for p in files("docs", "benchmarks", suffixes=IMAGES)),
        9_000_000,
        9_000_000,
    ),
    "files of results": Budget(
        lambda: sum(p.is_file() for p in (ROOT / "benchmarks" / "results").rglob("*")), 59, 59
    ),
}
"""What is counted, the most that there may be now, and the most that there is to be."""


@pytest.mark.parametrize("name", BUDGETS)
def test_a_budget_is_kept(name):
    measure, limit, goal = BUDGETS[name]
    assert goal <= limit, "a goal that is reached is the limit"
    assert measure() <= limit, f"{name}: make it less, the limit is not raised"


def main():
    print(f"{'':40}{'now':>12}{'limit':>12}{'goal':>12}")
    for name, (measure, limit, goal) in BUDGETS.items():
        print(f"{name:40}{measure():12,}{limit:12,}{goal:12,}")


if __name__ == "__main__":
    main()
