"""Content of a calibration file before its sensors get ids, and the text files it comes from."""

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.input_files import read_foreign_text
from maplab_py.sensors import Camera, Imu, yaml_entry, yaml_text

_MAX_BYTES = 16_000_000
_OPENCV_HEAD = re.compile(r"\A\s*%YAML[: ]1\.\d.*\n?")
_OPENCV_TAG = re.compile(r"!!opencv-(?:matrix|nd-matrix)\b|!<tag:yaml\.org,2002:opencv-matrix>")
_DOCUMENT_END = re.compile(r"^(?:---|\.\.\.)[ \t]*$", re.MULTILINE)
_CONTENT = re.compile(r"^[ \t]*[^#\s]", re.MULTILINE)
_LARGEST_DIFFERENCE_M = 1e-4
_LARGEST_DIFFERENCE_DEG = 0.01
"""Poses that a program prints twice agree to its rounding."""


@dataclasses.dataclass(frozen=True, eq=False)
class Parts:
    """Cameras and IMU of a file; poses are on a body frame B, which the file chooses."""

    format: str  # for people: "kalibr", "EuRoC", ...
    cameras: Sequence[Camera] = ()
    T_B_C: F64 = dataclasses.field(default_factory=lambda: np.zeros((0, 7)))
    imu: Imu | None = None
    T_B_I: F64 = dataclasses.field(default_factory=se3.identity)
    is_on_body: bool = False  # B is no sensor, as in EuRoC's files; else it is the IMU or a camera
    time_shift_ns: int = 0  # of the file of an IMU: t_imu = t_camera + shift
    why_not_on_imu: str = ""  # where B is not fixed to an IMU: key and remedy
    notes: Sequence[str] = ()


def read_calibration_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        MapError: It cannot be read, is too large for a calibration, or is no text.
    """
    return read_foreign_text(path, _MAX_BYTES, remedy="it is no calibration")


def is_json(path: Path) -> bool:
    """Return whether a file is JSON: it begins with a brace."""
    return read_calibration_text(path).lstrip().startswith("{")


def read_entry(path: Path) -> yaml_entry.Entry:
    """Read a YAML file of key-value pairs; OpenCV's first line and its matrices are accepted.

    Raises:
        MapError: It cannot be read or is no such file.
    """
    text = _OPENCV_TAG.sub("", _OPENCV_HEAD.sub("", read_calibration_text(path)))
    documents = [part for part in _DOCUMENT_END.split(text) if part.strip()]
    text = next((part for part in documents if _CONTENT.search(part)), "")  # messages repeat
    return yaml_entry.Entry(yaml_text.parse_yaml(text, str(path), _MAX_BYTES * 10), str(path))


def read_json_entry(path: Path) -> yaml_entry.Entry:
    """Read a JSON file of key-value pairs.

    Raises:
        MapError: It cannot be read or is no such file.
    """
    try:
        value: Any = json.loads(read_calibration_text(path))
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: not valid JSON: {error}") from error
    return yaml_entry.Entry(value, str(path))


def compare_poses(where: str, named: Sequence[tuple[str, F64]]) -> list[str]:
    """Return a note where a file gives the same pose (7,) differently; the first one is used."""
    notes = []
    (first_key, first), *others = named
    for key, pose in others:
        T = se3.relative(first, pose)
        distance_m = float(np.linalg.norm(T[4:]))
        angle_deg = float(np.degrees(2.0 * np.arctan2(np.linalg.norm(T[:3]), abs(T[3]))))
        if distance_m > _LARGEST_DIFFERENCE_M or angle_deg > _LARGEST_DIFFERENCE_DEG:
            notes.append(
                f"{where}: '{key}' contradicts '{first_key}' by {1e3 * distance_m:.3g} mm and "
                f"{angle_deg:.3g} deg: '{first_key}' is used"
            )
    return notes


def note_unknown_keys(
    entry: yaml_entry.Entry, ignored: Sequence[str] = (), *, settings: bool = False
) -> list[str]:
    """Return one note that names the keys which were not understood, none if there are none.

    Args:
        entry: Entry whose keys were read.
        ignored: Keys, at any level, that say nothing of the calibration.
        settings: The file also has the settings of a program: only keys that resemble one of the
            calibration are named.
    """
    unknown = [
        f"{key} ({suggestion}?)" if suggestion else key
        for key, suggestion in entry.unknown(frozenset(ignored))
        if suggestion or not settings
    ]
    if not unknown:
        return []
    shown = ", ".join(unknown[:12]) + (
        f" and {len(unknown) - 12} more" if len(unknown) > 12 else ""
    )
    return [f"{entry.where}: keys that are not understood: {shown}"]


def with_imu(cameras: Parts, imu: Parts) -> Parts:
    """Return cameras with the IMU of another file."""
    shifted = [
        dataclasses.replace(camera, time_offset_ns=camera.time_offset_ns + imu.time_shift_ns)
        for camera in cameras.cameras
    ]
    notes = [*cameras.notes, *imu.notes]
    T_B_I = imu.T_B_I
    if imu.is_on_body and not cameras.is_on_body:
        T_B_I = se3.identity()  # the cameras are on the IMU itself
    elif cameras.is_on_body and not imu.is_on_body:
        notes.append(
            f"{cameras.format}: cameras are on a body, and the file of the IMU ({imu.format}) does not say "
            "where it is: it is taken as the body"
        )
    return dataclasses.replace(cameras, cameras=shifted, imu=imu.imu, T_B_I=T_B_I, notes=notes)
