"""Write the measured tables and numbers of the pages from the records in `benchmarks/results/`.

    python docs/build_tables.py          write all pages
    python docs/build_tables.py --check  fail where a page is not current

A table stands between two marks of a page. The first mark says what the table is made of: a record,
its rows, and a line `heading | cell` for each column.

    <!-- table: rollouts
    record: paper_h200
    rows: r.tables.public
    Workload (B, N, T) | {workload}
    Inference [µs a step] | {infer_us.median:.0f}
    Training [µs a step] | {train_us.median:.0f}
    -->
    (made: the table, and a line with the record, its machine, commit, date and command)
    <!-- /table -->

`record` is the name of a file in `benchmarks/results/` without `.json`, or with `.jsonl`; a path
from the repository's root is one with a slash and its ending; a pattern (`shipped/*.json`) or
several names, separated by spaces, make `r` a dictionary of records by file name (without ending).
`rows` is a Python expression over `r`: a list, or a dictionary, whose keys are then called `key`.
A cell is the text of a Python f-string over the fields of a row (`it` is the row itself). Fields of
records are attributes as well, and `mean`, `error` (standard error), `option(x, ".0f")` (a dash for
None) and Python's own functions are there. `caption: no` leaves out the line about the record.
Digits are those that the cell's format gives.

A number in prose is the cell of such a table, of any page, by its row's first cell and its column:

    <!-- n: rollouts | 2D (8, 4096, 64) | Training [µs a step] -->128<!-- /n -->

No line may begin with that mark, because Markdown would take the line for HTML. A table between
`<!-- table: NAME` and `-->` that only numbers need is hidden by `show: no`.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any, NamedTuple

from page_parts import table, write_or_check

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
TABLE = re.compile(r"<!-- table: (?P<name>[\w-]+)\n(?P<spec>.*?)\n-->\n.*?<!-- /table -->", re.S)
NUMBER = re.compile(r"<!-- n: (?P<cell>[^>]+?) -->[^<]*<!-- /n -->")
KEYS = {"record", "rows", "caption", "show"}
"""First words of lines that are no columns."""

MEASURED = re.compile(r"\d\s?(?:µs|ms|dB|%|times)(?![\w-])|±")
"""What only made text may hold: a digit with a unit of a measurement."""

MADE = (
    re.compile(r"<!-- table: .*?<!-- /table -->", re.S),
    re.compile(r"<!-- made: .*?<!-- end -->", re.S),
    re.compile(r"^ *```.*?^ *```", re.S | re.M),
    NUMBER,
    re.compile(r"`[^`\n]*`"),
)
"""Parts of a page that may hold it: tables, tables of NPA-Bench, code, numbers."""


class Fields(dict[str, Any]):
    """An object of a JSON file whose fields are attributes as well."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"no field {name!r} among {', '.join(self)}") from None


class Made(NamedTuple):
    """A table that was made: its headings, its cells, and the line below it."""

    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    caption: str
    show: bool

    def markdown(self) -> str:
        """Return the table and the line below it."""
        parts = [table(self.headings, self.rows)] if self.show else []
        return "\n\n".join(parts + ([self.caption] if self.caption else []))

    def cell(self, row: str, column: str) -> str:
        """Return a cell by the first cell of its row and the heading of its column."""
        found = [cells for cells in self.rows if cells[0] == row]
        if len(found) != 1 or column not in self.headings:
            raise SystemExit(f"no single cell {row!r} | {column!r} in {self.headings}")
        return found[0][self.headings.index(column)]


def error(values: Sequence[float]) -> float:
    """Return the standard error of the mean of some values."""
    return stdev(values) / len(values) ** 0.5


def option(value: float | None, digits: str) -> str:
    """Return a number in a format, a dash for None."""
    return "–" if value is None else format(value, digits)


HELPERS: dict[str, Callable[..., Any]] = {
    "Fields": Fields,
    "mean": mean,
    "error": error,
    "option": option,
}


def paths_of(names: str) -> list[Path]:
    """Return the files that a line `record` names; raise where there are none."""
    found: list[Path] = []
    for name in names.split():
        folder = ROOT if "/" in name else RESULTS
        path = name if "." in name else f"{name}.json"
        there = sorted(folder.glob(path))
        if not there:
            raise SystemExit(f"record: no file {folder / path}")
        found += there
    return found


