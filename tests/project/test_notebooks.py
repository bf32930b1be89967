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
    "own_loss": {"iterations": 2, "world_count": 2, "particle_count": 64},
    "hidden_channels": {"particle_count": 128, "growth": 16},
    "ppo_for_species": {"rounds": 1, "world_count": 4},
    "two_species": {"particle_count": 256, "meeting": 2},
}
"""What the cell with the tag "parameters" assigns, small."""

LARGEST = 300_000
"""Bytes of a notebook, at most."""


def cells(name: str, kind: str) -> list[dict]:
    """The cells of a notebook that are of a kind, without those for Colab."""
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    own = [c for c in notebook["cells"] if "address" not in c["metadata"].get("tags", ())]
    return [cell for cell in own if cell["cell_type"] == kind]


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
def test_a_notebook_runs(name, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    state, threads = torch.random.get_rng_state(), torch.get_num_threads()
    names = {"__name__": "__main__"}
    results = []
    for cell in cells(name, "code"):
        results.append(run_cell("".join(cell["source"]), names))
        if "parameters" in cell["metadata"].get("tags", ()):
            assert set(SMALL[name]) <= set(names)
            names |= SMALL[name]
    torch.random.set_rng_state(state)
    torch.set_num_threads(threads)
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


@pytest.mark.parametrize("name", SMALL)
def test_a_notebook_has_an_exercise_with_a_solution_that_is_folded(name):
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    starts = [k for k, cell in enumerate(notebook) if cell["source"][0] == "## Exercise\n"]
    assert len(starts) == 1
    solution = notebook[starts[0] + 1]
    assert solution["cell_type"] == "code"
    assert solution["outputs"]
    assert "hide-cell" in solution["metadata"]["tags"]


def test_the_page_about_an_own_loss_has_the_program_of_its_notebook():
    page = (FOLDER.parent / "own_loss.md").read_text(encoding="utf-8")
    program = page.split("```python\n")[1].split("```")[0].split("\n")
    sources = ["".join(cell["source"]) for cell in cells("own_loss", "code")]
    trained = next(k for k, source in enumerate(sources) if "save_rule" in source)
    lines = "\n".join(sources[: trained + 1]).split("\n")
    assert list(filter(None, program)) == list(filter(None, lines))
    (printed,) = (out["text"] for out in cells("own_loss", "code")[trained]["outputs"])
    assert f"```text\n{''.join(printed)}```" in page
