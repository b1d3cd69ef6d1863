"""Damaged files and entries that are no numbers: one line with file and field, or repaired."""

import gzip
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status, status_of
from maplab_py.errors import MapError
from maplab_py.storage import map_saving
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.protobuf import ids, scan, scan_kernel
from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_consistency, check_saved
from maplab_py.vimap.number_repair import without_bad_numbers
from maplab_py.warmup import jobs
from tests.e2e.support import run_program
from tests.interop.small_map import VERTICES
from tests.interop.small_map import make_map as rootless_map
from tests.storage import damages, damaging
from tests.support.data import REPOSITORY


@pytest.fixture(scope="session")
def whole_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "map"
    damaging.write_whole_map(folder)
    return folder


@pytest.fixture
def folder(whole_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole_map, tmp_path / "map"))


def test_the_map_itself_is_whole(whole_map: Path) -> None:
    vi_map, report = load_map(whole_map, max_size_megabytes=damaging.BOUND_MEGABYTES)
    assert report.notes == []
    assert check_consistency(vi_map).failure == ""
    assert len(damages.DAMAGES) >= 79


@pytest.mark.parametrize("name", damages.DAMAGES)
def test_damage_is_told_in_one_line(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ids, "_WORTH_A_KERNEL", 0)  # as in large maps
    damage = damages.DAMAGES[name]
    damage.apply(folder)
    session = Session()
    session.run("create_new_map", map_key="earlier")
    before = session.maps.state
    megabytes = {"proto_max_size_megabytes": damaging.BOUND_MEGABYTES}
    if damage.is_note:
        session.run("load", map_folder=folder, **megabytes)
        _, report = load_map(folder)
        said = "\n".join(report.notes)
        assert len(report.notes) == 1
    else:
        with pytest.raises(MapError) as error:
            session.run("load", map_folder=folder, **megabytes)
        assert status_of(error.value) is Status.USER_ERROR
        assert session.maps.state is before
        said = str(error.value)
        assert "\n" not in said
        assert str(folder / damage.file) in said
    for part in damage.said:
        assert part in said


