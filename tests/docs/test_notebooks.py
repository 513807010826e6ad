"""The notebooks run from top to bottom, and are kept without what they printed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from documentation_pages import ROOT

NOTEBOOKS = sorted(ROOT.glob("docs/notebooks/*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_its_results(path: Path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells
    for cell in cells:
        assert (cell["outputs"], cell["execution_count"]) == ([], None)
        compile("".join(cell["source"]), path.name, "exec")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_the_first_track_runs_and_finds_the_turn(tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="the extra `notebook` is not installed")
    nbclient = pytest.importorskip("nbclient", reason="the extra `notebook` is not installed")
    pytest.importorskip("ipykernel", reason="the extra `notebook` is not installed")
    notebook = nbformat.read(ROOT / "docs/notebooks/first_track.ipynb", as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    printed = ["".join(out.get("text", "") for out in cell.outputs) for cell in cells]
    found, truly = (
        [float(number) for number in re.findall(r"\d+\.\d*|\d+", line.partition(":")[2])]
        for line in printed[3].splitlines()[:2]
    )
    assert len(found) == len(truly) == 7
    assert abs(found[-1] - truly[-1]) < 8
    assert float(re.search(r"IoU of the masks: ([\d.]+)", printed[3])[1]) > 0.85
    assert any("image/png" in out.get("data", {}) for out in cells[2].outputs)
    assert printed[4].startswith("finished 8 ")
    assert (tmp_path / "runs/first/run.json").is_file()
