"""Run the notebooks of `docs/notebooks/` and keep what they print and show.

    python docs/scripts/run_notebooks.py [NAME ...]

It takes five minutes on a CPU, and needs nbclient and ipykernel, which the extra `docs` brings.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import build_address
import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"


def run(path: Path) -> None:
    """Run a notebook and write its outputs into it."""
    own = build_address.with_colab(path.read_text(encoding="utf-8"), path.stem, None)
    notebook = nbformat.reads(own, as_version=4)
    with TemporaryDirectory() as folder:
        # What a notebook writes is not kept.
        resources = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=1200, resources=resources).execute()
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number}"
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            # Warnings of this machine: other readers have other ones.
            cell.outputs = [one for one in cell.outputs if one.get("name") != "stderr"]
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    nbformat.validate(notebook)
    path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        run(FOLDER / f"{name}.ipynb")
    build_address.main([])
