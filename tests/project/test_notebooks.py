"""The notebooks run on small settings, and are stored with what they showed on their own."""

import ast
import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import torch

FOLDER = Path(__file__).resolve().parents[2] / "docs/notebooks"
SMALL = {
    "grow_and_hurt": {"particle_count": 256, "growth": 16, "healing": 16},
    "own_loss": {"iterations": 2, "world_count": 2, "particle_count": 64, "watched": 6},
    "hidden_channels": {"particle_count": 128, "growth": 16},
    "species_and_ppo": {"particle_count": 256, "meeting": 2, "rounds": 1, "world_count": 4},
}
"""What the cell with the tag "parameters" assigns, small."""

LARGEST = 300_000
"""Bytes of a notebook, at most."""


def cells(name: str, kind: str) -> list[dict]:
    """The cells of a notebook that are of a kind."""
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == kind]


def run_cell(source: str, names: dict) -> object:
    """Run a cell as Jupyter does, and return what its last line is worth."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    if last is None:
        return None
    return eval(compile(ast.Expression(last.value), "cell", "eval"), names)


def test_every_notebook_is_tested():
    assert sorted(SMALL) == sorted(path.stem for path in FOLDER.glob("*.ipynb"))


@pytest.mark.parametrize("name", SMALL)
def test_a_notebook_runs(name, capsys):
    plt.switch_backend("Agg")
    state = torch.random.get_rng_state()
    names = {"__name__": "__main__"}
    results = []
    for cell in cells(name, "code"):
        results.append(run_cell("".join(cell["source"]), names))
        if "parameters" in cell["metadata"].get("tags", ()):
            assert set(SMALL[name]) <= set(names)
            names |= SMALL[name]
    torch.random.set_rng_state(state)
    plt.close("all")
    # Where a notebook prints a number, it is one.
    assert "nan" not in capsys.readouterr().out
    shown = [cell["outputs"] for cell in cells(name, "code") if cell["outputs"]]
    pictures = [result for result in results if hasattr(result, "_repr_mimebundle_")]
    assert all(picture._repr_mimebundle_() for picture in pictures)
    assert len(shown) >= len(pictures)


@pytest.mark.parametrize("name", SMALL)
def test_a_notebook_is_stored_as_it_ran(name):
    assert (FOLDER / f"{name}.ipynb").stat().st_size < LARGEST
    counts = [cell["execution_count"] for cell in cells(name, "code")]
    assert counts == list(range(1, len(counts) + 1))
    stored = [out for cell in cells(name, "code") for out in cell["outputs"]]
    assert stored
    assert not [out for out in stored if out["output_type"] == "error"]
    assert not [out for out in stored if out.get("name") == "stderr"]
