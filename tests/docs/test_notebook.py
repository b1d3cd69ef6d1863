"""The notebook runs from its first to its last cell, in a kernel as a reader's would."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from maplab_py.report import Message, to_html
from tests.support.data import REPOSITORY

NOTEBOOK = REPOSITORY / "docs" / "notebooks" / "multi_session.ipynb"


def test_it_is_what_the_script_makes() -> None:
    path = REPOSITORY / "docs" / "scripts" / "make_notebook.py"
    spec = importlib.util.spec_from_file_location("make_notebook", path)
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert json.loads(NOTEBOOK.read_text()) == module.notebook()


@pytest.mark.slow
def test_it_runs_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws into the notebook
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [o for o in outputs if "image/png" in o.get("data", {})]
    assert len(pictures) >= 2
    text = "".join(o.get("text", "") for o in outputs)
    assert "now 0.0" in text
    assert "done ['office-1'] ['office', 'office-1']" in text
    assert any("<table>" in o.get("data", {}).get("text/html", "") for o in outputs)


def test_reports_are_tables_in_notebooks() -> None:
    assert Message("a < b")._repr_html_() == "<pre>a &lt; b</pre>"
    table = to_html({"n": [{"x": 1.5, "y": None}, {"x": 2.0, "y": "<"}]})
    assert "<th>x</th><th>y</th>" in table
    assert "<td>1.5</td><td></td>" in table
    assert "&lt;" in table
