"""Facts about a vertex, a landmark or a loop closure for the panel."""

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.algorithms.loop_closure import closure_record, listing, options
from maplab_py.algorithms.loop_closure.explanation import explain_closure
from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.report import counted
from maplab_py.viewer.scene import Entity
from maplab_py.vimap import IdArray, LandmarkQuality, VIMap, mission_labels, ragged_rows, to_hex

Facts = tuple[tuple[str, str], ...]
"""Names and values, in the order in which they are shown."""


ID_DIGITS = 8
"""Digits of ids in the panel: as the console prints them."""


def _short(id_: IdArray) -> str:
    return to_hex(id_)[:ID_DIGITS]


def vertex_facts(vi_map: VIMap, row: int) -> Facts:
    """Return id, time, state and observations of a vertex."""
    vertex = vi_map.vertex(row)
    keypoints = ragged_rows(vi_map.keypoint_start, np.array(vertex.frames, dtype=np.int64))
    observing = keypoints[vi_map.keypoints.landmark[keypoints] >= 0]
    mission = vi_map.mission(vertex.mission)
    since_s = 1e-9 * (vertex.timestamp_ns - int(vi_map.vertices.timestamp_ns[mission.vertices[0]]))
    return (
        ("vertex", vertex.id[:ID_DIGITS]),
        ("mission", mission_labels(vi_map)[vertex.mission]),
        ("time", f"{since_s:.3f} s after the start"),
        ("time stamp", f"{vertex.timestamp_ns} ns"),
        ("number", f"{row - mission.vertices[0] + 1} of {len(mission.vertices)}"),
        ("p_G_I", f"{_vector(vertex.T_G_I[4:])} m"),
        ("roll, pitch, yaw", f"{_vector(_euler_deg(vertex.T_G_I[:4]), 1)} deg"),
        ("speed", f"{np.linalg.norm(vertex.v_M):.2f} m/s"),
        ("accelerometer bias", f"{_vector(vertex.accel_bias)} m/s²"),
        ("gyroscope bias", f"{_vector(vertex.gyro_bias, 4)} rad/s"),
        ("images", str(len(vertex.frames))),
        ("keypoints", f"{len(keypoints):,}"),
        ("observations", f"{len(observing):,}"),
        ("reprojection error", _error_text(vi_map, observing)),
    )


def landmark_facts(vi_map: VIMap, row: int) -> Facts:
    """Return id, quality, observations and reprojection error of a landmark."""
    landmark = vi_map.landmark(row)
    observers = vi_map.keypoint_vertex[landmark.keypoints]
    missions = np.unique(vi_map.vertices.mission[observers])
    times = vi_map.vertices.timestamp_ns[observers]
    distance = np.linalg.norm(vi_map.T_G_I[observers, 4:] - landmark.p_G, axis=1)
    seen = f"{1e-9 * np.ptp(times):.2f} s" if len(times) else "never"
    labels = mission_labels(vi_map)
    names = ", ".join(labels[mission] for mission in missions.tolist())
    return (
        ("landmark", landmark.id[:ID_DIGITS]),
        ("quality", LandmarkQuality(landmark.quality).name.lower()),
        ("p_G", f"{_vector(landmark.p_G)} m"),
        (
            "observations",
            f"{len(observers)} by {counted(len(np.unique(observers)), 'vertex', 'vertices')}",
        ),
        ("missions", names or "none"),
        ("seen over", seen),
        ("distance", _range_text_m(distance)),
        ("largest ray angle", f"{_largest_angle_deg(vi_map, landmark.p_G, observers):.1f} deg"),
        ("reprojection error", _error_text(vi_map, landmark.keypoints)),
        ("stored in", _short(vi_map.vertices.id[landmark.vertex])),
        ("feature type", str(int(vi_map.landmarks.feature_type[row]))),
    )


def loop_closure_facts(vi_map: VIMap, row: int) -> Facts:
    """Return both ends of a loop closure edge and how much it would correct."""
    edges = vi_map.loop_closure_edges
    start, end = int(edges.from_vertex[row]), int(edges.to_vertex[row])
    T_A_B = se3.relative(vi_map.T_G_I[start], vi_map.T_G_I[end])
    wrong = se3.local(edges.T_A_B[row], T_A_B)
    common = len(np.intersect1d(_landmarks_of(vi_map, start), _landmarks_of(vi_map, end)))
    mission, labels = vi_map.vertices.mission, mission_labels(vi_map)
    return (
        ("loop closure", _short(edges.id[row])),
        ("query vertex", _short(vi_map.vertices.id[start])),
        ("query mission", labels[mission[start]]),
        ("target vertex", _short(vi_map.vertices.id[end])),
        ("target mission", labels[mission[end]]),
        ("switch value", f"{edges.switch_variable[row]:.3f}"),
        ("correction", f"{np.linalg.norm(wrong[:3]):.3f} m"),
        ("correction of heading", f"{np.degrees(np.linalg.norm(wrong[3:])):.2f} deg"),
        ("inliers", f"{common} landmarks in common"),
        *_recorded_gates(vi_map, edges.id[row]),
    )


