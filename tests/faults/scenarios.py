"""What is saved under faults: maps, databases, summary maps, output files, files of the console."""

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from maplab_py.errors import MaplabError
from tests.vimap.builders import walk_map

_SIZE = {"vertices": 4, "landmarks": 6}


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A way from an old state of a folder to a new one."""

    prepare: Callable[[Path], object]
    save: Callable[[Path], object]
    tidy: Callable[[Path], object] | None = None  # what a reader does; None = only writers tidy up
    swaps: bool = False  # two folders change places: explored without renameat2, too
    has_many_files: bool = False  # each of them is old or new
    may_be_cut: bool = False  # a file that is appended to: a kill may leave a part of the last line


def _map(seed: int, name: str = "map", *, overwrite: bool = False) -> Callable[[Path], object]:
    from maplab_py.storage.native import save_map

    vi_map = walk_map(**_SIZE, seed=seed)
    return lambda folder: save_map(vi_map, folder / name, overwrite=overwrite)


def _old_map(folder: Path) -> None:
    _map(1)(folder)
    resources = folder / "map/resources/raw_images"
    resources.mkdir(parents=True)
    (resources / "a.pgm").write_bytes(b"P5 1 1 255\n0")
    (folder / "map/notes.txt").write_text("of the user")


def _linked_map(folder: Path) -> None:
    (folder / "disk").mkdir()
    _old_map(folder / "disk")
    (folder / "map").symlink_to("disk/map")


def _load(folder: Path) -> None:
    from maplab_py.storage.native import load_map

    with contextlib.suppress(MaplabError):
        load_map(folder / "map")


def _load_deep(folder: Path) -> None:
    from maplab_py.storage.native import load_map

    with contextlib.suppress(MaplabError):
        load_map(folder / "a/b/map")


def _nothing(folder: Path) -> None:
    """Start with an empty folder."""


def _file(write: Callable[[Path, int], object], name: str) -> Scenario:
    """Return the replacement of one file: `write` gets the path and 1 (old) or 2 (new)."""
    return Scenario(lambda folder: write(folder / name, 1), lambda folder: write(folder / name, 2))


def _database(path: Path, version: int) -> None:
    from maplab_py.algorithms.self_calibration.segments.database import (
        SegmentDatabase,
        save_database,
    )

    vi_map = walk_map(**_SIZE, seed=version)
    tables = {"imu": ("imu",)}
    save_database(SegmentDatabase(vi_map, (), tables, "trace", version, (), np.zeros(0)), path)


def _summary(path: Path, version: int) -> None:
    from maplab_py.storage.summary_map import write_summary_map
    from tests.storage.test_summary_map import make

    write_summary_map(make(landmarks=6 + version), path.parent, overwrite=True)


def _trajectory(version: int):  # type: ignore[no-untyped-def]
    from maplab_py.interop.trajectories import Trajectory

    poses = np.tile([0.0, 0.0, 0.0, 1.0, 1.0, 2.0, float(version)], (5, 1))
    return Trajectory(np.arange(5) * 10**8, poses)


def _csv(path: Path, version: int) -> None:
    from maplab_py.interop.trajectories import write_euroc

    write_euroc(_trajectory(version), path, overwrite=True)


def _plot(path: Path, version: int) -> None:
    from maplab_py.plotting.figure import new_figure, write_figure

    figure = new_figure(1.0, 1.0)
    figure.add_subplot().plot([0, version])
    write_figure(figure, path)


def _page(path: Path, version: int) -> None:
    from maplab_py.output_files import write_text

    write_text(path, ["<html>", f"{version}" * 20_000, "</html>"], overwrite=True)


def _aliases(path: Path, version: int) -> None:
    from maplab_py.console.scripts.aliases import write_aliases

    write_aliases(path, {"tidy": "elq; rbl" * version})


def _history(path: Path, version: int) -> None:
    from maplab_py.console.prompt.loop import open_history

    open_history(path)[0].store_string(f"optvi --ba_num_iterations={version}")


def _files(version: int) -> Callable[[Path], object]:
    """Return a command that replaces two files and makes two."""
    from maplab_py.output_files import staging, write_text

    def write(folder: Path) -> None:
        names = ("a.csv", "b.csv", "new/c.csv", "new/deep/d.csv")[: 2 * version]
        with staging() as staged:
            for name in names:
                write_text(folder / name, [f"{version}" * 100], overwrite=True)
            staged.publish()

    return write


SCENARIOS: dict[str, Callable[[], Scenario]] = {
    "new map": lambda: Scenario(_nothing, _map(2, "a/b/map"), _load_deep),
    "replaced map": lambda: Scenario(_old_map, _map(2, overwrite=True), _load, swaps=True),
    "linked map": lambda: Scenario(_linked_map, _map(2, overwrite=True), _load),
    "segment database": lambda: _file(_database, "device.segments"),
    "summary map": lambda: _file(_summary, "localization_summary_map"),
    "new file": lambda: Scenario(_nothing, lambda folder: _csv(folder / "a/b.csv", 2)),
    "csv": lambda: _file(_csv, "poses.csv"),
    "plot": lambda: _file(_plot, "plot.svg"),
    "exported page": lambda: _file(_page, "map.html"),
    "aliases": lambda: _file(_aliases, "aliases"),
    "history": lambda: dataclasses.replace(_file(_history, "history"), may_be_cut=True),
    "files of one command": lambda: Scenario(_files(1), _files(2), has_many_files=True),
}
