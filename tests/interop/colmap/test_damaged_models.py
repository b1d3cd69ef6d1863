"""Models that are cut, damaged, or do not fit: one line, and no map."""

import dataclasses
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.colmap.exporting import export_colmap, model_of_map
from maplab_py.interop.colmap.importing import import_colmap
from maplab_py.interop.colmap.model import FILE_NAME, FILES, ColmapModel
from maplab_py.interop.colmap.options import ColmapExportOptions, ColmapImportOptions
from maplab_py.interop.colmap.records import binary_files
from maplab_py.vimap import VIMap
from tests.support.scene import Scene


@pytest.fixture(scope="module")
def vi_map() -> VIMap:
    return Scene(vertices=4, landmarks=30).make()


@pytest.fixture(scope="module")
def model(vi_map: VIMap) -> ColmapModel:
    return model_of_map(vi_map, quality="all").model


@pytest.fixture(scope="module")
def binary(vi_map: VIMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("binary")
    export_colmap(vi_map, folder, ColmapExportOptions(colmap_database=True))
    return folder


@pytest.fixture(scope="module")
def text(vi_map: VIMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("text")
    export_colmap(vi_map, folder, ColmapExportOptions(colmap_format="text"))
    return folder


def one_line(error: pytest.ExceptionInfo[Exception]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("kind", FILES)
def test_binary_files_cut_anywhere(binary: Path, tmp_path: Path, kind: str) -> None:
    shutil.copytree(binary, tmp_path / "cut")
    path = tmp_path / "cut" / f"{kind}.bin"
    data = path.read_bytes()
    for size in {0, 3, 8, *np.linspace(9, len(data) - 1, 25).astype(int).tolist()}:
        path.write_bytes(data[:size])
        with pytest.raises(MapError, match="ends too early") as error:
            import_colmap(tmp_path / "cut")
        assert str(path) in one_line(error)
    path.write_bytes(data + b"\0")
    with pytest.raises(MapError, match="1 bytes follow its last record"):
        import_colmap(tmp_path / "cut")
    path.unlink()
    with pytest.raises(MapError, match=f"cannot read .*{kind}.bin"):
        import_colmap(tmp_path / "cut")


@pytest.mark.parametrize("kind", ["cameras", "images", "points3D"])
def test_text_files_cut_in_the_middle(text: Path, tmp_path: Path, kind: str) -> None:
    shutil.copytree(text, tmp_path / "cut")
    path = tmp_path / "cut" / f"{kind}.txt"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-2]))
    with pytest.raises(MapError) as error:
        import_colmap(tmp_path / "cut")
    assert str(tmp_path / "cut") in one_line(error)


def _with_images(model: ColmapModel, **columns: object) -> ColmapModel:
    return dataclasses.replace(model, images=dataclasses.replace(model.images, **columns))


def _twice_named(model: ColmapModel) -> ColmapModel:
    return _with_images(model, name=(model.images.name[0],) * len(model.images.name))


def _unknown_camera(model: ColmapModel) -> ColmapModel:
    cameras = tuple(dataclasses.replace(camera, id=99) for camera in model.cameras)
    return dataclasses.replace(model, cameras=cameras)


def _not_finite(model: ColmapModel) -> ColmapModel:
    return _with_images(model, uv=np.full_like(model.images.uv, np.nan))


def _same_point(model: ColmapModel) -> ColmapModel:
    ids = model.points.id.copy()
    ids[1] = ids[0]
    point = np.full_like(model.images.point, -1)
    points = dataclasses.replace(model.points, id=ids)
    return dataclasses.replace(_with_images(model, point=point), points=points)


def _unknown_model(model: ColmapModel) -> ColmapModel:
    return dataclasses.replace(
        model, cameras=(dataclasses.replace(model.cameras[0], model=77), *model.cameras[1:])
    )


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (_twice_named, "two images are called"),
        (_unknown_camera, "names camera 99, which is not there"),
        (_not_finite, "not finite"),
        (_same_point, "is there twice"),
        (_unknown_model, "unknown camera model 77"),
    ],
)
def test_what_does_not_fit_is_named(
    model: ColmapModel,
    tmp_path: Path,
    damage: Callable[[ColmapModel], ColmapModel],
    reason: str,
) -> None:
    for name, content in binary_files(damage(model)).items():
        (tmp_path / name).write_bytes(b"".join(content))
    if damage is _unknown_camera:
        (tmp_path / "cameras.bin").write_bytes(b"".join(binary_files(model)["cameras.bin"]))
    with pytest.raises(MapError, match=reason) as error:
        import_colmap(tmp_path)
    assert str(tmp_path) in one_line(error)


