"""Files that pages name exist, and define what a page says that they define."""

import functools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = ("npa_envs", "envs", "wrappers", "agents", "docs", "benchmarks", "tests")
SUFFIXES = "py|cuh|js|md|toml|json|txt|ipynb"
FENCE = re.compile(r"^ *```.*?^ *```$", re.MULTILINE | re.DOTALL)
NAME = r"[A-Za-z_]\w*(?:\.\w+)*"


@functools.cache
def files() -> list[Path]:
    """Return the files of the repository's own folders, without what is built."""
    inner = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.*")]
    return [*ROOT.glob("*"), *inner]


@functools.cache
def words_of(path: Path) -> set[str]:
    return set(re.findall(r"\w+", path.read_text(encoding="utf-8")))


@functools.cache
def known_words() -> set[str]:
    """Return the words of all programs, those in pages included, and the names of all files."""
    programs = (path for path in files() if path.suffix in (".py", ".cuh", ".js", ".toml", ".txt"))
    words = set().union(*(words_of(path) for path in programs if path != Path(__file__)))
    blocks = (block for page in PAGES for block in FENCE.findall(page.read_text(encoding="utf-8")))
    words.update(word for block in blocks for word in re.findall(r"\w+", block))
    return words | {path.stem for path in files()}


def path_of(name: str) -> Path | None:
    """Return the path of a file or folder whose name may leave out folders above it."""
    for folder in ("", "npa_envs/", "docs/"):
        if (ROOT / folder / name).exists():
            return ROOT / folder / name
    if "/" in name:
        return None
    return next((path for path in files() if path.name == name), None)


def prose(page: Path) -> str:
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def test_files_in_code_exist():
    """A file without a folder may be what a program writes, or a page's own program."""
    pattern = rf"`((?:{'|'.join(FOLDERS)})/[\w./]*|[\w/.]+\.(?:{SUFFIXES}))`"
    named = {(page.stem, name) for page in PAGES for name in re.findall(pattern, prose(page))}
    named = {(s, n) for s, n in named if not re.search("[A-Z]{4}", n) and path_of(n) is None}
    assert [(s, n) for s, n in named if Path(n).stem not in {s, *known_words()}] == []


def test_files_contain_what_pages_say_that_they_define():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        # In drawings: file name
        pairs = re.findall(rf"((?:npa_envs|envs|world|ops|rule)/[\w/]+\.py):? +({NAME}) ", text)
        # `name` in `file`
        pairs += [
            (file, n) for n, file in re.findall(rf"`({NAME})`\s(?:in|of)\s`([\w/]+\.py)`", text)
        ]
        # `file`: `name`, `name`; and `file` (`name`)
        lists = re.findall(
            r"`([\w/]+\.(?:py|js))`(?:: ([^;]+?)(?=;|\n\n|\n-|`[\w/]+\.)| \(([^)]+)\))", text
        )
        pairs += [(file, n) for file, *rest in lists for n in re.findall(f"`({NAME})`", str(rest))]
        assert len(pairs) > 100 or page.stem != "architecture", "most are written in another form"
        for file, name in (pair for pair in pairs if "NAME" not in pair[0]):
            path = path_of(file)
            assert path is not None, file
            # A member may be of a base class in another file.
            owner, *members = name.split(".")
            assert owner in words_of(path), (file, name)
            assert known_words().issuperset(members), (file, name)
