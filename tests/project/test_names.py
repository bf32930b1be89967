"""What pages name in code exists: files, modules, classes with their members, functions, words."""

import ast
import builtins
import functools
import itertools
import re
import tomllib
from pathlib import Path

import pytest

from npa_envs.registration import ALL, SPECIES_SIZES

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = ("npa_envs", "envs", "wrappers", "agents", "docs", "benchmarks", "tests")
SUFFIXES = "py|cuh|js|md|toml|json|txt|ipynb"
FENCE = re.compile(r"^ *```.*?^ *```$", re.MULTILINE | re.DOTALL)
NAME = r"[A-Za-z_]\w*(?:\.\w+)*"

OTHERS = {
    *("GymEnv", "NormalizeObservation", "NormalizeReward", "NumpyToTorch", "SubprocVecEnv"),
    *("VecMonitor", "VecVideoRecorder", "black_death_v3", "num_gpus_per_learner", "__ldg"),
    "heart_h100",
}
"""Names of other libraries that no program of ours uses, and of a rule in records."""

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


@functools.cache
def files() -> list[Path]:
    """Return what the repository's own folders hold, without what is built."""
    own = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.*")]
    return [*ROOT.glob("*"), *own]


@functools.cache
def syntax() -> dict[Path, ast.Module]:
    paths = [path for path in files() if path.suffix == ".py" and path != Path(__file__)]
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


@functools.cache
def words_of(tree: ast.AST) -> set[str]:
    """Return all identifiers of a program, and those that its strings are."""
    found: set[str] = set()
    for node in ast.walk(tree):
        values = [getattr(node, key, None) for key in ("id", "attr", "name", "arg", "module")]
        if isinstance(node, ast.Constant):
            values = [node.value]
        for value in values:
            if isinstance(value, str) and re.fullmatch(NAME, value):
                found.update(value.split("."))
    return found


@functools.cache
def strings() -> str:
    """Return all strings of all programs, in lines."""
    nodes = (node for tree in syntax().values() for node in ast.walk(tree))
    values = (node.value for node in nodes if isinstance(node, ast.Constant))
    return "\n".join(value for value in values if isinstance(value, str))


@functools.cache
def known_words() -> set[str]:
    """Return the words of all programs: ours, those of pages, extras, ids of environments."""
    found = {word for tree in syntax().values() for word in words_of(tree)}
    texts = [path.read_text(encoding="utf-8") for path in files() if path.suffix in (".js", ".txt")]
    texts += [block for page in PAGES for block in FENCE.findall(page.read_text(encoding="utf-8"))]
    texts += [row.id for row in (*ALL, *SPECIES_SIZES)] + [path.stem for path in files()]
    texts += tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    return found | {word for text in texts for word in re.findall(r"\w+", text)} | {*dir(builtins)}


@functools.cache
def defined_in(path: Path) -> dict[str, set[str]]:
    """Return what a file defines at any depth: by class, and of the whole file by ""."""
    if path.suffix != ".py":
        return {"": set(re.findall(r"\w+", path.read_text(encoding="utf-8")))}
    found: dict[str, set[str]] = {"": set()}

    def visit(node: ast.AST, owner: str, outside: str) -> None:
        """Visit what lies in a node, whose attributes are of one class and names of another."""
        for child in ast.iter_child_nodes(node):
            inner, attributes = outside, owner
            if isinstance(child, ast.ClassDef):
                found[outside].add(child.name)
                bases = {f"<{word}" for base in child.bases for word in words_of(base)}
                found.setdefault(child.name, set()).update(bases)
                inner = attributes = child.name
            elif isinstance(child, ast.FunctionDef):
                found[outside].add(child.name)
                inner = ""
            elif isinstance(child, ast.Attribute) and isinstance(child.ctx, ast.Store):
                found[owner].add(child.attr)
            elif isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                found[outside].add(child.id)
            elif isinstance(child, ast.arg):
                found[""].add(child.arg)
            visit(child, attributes, inner)

    visit(syntax()[path], "", "")
    found[""] = set().union(*found.values())
    return found