def test_camera_models_that_maplab_lacks(model: ColmapModel, tmp_path: Path) -> None:
    camera = model.cameras[0]
    prism = dataclasses.replace(
        camera,
        model=10,
        parameters=np.concatenate([camera.parameters[:4], np.zeros(8)]),
    )
    for name, content in binary_files(dataclasses.replace(model, cameras=(prism,))).items():
        (tmp_path / name).write_bytes(b"".join(content))
    with pytest.raises(UserError, match="no camera model THIN_PRISM_FISHEYE: give --undistort"):
        import_colmap(tmp_path)
    again, _ = import_colmap(tmp_path, ColmapImportOptions(undistort=True))
    assert len(again.vertices) == 4
    with pytest.raises(UserError, match="--undistort changes the cameras"):
        import_colmap(tmp_path, ColmapImportOptions(undistort=True, images="somewhere"))


def test_databases_that_do_not_fit(binary: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        import_colmap(binary, database=tmp_path / "none.db")
    (tmp_path / "bad.db").write_bytes(b"no database" * 100)
    with pytest.raises(MapError, match="is damaged or no database"):
        import_colmap(binary, database=tmp_path / "bad.db")
    shutil.copy(binary / "database.db", tmp_path / "other.db")
    with sqlite3.connect(tmp_path / "other.db") as store:
        store.execute("UPDATE keypoints SET data = x'00' WHERE image_id = 1")
    store.close()
    with pytest.raises(MapError, match="wrong size") as error:
        import_colmap(binary, database=tmp_path / "other.db")
    one_line(error)
    with sqlite3.connect(tmp_path / "other.db") as store:
        signalling_nan = b"\x01\x00\x80\x7f" * 2
        store.execute(
            "UPDATE keypoints SET rows = 1, cols = 2, data = ? WHERE image_id = 1",
            (signalling_nan,),
        )
    store.close()
    with np.errstate(invalid="raise"), pytest.raises(MapError, match="are no pixels"):
        import_colmap(binary, database=tmp_path / "other.db")
    with sqlite3.connect(tmp_path / "other.db") as store:
        store.execute("UPDATE images SET name = 'another' WHERE image_id = 1")
    store.close()
    with pytest.raises(MapError, match="name the database of this model"):
        import_colmap(binary, database=tmp_path / "other.db")


def test_side_files_that_are_damaged(binary: Path, tmp_path: Path) -> None:
    shutil.copytree(binary, tmp_path / "model")
    path = tmp_path / "model" / FILE_NAME
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises((MapError, UserError), match="delete it to import the model with new ids"):
        import_colmap(tmp_path / "model")


def test_times_and_flags(binary: Path, tmp_path: Path) -> None:
    shutil.copytree(binary, tmp_path / "model")
    (tmp_path / "model" / FILE_NAME).unlink()
    stamps = tmp_path / "stamps.txt"

    def refuse(reason: str, **flags: object) -> None:
        with pytest.raises((UserError, MapError), match=reason):
            import_colmap(tmp_path / "model", ColmapImportOptions(**flags))  # type: ignore[arg-type]

    refuse("give --timestamps_file", timestamps_from="file")
    stamps.write_text("a.png 12\n")
    refuse("has no time stamp of image", timestamps_from="file", timestamps_file=str(stamps))
    stamps.write_text("a.png twelve\n")
    refuse(":1: wants an image name", timestamps_from="file", timestamps_file=str(stamps))
    stamps.write_text("a.png 1\na.png 2\n")
    refuse("a.png is there twice", timestamps_from="file", timestamps_file=str(stamps))
    refuse("leave --scale and --gravity out", align_to="x", scale=2.0)
    refuse("wants a direction", gravity="down")
    refuse("metres per unit", scale=-1.0)
    refuse("has no image of the model", images=str(tmp_path))
    again, _ = import_colmap(
        tmp_path / "model", ColmapImportOptions(timestamps_from="order", order_interval_s=0.5)
    )
    assert np.diff(again.vertices.timestamp_ns).tolist() == [500_000_000] * 3
