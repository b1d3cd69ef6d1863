"""Descriptors and images of an imported model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import read_bytes
from maplab_py.interop.colmap.database_reading import SCALED, UNDISTORTED, ColmapDatabase
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.storage.new_resources import NewResources
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.queries import mission_sensor_id
from maplab_py.vimap.table import object_column

_RAW_GREY, _RAW_COLOUR = 0, 4
_MAX_IMAGE_BYTES = 1_000_000_000


def with_features(
    vi_map: VIMap, names: list[str], uv: F64, database: Path, *, progress: Progress = SILENT
) -> tuple[VIMap, list[str]]:
    """Return the map with the descriptors and scales of a database, and notes.

    Args:
        vi_map: Map.
        names: Name of the image of each frame (F).
        uv: Keypoints (K, 2) as the model has them.
        database: COLMAP's database.
        progress: Is told about every image.

    Raises:
        UserError: There is no such file.
        MapError: It does not fit the model, or is damaged.
    """
    store = ColmapDatabase(database)
    features = []
    try:
        start = vi_map.keypoint_start.tolist()
        for row, name in enumerate(names):
            progress.step(row, len(names), "descriptors")
            features.append(store.features(name, uv[start[row] : start[row + 1]]))
    finally:
        store.close()
    width = max((part.descriptor.shape[1] for part in features), default=0)
    descriptor: U8 = np.zeros((len(vi_map.keypoints), width), dtype=np.uint8)
    for start, part in zip(vi_map.keypoint_start.tolist(), features, strict=False):
        rows, columns = part.descriptor.shape
        descriptor[start : start + rows, :columns] = part.descriptor
    blocks = [(part.block,) if part.block is not None else None for part in features]
    frames = vi_map.frames.replace(descriptor_blocks=object_column(blocks))
    scale = np.concatenate([part.scale for part in features] or [np.zeros(0)])
    keypoints = vi_map.keypoints.replace(descriptor=descriptor, scale=scale)
    notes = [
        f"the keypoints of {counted(count, 'image')} are {kind} against those of the database"
        for kind in (SCALED, UNDISTORTED)
        if (count := sum(part.agreement == kind for part in features))
    ]
    return _with_landmark_types(vi_map.replace(frames=frames, keypoints=keypoints)), notes


def _with_landmark_types(vi_map: VIMap) -> VIMap:
    """Give each landmark the feature type of its first observation."""
    first = vi_map.observations[vi_map.observation_start[:-1]]
    kind = np.maximum(vi_map.feature_type[first], 0)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(feature_type=kind))


def with_images(
    vi_map: VIMap, names: list[str], folder: Path, *, link: bool, progress: Progress = SILENT
) -> tuple[VIMap, int]:
    """Return the map with the images of a folder as resources, and their number.

    Raises:
        UserError: The folder has none of the images.
        MapError: A file is no image, or has another size than its camera.
    """
    new = NewResources(seed=vi_map.missions.id.tobytes())
    rows, owners = [], []
    for frame, name in enumerate(names):
        progress.step(frame, len(names), "images")
        path = folder / name
        if path.is_file():
            rows.append(_add(new, vi_map, frame, path, link=link))
            owners.append(frame)
    if not rows:
        raise UserError(
            f"--images={folder}: has no image of the model, such as {names[0]}: name the folder that "
            "COLMAP's image names begin in"
        )
    return new.attached(vi_map, rows, owners), len(rows)


def _add(new: NewResources, vi_map: VIMap, frame: int, path: Path, *, link: bool) -> int:
    import cv2

    data = read_bytes(path, _MAX_IMAGE_BYTES, remedy="it is no image", error=MapError)
    image = (
        cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    )
    if image is None or image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise MapError(f"{path}: is no 8-bit grey or colour image")
    mission = int(vi_map.vertices.mission[vi_map.frames.vertex[frame]])
    rig = vi_map.sensors.camera_rig(mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA))
    camera = rig.cameras[int(vi_map.frames.camera_index[frame])]
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise MapError(
            f"{path}: has {image.shape[1]} x {image.shape[0]} pixels, and its camera {camera.width_px} x "
            f"{camera.height_px}: name the images that COLMAP used"
        )
    kind = _RAW_GREY if image.ndim == 2 else _RAW_COLOUR
    return new.add_link(kind, data, path.resolve()) if link else new.add_image(image, kind)