def _recorded_gates(vi_map: VIMap, edge: IdArray) -> Facts:
    """Return the gates of the recorded closure that an edge (id) was made from; none without one."""
    try:
        closures = closure_record.read_record(vi_map).closures
    except MapError:
        return ()
    rows = np.flatnonzero((closures.id == edge).all(axis=1))
    return gate_facts(vi_map, int(rows[0])) if len(rows) else ()


def closure_facts(vi_map: VIMap, row: int) -> Facts:
    """Return the recorded facts of a closure, as lc_report lists them, and its gates, as why does."""
    line = listing.describe_closure(vi_map, row)
    why, *gates = gate_facts(vi_map, row)
    return (
        ("closure", line.id),
        ("verdict", line.verdict),
        why,
        ("served for", line.use or "nothing"),
        ("query", f"mission {line.query} at {line.query_s:.2f} s"),
        ("target", f"mission {line.place} at {line.place_s:.2f} s"),
        ("matches", str(line.matches)),
        ("inliers", f"{line.inliers} ({100.0 * line.ratio:.0f} %)"),
        ("correction when found", f"{line.correction_m:.3f} m, {line.correction_deg:.2f} deg"),
        ("gap now", f"{line.gap_m:.3f} m, {line.gap_deg:.2f} deg"),
        ("tilt", f"{line.tilt_deg:.2f} deg"),
        ("agreeing neighbours", str(line.support)),
        ("landmarks merged", str(line.merged)),
        ("weight", f"{line.weight:.3f}"),
        *gates,
    )


def gate_facts(vi_map: VIMap, row: int) -> Facts:
    """Return why a recorded closure was accepted or refused: every gate, the failed ones first."""
    explanation = explain_closure(vi_map, row, options.LoopClosureOptions())
    gates = sorted(explanation.gates, key=lambda gate: gate.result)
    lines = [
        (f"{gate.result}: {gate.gate}", f"{gate.value}, wanted {gate.wanted} {gate.flag}".rstrip())
        for gate in gates
    ]
    return (("why", explanation.summary), *lines)


def _landmarks_of(vi_map: VIMap, vertex: int) -> NDArray[np.int32]:
    frames = np.arange(*vi_map.frame_start[vertex : vertex + 2])
    landmark = vi_map.keypoints.landmark[ragged_rows(vi_map.keypoint_start, frames)]
    return np.unique(landmark[landmark >= 0])


def _error_text(vi_map: VIMap, keypoints: I64) -> str:
    if not len(keypoints):
        return "no observations"
    try:
        p_G = vi_map.p_G[vi_map.keypoints.landmark[keypoints]]
        error_px = residuals(vi_map, keypoints, p_G).error_px
    except MapError:
        return "no calibrated camera"
    behind = int(np.count_nonzero(~np.isfinite(error_px)))
    seen = error_px[np.isfinite(error_px)]
    if not len(seen):
        return "behind every camera"
    text = f"mean {seen.mean():.2f} px, largest {seen.max():.2f} px"
    return f"{text}, {behind} behind the camera" if behind else text


def _largest_angle_deg(vi_map: VIMap, p_G: F64, observers: NDArray[np.int32]) -> float:
    """Return the largest angle between two lines of sight; zero with fewer than two."""
    rays = p_G - vi_map.T_G_I[np.unique(observers), 4:]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-12)[:, None]
    if len(rays) < 2:
        return 0.0
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))


def _euler_deg(q: F64) -> F64:
    """Return roll, pitch, yaw (3,) of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    R = so3.to_matrix(q)
    pitch = np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    return np.degrees([roll, pitch, yaw])


def _vector(v: F64, digits: int = 3) -> str:
    return "[" + ", ".join(f"{x:.{digits}f}" for x in v.tolist()) + "]"


def _range_text_m(values: F64) -> str:
    if not len(values):
        return "-"
    return f"{values.min():.2f} to {values.max():.2f} m"


_OF_ENTITY = {
    Entity.VERTEX: vertex_facts,
    Entity.LANDMARK: landmark_facts,
    Entity.LOOP_CLOSURE: loop_closure_facts,
    Entity.CLOSURE: closure_facts,
}


def facts(vi_map: VIMap, entity: Entity, row: int) -> Facts:
    """Return what is known of an entity of a map."""
    return _OF_ENTITY[entity](vi_map, row) if entity in _OF_ENTITY else ()
