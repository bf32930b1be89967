"""The table of seeded faults fits the tree; `make faults` tries them."""

import runpy
from pathlib import Path

RUNNER = runpy.run_path(str(Path(__file__).resolve().parents[1] / "faults" / "run.py"))
FAULTS = RUNNER["faults"]()


def test_a_fault_can_be_put_where_its_text_stands_once():
    assert [found for fault in FAULTS if (found := RUNNER["stale"](fault)) is not None] == []


def test_there_are_forty_faults_of_different_names():
    assert len({fault["name"] for fault in FAULTS}) == len(FAULTS) == 40


def test_a_fault_whose_code_has_moved_is_noticed():
    moved = FAULTS[0] | {"file": "npa_envs/nowhere.py"}
    assert "0 times" in RUNNER["stale"](moved)
    assert "0 times" in RUNNER["stale"](FAULTS[0] | {"old": "no such text"})
    assert "no tests" in RUNNER["stale"](FAULTS[0] | {"tests": ["tests/nowhere.py"]})
