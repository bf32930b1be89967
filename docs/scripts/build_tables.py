"""Write the measured tables of the pages from the records in `benchmarks/results/`.

    python docs/scripts/build_tables.py          write all pages
    python docs/scripts/build_tables.py --check  fail where a page is not current

A page has the table, and a line with its record, machine, commit, date and command, between two
marks:

    <!-- table: rollouts -->
    <!-- /table -->

`docs/tables.txt` says how it is made: its name, a record, its rows, and a line `heading | cell` for
each column.

    [rollouts]
    record: paper_h200
    rows: r.tables.public
    Workload (B, N, T) | {workload}
    Inference [µs a step] | {infer_us.median:.0f}
    Training [µs a step] | {train_us.median:.0f}

`record` is the name of a file in `benchmarks/results/` without `.json`, or with `.jsonl`; a path
from the repository's root is one with a slash and its ending; a pattern (`shipped/*.json`) or
several names, separated by spaces, make `r` a dictionary of records by file name (without ending).
`name#entry` is an entry of one record, with its own metadata.
`rows` is a Python expression over `r`: a list, or a dictionary, whose keys are then called `key`.
A cell is the text of a Python f-string over the fields of a row (`it` is the row itself). Fields of
records are attributes as well, and `mean`, `error` (standard error), `option(x, ".0f")` (a dash for
None) and Python's own functions are there. `caption: no` leaves out the line about the record.
Digits are those that the cell's format gives.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from page_parts import table, write_or_check

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
SPECS = ROOT / "docs" / "tables.txt"
TABLE = re.compile(r"(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- /table -->)", re.S)
KEYS = {"record", "rows", "caption"}
"""First words of lines that are no columns."""

MEASURED = re.compile(r"\d\s?(?:µs|ms|dB|%|times)(?![\w-])|±")
"""What only made text may hold: a digit with a unit of a measurement."""

MADE = (
    re.compile(r"<!-- table: .*?<!-- /table -->", re.S),
    re.compile(r"<!-- made: .*?<!-- end -->", re.S),
    re.compile(r"^ *```.*?^ *```", re.S | re.M),
    re.compile(r"`[^`\n]*`"),
)
"""Parts of a page that may hold it: tables, tables of NPA-Bench, code."""


class Fields(dict[str, Any]):
    """An object of a JSON file whose fields are attributes as well."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"no field {name!r} among {', '.join(self)}") from None


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
    parts = []
    for key, form in (
        ("machine", "{}"),
        ("date", "{}"),
        ("commit", "commit {}"),
        ("command", "`{}`"),
    ):
        values = {
            str(facts.get(key)) for facts in found if not isinstance(facts.get(key), (list, dict))
        }
        parts += [form.format(*values)] if len(values) == 1 and values != {"None"} else []
    return f"Measured: {', '.join(links + parts)}."


def short(text: str) -> str:
    """Return a text whose powers of ten have no signs and zeros that say nothing."""
    text = re.sub(r"(?<=\d)e([+-])0?(\d+)", lambda m: f"e{m[1].strip('+')}{m[2]}", text)
    return re.sub(r"\b0(\.0+)?e0\b", "0", text)


def made_of(name: str, text: str, folder: Path) -> str:
    """Return the table that a text of `SPECS` describes, for a page of a folder, Markdown."""
    lines = [line for line in text.splitlines() if line.strip()]
    spec = {k: v.strip() for k, _, v in (line.partition(":") for line in lines) if k in KEYS}
    columns = [line.split(" | ", 1) for line in lines if line.partition(":")[0] not in KEYS]
    files, _, entry = spec["record"].partition("#")
    paths = paths_of(files)
    records = [read(path)[entry] if entry else read(path) for path in paths]
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
    made = table(tuple(head.strip() for head, _ in columns), cells)
    if spec.get("caption") == "no":
        return made
    return f"{made}\n\n{caption_of(paths, records, folder)}"


def pages() -> dict[str, str]:
    """Return the texts of all pages that are written by hand, by their paths from the root."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in paths}


def specs(text: str) -> dict[str, str]:
    """Return the descriptions of tables by their names; raise for names that come twice."""
    parts = re.split(r"^\[([\w-]+)\]\n", text, flags=re.M)[1:]
    names = parts[::2]
    if len(set(names)) < len(names):
        raise SystemExit(f"a table is described twice among {', '.join(names)}")
    return dict(zip(names, parts[1::2], strict=True))


def rebuilt(texts: Mapping[str, str], described: Mapping[str, str]) -> dict[str, str]:
    """Return pages with all tables made anew; raise for tables without a page or a description."""
    shown = [found["name"] for text in texts.values() for found in TABLE.finditer(text)]
    if sorted(shown) != sorted(described):
        odd = set(shown) ^ set(described) or {name for name in shown if shown.count(name) > 1}
        raise SystemExit(f"each table is described once and shown once, not {', '.join(odd)}")

    def made(page: str, found: re.Match[str]) -> str:
        name = found["name"]
        return f"{found[1]}{made_of(name, described[name], (ROOT / page).parent)}\n{found[3]}"

    return {page: TABLE.sub(partial(made, page), text) for page, text in texts.items()}


def loose_figures(text: str) -> list[str]:
    """Return the lines of a page that hold a measurement outside of made text and code."""
    for made in MADE:
        text = made.sub("", text)
    return [line for line in text.splitlines() if MEASURED.search(line)]


def main(arguments: list[str] | None = None) -> int:
    """Write or check the pages; return the exit status."""
    texts = pages()
    made = rebuilt(texts, specs(SPECS.read_text(encoding="utf-8")))
    # The gallery is made as a whole.
    written = {name: text for name, text in made.items() if name != "docs/gallery.md"}
    loose = [f"{name}: {line}" for name, text in written.items() for line in loose_figures(text)]
    if loose:
        raise SystemExit("\n".join(["a page has measurements outside of tables:", *loose]))
    return write_or_check(ROOT, made, list(texts), __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