def read(path: Path) -> Any:
    """Return what a record holds: JSON, or a list of the lines of a `.jsonl` file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".jsonl":
        text = f"[{','.join(line for line in text.splitlines() if line.strip())}]"
    return json.loads(text, object_hook=Fields)


def caption_of(paths: Sequence[Path], records: Sequence[Any], folder: Path) -> str:
    """Return a line that links to records, and says what all of them say of themselves."""
    links = [f"[{p.name}]({Path(os.path.relpath(p, folder)).as_posix()})" for p in paths]
    if len(links) > 3:
        links = [f"`{paths[0].parent.relative_to(ROOT).as_posix()}/`, {len(links)} files"]
    found: list[dict[str, Any]] = []
    for own in (
        row for record in records for row in (record if isinstance(record, list) else [record])
    ):
        facts = own.get("facts", {})
        found.append({**facts.get("settings", {}), **facts, **own})
    told = []
    for key, shown in (
        ("machine", "{}"),
        ("date", "{}"),
        ("commit", "commit {}"),
        ("command", "`{}`"),
    ):
        values = {
            str(facts.get(key)) for facts in found if not isinstance(facts.get(key), (list, dict))
        }
        told += [shown.format(*values)] if len(values) == 1 and values != {"None"} else []
    return f"Measured: {', '.join(links + told)}."


def short(text: str) -> str:
    """Return a text whose powers of ten have no signs and zeros that say nothing."""
    text = re.sub(r"(?<=\d)e([+-])0?(\d+)", lambda m: f"e{m[1].strip('+')}{m[2]}", text)
    return re.sub(r"\b0(\.0+)?e0\b", "0", text)


def made_of(name: str, text: str, folder: Path) -> Made:
    """Return the table that lines of a mark describe, for a page of a folder."""
    lines = [line for line in text.splitlines() if line.strip()]
    spec = {k: v.strip() for k, _, v in (line.partition(":") for line in lines) if k in KEYS}
    columns = [line.split(" | ", 1) for line in lines if line.partition(":")[0] not in KEYS]
    paths = paths_of(spec["record"])
    records = [read(path) for path in paths]
    r = Fields({path.stem: found for path, found in zip(paths, records, strict=True)})
    r = records[0] if len(records) == 1 else r
    try:
        rows = eval(spec["rows"], {"r": r, **HELPERS})
        pairs = rows.items() if isinstance(rows, Mapping) else ((None, row) for row in rows)
        cells = []
        for key, row in pairs:
            fields = row if isinstance(row, Mapping) else {}
            names = {**HELPERS, "r": r, **fields, "it": row} | ({"key": key} if key else {})
            cells.append(tuple(short(eval(f"f'''{cell}'''", names)) for _, cell in columns))
    except Exception as problem:
        raise SystemExit(f"table {name}: {type(problem).__name__}: {problem}") from problem
    caption = (
        ""
        if "no" in (spec.get("caption"), spec.get("show"))
        else caption_of(paths, records, folder)
    )
    heads = tuple(head.strip() for head, _ in columns)
    return Made(heads, cells, caption, spec.get("show") != "no")


def pages() -> dict[str, str]:
    """Return the texts of all pages that are written by hand, by their paths from the root."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in paths}


def rebuilt(texts: Mapping[str, str]) -> dict[str, str]:
    """Return pages with all tables and numbers made anew; raise for names that come twice."""
    tables: dict[str, Made] = {}
    for page, text in texts.items():
        for found in TABLE.finditer(text):
            if found["name"] in tables:
                raise SystemExit(f"{page}: a table {found['name']} is there already")
            tables[found["name"]] = made_of(found["name"], found["spec"], (ROOT / page).parent)

    def in_place(found: re.Match[str]) -> str:
        head = f"<!-- table: {found['name']}\n{found['spec']}\n-->\n"
        body = tables[found["name"]].markdown()
        return f"{head}{body}\n<!-- /table -->" if body else f"{head}<!-- /table -->"

    def number(found: re.Match[str]) -> str:
        name, _, rest = found["cell"].partition(" | ")
        row, _, column = rest.rpartition(" | ")
        if name not in tables:
            raise SystemExit(f"n: no table {name}")
        return f"<!-- n: {found['cell']} -->{tables[name].cell(row, column)}<!-- /n -->"

    return {page: NUMBER.sub(number, TABLE.sub(in_place, text)) for page, text in texts.items()}


def loose_figures(text: str) -> list[str]:
    """Return the lines of a page that hold a measurement outside of made text and code."""
    marks = re.findall(r"^<!-- n: .*$", text, re.M)
    for made in MADE:
        text = made.sub("", text)
    return marks + [line for line in text.splitlines() if MEASURED.search(line)]


def main(arguments: list[str] | None = None) -> int:
    """Write or check the pages; return the exit status."""
    texts = pages()
    return write_or_check(ROOT, rebuilt(texts), list(texts), __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
