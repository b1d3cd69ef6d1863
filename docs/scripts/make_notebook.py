"""Run the multi-session workflow in Python and store it, with figures, as a notebook.

python docs/scripts/make_notebook.py    (writes docs/notebooks/multi_session.ipynb)
"""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

PATH = Path(__file__).resolve().parents[1] / "notebooks" / "multi_session.ipynb"
_PROSE = "prose: "
CELLS = (
    """prose: # Three sessions become one map

The tutorial's workflow in Python. Every command of the console is a method of the session, its
flags are keyword arguments, and what it returns is a report: an object with fields.""",
    """import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import maplab_py

folder = Path(tempfile.mkdtemp())
session = maplab_py.Session()
session.simulate(scenario="three_sessions", map_folder=folder / "sessions");""",
    """prose: Sessions, maps and reports show themselves as tables:""",
    """session.load_merge_all_maps(maps_folder=folder / "sessions", target_map_key="office")
session""",
    """session.vi_map""",
    """truth = folder / "sessions" / "truth.npz"
drifted = session.vi_map  # a value: it stays as it is
before = session.evaluate_map(truth=truth)
before""",
    """prose: Each session by itself, then all of them in one frame, then the loops:""",
    """session.elq()
optimised = session.optvi()
print(f"cost {optimised.cost_before:.0f} -> {optimised.cost_after:.0f}")
session.set_mission_baseframe_to_known()
session.anchor_all_missions()
session.relax()
loops = session.lc()
session.optvi()
after = session.evaluate_map(truth=truth)
print(f"drift {before.ate_each_m:.3f} m, now {after.ate_m:.3f} m, all sessions together")""",
    """prose: ## Before and after

A map is a bundle of numpy arrays; `vi_map.T_G_I` has one row [qx qy qz qw px py pz] per vertex.""",
    """figure, axes = plt.subplots(1, 2, figsize=(10, 4.5), sharex=True, sharey=True)
shown = {"before": drifted, "after": session.vi_map}
for panel, (title, vi_map) in zip(axes, shown.items(), strict=True):
    good = vi_map.landmarks.quality != 1
    panel.plot(*vi_map.p_G[good, :2].T, ".", color="0.8", markersize=2)
    for row in range(len(vi_map.missions)):
        of_mission = vi_map.vertices.mission == row
        panel.plot(*vi_map.T_G_I[of_mission, 4:6].T)
    panel.set_title(title)
    panel.set_xlabel("x in G [m]")
    panel.set_aspect("equal")
axes[0].set_ylabel("y in G [m]")
plt.show()""",
    """prose: The `plot_...` commands write such figures to files; `maplab_py.plotting` returns them:""",
    """from maplab_py.plotting import maps

maps.coobservability(session.vi_map)""",
    """prose: `session.view()` embeds the viewer. Its page is served by this process, so a stored notebook
has no picture of it; `session.export_view(file="office.html")` writes a page that stands alone.

A report is also text for programs:""",
    """print(after.as_json())""",
    """prose: Nothing is lost: `undo` takes back any command, and jobs run while one goes on.""",
    """job = session.start("optvi", ba_num_iterations=3)  # works on the map as it is now
session.undo()
job.wait()
print(job.state, [conflict.kept_as for conflict in job.conflicts], session.maps.keys)""",
    """session.save(map_folder=folder / "merged");""",
)


def notebook() -> dict[str, Any]:
    """Return the notebook without outputs; the tests compare the stored one with it."""
    return {
        "cells": [_cell(number, text) for number, text in enumerate(CELLS)],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def _cell(number: int, text: str) -> dict[str, Any]:
    is_prose = text.startswith(_PROSE)
    lines = text.removeprefix(_PROSE).splitlines(keepends=True)
    common = {"id": f"cell-{number}", "metadata": {}, "source": lines}
    if is_prose:
        return {"cell_type": "markdown", **common}
    return {"cell_type": "code", "execution_count": None, "outputs": [], **common}


def with_outputs(timeout_s: float = 1800.0) -> dict[str, Any]:
    """Run the notebook in a folder of its own and return it with what its cells show."""
    os.environ.pop("MPLBACKEND", None)  # the kernel draws into the notebook
    node = nbformat.reads(json.dumps(notebook()), as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        NotebookClient(
            node, timeout=int(timeout_s), kernel_name="python3", resources=resources
        ).execute()
    made = notebook()
    for cell, run in zip(made["cells"], node.cells, strict=True):
        if cell["cell_type"] == "code":
            cell["execution_count"] = run.execution_count
            cell["outputs"] = json.loads(json.dumps(run.outputs))
    return made


if __name__ == "__main__":
    PATH.parent.mkdir(exist_ok=True)
    text = json.dumps(with_outputs(), indent=1, ensure_ascii=False)
    PATH.write_text(text + "\n", encoding="utf-8")
