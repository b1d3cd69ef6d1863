"""Summary maps: the part of a map that localisation needs, in one file.

The fields that C++ maplab knows are written as it writes them, so that it can read the file.
It skips `extras`: ids, landmark covariances, sensors, the descriptor projection and a checksum. A
file without extras is read too; localisation then needs the projection from elsewhere.
"""

import dataclasses
import gzip
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F32, U8, U32, U64
from maplab_py.errors import MapError
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.sensors import SensorSet, sensors_yaml
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.extension_fields import read_extension, with_extension
from maplab_py.storage.protobuf import map_files, scan
from maplab_py.vimap.descriptors import DescriptorDepth

FILE_NAME = "localization_summary_map"

_GZIP_LEVEL = 6
_EXISTENCE = 1001
"""Number of the field of `existence_percent` in the extras."""
_UPPER_TRIANGLE = np.triu_indices(3)


@dataclasses.dataclass(frozen=True, eq=False)
class SummaryMap:
    """L landmarks, K observing vertices, N observations with a projected descriptor each."""

    p_G: F32  # (L, 3) landmarks [m]
    p_G_observer: F32  # (K, 3) [m]
    descriptors: F32  # (N, dimensions)
    landmark: U32  # (N,) rows of p_G
    observer: U32  # (N,) rows of p_G_observer
    # extras, None or empty where the file has none
    landmark_id: U64 | None = None  # (L, 2)
    observer_id: U64 | None = None  # (K, 2)
    landmark_covariance: F32 | None = None  # (L, 3, 3) in G [m^2]
    projection: F32 | None = None  # (dimensions, bits or numbers of a descriptor)
    sensors: SensorSet | None = None
    descriptor_kind: tuple[int, int, int] | None = None  # bytes, feature type, depth; None = binary
    existence_percent: U8 | None = None  # (L,) probability that the landmark exists


def summary_map_file(path: Path) -> Path | None:
    """Return the file of a summary map: the path itself or a file in that folder; None if none."""
    if path.is_file():
        return path
    inside = path / FILE_NAME
    return inside if inside.is_file() else None


def summary_map_bytes(summary: SummaryMap) -> bytes:
    """Return the content of the file; the same summary gives the same bytes."""
    return gzip.compress(_message(summary).SerializeToString(), _GZIP_LEVEL, mtime=0)


