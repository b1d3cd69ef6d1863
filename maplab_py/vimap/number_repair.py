"""Removal of rows with non-finite numbers, so that the rest of a map can be loaded and saved."""

from typing import Any

import numpy as np

from maplab_py.array_types import Mask
from maplab_py.geometry import se3
from maplab_py.report import counted
from maplab_py.vimap import edits
from maplab_py.vimap.consistency import LOADED_UNIT_TOLERANCE
from maplab_py.vimap.table import Table
from maplab_py.vimap.vi_map import VIMap

_POSES = {
    "baseframes": "T_G_M",
    "vertices": "T_M_I",
    "transformation_edges": "T_A_B",
    "loop_closure_edges": "T_A_B",
    "absolute_poses": "T_G_S",
}
_DROPPED = "without finite numbers dropped"
_STATE = ("v_M", "gyro_bias", "accel_bias")


def without_bad_numbers(vi_map: VIMap) -> tuple[VIMap, list[str]]:
    """Return a map without the entries that have infinite values or NaN, and a note for each kind.

    Landmarks, keypoints, edges, absolute poses, IMU samples and vertices without a pose are removed, and
    missions that lose all vertices; velocities and biases become zero, base frames unknown.
    """
    notes: list[str] = []

    def note(bad: Mask, noun: str, done: str, plural: str = "") -> bool:
        if bad.any():
            notes.append(f"{counted(int(bad.sum()), noun, plural)} {done}")
        return bool(bad.any())

    for field, name in _POSES.items():
        table: Any = getattr(vi_map, field)
        length = np.hypot.reduce(table.columns()[name][:, :4], axis=1)
        scaled = (
            np.isfinite(length) & (length > 0.0) & (np.abs(length - 1.0) > LOADED_UNIT_TOLERANCE)
        )
        if note(
            scaled,
            f"quaternion of {field.replace('_', ' ')}",
            "scaled to unit length",
            f"quaternions of {field.replace('_', ' ')}",
        ):
            T = np.array(table.columns()[name])
            T[scaled, :4] /= length[scaled, None]
            vi_map = vi_map.replace(**{field: table.replace(**{name: T})})
    frames = vi_map.baseframes
    bad = _bad(frames, "T_G_M")
    if note(bad, "base frame", "without a finite pose taken as unknown"):
        T_G_M = np.where(bad[:, None], se3.identity(), frames.T_G_M)
        frames = frames.replace(T_G_M=T_G_M, is_known=frames.is_known & ~bad)
        vi_map = vi_map.replace(baseframes=frames)
    for name in _STATE:
        bad = _bad(vi_map.vertices, name)
        if note(
            bad, f"vertex with a {name}", "that is no number set to zero", f"vertices with a {name}"
        ):
            values = np.where(bad[:, None], 0.0, getattr(vi_map.vertices, name))
            vi_map = vi_map.replace(vertices=vi_map.vertices.replace(**{name: values}))
    bad = _bad(vi_map.imu_samples, "accel_gyro")
    if note(bad, "IMU sample", _DROPPED):
        edge = np.repeat(np.arange(len(vi_map.imu_edges)), vi_map.imu_edges.sample_count)
        count = np.bincount(edge[~bad], minlength=len(vi_map.imu_edges))
        count = count.astype(vi_map.imu_edges.sample_count.dtype)
        vi_map = vi_map.replace(
            imu_edges=vi_map.imu_edges.replace(sample_count=count),
            imu_samples=vi_map.imu_samples.take(~bad),
        )
    edges: tuple[tuple[str, str, tuple[str, ...]], ...] = (
        ("transformation_edges", "relative-pose edge", ("T_A_B",)),
        ("loop_closure_edges", "loop closure edge", ("T_A_B", "switch_variable")),
        ("absolute_poses", "absolute pose", ("T_G_S",)),
    )
    for field, noun, names in edges:
        table = getattr(vi_map, field)
        bad = _bad(table, *names)
        if note(bad, noun, _DROPPED):
            vi_map = vi_map.replace(**{field: table.take(~bad)})
    bad = _bad(vi_map.keypoints, "uv_px", "sigma_px", "scale")
    if note(bad, "keypoint", _DROPPED):
        vi_map = edits.remove_keypoints(vi_map, bad)
    bad = _bad(vi_map.vertices, "T_M_I")
    stored = bad[vi_map.landmarks.vertex]
    note(bad, "vertex", _DROPPED, "vertices")
    bad = _bad(vi_map.landmarks, "p_I") | stored  # their place is relative to that of the vertex
    note(bad, "landmark", _DROPPED)
    return _without_vertices(edits.remove_landmarks(vi_map, bad)), notes


def _without_vertices(vi_map: VIMap) -> VIMap:
    """Remove vertices without a pose, and missions in which all are such."""
    bad = _bad(vi_map.vertices, "T_M_I")
    if not bad.any():
        return vi_map
    left = np.bincount(vi_map.vertices.mission[~bad], minlength=len(vi_map.missions))
    lost = (left == 0) & (np.diff(vi_map.vertex_start) > 0)
    if lost.any():
        vi_map = edits.remove_missions(vi_map, lost)
        bad = _bad(vi_map.vertices, "T_M_I")
    return edits.remove_vertices(vi_map, bad)


def _bad(table: Table, *names: str) -> Mask:
    """Return which rows have a value that is not finite, or a quaternion without direction."""
    bad = np.zeros(len(table), dtype=np.bool_)
    for name in names:
        values = table.columns()[name].reshape(len(table), -1) if len(table) else np.zeros((0, 7))
        bad |= ~np.isfinite(values).all(axis=1)
        if name.startswith("T_"):
            bad |= ~values[:, :4].any(axis=1)
    return bad
