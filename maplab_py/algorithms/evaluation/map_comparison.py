"""Differences of two maps: rows by their ids, then poses, landmarks, keypoints, observations."""

import dataclasses

import numpy as np

from maplab_py.algorithms.evaluation.reports import Difference, MapComparisonReport, RowCounts
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, CameraRig, sensor_set
from maplab_py.vimap import IdArray, VIMap, as_keys, comparison, is_valid, sensor_merge

_TABLES = (
    ("missions", "missions"),
    ("vertices", "vertices"),
    ("frames", "frames"),
    ("landmarks", "landmarks"),
    ("IMU edges", "imu_edges"),
    ("relative-pose edges", "transformation_edges"),
    ("loop closure edges", "loop_closure_edges"),
    ("resources", "resources"),
)
I8 = NDArray[np.int8]
_ROUNDING = 1e-9
_NONE = Difference(0, 0.0, 0.0)


def compare_maps(first: VIMap, second: VIMap) -> MapComparisonReport:
    """Compare the common rows of two maps, and count rows that only one of them has.

    Rows belong together if their ids are equal. An observation is a keypoint, by its frame and place
    there, with its landmark. Poses and landmarks are compared in G.
    """
    rows = []
    common: dict[str, tuple[I64, I64]] = {}
    for noun, name in _TABLES:
        a, b = getattr(first, name).id, getattr(second, name).id
        common[name] = common_rows(a, b)
        shared = len(common[name][0])
        valid = int(np.count_nonzero(is_valid(a))), int(np.count_nonzero(is_valid(b)))
        rows.append(RowCounts(noun, shared, valid[0] - shared, valid[1] - shared))
    keypoints = _common_keypoints(first, second, *common["frames"])
    rows.append(_observations(first, second, *keypoints))
    position, rotation = _poses(first, second, *common["vertices"])
    names = [field.name for field in dataclasses.fields(VIMap) if field.name != "metadata"]
    report = MapComparisonReport(
        rows=tuple(rows),
        position_m=position,
        rotation_deg=rotation,
        landmark_position_m=_distance(first.p_G, second.p_G, *common["landmarks"]),
        keypoint_px=_distance(first.keypoints.uv_px, second.keypoints.uv_px, *keypoints),
        time_ns=_distance(
            first.vertices.timestamp_ns[:, None].astype(np.float64),
            second.vertices.timestamp_ns[:, None].astype(np.float64),
            *common["vertices"],
        ),
        frames_with_other_keypoints=_other_keypoints(first, second, *common["frames"]),
        landmarks_of_other_quality=_unequal(
            first.landmarks.quality, second.landmarks.quality, *common["landmarks"]
        ),
        descriptors_differing=_descriptors(first, second, *keypoints),
        sensors_differing=_sensors(first, second),
        is_identical=all(
            comparison.is_same(getattr(first, name), getattr(second, name)) for name in names
        ),
    )
    return dataclasses.replace(report, in_words=_in_words(report))


def _in_words(report: MapComparisonReport) -> str:
    """Return the differences as sentences, the important first."""
    if report.is_identical:
        return "the maps are identical to the last bit"
    if report.position_m.is_empty:
        return "no vertex is in both maps: they are of other recordings, or one has new ids"
    parts = [_counts_in_words(row) for row in report.rows if row.what in _TOLD]
    parts = [part for part in parts if part]
    position, rotation = report.position_m, report.rotation_deg
    moved = max(position.largest, rotation.largest) > _ROUNDING
    parts.append(
        f"vertices moved by {_millimetres(position.rmse)} (RMSE), at most "
        f"{_millimetres(position.largest)} and {rotation.largest:.2g} deg"
        if moved
        else "the vertices are at the same poses"
    )
    if report.landmark_position_m.largest > 0.0:
        parts.append(f"landmarks moved by {_millimetres(report.landmark_position_m.rmse)} (RMSE)")
    if report.landmarks_of_other_quality:
        parts.append(f"{report.landmarks_of_other_quality} landmarks are judged differently")
    if report.sensors_differing:
        parts.append(f"calibrations differ: {', '.join(report.sensors_differing)}")
    if not report.keypoint_px.is_empty and report.keypoint_px.largest > 0.0:
        parts.append(f"keypoints differ by up to {report.keypoint_px.largest:.2g} px")
    return "; ".join(parts)


_TOLD = ("missions", "vertices", "landmarks", "observations")


def _counts_in_words(row: RowCounts) -> str:
    """Return which map has more rows of a table; an empty text if both have the same."""
    if not (row.only_in_first or row.only_in_second):
        return ""
    if not row.only_in_second:
        return f"this map has {row.only_in_first} more {row.what}"
    if not row.only_in_first:
        return f"the other map has {row.only_in_second} more {row.what}"
    return f"{row.only_in_first} {row.what} are only in this map and {row.only_in_second} only in the other"


