"""Jobs for pycolmap, in a process of their own.

Some functions of pycolmap abort a process that has imported cv2; nothing here imports it. A job reads and
writes files in its folder.
"""

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.child_processes import serve

BINARY, TEXT = "binary", "text"
"""Folders of models below the folder of a job."""


def write_text(folder: Path) -> None:
    """Convert the model in the folder `binary` to text."""
    import pycolmap

    (folder / TEXT).mkdir()
    pycolmap.Reconstruction(folder / BINARY).write_text(folder / TEXT)


def undistort(folder: Path) -> None:
    """Undistort pixels: of `pixels.npz`, uv (K, 2) and start (C + 1,) by camera of the model `binary`.

    Writes `undistorted.npz`: rays (K, 2) on the z = 1 plane, NaN where there is none.
    """
    import pycolmap

    with np.load(folder / "pixels.npz", allow_pickle=False) as pixels:
        uv, start, cameras = pixels["uv"], pixels["start"], pixels["cameras"]
    model = pycolmap.Reconstruction(folder / BINARY)
    rays = np.full(uv.shape, np.nan)
    for row, camera in enumerate(cameras.tolist()):
        part = slice(start[row], start[row + 1])
        rays[part] = np.asarray(model.camera(camera).cam_from_img(uv[part])).reshape(-1, 2)
    np.savez(folder / "undistorted.npz", rays=rays)


def database(folder: Path) -> None:
    """Write `database.db`: the model `binary`, and of `database.npz` descriptors, matches, and priors."""
    import pycolmap

    with np.load(folder / "database.npz", allow_pickle=False) as file:
        extra = {name: file[name] for name in file.files}
    model = pycolmap.Reconstruction(folder / BINARY)
    store = pycolmap.Database.open(folder / "database.db")
    with pycolmap.DatabaseTransaction(store):
        for camera in model.cameras.values():
            store.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            store.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            store.write_frame(frame, use_frame_id=True)
        for image in sorted(model.images.values(), key=lambda entry: entry.image_id):
            store.write_image(image, use_image_id=True)
        _write_features(store, extra)
        _write_matches(store, extra)
        if "priors" in extra:
            _write_priors(store, model)
    store.close()


def _write_features(store: Any, extra: dict[str, Any]) -> None:
    import pycolmap

    start = extra["keypoint_start"]
    kinds = pycolmap.FeatureExtractorType
    for row, image in enumerate(extra["images"].tolist()):
        part = slice(start[row], start[row + 1])
        store.write_keypoints(image, extra["keypoints"][part])
        width = int(extra["descriptor_bytes"][row])
        if width:
            kind = kinds.SIFT if extra["is_sift"][row] else kinds.UNDEFINED
            data = np.ascontiguousarray(extra["descriptors"][part, :width])
            store.write_descriptors(image, pycolmap.FeatureDescriptors(kind, data))


def _write_matches(store: Any, extra: dict[str, Any]) -> None:
    import pycolmap

    start = extra["match_start"]
    for row, (first, second) in enumerate(extra["pairs"].tolist()):
        matches = extra["matches"][start[row] : start[row + 1]]
        store.write_matches(first, second, matches)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = matches
        store.write_two_view_geometry(first, second, geometry)


def _write_priors(store: Any, model: Any) -> None:
    import pycolmap

    for image in model.images.values():
        prior = pycolmap.PosePrior()
        prior.corr_data_id = image.data_id
        prior.position = image.projection_center()
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        store.write_pose_prior(prior)


JOBS = {job.__name__: job for job in (write_text, undistort, database)}


def _answer(request: tuple[str, Path]) -> tuple[str, str]:
    """Run a job on a folder; return what the disk said, and what pycolmap said, empty = nothing."""
    name, folder = request
    try:
        JOBS[name](folder)
    except OSError as error:
        return error.strerror or str(error), ""
    except Exception as error:  # noqa: BLE001  (pycolmap raises its own types)
        return "", f"{type(error).__name__}: {error}"
    return "", ""


if __name__ == "__main__":
    serve(_answer)
