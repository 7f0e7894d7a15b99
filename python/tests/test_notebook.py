"""The notebooks in examples/ run from their first cell to their last, with fewer gradient steps."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[2] / "examples"
# Changes that make them quick.
QUICK = {"step_000006000": "step_000000600", "--steps 6000 --eval-interval 1000": "--steps 600 --eval-interval 200", "steps=3000": "steps=600"}
# Texts that each shows. Commands of a shell do not fail a cell.
SHOWN = {
    "from_python": ("20027 transitions", "transitions   20026", "run folder: runs/iql", "returns: [", "10 candidates"),
    "robot": ("episodes      300", "page: http://", "training is done", "4 -> 2 numbers", "of the policy's"),
}


@pytest.mark.parametrize("name", SHOWN)
def test_the_notebook_runs(name, tmp_path):
    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs are kept out of the repository"
    for cell in notebook.cells:
        for usual, here in QUICK.items():
            cell.source = cell.source.replace(usual, here)
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    text = "".join(str(cell.get("outputs")) for cell in notebook.cells)
    for shown in SHOWN[name]:
        assert shown in text, shown
