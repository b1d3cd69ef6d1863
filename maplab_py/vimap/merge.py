"""Merge the missions of one map into another."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.errors import MapError
from maplab_py.report import Report
from maplab_py.vimap.edits import content_rng, with_new_ids
from maplab_py.vimap.ids import as_keys, is_valid, random_ids, to_hex, to_hex_list
from maplab_py.vimap.sensor_merge import conflicting_sensors, with_renamed_sensors
from maplab_py.vimap.stacking import stack
from maplab_py.vimap.vi_map import VIMap

_UNIQUE_TABLES = {
    "missions": "mission",
    "baseframes": "base frame",
    "vertices": "vertex",
    "landmarks": "landmark",
    "imu_edges": "IMU edge",
    "transformation_edges": "transformation edge",
    "loop_closure_edges": "loop closure edge",
    "frames": "frame",
}


@dataclasses.dataclass(frozen=True)
class MergeReport(Report):
    """Missions and sensors added by a merge."""

    missions_added: tuple[str, ...]  # ids they have now
    vertices_added: int
    landmarks_added: int
    assigned_new_ids: bool
    sensors_shared: tuple[str, ...]
    sensors_renamed: tuple[tuple[str, str], ...]  # (old id, new id): the calibration differed


def merge_maps(
    base: VIMap, other: VIMap, *, assign_new_ids: bool = False
) -> tuple[VIMap, MergeReport]:
    """Return `base` with the missions of `other` added.

    Sensors with equal calibration are shared. If the calibrations differ, both sensors are kept and
    that of the other map gets a new id, derived from the content of both maps.

    Args:
        base: The map whose metadata are kept and whose missions come first.
        other: The map whose missions are added.
        assign_new_ids: Assign new ids to `other` first, so that the map can hold a recording
            twice.

    Raises:
        MapError: An id of `other` is in `base` already and `assign_new_ids` is off.
    """
    if assign_new_ids:
        other = with_new_ids(other, content_rng(base, "merge", other))
    _check_disjoint(base, other)
    other, shared, renamed = with_compatible_sensors(base, other)
    merged = stack(base, other)
    report = MergeReport(
        missions_added=tuple(to_hex_list(other.missions.id)),
        vertices_added=len(other.vertices),
        landmarks_added=len(other.landmarks),
        assigned_new_ids=assign_new_ids,
        sensors_shared=shared,
        sensors_renamed=renamed,
    )
    return merged, report


def with_compatible_sensors(
    base: VIMap, other: VIMap
) -> tuple[VIMap, tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Rename the other map's sensors whose calibration differs from the base's of the same id.

    Returns:
        The other map, the ids of shared sensors, and (old id, new id) of renamed ones.
    """
    conflicts = conflicting_sensors(base.sensors, other.sensors)
    renamed: tuple[tuple[str, str], ...] = ()
    if conflicts:
        new_ids = random_ids(len(conflicts), content_rng(base, "sensors", other))
        renamed = tuple(zip(conflicts, to_hex_list(new_ids), strict=True))
    shared = tuple(
        sensor_id
        for sensor_id in other.sensors.sensors
        if sensor_id in base.sensors.sensors and sensor_id not in conflicts
    )
    return with_renamed_sensors(other, dict(renamed)), shared, renamed


def _check_disjoint(base: VIMap, other: VIMap) -> None:
    for name, noun in _UNIQUE_TABLES.items():
        mine, theirs = getattr(base, name).id, getattr(other, name).id
        clash = np.flatnonzero(np.isin(as_keys(theirs), as_keys(mine)) & is_valid(theirs))
        if len(clash):
            raise MapError(
                f"{noun} {to_hex(theirs[clash[0]])} is in both maps ({len(clash)} equal {noun} "
                "ids): use --assign_new_ids to keep both, or, if these are pieces of "
                "one mission, load_merge_submap or load_merge_all_submaps"
            )
