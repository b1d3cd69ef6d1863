"""Models as other people have them: names with blanks, changed poses, other databases, many models."""

import dataclasses
import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.colmap import exporting, reading
from maplab_py.interop.colmap.features import SCALED, UNDISTORTED, agreement
from maplab_py.interop.colmap.importing import import_colmap
from maplab_py.interop.colmap.model import FILE_NAME
from maplab_py.interop.colmap.options import ColmapExportOptions, ColmapImportOptions
from tests.interop.colmap.test_round_trip import PINHOLES, Scene

ORDER = ColmapImportOptions(timestamps_from="order")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Text model of two cameras, with a database and without side file."""
    folder = tmp_path_factory.mktemp("model")
    options = ColmapExportOptions(quality="all", colmap_format="text", colmap_database=True)
    vi_map = Scene(missions=1, vertices=8, models=PINHOLES[:2], landmarks=150).make()
    exporting.export_colmap(vi_map, folder, options)
    (folder / FILE_NAME).unlink()
    return folder


@pytest.fixture
def copy(model: Path, tmp_path: Path) -> Path:
    shutil.copytree(model, tmp_path / "copy")
    return tmp_path / "copy"


def edit_images(folder: Path, change: object) -> None:
    """Change the words of the image lines of images.txt."""
    path, lines, is_image = folder / "images.txt", [], True
    for line in path.read_text().splitlines():
        if line.startswith("#"):
            lines.append(line)
            continue
        lines.append(" ".join(change(line.split())) if is_image else line)  # type: ignore[operator]
        is_image = not is_image
    path.write_text("\n".join(lines) + "\n")


def edit_keypoints(database: Path, change: object) -> None:
    with sqlite3.connect(database) as store:
        rows = store.execute("SELECT image_id, rows, cols, data FROM keypoints").fetchall()
        for image, count, columns, data in rows:
            values = np.frombuffer(data, dtype="<f4").reshape(count, columns).copy()
            changed = np.asarray(change(values), dtype="<f4")  # type: ignore[operator]
            store.execute(
                "UPDATE keypoints SET data = ? WHERE image_id = ?", (changed.tobytes(), image)
            )


def test_names_keep_their_blanks(copy: Path) -> None:
    before = reading.read_model(copy).images.name
    edit_images(copy, lambda w: [*w[:9], f"Phone of A. Müller/IMG  {w[0]} (1).png"])
    named = reading.read_model(copy)
    assert named.images.name == tuple(
        f"Phone of A. Müller/IMG  {number} (1).png" for number in named.images.id.tolist()
    )
    assert len(set(named.images.name)) == len(before)
    assert len(import_colmap(copy, ORDER)[0].frames) == len(before)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 1 0 0", r"images\.txt:\d+: is damaged: wants IMAGE_ID QW"),
        ("1 x 0 0 0 0 0 0 1 a.png", r"images\.txt:\d+: is damaged: wants IMAGE_ID QW"),
        ("1 1 0 0 0 0 0 0 1", r"images\.txt:\d+: is damaged: wants IMAGE_ID QW"),
        (
            "1 0 0 0 0 0 0 0 1 a.png",
            r"images\.txt:\d+: is damaged: it has a quaternion that is not",
        ),
        ("1 nan 0 0 0 0 0 0 1 a.png", r"images\.txt:\d+: is damaged: .* not finite"),
        ("1 1 0 0 0 0 0 0 1 a.png\n1 2", r"images\.txt:\d+: is damaged: wants X Y POINT3D_ID"),
    ],
)
def test_lines_that_are_no_image_are_named(copy: Path, line: str, reason: str) -> None:
    path = copy / "images.txt"
    path.write_text(path.read_text() + line + "\n\n")
    with pytest.raises(MapError, match=reason):
        import_colmap(copy, ORDER)


def test_a_fault_names_the_text_file_and_the_line(copy: Path) -> None:
    path = copy / "cameras.txt"
    lines = path.read_text().splitlines()
    words = lines[-1].split()
    path.write_text("\n".join([*lines[:-1], " ".join([*words[:2], "0", *words[3:]]), ""]))
    with pytest.raises(
        MapError, match=rf"^{path}:\d+: is damaged: the images of camera \d+ have no pixels"
    ):
        reading.read_model(copy)


def test_quaternions_of_any_length_are_read(copy: Path) -> None:
    for name in ("rigs", "frames"):
        (copy / f"{name}.txt").unlink()
    before = reading.read_model(copy).images.T_C_W
    edit_images(copy, lambda w: [w[0], *(str(2.0 * float(q)) for q in w[1:5]), *w[5:]])
    np.testing.assert_allclose(reading.read_model(copy).images.T_C_W, before, atol=1e-12)


@pytest.mark.parametrize("kind", ["cameras", "points3D", "frames", "rigs"])
def test_no_text_of_the_library_reaches_the_user(copy: Path, kind: str) -> None:
    path = copy / f"{kind}.txt"
    path.write_text(path.read_text() + "1 SOMETHING x y z\n")
    with pytest.raises(MapError) as caught:
        import_colmap(copy, ORDER)
    message = str(caught.value)
    assert "copy or write the model again" in message
    for word in ("pycolmap", ".cc", "Check failed", "Error:", "write_binary"):
        assert word not in message


def test_changed_poses_of_images_are_named_and_taken(copy: Path) -> None:
    plain, report = import_colmap(copy, ORDER)
    assert not any("differ" in note for note in report.notes)
    turn = so3.exp([0.0, np.deg2rad(20.0), 0.0])

    def turned(words: list[str]) -> list[str]:
        if words[0] != "1":
            return words
        w, x, y, z = map(float, words[1:5])
        q = so3.multiply(turn, [x, y, z, w])
        return [words[0], *(f"{v:.17g}" for v in q[[3, 0, 1, 2]]), *words[5:]]

    edit_images(copy, turned)
    changed, report = import_colmap(copy, ORDER)
    said = [note for note in report.notes if "differ" in note]
    assert len(said) == 1
    assert "1 image differ from those of rigs and frames by up to 20 deg" in said[0]
    assert "--colmap_poses=frames" in said[0]
    apart = np.linalg.norm(se3.local(plain.vertices.T_M_I, changed.vertices.T_M_I)[:, 3:], axis=1)
    assert np.count_nonzero(apart > 1e-3) == 1
    assert np.rad2deg(apart.max()) == pytest.approx(20.0, abs=1e-6)
    kept, report = import_colmap(copy, dataclasses.replace(ORDER, colmap_poses="frames"))
    np.testing.assert_allclose(kept.vertices.T_M_I, plain.vertices.T_M_I, atol=1e-12)
    assert any("those of the frames are taken" in note for note in report.notes)


def test_a_database_of_another_extraction_is_refused_by_image(copy: Path) -> None:
    database = copy / "database.db"
    plain, report = import_colmap(copy, ORDER, database=database)
    assert not any("database" in note for note in report.notes)
    edit_keypoints(database, lambda values: values[::-1])
    with pytest.raises(MapError, match=r"image .*\.png: the keypoints are not those of the model"):
        import_colmap(copy, ORDER, database=database)
    edit_keypoints(database, lambda values: np.roll(values[::-1], 3, axis=0))
    with pytest.raises(MapError, match="another extraction"):
        import_colmap(copy, ORDER, database=database)
    np.testing.assert_array_equal(
        plain.keypoints.uv_px, import_colmap(copy, ORDER)[0].keypoints.uv_px
    )


@pytest.mark.parametrize("count", [12, 300])
def test_keypoints_agree_up_to_distortion(count: int) -> None:
    uv = np.random.default_rng(4).uniform(0.0, 600.0, (count, 2))
    centred = (uv - 300.0) / 300.0
    bent = centred * (1.0 - 0.08 * np.sum(centred**2, axis=1, keepdims=True)) * 300.0 + 300.0
    assert agreement(bent, uv) == (1.0, UNDISTORTED)
    assert agreement(uv, uv + 0.01) == (1.0, "")
    assert agreement(bent[::-1], uv)[1] is None
    assert agreement(np.random.default_rng(5).uniform(0.0, 600.0, (count, 2)), uv)[1] is None
    ratio, kind = agreement(uv * (2.0, 4.0) + 0.5, uv)
    assert kind == SCALED
    assert ratio == pytest.approx(np.sqrt(1.0 / 8.0))


def test_scaled_and_undistorted_keypoints_belong_to_the_model(copy: Path, tmp_path: Path) -> None:
    database = copy / "database.db"
    plain, _ = import_colmap(copy, ORDER, database=database)
    shutil.copy(database, tmp_path / "scaled.db")
    edit_keypoints(tmp_path / "scaled.db", lambda v: np.hstack([2.0 * v[:, :2], v[:, 2:]]))
    scaled, report = import_colmap(copy, ORDER, database=tmp_path / "scaled.db")
    assert any("scaled against those of the database" in note for note in report.notes)
    np.testing.assert_allclose(scaled.keypoints.scale, 0.5 * plain.keypoints.scale, rtol=1e-5)

    def distorted(values: np.ndarray) -> np.ndarray:
        uv = (values[:, :2] - 300.0) / 300.0
        bent = uv * (1.0 - 0.1 * np.sum(uv**2, axis=1, keepdims=True))
        return np.hstack([bent * 300.0 + 300.0, values[:, 2:]])

    edit_keypoints(database, distorted)
    bent, report = import_colmap(copy, ORDER, database=database)
    assert any("undistorted against" in note for note in report.notes)
    np.testing.assert_array_equal(bent.keypoints.scale, plain.keypoints.scale)


def test_several_models_are_listed_with_what_they_have(tmp_path: Path) -> None:
    for number, (images, points) in enumerate([(12, 300), (404, 90_000), (2, 0)]):
        folder = tmp_path / "sparse" / str(number)
        folder.mkdir(parents=True)
        for kind, count in (("cameras", 1), ("images", images), ("points3D", points)):
            (folder / f"{kind}.bin").write_bytes(struct.pack("<Q", count))
    (tmp_path / "sparse" / "2" / "images.bin").unlink()
    (tmp_path / "sparse" / "3").mkdir()
    (tmp_path / "sparse" / "3" / "cameras.txt").write_text("# Number of cameras: 1\n")
    for folder, prefix in ((tmp_path, "sparse/"), (tmp_path / "sparse", "")):
        with pytest.raises(UserError) as caught:
            import_colmap(folder)
        message = str(caught.value)
        assert (
            f"{prefix}1 (404 images, 90000 points), {prefix}0 (12 images, 300 points), "
            f"{prefix}2 (incomplete: no images.bin), "
            f"{prefix}3 (incomplete: no images.txt, points3D.txt)"
        ) in message
        assert message.endswith(f"the largest is {tmp_path / 'sparse' / '1'}")
