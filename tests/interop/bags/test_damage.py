"""Bags that are cut or changed: a line that names the file, or the right content; nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags.exporting import export_bag
from maplab_py.interop.bags.importing import import_bag_resources
from maplab_py.interop.bags.listing import bag_info
from maplab_py.interop.bags.options import BagExportOptions, BagImportOptions
from maplab_py.interop.bags.poses import add_poses_to_bag
from maplab_py.interop.recordings.bag_writing import BagFormat, bag_files
from maplab_py.vimap import VIMap
from tests.interop.bags.small_bags import FORMATS, named, with_time_offset
from tests.interop.small_map import IMU_ID, make_map

pytest.importorskip("rosbags")

CONTENT = "poses,tf,imu"
POSES = BagImportOptions("/points0", sensor_id=IMU_ID)


@pytest.fixture
def vi_map() -> VIMap:
    return with_time_offset(make_map())


def tried(path: Path, vi_map: VIMap, target: Path) -> list[str]:
    """Use a bag in every way; return what was refused."""
    problems = []
    for use in (
        lambda: bag_info(path),
        lambda: add_poses_to_bag(vi_map, path, target),
        lambda: import_bag_resources(vi_map, 0, path, POSES),
    ):
        try:
            use()
        except (MapError, UserError) as error:
            problems.append(str(error))
    assert [problem for problem in problems if "\n" in problem or path.stem not in problem] == []
    return problems


@pytest.mark.parametrize("kind", FORMATS)
def test_cut_bags(tmp_path: Path, kind: BagFormat, vi_map: VIMap) -> None:
    path = named(tmp_path, kind)
    export_bag(vi_map, tmp_path, 0, path, BagExportOptions(kind.value, CONTENT))
    whole = bag_files(path, kind)[0].read_bytes()
    for number, length in enumerate(np.linspace(0, len(whole) - 1, 12).astype(int).tolist()):
        damaged = named(tmp_path, kind, f"cut{number}")
        if kind.is_ros_2:
            shutil.copytree(path, damaged)
            (damaged / path.name).with_suffix(bag_files(path, kind)[0].suffix).write_bytes(
                whole[:length]
            )
        else:
            damaged.write_bytes(whole[:length])
        problems = tried(damaged, vi_map, named(tmp_path, kind, f"out{number}"))
        assert len(problems) == 3, length
        assert not named(tmp_path, kind, f"out{number}").exists()


@pytest.mark.parametrize("kind", FORMATS)
def test_changed_bags(tmp_path: Path, kind: BagFormat, vi_map: VIMap) -> None:
    rng = np.random.default_rng(7)
    path = named(tmp_path, kind)
    export_bag(vi_map, tmp_path, 0, path, BagExportOptions(kind.value, CONTENT))
    whole = bag_files(path, kind)[0].read_bytes()
    for number in range(15):
        data = np.frombuffer(whole, dtype=np.uint8).copy()
        data[rng.integers(0, len(data), 40)] = rng.integers(0, 256, 40)
        bag_files(path, kind)[0].write_bytes(data.tobytes())
        tried(path, vi_map, named(tmp_path, kind, f"out{number}"))


def test_a_folder_without_its_file(tmp_path: Path, vi_map: VIMap) -> None:
    export_bag(vi_map, tmp_path, 0, tmp_path / "walk", BagExportOptions(content=CONTENT))
    (tmp_path / "walk" / "walk.mcap").unlink()
    with pytest.raises(MapError, match="walk: the bag cannot be read"):
        bag_info(tmp_path / "walk")
    (tmp_path / "walk" / "metadata.yaml").write_text(
        "- !!python/object/apply:os.system [touch x]\n"
    )
    with pytest.raises(MapError, match="walk: the bag cannot be read"):
        bag_info(tmp_path / "walk")
