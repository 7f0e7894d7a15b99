"""The notebook in examples/ runs from its first cell to its last."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "examples" / "from_python.ipynb"


def test_the_notebook_runs(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs are kept out of the repository"
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    text = "".join(str(cell.get("outputs")) for cell in notebook.cells)
    # Commands of a shell do not fail a cell.
    for shown in ("20027 transitions", "transitions   20026", "run folder: runs/iql", "returns: [", "10 candidates"):
        assert shown in text, shown
