"""What a COLMAP model cannot hold of a map: ids, times, body frames and qualities, in a file beside it.

COLMAP ignores the file. Whoever imports the model again, refined or not, gets the ids of the map back.
"""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any, Self

import numpy as np

from maplab_py.array_types import F64, I64, U64
from maplab_py.errors import MapError
from maplab_py.input_files import read_npz

FILE_NAME = "maplab.npz"
_VERSION = 1


@dataclasses.dataclass(frozen=True, eq=False)
class SideFile:
    """Rows of the map by names of images and by ids of the model.

    Points carry an observation, which tells whether a refined model still has the same point.
    """

    mission_id: U64  # (M, 2)
    mission_name: np.ndarray  # (M,) text
    is_metric: I64  # (M,) 1 = scale and gravity are known
    vertex_id: U64  # (F, 2)
    vertex_mission: I64  # (F,) rows
    vertex_time_ns: I64  # (F,)
    image_name: np.ndarray  # (N,) text
    image_vertex: I64  # (N,) rows
    image_frame_id: U64  # (N, 2) ids of frames of the map
    image_time_ns: I64  # (N,)
    point: I64  # (L,) ids of points, ascending
    point_image: I64  # (L,) rows of images that observe them
    point_keypoint: I64  # (L,) keypoints of these images
    landmark_id: U64  # (L, 2)
    landmark_quality: I64  # (L,)
    rig: I64  # (R,) ids of rigs
    rig_id: U64  # (R, 2)
    T_I_R: F64  # (R, 7)
    camera: I64  # (C,) ids of cameras
    camera_id: U64  # (C, 2)

    def content(self) -> bytes:
        """Return the file's bytes, the same for the same content."""
        stream = io.BytesIO()
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        np.savez(stream, version=np.array([_VERSION]), **values)
        return stream.getvalue()

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Read the file of a model's folder; None if there is none.

        Raises:
            MapError: The file is damaged, or of a newer version.
        """
        path = folder / FILE_NAME
        if not path.is_file():
            return None
        without = "delete it to import the model with new ids"
        try:
            arrays = read_npz(path)
        except (MapError, ValueError, OSError) as error:
            raise MapError(f"{path}: is damaged: {error}; {without}") from error
        if int(arrays.pop("version", np.zeros(1)).ravel()[0]) != _VERSION:
            raise MapError(f"{path}: was written by another version; {without}")
        names = {field.name for field in dataclasses.fields(cls)}
        if set(arrays) != names or not _fits(arrays):
            raise MapError(f"{path}: is damaged: its columns do not fit; {without}")
        return cls(**arrays)


_COLUMNS = {
    "mission_id": ("mission_id", "mission_name", "is_metric"),
    "vertex_id": ("vertex_id", "vertex_mission", "vertex_time_ns"),
    "image_name": ("image_name", "image_vertex", "image_frame_id", "image_time_ns"),
    "point": ("point", "point_image", "point_keypoint", "landmark_id", "landmark_quality"),
    "rig": ("rig", "rig_id", "T_I_R"),
    "camera": ("camera", "camera_id"),
}
_WIDTH = {"T_I_R": 7}
_REFERENCES = {
    "vertex_mission": "mission_id",
    "image_vertex": "vertex_id",
    "point_image": "image_name",
}


def _fits(arrays: dict[str, np.ndarray[Any, Any]]) -> bool:
    """Return whether the columns have equal lengths, the right widths, and rows that exist."""
    for leader, columns in _COLUMNS.items():
        for name in columns:
            width = _WIDTH.get(name, 2 if name.endswith("_id") else 0)
            wanted = (len(arrays[leader]), width) if width else (len(arrays[leader]),)
            kind = "U" if name.endswith("_name") else "f" if width == 7 else "iu"
            if arrays[name].shape != wanted or arrays[name].dtype.kind not in kind:
                return False
    return all(
        np.all((arrays[rows] >= 0) & (arrays[rows] < len(arrays[table])))
        for rows, table in _REFERENCES.items()
    )
