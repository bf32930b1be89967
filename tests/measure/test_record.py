"""Records, tables and plots: what every measuring command shares."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.measure import benchmark_records as records
from npa_envs.measure.plots import write_plots

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
FACTS = {"commit": "0", "seeds": (1, 2)}


def read(path: Path, facts=FACTS, **options):
    return records.read_record(path, facts, lambda content: content["rows"], command="x", **options)


def test_a_record_comes_back_with_null_for_what_is_not_finite(tmp_path):
    path = tmp_path / "record.json"
    assert read(path) is None
    records.write_record(path, {"facts": FACTS, "rows": [1.5, math.inf, math.nan]})
    assert read(path) == [1.5, None, None]
    assert math.isnan(records.number(None))
    assert records.number(3) == 3.0


@pytest.mark.parametrize(
    ("content", "facts", "message"),
    [
        ('{"facts": {"commit": "0"}, "rows": []}', {"commit": "1"}, "commit was '0', now '1'"),
        ('{"facts": {}, "rows": []}', {"commit": "1"}, "commit was None, now '1'"),
        ('{"facts": {}}', {}, "must be a record of npa-envs x, but cannot be read"),
        ('{"facts": 3, "rows": []}', {}, "must be a record"),
        ("[]", {}, "must be a record"),
        ("{", {}, "must be a record"),
    ],
)
def test_other_settings_and_other_files_are_refused(content, facts, message, tmp_path):
    path = tmp_path / "record.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(NPAError, match=message) as error:
        read(path, facts)
    assert str(error.value).endswith("remove it, or choose another folder with --out")


def test_facts_name_the_machine_the_commit_and_the_versions():
    facts = records.measured_facts(torch.device("cpu"), None, seed=3)
    assert list(facts) == ["device", "machine", "seed", "commit", "versions"]
    assert facts["machine"].startswith("CPU (")
    assert facts["commit"] == records.current_commit()
    assert torch.__version__.startswith(facts["versions"]["torch"])
    assert records.measured_facts(torch.device("cpu"), "abc")["commit"] == "abc"


def test_a_commands_folders_are_not_told():
    words = ["heart", "--out", "a/b", "--output=c", "--seed", "a/b"]
    text = "npa-envs stress heart --out OUT --output=OUTPUT --seed a/b"
    assert records.command_text("stress", words, "--out", "--output") == text


def test_stored_records_can_be_read():
    """Those of robustness are read by the test that their tables are the stored ones."""
    from npa_envs.measure.accuracy.check_runner import StressRecord
    from npa_envs.measure.rule_interaction import InteractionRecord

    stress, met = (RESULTS / name for name in ("stress_57ffb7c_h100.json", "interactions_cpu.json"))
    facts = json.loads(stress.read_text("utf-8"))["facts"]
    assert StressRecord(facts, stress).read().counts()["fail"] == 1
    settings = json.loads(met.read_text("utf-8"))["settings"]
    assert len(InteractionRecord(settings, met).read().rows) == 16


@dataclass(frozen=True)
class Row:
    step: int
    mean_loss: float | None


def test_tables_as_text_markdown_and_comma_separated_values():
    rows = [Row(64, 31.41592), Row(128, None)]
    assert records.table_text(rows, missing=records.UNMEASURED).splitlines() == [
        "step  mean loss",
        "  64      31.42",
        " 128          -",
    ]
    assert records.table_text(rows[1:], missing=records.UNMEASURED).splitlines() == ["step", " 128"]
    assert records.table_text(rows[1:]).splitlines() == [
        "step  mean loss",
        " 128      never",
    ]
    assert records.table_text([]) == ""
    assert records.markdown_table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    assert records.csv_text(["a", "b"], [["x", 125.0], [1, math.nan]]) == "a,b\nx,125\n1,nan\n"
    estimates = [(1.0, 0.25), (2.0, math.nan), (math.nan, math.nan)]
    assert [records.mean_with_error(*one) for one in estimates] == [
        "1.000 ± 0.250",
        "2.000",
        "–",
    ]


def test_plots_without_matplotlib_name_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    (text,) = write_plots(lambda: pytest.fail("drawn"), tmp_path / "*.png", "curves")
    assert text.startswith("no curves: ")
    assert "pip install 'npa-envs[bench]'" in text
