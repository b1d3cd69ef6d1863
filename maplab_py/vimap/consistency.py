"""Consistency checks of a map; every violation is listed with the affected ids."""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import Mask, NDArray
from maplab_py.errors import MapError
from maplab_py.report import Report, counted
from maplab_py.sensors.wheels import wheel_scale
from maplab_py.vimap import tables as map_tables
from maplab_py.vimap.descriptors import NO_DESCRIPTOR
from maplab_py.vimap.ids import is_valid, to_hex, to_hex_list
from maplab_py.vimap.queries import has_link, mission_sensor_id
from maplab_py.vimap.table import Table
from maplab_py.vimap.vi_map import VIMap

_LISTED = 5
"""Ids that one violation names."""
_UNIT_TOLERANCE = 1e-6
_NO_ROOT = "mission without root vertex"
LOADED_UNIT_TOLERANCE = 1e-4
"""Largest deviation of a quaternion's length from 1 in a map that is loaded."""
_MAX_TWICE_IN_FRAME = 5
"""maplab: a landmark seen more often in one frame is an error ..."""
_MAX_SPREAD_PX = 75.0
"""... and so is one seen twice, further apart than this ..."""
_WARN_SPREAD_PX = 10.0
"""... while this is worth a warning."""


@dataclasses.dataclass(frozen=True)
class Violation:
    """A violated rule."""

    rule: str
    count: int
    where: tuple[str, ...]  # ids or rows of the first few


class ConsistencyReport(Report):
    """All violated rules of a map."""

    errors: tuple[Violation, ...]
    warnings: tuple[Violation, ...]

    def as_text(self) -> str | None:
        """Return a sentence if no rule is violated."""
        is_clean = not self.errors and not self.warnings
        return "the map is consistent: no rule is violated" if is_clean else None

    @property
    def failure(self) -> str:
        """Return a summary of the violated rules; empty if the map is consistent."""
        if not self.errors:
            return ""
        first = self.errors[0]
        rules = counted(len(self.errors), "violated rule")
        return f"the map is inconsistent: {rules}, first: {first.rule} ({first.count})"


class _Findings:
    def __init__(self) -> None:
        self.errors: list[Violation] = []
        self.warnings: list[Violation] = []
        self.refused: list[Violation] = []

    def check(
        self,
        rule: str,
        broken: NDArray[Any],
        ids: Any,
        *,
        warning: bool = False,
        refused: bool = False,
    ) -> None:
        """Record a rule with the rows (mask or numbers) that violate it.

        Args:
            rule: Description of the violation.
            broken: Mask or row numbers.
            ids: Ids (N, 2) of the rows; None = report row numbers.
            warning: The map is still consistent.
            refused: The map cannot be loaded.
        """
        rows = np.flatnonzero(broken) if broken.dtype == np.bool_ else np.unique(broken)
        if len(rows) == 0:
            return
        some = rows[:_LISTED]
        names = (
            tuple(f"row {row}" for row in some) if ids is None else tuple(to_hex_list(ids[some]))
        )
        violation = Violation(rule, len(rows), names)
        (self.warnings if warning else self.errors).append(violation)
        if refused:
            self.refused.append(violation)


def check_consistency(vi_map: VIMap) -> ConsistencyReport:
    """Check references, order, numbers, ids, chains, observations and sensors of a map.

    Checks that need valid references are skipped if references are invalid.
    """
    findings = _check_all(vi_map)
    return ConsistencyReport(tuple(findings.errors), tuple(findings.warnings))


def check_loaded(vi_map: VIMap) -> tuple[list[Violation], list[Violation]]:
    """Run the same checks on a map from a file.

    Returns:
        Violations that prevent loading, and errors that do not.
    """
    findings = _check_all(vi_map)
    return findings.refused, [v for v in findings.errors if v not in findings.refused]


def check_saved(vi_map: VIMap) -> list[Violation]:
    """Return the violations of a map in memory that would prevent loading it."""
    findings = _Findings()
    _check_references(vi_map, findings)
    rootless = np.flatnonzero(vi_map.missions.root_vertex == map_tables.NO_ROW)
    if not np.isin(vi_map.vertices.mission, rootless).any():  # empty missions need none
        findings.errors = [v for v in findings.errors if v.rule != _NO_ROOT]
    if findings.errors:
        return findings.errors
    _check_ids(vi_map, findings)
    twice = list(findings.errors)
    _check_numbers(vi_map, findings)
    _check_edges(vi_map, findings)
    return [*twice, *findings.refused]


def _check_all(vi_map: VIMap) -> _Findings:
    findings = _Findings()
    _check_references(vi_map, findings)
    if not findings.errors:
        _check_numbers(vi_map, findings)
        _check_ids(vi_map, findings)
        _check_order(vi_map, findings)
        _check_missions(vi_map, findings)
        _check_edges(vi_map, findings)
        _check_observations(vi_map, findings)
        _check_sensors(vi_map, findings)
        _check_resources(vi_map, findings)
    return findings


