"""Peers beside the library: those that need nothing installed perceive what the library does."""

import json
import sys

import peer_calls
import peers
import pytest
import torch
from drift import relative_error
from hash_grid import grid_fields
from support.slow import slow

from npa_envs import reference
from npa_envs.measure.speed.timing import Workload

ALWAYS = ("npa-envs", "wp.HashGrid and wp.Tape", "torch edge list")
"""Peers that need no other library."""

ERROR = 2e-6
"""Relative error that float32 may have; the worst measured is 3.6e-7."""


@pytest.mark.parametrize("space_dim", [slow(2), 3])
def test_peers_agree_with_the_library_in_float64_forward_and_backward(space_dim):
    left_out: dict[str, str] = {}
    cpu = torch.device("cpu")
    rows = peers.peer_rows(ALWAYS, space_dim, [300], cpu, left_out, repeats=1, longest=1e9)
    assert [(row.peer, row.backward) for row in rows] == [
        (name, backward) for backward in (False, True) for name in ALWAYS
    ]
    assert all(0.0 < row.error < ERROR and row.time_us.median > 0.0 for row in rows)
    assert left_out == {}


@pytest.mark.parametrize("space_dim", [2, 3])
def test_pairs_of_the_edge_list_are_all_that_are_nearer_than_eps(space_dim):
    x = Workload(space_dim, 1, 200, 1).worlds(torch.device("cpu"))[0][0].double()
    found = torch.stack(peer_calls.pairs_within(x, 0.1), dim=-1).tolist()
    expected = torch.nonzero(torch.cdist(x, x) < 0.1).tolist()
    assert sorted(found) == expected


def test_an_adjoint_of_the_hash_grid_survives_a_later_call_on_another_world():
    x, s = Workload(2, 1, 100, 1).worlds(torch.device("cpu"))
    s.requires_grad_()
    fields = grid_fields(x, s, 0.1)
    for states in (s, s.detach()):
        grid_fields(x.flip(1) * 0.5, states, 0.1)
    exact = reference.fields(x.double(), s.double(), 0.1)
    gradient = exact.grad0 + (exact.grad1 - exact.grad0).detach()
    for value, expected in ((fields.blur, exact.blur), (fields.grad1, gradient)):
        bars = [
            torch.autograd.grad(a.square().sum(), s, retain_graph=True)[0]
            for a in (value, expected)
        ]
        assert relative_error(*bars) < ERROR


def test_the_script_records_its_rows_and_why_a_peer_is_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sphWarpCore", None)
    given = ["peers.py", "--device", "cpu", "--space-dims", "2", "--sizes", "300", "150"]
    given += ["--peers", "npa-envs", "npa-envs, CUDA graph", "sphWarpCore", "nvalchemi-toolkit-ops"]
    given += ["--longest", "0", "--output", str(tmp_path / "record.json")]
    monkeypatch.setattr(sys, "argv", [*given, "--plot", str(tmp_path / "figure.png")])
    peers.main()
    record = json.loads((tmp_path / "record.json").read_text(encoding="utf-8"))
    assert [(row["peer"], row["particles"]) for row in record["rows"]] == [("npa-envs", 150)] * 2
    left_out = record["left_out"]
    assert left_out["npa-envs, 2D"].startswith("beyond 150 particles: a call took ")
    assert "ModuleNotFoundError" in left_out["sphWarpCore, 2D, with backward"]
    assert left_out["sphWarpCore, 2D"] in capsys.readouterr().out
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