def members(name: str) -> set[str]:
    """Return what classes of a name and their bases define; empty where we have no such class."""
    found: set[str] = set()
    for path in syntax():
        found |= defined_in(path).get(name, set())
    bases = {member[1:] for member in found if member.startswith("<")} - {name}
    return found.union(*map(members, bases))


def path_of(name: str) -> Path | None:
    """Return where a file or folder lies whose name may leave out folders above it."""
    for folder in ("", "npa_envs/", "docs/"):
        if (ROOT / folder / name).exists():
            return ROOT / folder / name
    if "/" in name:
        return None
    return next((path for path in files() if path.name == name), None)


def prose(page: Path) -> str:
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def leads_somewhere(parts: list[str]) -> bool:
    """Return whether a module below npa_envs names what follows it."""
    for k in range(len(parts), -1, -1):
        place = "/".join(parts[:k])
        module = path_of(f"{place}.py") or path_of(f"{place or 'npa_envs'}/__init__.py")
        if module is not None:
            return k == len(parts) or parts[k] in words_of(syntax()[module])
    return False


def missing(name: str) -> bool:
    """Return whether a dotted name has a word of no program, or a member that its class has not."""
    parts = name.split(".")
    if parts[0] == "npa_envs":
        return not leads_somewhere(parts[1:])
    owned = [(members(owner), member) for owner, member in itertools.pairwise(parts)]
    if any(inside and member not in inside for inside, member in owned):
        return True
    return not known_words().issuperset(part for part in parts if not part.isupper())


@every_page
def test_paths_in_code_exist(page):
    """A file without a folder may be what a program writes, or a page's own program."""
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w./]*|[\w/.]+\.(?:{SUFFIXES}))`", prose(page))
    named = [name for name in named if not re.search("[A-Z]{4}", name) and path_of(name) is None]
    named = [name for name in named if name != f"{page.stem}.py"]
    assert [name for name in named if Path(name).name not in strings()] == []


@every_page
def test_names_in_code_are_of_programs(page):
    spans = re.findall(rf"`({NAME})(?:\([^`]*\))?`", prose(page))
    ours = [span for span in spans if span.rpartition(".")[2] not in SUFFIXES.split("|")]
    assert [span for span in ours if span not in OTHERS and missing(span)] == []


@every_page
def test_a_file_defines_what_a_page_says_that_it_does(page):
    """Of "`name` in `file`" and of "`file`: `name`, `name`"; of drawings "file: name" as well."""
    text = page.read_text(encoding="utf-8")
    pairs = re.findall(rf"((?:npa_envs|envs)/[\w/]+\.py): ({NAME})", text)
    pairs += re.findall(r"((?:world|ops|rule|envs/core)/\w+\.py) +([A-Za-z_][\w.]*\w) ", text)
    pairs += [pair[::-1] for pair in re.findall(rf"`({NAME})`\s(?:in|of)\s`([\w/]+\.py)`", text)]
    told = re.findall(
        r"`([\w/]+\.(?:py|js))`(?:: ([^;]+?)(?=;|\n\n|\n-|`[\w/]+\.)| \(([^)]+)\))", text
    )
    pairs += [(file, name) for file, *rest in told for name in re.findall(f"`({NAME})`", str(rest))]
    if page.stem == "architecture":
        assert len(pairs) > 100
    for file, name in (pair for pair in pairs if "NAME" not in pair[0]):
        path = path_of(file)
        assert path is not None, file
        for part in name.split("."):
            assert part in defined_in(path)[""] or part in members(name.split(".")[0]), (file, name)


def test_names_of_the_past_are_found():
    wrong = ["GoalTask", "NPAEnv.steps", "npa_envs.nowhere", "EnvTask.judgement"]
    assert all(map(missing, wrong))
    assert not any(map(missing, ["EnvTask", "NPAEnv.step", "npa_envs.rollout", "EnvTask.losses"]))
