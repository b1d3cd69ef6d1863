"""Simulated sessions on disk: maps, their truth, and raw recordings."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from maplab_py.atomic import replaced_folder
from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.simulation.raw_data import write_raw_data
from maplab_py.simulation.reports import SimulatedMap, SimulatedMaps
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.storage.native import save_map

TRUTH_FILE = "truth.npz"


def write_maps(
    scenario: Scenario,
    map_folder: Path,
    *,
    raw_data: bool = False,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> SimulatedMaps:
    """Simulate a scenario; write one map per session, the truth, and on request raw recordings.

    A new folder appears as a whole; in a folder with other files, each map is replaced by itself.

    Raises:
        UserError: The scenario cannot be simulated, or a file cannot be written.
        Cancelled: The user wants to stop.
    """
    data = simulate(scenario, progress=progress)
    is_new = not map_folder.is_dir() or not any(map_folder.iterdir())
    with replaced_folder(map_folder) if is_new else nullcontext(map_folder) as target:
        maps = []
        for folder, vi_map in zip(session_folders(target, len(data.maps)), data.maps, strict=True):
            progress.check()
            save_map(vi_map, folder, overwrite=overwrite)
            counts = len(vi_map.vertices), len(vi_map.keypoints), len(vi_map.landmarks)
            maps.append(SimulatedMap(map_folder / folder.relative_to(target), *counts))
        data.truth.save(target / TRUTH_FILE)
        folders: list[Path] = []
        if raw_data:
            folders = write_raw_data(scenario, data, target, overwrite=overwrite, progress=progress)
        written = tuple(map_folder / folder.relative_to(target) for folder in folders)
    return SimulatedMaps(tuple(maps), map_folder / TRUTH_FILE, written)


def session_folders(folder: Path, count: int) -> list[Path]:
    """Return the folders of so many sessions."""
    return [folder / f"session_{number + 1}" for number in range(count)]


def refuse_used_folder(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder that is not empty, before any work is done; raises UserError."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--map_folder={folder} is a file")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"--map_folder={folder} is not empty; give another one or --overwrite")
