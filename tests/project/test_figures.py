"""The measured tables of the pages are those of the records that they are made from."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SPEC = """[times]
record: tests/project/*.json
rows: r.times.rows
Case | {name}
Time [ms] | {us * 1e-3:.1f}
Error | {relative:.0e}
caption: no
"""
PAGE = "<!-- table: times -->\n<!-- /table -->\n"


@pytest.fixture(scope="module")
def builder():
    """The script that makes tables."""
    sys.path.insert(0, str(DOCS))
    try:
        import build_tables
    finally:
        sys.path.remove(str(DOCS))
    return build_tables


def test_tables_are_current(builder, capsys):
    status = builder.main(["--check"])
    assert status == 0, capsys.readouterr().err


def test_a_table_is_made_of_a_record(builder, tmp_path, monkeypatch):
    folder = tmp_path / "tests" / "project"
    folder.mkdir(parents=True)
    monkeypatch.setattr(builder, "ROOT", tmp_path)
    row = '{"name": "one | world", "us": 1260, "relative": 3.6e-07}'
    (folder / "times.json").write_text(f'{{"rows": [{row}]}}', encoding="utf-8")
    (folder / "other.json").write_text("{}", encoding="utf-8")
    pages = {"docs/page.md": f"{PAGE}It takes long."}
    made = builder.rebuilt(pages, builder.specs(SPEC))
    assert "\n| one \\| world | 1.3 | 4e-7 |\n<!-- /table -->\nIt takes" in made["docs/page.md"]
    assert builder.rebuilt(made, builder.specs(SPEC)) == made
    with pytest.raises(SystemExit, match="table times: NameError: name 'us_' is not defined"):
        builder.rebuilt(pages, builder.specs(SPEC.replace("{us *", "{us_ *")))
    for texts in ({"docs/page.md": "nothing"}, {"a.md": PAGE, "b.md": PAGE}):
        with pytest.raises(SystemExit, match="described once and shown once, not times"):
            builder.rebuilt(texts, builder.specs(SPEC))
    with pytest.raises(SystemExit, match="a table is described twice"):
        builder.specs(SPEC + SPEC)


def test_a_measurement_outside_of_made_text_is_found(builder):
    for loose in ("It takes 48 µs.", "32.1 dB", "as 1.0 ± 0.2", "is 3 times as fast", "9 % of it"):
        assert builder.loose_figures(f"# Page\n\n{loose}\n") == [loose]
    fine = "`dt=0.1 ms`, [8, 4096], three times, `5 %`\n\n```sh\nwait 5 ms\n```\n"
    assert builder.loose_figures(PAGE.replace("\n", "\n5 ms\n", 1) + fine) == []


@pytest.mark.parametrize(
    "page", [p for p in sorted(DOCS.glob("*.md")) if p.stem != "gallery"], ids=lambda p: p.stem
)
def test_a_page_holds_no_measurement_that_is_not_made(builder, page):
    # The gallery is made as a whole.
    assert builder.loose_figures(page.read_text(encoding="utf-8")) == []