def _check_references(vi_map: VIMap, findings: _Findings) -> None:
    vertices, landmarks = len(vi_map.vertices), len(vi_map.landmarks)

    def refer(rule: str, rows: NDArray[np.int32], size: int, ids: Any, lowest: int = 0) -> None:
        findings.check(rule, (rows < lowest) | (rows >= size), ids)

    m, v, f = vi_map.missions, vi_map.vertices, vi_map.frames
    refer("mission without base frame", m.baseframe, len(vi_map.baseframes), m.id)
    refer(_NO_ROOT, m.root_vertex, vertices, m.id)
    refer("vertex without mission", v.mission, len(m), v.id)
    refer("frame without vertex", f.vertex, vertices, f.id)
    refer(
        "keypoint of a landmark that is not there", vi_map.keypoints.landmark, landmarks, None, -1
    )
    refer("landmark without store vertex", vi_map.landmarks.vertex, vertices, vi_map.landmarks.id)
    refer("absolute pose without vertex", vi_map.absolute_poses.vertex, vertices, None)
    for noun, edges in _edges(vi_map):
        refer(f"{noun} from a vertex that is not there", edges.from_vertex, vertices, edges.id)
        refer(f"{noun} to a vertex that is not there", edges.to_vertex, vertices, edges.id)
    resources = vi_map.resources
    size = np.where(resources.owner_kind == map_tables.ResourceOwner.FRAME, len(f), len(m))
    owned = resources.owner_kind != map_tables.ResourceOwner.NONE
    outside = owned & ((resources.owner < 0) | (resources.owner >= size))
    findings.check("resource of an owner that is not there", outside, resources.id)
    described = np.array([sum(b.keypoints for b in frame or ()) for frame in f.descriptor_blocks])
    has_blocks = np.array([bool(frame) for frame in f.descriptor_blocks], dtype=np.bool_)
    findings.check(
        "frame whose descriptors do not fit its keypoints",
        has_blocks & (described != f.keypoint_count),
        f.id,
    )
    counts = (
        ("keypoints", int(f.keypoint_count.sum()), len(vi_map.keypoints), f.keypoint_count, f.id),
        (
            "IMU samples",
            int(vi_map.imu_edges.sample_count.sum()),
            len(vi_map.imu_samples),
            vi_map.imu_edges.sample_count,
            vi_map.imu_edges.id,
        ),
    )
    for noun, said, there, count, ids in counts:
        findings.check(f"negative number of {noun}", count < 0, ids)
        if said != there:
            findings.errors.append(Violation(f"{said} {noun} announced, {there} there", 1, ()))


def _edges(vi_map: VIMap) -> tuple[tuple[str, Any], ...]:
    return (
        ("IMU edge", vi_map.imu_edges),
        ("relative-pose edge", vi_map.transformation_edges),
        ("loop closure edge", vi_map.loop_closure_edges),
    )


def _check_numbers(vi_map: VIMap, findings: _Findings) -> None:
    finite: tuple[tuple[str, Table, tuple[str, ...]], ...] = (
        ("base frame", vi_map.baseframes, ("T_G_M",)),
        ("vertex", vi_map.vertices, ("T_M_I", "v_M", "accel_bias", "gyro_bias")),
        ("keypoint", vi_map.keypoints, ("uv_px", "sigma_px", "scale")),
        ("landmark", vi_map.landmarks, ("p_I",)),
        ("IMU sample", vi_map.imu_samples, ("accel_gyro",)),
        ("relative-pose edge", vi_map.transformation_edges, ("T_A_B",)),
        ("loop closure edge", vi_map.loop_closure_edges, ("T_A_B", "switch_variable")),
        ("absolute pose", vi_map.absolute_poses, ("T_G_S",)),
    )
    for noun, table, names in finite:
        columns = table.columns()
        ids = columns.get("id")
        for name in names:
            values = columns[name].reshape(len(table), int(np.prod(columns[name].shape[1:])))
            findings.check(
                f"{noun} with a non-finite {name}",
                ~np.all(np.isfinite(values), axis=1),
                ids,
                refused=True,
            )
            if name.startswith("T_"):
                length = np.hypot.reduce(values[:, :4], axis=1)  # squares may overflow
                error = np.abs(length - 1.0)
                findings.check(
                    f"{noun} whose {name} has a quaternion that is not of unit length",
                    error > _UNIT_TOLERANCE,
                    ids,
                    refused=bool(np.any(error > LOADED_UNIT_TOLERANCE)),
                )
    covariances: tuple[tuple[str, Any, NDArray[np.float64]], ...] = (
        ("base frame", vi_map.baseframes, vi_map.baseframes.T_G_M_covariance),
        ("landmark", vi_map.landmarks, vi_map.landmarks.covariance),
        ("relative-pose edge", vi_map.transformation_edges, vi_map.transformation_edges.covariance),
        ("loop closure edge", vi_map.loop_closure_edges, vi_map.loop_closure_edges.covariance),
        ("absolute pose", vi_map.absolute_poses, vi_map.absolute_poses.covariance),
    )
    for noun, table, values in covariances:
        flat = values.reshape(len(table), int(np.prod(values.shape[1:])))
        partly = np.asarray(~np.isfinite(flat).all(axis=1) & ~np.isnan(flat).all(axis=1))
        rule = f"{noun} whose covariance is no matrix of numbers: it counts as absent"
        findings.check(rule, partly, table.columns().get("id"))
    loops = vi_map.loop_closure_edges
    outside = (loops.switch_variable < 0.0) | (loops.switch_variable > 1.0)
    findings.check("loop closure edge with a switch variable outside [0, 1]", outside, loops.id)


