"""The notebook of examples/: as it lies there, and run from its top to its end."""

import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "examples" / "maze.ipynb"


def test_the_notebook_is_kept_without_outputs_and_its_links_lead_somewhere():
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    for cell in cells:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            compile(text, NOTEBOOK.name, "exec")
            assert cell["outputs"] == [] and cell["execution_count"] is None
        for link in text.split("](")[1:]:
            assert (NOTEBOOK.parent / link.partition(")")[0]).exists(), link
    assert len({cell["id"] for cell in cells}) == len(cells) > 10


@pytest.mark.slow
def test_the_notebook_runs_and_shows_pictures_a_table_and_rules(tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="needs pip install -e '.[notebook]'")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    book = nbformat.read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(book, timeout=1200, resources=resources).execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    shown = [output["data"] for output in outputs if "data" in output]
    said = "".join(output["text"] for output in outputs if output.output_type == "stream")
    assert "\r" not in said  # of a progress bar
    assert sum("image/png" in data for data in shown) == 3
    assert any("text/html" in data and "steps" in data["text/plain"] for data in shown)
    assert "IF x is about" in said and "action: " in said
