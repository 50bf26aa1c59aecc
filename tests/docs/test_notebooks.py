"""The notebooks run and print their stored output."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs import notebook
from tests.docs.snippets import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.rest
@pytest.mark.usefixtures("every_package")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_prints_its_stored_output(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`tests.docs.notebook` runs the cells without Jupyter."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(tmp_path)
    printed = notebook.run(path)
    assert printed == notebook.stored_output(path), "run the notebook in Jupyter and save it"
    assert any(printed)
    assert not list(tmp_path.iterdir()), "the notebook leaves files behind"


@pytest.mark.rest
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs_in_jupyter(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("ipykernel", reason="needs Jupyter: pip install nbclient ipykernel")
    client = pytest.importorskip("nbclient", reason="needs Jupyter: pip install nbclient ipykernel")
    nbformat = pytest.importorskip("nbformat")
    book = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client.NotebookClient(book, timeout=300, kernel_name="python3", resources=resources).execute()
    pictures = [o for cell in book.cells for o in cell.get("outputs", ()) if "image/png" in o.get("data", {})]
    assert pictures


def test_an_error_names_the_failing_cell(tmp_path: Path) -> None:
    path = tmp_path / "broken.ipynb"
    path.write_text('{"cells": [{"cell_type": "code", "source": ["1 / 0"], "outputs": []}]}')
    with pytest.raises(ZeroDivisionError) as caught:
        notebook.run(path)
    assert "code cell 1" in caught.value.__notes__[0]