def _check_ids(vi_map: VIMap, findings: _Findings) -> None:
    tables: tuple[tuple[str, Any], ...] = (
        ("mission", vi_map.missions.id),
        ("base frame", vi_map.baseframes.id),
        ("vertex", vi_map.vertices.id),
        ("landmark", vi_map.landmarks.id),
        ("IMU edge", vi_map.imu_edges.id),
        ("relative-pose edge", vi_map.transformation_edges.id),
        ("loop closure edge", vi_map.loop_closure_edges.id),
        ("frame", vi_map.frames.id),
    )
    for noun, ids in tables:
        valid = is_valid(ids)
        if noun != "frame":  # un-set slots of a rig have none
            findings.check(f"{noun} without id", ~valid, None)
        rows = np.flatnonzero(valid)
        order = rows[np.lexsort((ids[rows, 1], ids[rows, 0]))]
        again = np.all(ids[order[1:]] == ids[order[:-1]], axis=1)
        findings.check(f"{noun} id that occurs twice", order[1:][again], ids)


def _check_order(vi_map: VIMap, findings: _Findings) -> None:
    v, f = vi_map.vertices, vi_map.frames
    same_mission = v.mission[1:] == v.mission[:-1]
    back = np.flatnonzero(
        (v.mission[1:] < v.mission[:-1])
        | (same_mission & (v.timestamp_ns[1:] < v.timestamp_ns[:-1]))
    )
    findings.check("vertex out of order (mission, time)", back + 1, v.id)
    same_vertex = f.vertex[1:] == f.vertex[:-1]
    back = np.flatnonzero(
        (f.vertex[1:] < f.vertex[:-1]) | (same_vertex & (f.camera_index[1:] <= f.camera_index[:-1]))
    )
    findings.check("frame out of order (vertex, camera)", back + 1, f.id)


def _check_missions(vi_map: VIMap, findings: _Findings) -> None:
    m, v = vi_map.missions, vi_map.vertices
    _, counts = np.unique(m.baseframe, return_counts=True)
    if np.any(counts > 1):
        findings.errors.append(
            Violation("base frame shared by missions", int(np.sum(counts > 1)), ())
        )
    unused = np.setdiff1d(np.arange(len(vi_map.baseframes)), m.baseframe)
    findings.check("base frame without mission", unused, vi_map.baseframes.id)
    empty = np.diff(vi_map.vertex_start) == 0
    findings.check("mission without vertices", empty, m.id)
    wrong_root = ~empty & (m.root_vertex != vi_map.vertex_start[:-1])
    findings.check("mission whose root is not its first vertex", wrong_root, m.id)
    same_mission = v.mission[1:] == v.mission[:-1]
    gaps = np.flatnonzero(same_mission & ~has_link(vi_map)[:-1])
    findings.check("vertex without an edge to the next of its mission", gaps, v.id)


def _check_edges(vi_map: VIMap, findings: _Findings) -> None:
    mission, time = vi_map.vertices.mission, vi_map.vertices.timestamp_ns
    for noun, edges in _edges(vi_map):
        circle = edges.from_vertex == edges.to_vertex
        findings.check(f"{noun} from a vertex to itself", circle, edges.id, refused=True)
        if noun != "loop closure edge":
            apart = mission[edges.from_vertex] != mission[edges.to_vertex]
            findings.check(f"{noun} between two missions", apart, edges.id, refused=True)
    for noun, edges in _edges(vi_map)[:2]:  # those of the chains
        circle = _in_circle(vi_map, edges)
        findings.check(f"{noun} in a circle of edges", circle, edges.id, refused=True)
    imu, samples = vi_map.imu_edges, vi_map.imu_samples
    findings.check(
        "IMU edge with fewer than two samples", imu.sample_count < 2, imu.id, warning=True
    )
    edge = np.repeat(np.arange(len(imu)), imu.sample_count)
    back = (np.diff(samples.timestamp_ns) <= 0) & (edge[1:] == edge[:-1])
    findings.check(
        "IMU edge whose sample times do not increase", edge[1:][back], imu.id, refused=True
    )
    findings.check(
        "IMU edge that leads back in time",
        time[imu.to_vertex] <= time[imu.from_vertex],
        imu.id,
        refused=True,
    )