def write_summary_map(summary: SummaryMap, folder: Path, *, overwrite: bool = False) -> Path:
    """Write `localization_summary_map` into a folder atomically.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    path = folder / FILE_NAME
    check_writable(path, overwrite=overwrite)
    write_bytes(path, [summary_map_bytes(summary)], overwrite=overwrite)
    return path


def read_summary_map(path: Path, *, max_size_megabytes: int = 2000) -> SummaryMap:
    """Read a summary map, the file or the folder that holds it.

    Raises:
        MapError: There is no such file, it is damaged, or its parts do not fit together.
    """
    file = summary_map_file(path)
    if file is None:
        raise MapError(f"{path}: there is no file {FILE_NAME}")
    message = pb.LocalizationSummaryMap()
    map_files.read_message(file, message, scan.MemoryBudget(max_size_megabytes * 1_000_000))
    inner = message.uncompressed_map
    summary = SummaryMap(
        p_G=_points(message.p_G_landmark, f"{file}: landmark positions"),
        p_G_observer=_points(inner.p_G_observer, f"{file}: observer positions"),
        descriptors=_matrix(inner.descriptors, f"{file}: descriptors").T.copy(),
        landmark=np.array(inner.observation_to_landmark_index, dtype=np.uint32),
        observer=np.array(inner.observer_indices, dtype=np.uint32),
    )
    _check_references(summary, file)
    if not message.HasField("extras"):
        return summary
    summary = _with_extras(summary, message.extras, file)
    if message.extras.sha256 and message.extras.sha256 != _digest(summary):
        raise MapError(f"{file}: is damaged: it does not have its checksum; {map_files.COPY_AGAIN}")
    return summary


def _message(summary: SummaryMap) -> Any:
    message = pb.LocalizationSummaryMap()
    message.p_G_landmark.extend(summary.p_G.ravel().tolist())
    inner = message.uncompressed_map
    _fill_matrix(inner.descriptors, summary.descriptors.T)
    inner.p_G_observer.extend(summary.p_G_observer.ravel().tolist())
    inner.observer_indices.extend(summary.observer.tolist())
    inner.observation_to_landmark_index.extend(summary.landmark.tolist())
    extras = message.extras
    if summary.landmark_id is not None:
        extras.landmark_ids = _id_bytes(summary.landmark_id)
    if summary.observer_id is not None:
        extras.observer_ids = _id_bytes(summary.observer_id)
    if summary.landmark_covariance is not None:
        upper = summary.landmark_covariance[:, _UPPER_TRIANGLE[0], _UPPER_TRIANGLE[1]]
        extras.landmark_covariance.extend(upper.ravel().tolist())
    if summary.projection is not None:
        _fill_matrix(extras.projection, summary.projection)
    if summary.descriptor_kind is not None:
        extras.descriptor_kind.extend(summary.descriptor_kind)
    if summary.sensors is not None:
        extras.sensors_yaml = sensors_yaml.write_sensors(summary.sensors)
    if summary.existence_percent is not None:
        content = summary.existence_percent.tobytes()
        extras.MergeFromString(with_extension(b"", _EXISTENCE, content))
    extras.sha256 = _digest(summary)
    return message


def _with_extras(summary: SummaryMap, extras: Any, file: Path) -> SummaryMap:
    landmarks, observers = len(summary.p_G), len(summary.p_G_observer)
    columns: dict[str, Any] = {}
    if extras.landmark_ids:
        columns["landmark_id"] = _ids(extras.landmark_ids, landmarks, f"{file}: landmark ids")
    if extras.observer_ids:
        columns["observer_id"] = _ids(extras.observer_ids, observers, f"{file}: observer ids")
    if len(extras.landmark_covariance):
        flat = np.array(extras.landmark_covariance, dtype=np.float32)
        if len(flat) != 6 * landmarks:
            raise MapError(f"{file}: {len(flat)} numbers in covariances of {landmarks} landmarks")
        full = np.zeros((landmarks, 3, 3), dtype=np.float32)
        full[:, _UPPER_TRIANGLE[0], _UPPER_TRIANGLE[1]] = flat.reshape(-1, 6)
        full[:, _UPPER_TRIANGLE[1], _UPPER_TRIANGLE[0]] = flat.reshape(-1, 6)
        columns["landmark_covariance"] = full
    if extras.HasField("projection"):
        matrix = _matrix(extras.projection, f"{file}: projection")
        kind = list(extras.descriptor_kind)
        if len(matrix) != summary.descriptors.shape[1] or not _takes(matrix, kind):
            raise MapError(f"{file}: the projection does not fit the descriptors")
        columns["descriptor_kind"] = (kind[0], kind[1], kind[2]) if kind else None
        columns["projection"] = np.ascontiguousarray(matrix)
    if extras.sensors_yaml:
        columns["sensors"] = sensors_yaml.parse_sensors(extras.sensors_yaml, f"{file}: sensors")
    existence = read_extension(extras.SerializeToString(), _EXISTENCE)
    if existence is not None:
        columns["existence_percent"] = percent = np.frombuffer(existence, dtype=np.uint8)
        if len(percent) != landmarks:
            raise MapError(f"{file}: {len(percent)} probabilities of {landmarks} landmarks")
        if percent.max(initial=0) > 100:
            raise MapError(f"{file}: a landmark exists with a probability of {percent.max()} %")
    return dataclasses.replace(summary, **columns)


def _takes(projection: F32, kind: list[int]) -> bool:
    """Return whether a projection takes descriptors of a kind; empty = binary of any size."""
    width = int(projection.shape[1])
    if not kind:
        return width % 8 == 0
    if len(kind) != 3 or kind[2] not in (DescriptorDepth.UINT8, DescriptorDepth.FLOAT32):
        return False
    return width * (4 if kind[2] == DescriptorDepth.FLOAT32 else 1) == kind[0]


def _digest(summary: SummaryMap) -> bytes:
    """Return the SHA-256 of all numbers and the sensors, little-endian, in the order of fields."""
    digest = hashlib.sha256()
    for field in dataclasses.fields(summary):
        value = getattr(summary, field.name)
        if field.name in ("descriptor_kind", "existence_percent"):
            if value is None:
                continue  # as in files from before there was this field
            value = np.asarray(value, dtype=None if field.name == "existence_percent" else np.int64)
        digest.update(f"{field.name}:".encode())
        if isinstance(value, np.ndarray):
            digest.update(np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes())
        elif value is not None:
            digest.update(sensors_yaml.write_sensors(value).encode())
    return digest.digest()


def _check_references(summary: SummaryMap, file: Path) -> None:
    count = len(summary.descriptors)
    for name, index, size in (
        ("landmarks", summary.landmark, len(summary.p_G)),
        ("observers", summary.observer, len(summary.p_G_observer)),
    ):
        if len(index) != count:
            raise MapError(f"{file}: {count} descriptors, but {len(index)} references to {name}")
        if count and int(index.max()) >= size:
            raise MapError(f"{file}: refers to {name} beyond the {size} that there are")


def _points(flat: Any, where: str) -> F32:
    values = np.array(flat, dtype=np.float32)
    if len(values) % 3:
        raise MapError(f"{where}: {len(values)} numbers are not points")
    if not np.isfinite(values).all():
        raise MapError(f"{where}: one is not a number")
    return values.reshape(-1, 3)


def _matrix(message: Any, where: str) -> F32:
    values = np.array(message.data, dtype=np.float32)
    if len(values) != message.rows * message.cols:
        raise MapError(f"{where}: {len(values)} numbers are no {message.rows} x {message.cols}")
    if not np.isfinite(values).all():
        raise MapError(f"{where}: one is not a number")
    return values.reshape(message.cols, message.rows).T


def _fill_matrix(message: Any, values: F32) -> None:
    message.rows, message.cols = values.shape
    message.data.extend(values.T.ravel().tolist())


def _id_bytes(ids: U64) -> bytes:
    return np.ascontiguousarray(ids, dtype=">u8").tobytes()


def _ids(data: bytes, count: int, where: str) -> U64:
    if len(data) != 16 * count:
        raise MapError(f"{where}: {len(data)} bytes are not the ids of {count}")
    return np.frombuffer(data, dtype=">u8").astype(np.uint64).reshape(-1, 2)
