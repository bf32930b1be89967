"""The measured numbers of the pages are those of the records that they are made from."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SPEC = """<!-- table: times
record: tests/project/*.json
rows: r.times.rows
Case | {name}
Time [ms] | {us * 1e-3:.1f}
Error | {relative:.0e}
caption: no
-->
<!-- /table -->
"""


@pytest.fixture(scope="module")
def builder():
    """The script that makes tables."""
    sys.path.insert(0, str(DOCS))
    try:
        import build_tables
    finally:
        sys.path.remove(str(DOCS))
    return build_tables


def test_tables_and_numbers_are_current(builder, capsys):
    status = builder.main(["--check"])
    assert status == 0, capsys.readouterr().err


def test_a_table_and_a_number_are_made_of_a_record(builder, tmp_path, monkeypatch):
    folder = tmp_path / "tests" / "project"
    folder.mkdir(parents=True)
    monkeypatch.setattr(builder, "ROOT", tmp_path)
    row = '{"name": "one | world", "us": 1260, "relative": 3.6e-07}'
    (folder / "times.json").write_text(f'{{"rows": [{row}]}}')
    (folder / "other.json").write_text("{}")
    number = "It takes <!-- n: times | one | world | Time [ms] -->0<!-- /n --> ms."
    made = builder.rebuilt({"docs/page.md": SPEC + number})
    assert "\n| one \\| world | 1.3 | 4e-7 |\n<!-- /table -->\nIt takes" in made["docs/page.md"]
    assert "| Time [ms] -->1.3<!-- /n --> ms." in made["docs/page.md"]
    assert builder.rebuilt(made) == made
    with pytest.raises(SystemExit, match="table times: NameError: name 'us_' is not defined"):
        builder.rebuilt({"docs/page.md": SPEC.replace("{us *", "{us_ *")})
    with pytest.raises(SystemExit, match="no table other"):
        builder.rebuilt({"docs/page.md": "<!-- n: other | a | b -->1<!-- /n -->"})


def test_a_measurement_outside_of_made_text_is_found(builder):
    for loose in ("It takes 48 µs.", "32.1 dB", "as 1.0 ± 0.2", "is 3 times as fast", "9 % of it"):
        assert builder.loose_figures(f"# Page\n\n{loose}\n") == [loose]
    fine = "`dt=0.1 ms`, [8, 4096], three times, `5 %`\n\n```sh\nwait 5 ms\n```\n"
    assert builder.loose_figures(SPEC.replace("caption: no\n", "A | 5 ms\n") + fine) == []
    assert builder.loose_figures("a\n<!-- n: a | b | c -->1<!-- /n --> b") != []


@pytest.mark.parametrize(
    "page", [p for p in sorted(DOCS.glob("*.md")) if p.stem != "gallery"], ids=lambda p: p.stem
)
def test_a_page_holds_no_measurement_that_is_not_made(builder, page):
    # The gallery is made as a whole.
    assert builder.loose_figures(page.read_text(encoding="utf-8")) == []
