"""Uses of pycolmap: models in text, databases, and cameras that maplab lacks.

Some other functions of it abort a process that has imported cv2.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.cancellation import check_cancelled
from maplab_py.errors import MapError, MaplabError
from maplab_py.interop.colmap import model as colmap
from maplab_py.interop.colmap.records import binary_files
from maplab_py.output_files import copy_file
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType
from maplab_py.vimap.table import starts_of_counts

DATABASE = "database.db"
_MAX_GAP = 50
"""Pairs of images are matched up to this many observations of a landmark apart."""
_MIN_MATCHES = 15
"""COLMAP's least number of inliers of a pair."""


def write_text_model(
    model: colmap.ColmapModel, work: Path, folder: Path, *, overwrite: bool = False
) -> None:
    """Write the text files of a model; `work` is an empty folder.

    Raises:
        MapError: pycolmap fails.
        UserError: A file exists and `overwrite` is not set, or cannot be written.
    """
    with _library(f"{folder}: the model cannot be written as text: give --colmap_format=binary"):
        _reconstruction(model, work).write_text(work)
    for kind in colmap.FILES:
        copy_file(work / f"{kind}.txt", folder / f"{kind}.txt", overwrite=overwrite)


def rays_of(camera: colmap.ColmapCamera, uv: F64) -> F64:
    """Return the rays (K, 2) of pixels (K, 2) on the z = 1 plane, NaN where there is none.

    Raises:
        MapError: pycolmap fails.
    """
    failure = f"camera {camera.id} cannot be undistorted: let COLMAP do it (image_undistorter)"
    size = {"width": camera.width_px, "height": camera.height_px}
    with _library(failure) as pycolmap:
        name, params = colmap.MODELS[camera.model].name, camera.parameters.tolist()
        lens = pycolmap.Camera(model=name, params=params, **size)
        return np.asarray(lens.cam_from_img(uv), dtype=np.float64).reshape(-1, 2)


def write_database(
    model: colmap.ColmapModel,
    vi_map: VIMap,
    frames: I64,
    keypoints: I64,
    folder: Path,
    *,
    has_priors: bool,
) -> None:
    """Write `database.db` into a folder for temporary files: keypoints, descriptors, matches and priors.

    Args:
        frames: Rows (N,) of the images in the map.
        keypoints: Rows (K,) of their keypoints.

    Raises:
        MapError: pycolmap fails.
    """
    with _library(f"{DATABASE} cannot be written: leave out --colmap_database") as pycolmap:
        content = _reconstruction(model, folder)
        store = pycolmap.Database.open(folder / DATABASE)
        with pycolmap.DatabaseTransaction(store):
            for camera in content.cameras.values():
                store.write_camera(camera, use_camera_id=True)
            for rig in content.rigs.values():
                store.write_rig(rig, use_rig_id=True)
            for frame in content.frames.values():
                store.write_frame(frame, use_frame_id=True)
            for image in sorted(content.images.values(), key=lambda entry: entry.image_id):
                store.write_image(image, use_image_id=True)
            _write_features(pycolmap, store, model.images, vi_map, frames, keypoints)
            _write_matches(pycolmap, store, model.images)
            for image in content.images.values() if has_priors else ():
                prior = pycolmap.PosePrior()
                prior.corr_data_id, prior.position = image.data_id, image.projection_center()
                prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
                store.write_pose_prior(prior)
        store.close()


@contextlib.contextmanager
def _library(failure: str) -> Iterator[Any]:
    """Give pycolmap, and raise what it refuses as a MapError."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield pycolmap
    except MaplabError:
        raise
    except OSError as error:
        raise MapError(f"{failure.partition(':')[0]}: {error.strerror or error}") from error
    except Exception as error:  # the library's own, of any type
        raise MapError(failure) from error


def _reconstruction(model: colmap.ColmapModel, folder: Path) -> Any:
    import pycolmap

    for name, content in binary_files(model).items():
        with (folder / name).open("wb") as stream:
            stream.writelines(content)
    return pycolmap.Reconstruction(folder)


def _write_features(
    pycolmap: Any, store: Any, images: colmap.ColmapImages, vi_map: VIMap, frames: I64, rows: I64
) -> None:
    """Write keypoints: x, y, scale, orientation (0); an image with several kinds of descriptors gets none."""
    table, kinds = vi_map.keypoints, pycolmap.FeatureExtractorType
    keypoints = np.zeros((len(images.uv), 4), dtype=np.float32)
    scale = table.scale[rows]
    keypoints[:, :2], keypoints[:, 2] = images.uv, np.where(scale > 0.0, scale, 1.0)
    blocks = vi_map.frames.descriptor_blocks[frames]
    start = images.keypoint_start.tolist()
    for row, image in enumerate(images.id.tolist()):
        check_cancelled()
        part = slice(start[row], start[row + 1])
        store.write_keypoints(image, keypoints[part])
        stored = {block[1:] for block in blocks[row] or () if block.keypoints}
        if len(stored) == 1:
            width, *kind = stored.pop()
            is_sift = kind == [DescriptorDepth.UINT8, FeatureType.SIFT]
            data = np.ascontiguousarray(table.descriptor[rows[part], :width])
            kind_of_colmap = kinds.SIFT if is_sift else kinds.UNDEFINED
            store.write_descriptors(image, pycolmap.FeatureDescriptors(kind_of_colmap, data))


def _write_matches(pycolmap: Any, store: Any, images: colmap.ColmapImages) -> None:
    """Write matches: keypoints that observe the same landmark; pairs with few of them are left out."""
    observing = np.flatnonzero(images.point != colmap.NO_POINT)
    observing = observing[np.argsort(images.point[observing], kind="stable")]
    point, image = images.point[observing], images.keypoint_image[observing]
    keypoint = observing - images.keypoint_start[image]
    parts = [np.zeros((0, 4), dtype=np.int64)]
    for gap in range(1, _MAX_GAP + 1):
        a = np.flatnonzero(point[gap:] == point[:-gap])
        if not len(a):
            break
        a = a[image[a] != image[a + gap]]
        parts.append(np.stack([image[a], image[a + gap], keypoint[a], keypoint[a + gap]], axis=1))
    table = np.concatenate(parts)
    table = table[np.lexsort((table[:, 3], table[:, 2], table[:, 1], table[:, 0]))]
    pairs, count = np.unique(table[:, :2], axis=0, return_counts=True)
    start = starts_of_counts(count).tolist()
    for row in np.flatnonzero(count >= _MIN_MATCHES).tolist():
        check_cancelled()
        first, second = images.id[pairs[row]].tolist()
        matches = table[start[row] : start[row + 1], 2:].astype(np.uint32)
        store.write_matches(first, second, matches)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = matches
        store.write_two_view_geometry(first, second, geometry)
