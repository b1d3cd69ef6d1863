"""Real maps go through load and save without loss; damaged ones are refused in one line."""

import dataclasses
import gzip
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.atomic import replaced_folder
from maplab_py.errors import MapError, UserError
from maplab_py.progress import SilentProgress
from maplab_py.sensors import Distortion, Projection
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.native import disk_copy, load_map, save_map
from maplab_py.storage.protobuf import ids
from maplab_py.vimap import VIMap, consistency
from tests.support import data, scene

SUBMAP = "maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"


def differences(a: VIMap, b: VIMap) -> list[str]:
    found = []
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        for name, column in x.columns().items() if hasattr(x, "columns") else ():
            other = y.columns()[name]
            if column.dtype == object:
                same = len(column) == len(other) and all(map(lambda p, q: p == q, column, other))
            else:
                same = np.array_equal(column, other, equal_nan=column.dtype.kind == "f")
            if not same:
                found.append(f"{field.name}.{name}")
    return found


def damaged_copy(tmp_path: Path, damage: Callable[[Path], None]) -> Path:
    folder = tmp_path / "map"
    shutil.copytree(data.shared_data(SUBMAP), folder)
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)
    damage(folder)
    return folder


def rewritten(folder: Path, name: str, change: Callable[[pb.VIMap], None]) -> None:
    path = folder / "vi_map" / name
    message = pb.VIMap.FromString(gzip.decompress(path.read_bytes()))
    change(message)
    path.write_bytes(gzip.compress(message.SerializeToString()))


def test_saved_messages_hold_what_the_original_files_hold(tmp_path: Path) -> None:
    """Compare entity by entity with the original files, without this project's reader."""
    source = data.shared_data(SUBMAP)
    save_map(load_map(source)[0], tmp_path / "map")

    def entities(folder: Path) -> dict[tuple[int, ...], object]:
        found: dict[tuple[int, ...], object] = {}
        for path in sorted((folder / "vi_map").iterdir()):
            if path.name in ("sensors.yaml", "vi_map_metadata"):
                continue
            message = pb.VIMap.FromString(gzip.decompress(path.read_bytes()))
            for name in ("vertex", "edge", "mission", "baseframe"):
                plural = {"vertex": "vertices"}.get(name, name + "s")
                for i, entity in zip(
                    getattr(message, f"{name}_ids"), getattr(message, plural), strict=True
                ):
                    found[tuple(i.words)] = entity
        return found

    before, after = entities(source), entities(tmp_path / "map")
    assert before.keys() == after.keys()
    for key, entity in before.items():
        other = after[key]
        if isinstance(entity, pb.Vertex):
            assert isinstance(other, pb.Vertex)
            assert entity.nframe == other.nframe
            assert list(entity.T_M_I) == list(other.T_M_I)
            stored = {tuple(lm.id.words): lm for lm in entity.landmark_store.landmarks}
            again = {tuple(lm.id.words): lm for lm in other.landmark_store.landmarks}
            assert stored.keys() == again.keys()
            for name, landmark in stored.items():
                assert list(landmark.p_I) == list(again[name].p_I)
                assert landmark.quality == again[name].quality
        elif isinstance(entity, pb.Edge):
            assert isinstance(other, pb.Edge)
            assert list(entity.imu.accel_gyro) == list(other.imu.accel_gyro)
            assert list(entity.imu.timestamps_ns) == list(other.imu.timestamps_ns)
        else:
            assert entity == other


def test_unknown_fields_survive(tmp_path: Path) -> None:
    extra = b"\xa2\x1f\x05hello"  # field 500, five bytes

    def damage(folder: Path) -> None:
        rewritten(folder, "missions", lambda m: m.missions[0].MergeFromString(extra))
        rewritten(folder, "vertices0", lambda m: m.vertices[3].MergeFromString(extra))

    vi_map, _ = load_map(damaged_copy(tmp_path, damage))
    save_map(vi_map, tmp_path / "again")
    again, _ = load_map(tmp_path / "again")
    assert vi_map.missions.unknown[0] == extra
    assert again.missions.unknown[0] == extra
    assert sorted(again.vertices.unknown)[-1] == extra


@pytest.mark.parametrize("extra", [b"", b"\xa2\x1f\x05hello"])
def test_bytes_and_objects_of_landmarks_say_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: bytes
) -> None:
    def change(message: pb.VIMap) -> None:
        store = next(v.landmark_store for v in message.vertices if v.landmark_store.landmarks)
        store.landmarks[0].covariance.extend(range(9))
        store.landmarks[0].ClearField("p_I")
        store.landmarks[0].feature_type = 3
        store.landmarks[1].MergeFromString(extra)

    folder = damaged_copy(tmp_path, lambda folder: rewritten(folder, "vertices0", change))
    monkeypatch.setattr(ids, "_WORTH_A_KERNEL", 0)
    read, _ = load_map(folder)
    monkeypatch.setattr(ids, "_WORTH_A_KERNEL", 1 << 62)
    assert differences(read, load_map(folder)[0]) == []
    assert (b"".join(read.landmarks.unknown), read.landmarks.feature_type.max()) == (extra, 3)
    assert np.count_nonzero(np.isfinite(read.landmarks.covariance)) == 9


