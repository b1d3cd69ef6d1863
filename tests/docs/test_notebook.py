"""The notebook is stored with its pictures and runs from its first to its last cell."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

import maplab_py
from maplab_py.report import Message, to_html
from tests.support.data import REPOSITORY
from tests.vimap.builders import walk_map

NOTEBOOK = REPOSITORY / "docs" / "notebooks" / "multi_session.ipynb"


def test_it_is_what_the_script_makes() -> None:
    path = REPOSITORY / "docs" / "scripts" / "make_notebook.py"
    spec = importlib.util.spec_from_file_location("make_notebook", path)
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    stored = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    for cell in stored["cells"]:
        if cell["cell_type"] == "code":
            cell |= {"execution_count": None, "outputs": []}
    assert stored == module.notebook()


def test_it_is_stored_with_pictures_and_tables() -> None:
    stored = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(stored)
    _check_outputs(stored)
    code = [cell for cell in stored.cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert "/tmp/" not in NOTEBOOK.read_text(encoding="utf-8")
    assert NOTEBOOK.stat().st_size < 500_000


@pytest.mark.slow
def test_it_runs_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws into the notebook
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()
    _check_outputs(notebook)


def _check_outputs(notebook: Any) -> None:
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output["output_type"] == "error"]
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


def test_a_report_is_a_dictionary_and_json_text() -> None:
    report = Message("grüße")
    assert report.as_dict() == {"text": "grüße"}
    assert report.as_json() == '{"text": "grüße"}'
    assert report.as_json(indent=1).splitlines()[0] == "{"


def test_sessions_and_maps_show_what_they_hold() -> None:
    session = maplab_py.Session()
    assert repr(session) == "Session(no map)"
    assert session._repr_html_() == "no map in memory"
    session.maps.add("a-b", walk_map())
    assert repr(session).startswith("Session(a-b: VIMap(1 mission, 12 vertices, ")
    assert "<td>a-b (selected)</td><td>1</td><td>12</td>" in session._repr_html_()
    table = session.vi_map._repr_html_()
    assert "<tr><th>vertices</th><td>12</td></tr>" in table
    assert "<th>mission</th>" in table


def test_the_viewer_is_embedded() -> None:
    with maplab_py.Session() as session:
        session.maps.add("walk", walk_map())
        frame = session.view(height_px=300)._repr_html_()
    assert '<iframe src="http://' in frame
    assert "height: 300px" in frame