@pytest.mark.parametrize("members", [2, 5])
def test_all_members_of_a_gzip_file_are_read(folder: Path, members: int) -> None:
    path = folder / "vi_map/edges0"
    whole = load_map(folder)[0]
    data = gzip.decompress(path.read_bytes())
    step = -(-len(data) // members)
    parts = [gzip.compress(data[k : k + step]) for k in range(0, len(data), step)]
    path.write_bytes(b"".join(parts))
    vi_map = load_map(folder)[0]
    assert len(parts) == members
    assert vi_map.imu_edges.id.tolist() == whole.imu_edges.id.tolist()
    assert vi_map.imu_samples.accel_gyro.tolist() == whole.imu_samples.accel_gyro.tolist()


@pytest.mark.parametrize(
    "name",
    [
        "a vertex that lists an edge that is not there",
        "a vertex that lists an edge of another",
        "landmark seen at a keypoint that is not there",
        "index entry lost",
    ],
)
def test_what_repair_is_advised_for_it_repairs(folder: Path, tmp_path: Path, name: str) -> None:
    damages.DAMAGES[name].apply(folder)
    vi_map, report = load_map(folder, repair=True)
    assert len(report.notes) == 1
    assert check_consistency(vi_map).failure == ""
    save_map(vi_map, tmp_path / "repaired")
    assert load_map(tmp_path / "repaired")[1].notes == []


@pytest.mark.parametrize("name", ["m" * 255, "/".join(["deep" * 60] * 12)])
def test_maps_with_long_names_are_loaded(whole_map: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    shutil.copytree(whole_map, folder)
    assert load_map(folder)[1].notes == []


@pytest.mark.parametrize("name", ["m" * 256, "/".join(["deep" * 60] * 30)])
def test_names_that_no_file_can_have_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(MapError, match=r"cannot be read \(File name too long\)$"):
        load_map(tmp_path / name)


_IN_THE_PROGRAM = [
    "T_M_I with NaN",
    "edge without kind",
    "edges0 with rubbish behind",
    "listing with files misspelt",
    "imu stamps that run backwards",
    "vertices0 of zero bytes",
    "sensors.yaml with an alias bomb",
    "resource_info a bomb",
]


def test_the_program_says_it_and_keeps_its_maps(whole_map: Path, tmp_path: Path) -> None:
    lines = [f"load --map_folder={whole_map} --map_key=earlier"]
    for number, name in enumerate(_IN_THE_PROGRAM):
        folder = tmp_path / f"damaged_{number}"
        shutil.copytree(whole_map, folder)
        damages.DAMAGES[name].apply(folder)
        lines.append(f"load {folder} --proto_max_size_megabytes={damaging.BOUND_MEGABYTES}")
    (tmp_path / "script").write_text("\n".join([*lines, "list"]))
    done = run_program(tmp_path, "run", "script", "--keep_going")
    assert done.returncode == Status.USER_ERROR
    assert "Traceback" not in done.stderr + done.stdout
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: load: ")]
    for number, (name, error) in enumerate(zip(_IN_THE_PROGRAM, errors, strict=True)):
        assert str(tmp_path / f"damaged_{number}") in error
        assert all(part in error for part in damages.DAMAGES[name].said)
    (listed,) = [line for line in done.stdout.splitlines() if " saved " in line]
    assert listed.startswith("earlier")


_MEASURE = """
import resource, sys
from pathlib import Path
from maplab_py.errors import MapError
from maplab_py.storage.native import load_map
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
load_map(Path(sys.argv[1]))
before = peak()
try:
    load_map(Path(sys.argv[2]), max_size_megabytes=int(sys.argv[3]))
    print("loaded", peak() - before)
except MapError as error:
    print("refused" if "proto_max_size" in str(error) else error, peak() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs the peak of memory")
@pytest.mark.parametrize("megabytes", [40])
@pytest.mark.parametrize("name", damages.BOMB_ENTRIES)
def test_a_bomb_takes_at_most_twice_the_bound(
    whole_map: Path, folder: Path, name: str, megabytes: int
) -> None:
    file, entry, wrappers = damages.BOMB_ENTRIES[name]
    size = megabytes * 900_000  # below the bound: only the entries tell
    (folder / "vi_map" / file).write_bytes(damaging.zeros(entry, size, *wrappers))
    done = subprocess.run(
        [sys.executable, "-c", _MEASURE, whole_map, folder, str(megabytes)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    verdict, peak_bytes = done.stdout.split()
    assert verdict == "refused"
    assert int(peak_bytes) < 2 * megabytes * 1_000_000


def test_many_files_are_charged_what_they_take(whole_map: Path) -> None:
    """Quick estimates that do not fit together give way to the exact ones."""
    path = whole_map / "vi_map/vertices0"
    data = gzip.decompress(path.read_bytes())
    exact, quick = scan.estimate(data, pb.VIMap.DESCRIPTOR), scan.quick_estimate(data)
    assert exact < quick
    budget = scan.MemoryBudget(5 * exact)
    for _ in range(10):
        budget.admit(path, data, pb.VIMap.DESCRIPTOR)
    with pytest.raises(MapError, match="vertices0: its entries need more than"):
        budget.admit(path, data, pb.VIMap.DESCRIPTOR)


_AS_SOMEBODY_ELSE = """
import os, sys
from pathlib import Path
from maplab_py.errors import MapError
from maplab_py.storage.native import load_map
if os.geteuid() == 0: os.setresuid(65534, 65534, 65534)
try: load_map(Path(sys.argv[1]))
except MapError as error: print(error)
"""


@pytest.mark.skipif(not hasattr(os, "setresuid"), reason="root must become somebody else")
@pytest.mark.parametrize("name", ["vi_map", "vi_map/vi_map_metadata", "vi_map/vertices0"])
def test_what_may_not_be_read_is_named_in_one_line(folder: Path, name: str) -> None:
    temporary = Path(tempfile.gettempdir()).resolve()
    parents = [parent for parent in folder.parents if temporary in parent.parents]
    for parent in (folder, folder / "vi_map", *parents):
        parent.chmod(0o755)
    mode = (folder / name).stat().st_mode
    (folder / name).chmod(0)
    done = subprocess.run(
        [sys.executable, "-c", _AS_SOMEBODY_ELSE, str(folder)],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
    )  # fmt: skip
    (folder / name).chmod(mode)
    (line,) = done.stdout.splitlines()
    assert line.startswith(str(folder / name))
    assert "cannot be read (Permission denied)" in line
    assert done.stderr == ""


def test_the_warmup_compiles_the_scan_of_messages_once_for_all() -> None:
    jobs()["message scan"]()
    signatures = list(scan_kernel.count_parts.signatures)
    assert len(signatures) == 1
    data = pb.VIMapMetadata(files=[pb.FileTypeWithPath(path="a")]).SerializeToString()
    assert scan.estimate(data, pb.VIMapMetadata.DESCRIPTOR) > 0
    assert scan.estimate(bytearray(data), pb.VIMapMetadata.DESCRIPTOR) > 0
    assert list(scan_kernel.count_parts.signatures) == signatures


PLACES = [
    ("landmarks", "p_I", "1 landmark without finite numbers dropped"),
    ("vertices", "T_M_I", "1 vertex without finite numbers dropped"),
    ("vertices", "v_M", "1 vertex with a v_M that is no number set to zero"),
    ("vertices", "gyro_bias", "1 vertex with a gyro_bias that is no number set to zero"),
    ("keypoints", "uv_px", "1 keypoint without finite numbers dropped"),
    ("baseframes", "T_G_M", "1 base frame without a finite pose taken as unknown"),
]


def make_map() -> VIMap:
    vi_map = rootless_map()
    return vi_map.replace(
        missions=vi_map.missions.replace(root_vertex=np.array([0, VERTICES], dtype=np.int32))
    )


def with_value(vi_map: VIMap, field: str, name: str, value: Any, row: int = 1) -> VIMap:
    table: Any = getattr(vi_map, field)
    values = np.array(table.columns()[name], dtype=np.float64)
    values[row] = values[row] * value
    return vi_map.replace(**{field: table.replace(**{name: values})})


def save_unchecked(vi_map: VIMap, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Save what other programs, and older versions, saved."""
    with monkeypatch.context() as patch:
        patch.setattr(map_saving, "check_loadable", lambda *_: None)
        save_map(vi_map, folder)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("field", "name", "said"), PLACES)
def test_save_refuses_what_load_refuses_and_both_repair(
    field: str, name: str, said: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with np.errstate(invalid="ignore"):
        bad = with_value(make_map(), field, name, value)
        bad = with_value(bad, field, name, np.nan)
    with pytest.raises(MapError, match=r"not saved.*non-finite.*--repair") as caught:
        save_map(bad, tmp_path / "refused")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "refused").exists()
    save_unchecked(bad, tmp_path / "other", monkeypatch)
    with pytest.raises(MapError, match=r"not a number; load with --repair"):
        load_map(tmp_path / "other")
    repaired, report = load_map(tmp_path / "other", repair=True)
    assert said in report.notes
    assert check_saved(repaired) == []
    assert said in save_map(bad, tmp_path / "repaired", repair=True).notes
    again, report = load_map(tmp_path / "repaired")
    assert len(again.vertices) == len(repaired.vertices)
    np.testing.assert_array_equal(again.landmarks.id, repaired.landmarks.id)


@pytest.mark.parametrize("factor", [1.1, 1e200])
def test_quaternions_of_another_length_are_scaled(
    factor: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vi_map = make_map()
    bad = with_value(vi_map, "vertices", "T_M_I", np.array([factor] * 4 + [1.0] * 3))
    with pytest.raises(MapError, match="not of unit length"):
        save_map(bad, tmp_path / "map")
    save_unchecked(bad, tmp_path / "map", monkeypatch)
    with pytest.raises(MapError, match=r"has length .*, not 1"):
        load_map(tmp_path / "map")
    repaired, report = load_map(tmp_path / "map", repair=True)
    assert "1 quaternion of vertices scaled to unit length" in report.notes
    np.testing.assert_allclose(repaired.vertices.T_M_I, vi_map.vertices.T_M_I, atol=1e-12)


def test_references_and_ids_are_checked_before_saving(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="mission without root vertex"):
        save_map(rootless_map(), tmp_path / "a")
    vi_map = make_map()
    vertex = vi_map.landmarks.vertex.copy()
    vertex[0] = len(vi_map.vertices)
    with pytest.raises(MapError, match="landmark without store vertex"):
        save_map(vi_map.replace(landmarks=vi_map.landmarks.replace(vertex=vertex)), tmp_path / "a")
    ids = vi_map.landmarks.id.copy()
    ids[1] = ids[0]
    with pytest.raises(MapError, match="landmark id that occurs twice"):
        save_map(vi_map.replace(landmarks=vi_map.landmarks.replace(id=ids)), tmp_path / "a")


def test_a_sound_map_stays_what_it_is(tmp_path: Path) -> None:
    vi_map = make_map()
    same, notes = without_bad_numbers(vi_map)
    assert notes == []
    assert same.landmarks is vi_map.landmarks
    assert save_map(vi_map, tmp_path / "map", repair=True).notes == ()


def test_a_mission_without_any_pose_goes() -> None:
    vi_map = make_map()
    T = vi_map.vertices.T_M_I.copy()
    T[vi_map.vertices.mission == 1] = np.nan
    left, notes = without_bad_numbers(vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T)))
    assert len(left.missions) == 1
    assert any("vertices without finite numbers dropped" in note for note in notes)
    assert check_saved(left) == []