def _millimetres(distance_m: float) -> str:
    """Return a distance in the unit that reads best."""
    return f"{1e3 * distance_m:.3g} mm" if distance_m < 1.0 else f"{distance_m:.3g} m"


def common_rows(a: IdArray, b: IdArray) -> tuple[I64, I64]:
    """Return the rows of ids (N, 2) and (M, 2) that are equal and not zero."""
    _, first, second = np.intersect1d(as_keys(a), as_keys(b), return_indices=True)
    kept = is_valid(a[first])
    return first[kept].astype(np.int64), second[kept].astype(np.int64)


def _common_keypoints(first: VIMap, second: VIMap, a: I64, b: I64) -> tuple[I64, I64]:
    """Return the keypoint rows of frames with equally many keypoints."""
    count_a, count_b = first.frames.keypoint_count[a], second.frames.keypoint_count[b]
    same = count_a == count_b
    a, b, count = a[same], b[same], count_a[same].astype(np.int64)
    inside = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    rows_a = np.repeat(first.keypoint_start[a], count) + inside
    rows_b = np.repeat(second.keypoint_start[b], count) + inside
    return rows_a, rows_b


def _observations(first: VIMap, second: VIMap, a: I64, b: I64) -> RowCounts:
    of_a, of_b = first.keypoints.landmark[a], second.keypoints.landmark[b]
    both = np.flatnonzero((of_a >= 0) & (of_b >= 0))
    equal = first.landmarks.id[of_a[both]] == second.landmarks.id[of_b[both]]
    shared = int(np.count_nonzero(equal.all(axis=1)))
    counts = len(first.observations), len(second.observations)
    return RowCounts("observations", shared, counts[0] - shared, counts[1] - shared)


def _poses(first: VIMap, second: VIMap, a: I64, b: I64) -> tuple[Difference, Difference]:
    position = _distance(first.T_G_I[:, 4:], second.T_G_I[:, 4:], a, b)
    turn = se3.local(first.T_G_I[a], second.T_G_I[b])[:, 3:]
    return position, _difference(np.degrees(np.linalg.norm(turn, axis=1)))


def _distance(values_a: F64, values_b: F64, a: I64, b: I64) -> Difference:
    return _difference(np.linalg.norm(values_a[a] - values_b[b], axis=1))


def _difference(errors: F64) -> Difference:
    if not len(errors):
        return _NONE
    return Difference(len(errors), float(np.sqrt(np.mean(errors**2))), float(errors.max()))


def _other_keypoints(first: VIMap, second: VIMap, a: I64, b: I64) -> int:
    return int(np.count_nonzero(first.frames.keypoint_count[a] != second.frames.keypoint_count[b]))


def _unequal(values_a: I8, values_b: I8, a: I64, b: I64) -> int:
    return int(np.count_nonzero(values_a[a] != values_b[b]))


def _descriptors(first: VIMap, second: VIMap, a: I64, b: I64) -> int:
    """Return how many common keypoints have descriptors of another type, or other bytes."""
    other = first.feature_type[a] != second.feature_type[b]
    of_a, of_b = first.keypoints.descriptor, second.keypoints.descriptor
    width = min(of_a.shape[1], of_b.shape[1])
    other |= (of_a[a, :width] != of_b[b, :width]).any(axis=1)
    other |= of_a[a, width:].any(axis=1) | of_b[b, width:].any(axis=1)
    return int(np.count_nonzero(other))


def _sensors(first: VIMap, second: VIMap) -> tuple[str, ...]:
    """Return the ids of sensors of both maps with another calibration."""
    a, b = first.sensors.sensors, second.sensors.sensors
    common = [sensor_id for sensor_id in a if sensor_id in b]
    return tuple(name for name in common if not _same_sensor(a[name], b[name]))


def _same_sensor(a: sensor_set.Sensor, b: sensor_set.Sensor) -> bool:
    """Return whether two sensors are equal up to the rounding of files."""
    if not (isinstance(a, CameraRig) and isinstance(b, CameraRig)):
        return sensor_merge.same_calibration(a, b)
    if len(a.cameras) != len(b.cameras) or not np.allclose(
        a.T_B_C, b.T_B_C, rtol=0, atol=_ROUNDING
    ):
        return False
    return all(
        _same_camera(first, second) for first, second in zip(a.cameras, b.cameras, strict=True)
    )


def _same_camera(a: Camera, b: Camera) -> bool:
    fixed = [
        (c.projection, c.distortion, c.width_px, c.height_px, c.time_offset_ns, c.line_delay_ns)
        for c in (a, b)
    ]
    return fixed[0] == fixed[1] and np.allclose(
        [*a.intrinsics, *a.distortion_parameters],
        [*b.intrinsics, *b.distortion_parameters],
        rtol=_ROUNDING,
        atol=_ROUNDING,
    )