def _in_circle(vi_map: VIMap, edges: Any) -> Mask:
    """Return which edges (E,) of a mission's backbone lie on a directed cycle."""
    chain = np.ones(len(edges), dtype=np.bool_)
    if isinstance(edges, map_tables.TransformationEdges):
        chain = edges.kind != map_tables.TransformationKind.TRANSFORMATION
    start, stop = edges.from_vertex[chain], edges.to_vertex[chain]
    circle = np.zeros(len(edges), dtype=np.bool_)
    if not np.any(stop <= start):  # rows are in the order of time
        return circle
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(vi_map.vertices)
    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(size, size))
    _, label = connected_components(graph, directed=True, connection="strong")
    circle[chain] = label[start] == label[stop]
    return circle


def _check_observations(vi_map: VIMap, findings: _Findings) -> None:
    """maplab: a landmark may be seen twice in a frame, but not often and not far apart."""
    keypoints = vi_map.observations
    landmark, frame = vi_map.keypoints.landmark[keypoints], vi_map.keypoint_frame[keypoints]
    begins = np.ones(len(keypoints), dtype=np.bool_)
    begins[1:] = (landmark[1:] != landmark[:-1]) | (frame[1:] != frame[:-1])
    group = np.flatnonzero(begins)
    count = np.diff(np.append(group, len(keypoints)))
    kind = vi_map.feature_type[keypoints]
    other = (kind != NO_DESCRIPTOR) & (kind != vi_map.landmarks.feature_type[landmark])
    findings.check(
        "landmark of another feature type than a keypoint that observes it",
        landmark[other],
        vi_map.landmarks.id,
        warning=True,
    )
    several = np.flatnonzero(count > 1)
    if len(several) == 0:
        return
    uv = vi_map.keypoints.uv_px[keypoints]
    spread = np.linalg.norm(np.maximum.reduceat(uv, group) - np.minimum.reduceat(uv, group), axis=1)
    of_group = landmark[group]
    ids = vi_map.landmarks.id
    often = of_group[count > _MAX_TWICE_IN_FRAME]
    findings.check(f"landmark seen more than {_MAX_TWICE_IN_FRAME} times in a frame", often, ids)
    far = of_group[several[spread[several] > _MAX_SPREAD_PX]]
    findings.check(f"landmark seen twice in a frame, over {_MAX_SPREAD_PX:g} px apart", far, ids)
    near = several[(spread[several] > _WARN_SPREAD_PX) & (spread[several] <= _MAX_SPREAD_PX)]
    findings.check(
        f"landmark seen twice in a frame, over {_WARN_SPREAD_PX:g} px apart",
        of_group[near],
        ids,
        warning=True,
    )


def _check_resources(vi_map: VIMap, findings: _Findings) -> None:
    resources = vi_map.resources
    folders = len(vi_map.metadata.external_resource_folders)
    outside = (resources.folder < -1) | (resources.folder >= folders)
    findings.check("resource in a folder that `metadata` does not list", outside, resources.id)


def _check_sensors(vi_map: VIMap, findings: _Findings) -> None:
    known = vi_map.sensors.sensors
    for row in range(len(vi_map.missions)):
        missing = [
            kind.name.lower()
            for kind in map_tables.MissionSensor
            if (sensor_id := mission_sensor_id(vi_map, row, kind)) and sensor_id not in known
        ]
        if missing:
            name = to_hex(vi_map.missions.id[row])
            rule = f"mission whose {', '.join(missing)} is not in sensors.yaml"
            findings.errors.append(Violation(rule, 1, (name,)))
    for sensor_id in known:
        try:
            wheel_scale(vi_map.sensors, sensor_id)
        except MapError:
            rule = "wheel sensor whose scale in sensors.yaml is no positive number"
            findings.errors.append(Violation(rule, 1, (sensor_id,)))
    edges = vi_map.transformation_edges
    for words in np.unique(edges.sensor_id[is_valid(edges.sensor_id)], axis=0):
        if to_hex(words) not in known:
            broken = np.all(edges.sensor_id == words, axis=1)
            findings.check(
                "relative-pose edge of an unknown sensor", broken, edges.id, warning=True
            )
