"""The notebooks run from the first cell to the last, in kernels of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from run_python import output_of

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"

# A backend that something else has chosen for its process would draw nothing here.
EXECUTE = """
import os
import sys
import nbformat
from nbclient import NotebookClient

os.environ.pop("MPLBACKEND", None)
notebook = nbformat.read(sys.argv[1], as_version=4)
notebook.cells = [c for c in notebook.cells if "install" not in c.metadata.get("tags", [])]
NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
nbformat.write(notebook, "executed.ipynb")
"""


def test_it_is_kept_without_outputs() -> None:
    """What it shows is made by whoever opens it."""
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


@pytest.mark.simulators
def test_the_tutorial_runs(tmp_path: Path) -> None:
    """It is killed, resumed, evaluated and filmed, as the page is."""
    for needed in ("ipykernel", "nbclient"):
        pytest.importorskip(needed)
    tutorial = NOTEBOOK.with_name("tutorial.ipynb")
    output_of("-c", EXECUTE, tutorial, folder=tmp_path, asyncio_debug=False)
    cells = json.loads((tmp_path / "executed.ipynb").read_text())["cells"]
    texts = ["".join(o.get("text", "")) for cell in cells for o in cell.get("outputs", [])]
    assert "killed after update" in "".join(texts)
    assert "reach-0-episode-0.mp4" in "".join(texts)


@pytest.mark.simulators
def test_it_runs(tmp_path: Path) -> None:
    """It shows two figures, and counts steps and episodes."""
    for needed in ("ipykernel", "matplotlib", "nbclient", "pygame"):
        pytest.importorskip(needed)
    output_of("-c", EXECUTE, NOTEBOOK, folder=tmp_path, asyncio_debug=False)
    cells = json.loads((tmp_path / "executed.ipynb").read_text())["cells"]
    shown = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
    assert sum("image/png" in data for data in shown) == 2
    texts = ["".join(data.get("text/plain", "")) for data in shown]
    (counts,) = [json.loads(f"[{text[1:-1]}]") for text in texts if text.startswith("(")]
    assert min(counts) > 0