def _disagreement(folder: Path) -> None:
    def change(message: pb.VIMap) -> None:
        store = next(v.landmark_store for v in message.vertices if v.landmark_store.landmarks)
        landmark = next(lm for lm in store.landmarks if lm.keypoint_indices)
        landmark.keypoint_indices[0] += 1

    rewritten(folder, "vertices0", change)


def test_a_folder_that_is_none_is_told_from_one_without_a_map(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"nowhere: there is no such folder"):
        load_map(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for name in ("empty", "file"):
        with pytest.raises(MapError, match=rf"{name} is not a map: it has no vi_map/"):
            load_map(tmp_path / name)


def test_repair_keeps_what_both_sides_say(tmp_path: Path) -> None:
    folder = damaged_copy(tmp_path, _disagreement)
    vi_map, report = load_map(folder, repair=True)
    assert report.notes
    assert consistency.check_consistency(vi_map).failure == ""


def test_a_changed_byte_is_found_by_its_checksum(tmp_path: Path) -> None:
    save_map(load_map(data.shared_data(SUBMAP))[0], tmp_path / "map")
    path = tmp_path / "map/vi_map/sensors.yaml"
    path.write_text(path.read_text() + "\n# touched\n")
    with pytest.raises(MapError, match=r"sensors\.yaml"):
        load_map(tmp_path / "map")


def test_saving_refuses_what_it_must_not_replace(tmp_path: Path) -> None:
    vi_map, _ = load_map(data.shared_data(SUBMAP))
    save_map(vi_map, tmp_path / "map")
    with pytest.raises(UserError, match="--overwrite"):
        save_map(vi_map, tmp_path / "map")
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").write_text("precious")
    with pytest.raises(UserError, match="not a map"):
        save_map(vi_map, tmp_path / "other", overwrite=True)
    assert (tmp_path / "other/file").read_text() == "precious"


def test_same_map_same_bytes_and_resources_stay(tmp_path: Path) -> None:
    vi_map, _ = load_map(data.shared_data(SUBMAP))
    save_map(vi_map, tmp_path / "map")
    resource = tmp_path / "map/resources/raw_images/a.pgm"
    resource.parent.mkdir(parents=True)
    resource.write_bytes(b"P5")
    before = {p.name: p.read_bytes() for p in (tmp_path / "map/vi_map").iterdir()}
    save_map(vi_map, tmp_path / "map", overwrite=True)
    assert {p.name: p.read_bytes() for p in (tmp_path / "map/vi_map").iterdir()} == before
    assert resource.read_bytes() == b"P5"


def test_what_else_lies_in_the_folder_stays(tmp_path: Path) -> None:
    vi_map, _ = load_map(data.shared_data(SUBMAP))
    folder = tmp_path / "map"
    save_map(vi_map, folder)
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk/a.pgm").write_bytes(b"P5")
    (folder / "resources").symlink_to("../disk")
    (folder / "notes.txt").write_text("kitchen, second floor")
    save_map(vi_map, folder, overwrite=True)
    assert (folder / "resources").is_symlink()
    assert (folder / "resources/a.pgm").read_bytes() == b"P5"
    assert (folder / "notes.txt").read_text() == "kitchen, second floor"
    (folder / "notes.txt").write_text("changed")
    assert load_map(folder)[1].notes == []


def test_the_fingerprint_stands_for_the_content(tmp_path: Path) -> None:
    vi_map, _ = load_map(data.shared_data(SUBMAP))
    first = save_map(vi_map, tmp_path / "a").fingerprint
    assert save_map(vi_map, tmp_path / "b").fingerprint == first
    assert disk_copy(tmp_path / "a").fingerprint == first
    (tmp_path / "a/vi_map/sensors.yaml").write_text("sensors: []\n")
    assert disk_copy(tmp_path / "a").fingerprint != first
    with pytest.raises(UserError, match="--force"):
        save_map(vi_map, tmp_path / "a", overwrite=True, known=first)
    assert save_map(vi_map, tmp_path / "a", known=first, force=True).fingerprint == first


@pytest.mark.skipif(os.name != "posix", reason="the lock is a POSIX one")
def test_the_second_program_that_saves_is_told(tmp_path: Path) -> None:
    vi_map, _ = load_map(data.shared_data(SUBMAP))
    with replaced_folder(tmp_path / "map") as temporary:
        with pytest.raises(UserError, match="another program is saving"):
            save_map(vi_map, tmp_path / "map")
        (temporary / "file").write_text("first")
    assert (tmp_path / "map/file").read_text() == "first"


def test_saving_says_once_that_maplab_does_not_know_a_model(tmp_path: Path) -> None:
    class Lines(SilentProgress):
        def __init__(self) -> None:
            self.lines: list[str] = []

        def line(self, text: str) -> None:
            self.lines.append(text)

    known, unknown = Lines(), Lines()
    radtan = (Projection.PINHOLE, Distortion.RADTAN)
    double_sphere = (Projection.DOUBLE_SPHERE, Distortion.NONE)
    save_map(scene.Scene(vertices=3, models=(radtan,)).make(), tmp_path / "a", progress=known)
    vi_map = scene.Scene(vertices=3, models=(radtan, double_sphere, double_sphere)).make()
    save_map(vi_map, tmp_path / "b", progress=unknown)
    assert known.lines == []
    assert unknown.lines == [
        "C++ maplab cannot load this map: it does not know the camera model double-sphere"
    ]
    loaded, _ = load_map(tmp_path / "b")
    assert set(differences(vi_map, loaded)) <= {"frames.present"}
