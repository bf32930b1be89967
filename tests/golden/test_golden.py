"""Results are those of the commit that wrote the golden files; NPA_GOLDEN=exact: bit for bit."""

import json
import os
import shutil
from pathlib import Path

import names
import numpy as np
import pytest
import scenes
import torch

import npa_envs
from npa_envs.cli import main

FOLDER = Path(__file__).resolve().parent
RUNS = {"morphogenesis2d": "unfinished_run", "co_morphogenesis2d": "unfinished_joint_run"}
"""Folders of runs that were killed, by task."""
CHECKPOINT_INTERVAL, ITERATIONS = 6, 12
"""Of these runs."""
EXACT = os.environ.get("NPA_GOLDEN") == "exact"

DOUBLE, SINGLE, SINGLE_GRADIENT = 1e-11, 2e-5, 5e-3
"""Bounds on errors relative to an array's largest number: float64, float32, its gradients."""


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def stored():
    with np.load(scenes.GOLDEN) as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def content():
    return json.loads((FOLDER / "golden.json").read_text(encoding="utf-8"))


def complaint(key, got, expected, exact=EXACT):
    """Return what is wrong with an array, or None."""
    if got.dtype != expected.dtype or got.shape != expected.shape:
        return f"{key}: {got.dtype} {got.shape}, was {expected.dtype} {expected.shape}"
    if got.dtype.kind == "f" and not np.isfinite(got).all():
        return f"{key}: not finite"
    if np.array_equal(got, expected):
        return None
    difference = np.abs(got.astype(np.float64) - expected.astype(np.float64))
    if got.dtype.kind == "f":
        single = SINGLE_GRADIENT if "/grad/" in key else SINGLE
        limit = DOUBLE if got.dtype == np.float64 else single
        error = float(difference.max() / max(np.abs(expected).max(), np.finfo(np.float32).tiny))
    else:
        # A colour that is rounded to whole numbers may fall to the next one.
        limit = 1.0 if key.endswith("/picture") else 0.0
        error = float(difference.max())
    if error <= limit and not exact:
        return None
    return f"{key}: error {error:.3g}, allowed {limit:.3g}"


@pytest.mark.parametrize("name", scenes.SCENES)
def test_scene_is_as_it_was(name, stored):
    got = scenes.compute(name)
    assert sorted(got) == sorted(key for key in stored if key.startswith(f"{name}/"))
    found = [complaint(key, array, stored[key]) for key, array in got.items()]
    wrong = [line for line in found if line is not None]
    assert not wrong, "\n".join(wrong)


def test_all_that_is_stored_is_compared(stored):
    worlds = {key.split("/")[1] for key in stored if key.startswith("world/")}
    assert worlds == scenes.RULES.keys()
    assert {key.split("/")[0] for key in stored} == {*scenes.SCENES, "world"}


def test_wrong_numbers_are_found(stored):
    for key, limit in (
        ("grown-gecko/f32/s", SINGLE),
        ("grown-gecko/f64/s", DOUBLE),
        ("gradients-gecko/f32/grad/hidden.weight", SINGLE_GRADIENT),
    ):
        right = stored[key]
        for factor, fine in ((1.0, True), (1.0 + 0.3 * limit, True), (1.0 + 3.0 * limit, False)):
            wrong = (right.astype(np.float64) * factor).astype(right.dtype)
            assert (complaint(key, wrong, right, exact=False) is None) == fine, (key, factor)
        assert complaint(key, right * np.nan, right, exact=False) is not None
        assert complaint(key, right[1:], right, exact=False) is not None
        assert complaint(key, np.nextafter(right, right.dtype.type(9)), right, exact=True)
    ends = stored["env-texture/ends"]
    assert complaint("env-texture/ends", ~ends, ends, exact=False) is not None


def test_public_names_are_there(content):
    got = names.public_names()
    assert got["npa_envs"] == content["packages"]["npa_envs"]
    for package, expected in content["packages"].items():
        assert set(expected) <= set(got[package]), package
        assert [name for name in expected if not names.is_there(f"{package}.{name}")] == []
    signatures = names.signatures()
    for name, expected in content["signatures"].items():
        # Keywords may be added; the others keep their order and defaults.
        added = set(signatures[name]) - set(expected)
        assert [own for own in signatures[name] if own not in added] == expected, name
        assert all("KEYWORD_ONLY" in own for own in added), name
    for kind, expected in content["ids"].items():
        assert set(expected) <= set(names.ids()[kind]), kind
    assert set(content["rules"]) <= set(npa_envs.shipped_rules())


def test_documented_names_are_there(content):
    assert [name for name in content["documented"] if not names.is_there(name)] == []


def test_commands_still_take_their_options(content, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    got = names.everything()
    for kind in ("presets", "commands"):
        for name, expected in content[kind].items():
            assert set(expected) <= set(got[kind][name]), name


@pytest.mark.parametrize("task", RUNS)
def test_run_killed_at_the_old_commit_goes_on(task, tmp_path):
    """Its next iterations are those of a run that was never killed."""
    folder = tmp_path / "run"
    shutil.copytree(FOLDER / RUNS[task], folder)
    whole = records(folder / "whole_log.jsonl")
    assert len(records(folder / "log.jsonl")) < ITERATIONS
    words = ["train", task, "--out", str(folder), "--resume", "--no-progress", "--no-report"]
    assert main(words) == 0
    resumed = records(folder / "log.jsonl")
    assert [r["iteration"] for r in resumed] == [r["iteration"] for r in whole]
    count = ITERATIONS if EXACT else CHECKPOINT_INTERVAL + 1
    for got, expected in zip(resumed[:count], whole, strict=False):
        assert got.keys() == expected.keys()
        for name, value in expected.items():
            if "seconds" not in name and isinstance(value, float):
                close = pytest.approx(value, rel=0.0 if EXACT else 1e-2, abs=0.0)
                assert got[name] == close, (got["iteration"], name)
    for path in folder.glob("rule*.safetensors"):
        assert np.isfinite([p.detach().sum() for p in npa_envs.load_rule(path).parameters()]).all()


def records(path):
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
