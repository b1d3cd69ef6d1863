"""Satellite positions as absolute measurements of vertices, in a local frame east, north, up.

Positions are stored as absolute poses whose orientation is the estimated one with a deviation of
1000 rad: it weighs nothing, and the format needs no type of its own.
"""

from pathlib import Path

import numpy as np

from maplab_py.algorithms.external_poses import alignment, trajectories
from maplab_py.algorithms.external_poses.options import GpsImport, GpsOptions, LeftOutFixes
from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.interop.gps import GpsTrack, east_north_up_m
from maplab_py.sensors import OtherSensor
from maplab_py.sensors.yaml_entry import Entry
from maplab_py.vimap import AbsolutePoses, MissionSensor, VIMap, mission_labels

ORIGIN = "enu_origin"
"""Key of the origin in the sensor's entry of sensors.yaml."""
_ORIGIN_KEYS = ("latitude_deg", "longitude_deg", "altitude_m")

Origin = tuple[float, float, float]
"""Latitude, longitude [deg] and ellipsoidal altitude [m] of the origin of G."""


def origin_of(vi_map: VIMap) -> Origin | None:
    """Return the origin of east, north and up that the sensors of a map name, None if there is none.

    Raises:
        MapError: An entry of sensors.yaml is wrong, or two sensors have different origins.
    """
    origins: set[Origin] = set()
    for sensor in vi_map.sensors.sensors.values():
        if isinstance(sensor, OtherSensor) and ORIGIN in sensor.keys:
            entry = Entry(sensor.keys[ORIGIN], f"sensors.yaml: sensor {sensor.id}: {ORIGIN}")
            lat, lon, alt = (entry.number(key) for key in _ORIGIN_KEYS)
            origins.add((lat, lon, alt))
    if len(origins) > 1:
        raise MapError(
            f"sensors.yaml: sensors name {len(origins)} origins of east, north and up: the missions were "
            "merged from maps with different ones; import their positions again with one --gps_origin"
        )
    return origins.pop() if origins else None


def attach_fixes(
    vi_map: VIMap, mission: int, track: GpsTrack, options: GpsOptions
) -> tuple[VIMap, GpsImport]:
    """Attach positions to the nearest vertices of a mission (row) and move its base frame.

    A fix is moved to the time of its vertex by the estimated motion between the two.

    Raises:
        UserError: Fewer than two fixes are at the time of the mission, the mission has absolute poses and
            `options.replace` is not set, or another origin is given than the map has.
        EstimationError: The positions have no horizontal extent.
    """
    before = origin_of(vi_map)
    vi_map = trajectories.without_absolute_poses(
        vi_map, mission, track.source, replace=options.replace, flag="gps_replace"
    )
    origin = _origin(vi_map, before, track, options)
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    stamps, times = vi_map.vertices.timestamp_ns[rows], options.shifted(track.times_ns)
    fixes, place = _matches(stamps, times, options, track.source)
    T_I_S = se3.make(se3.identity()[:4], np.array(options.lever_arm))
    T_M_S = se3.compose(vi_map.vertices.T_M_I[rows], T_I_S)
    p_G = east_north_up_m(track, origin)[fixes]
    p_M = interpolation.interpolate_poses(stamps, T_M_S, times[fixes])[0][:, 4:]
    T_G_M = alignment.robust_yaw_position(p_G, p_M) if options.align else vi_map.T_G_M[mission]
    error_m = np.linalg.norm(p_G - se3.transform(T_G_M, p_M), axis=1)
    movement = alignment.Movement(0.0, 0.0)
    if options.align:
        vi_map, movement = alignment.with_aligned_base_frame(vi_map, mission, T_G_M)
    at_vertex = p_G + so3.rotate(T_G_M[:4], T_M_S[place, 4:] - p_M)
    q_G_S = se3.compose(T_G_M, T_M_S[place])[:, :4]
    words = trajectories.content_words(vi_map, mission, "gps", times, p_G)
    keys = {
        "topic": "",
        "description": "satellite positions, east north up of an origin on WGS 84",
        ORIGIN: dict(zip(_ORIGIN_KEYS, origin, strict=True)),
    }
    vi_map = trajectories.with_sensor(
        vi_map, mission, MissionSensor.ABSOLUTE_6DOF, words, T_I_S, keys
    )
    added = AbsolutePoses.filled(
        len(fixes),
        vertex=rows[place],
        timestamp_ns=stamps[place],
        sensor_id=np.tile(words, (len(fixes), 1)),
        T_G_S=se3.make(q_G_S, at_vertex),
        covariance=np.tile(np.diag(_variance(options)), (len(fixes), 1, 1)),
    )
    table = AbsolutePoses.concatenate([vi_map.absolute_poses, added])
    return vi_map.replace(absolute_poses=table), GpsImport(
        Path(track.source),
        mission_labels(vi_map)[mission],
        len(track),
        len(fixes),
        tuple(LeftOutFixes(reason, count) for reason, count in track.left_out),
        *origin,
        *movement,
        float(np.median(error_m)),
    )


def _origin(vi_map: VIMap, before: Origin | None, track: GpsTrack, options: GpsOptions) -> Origin:
    """Return the origin that other missions have, else the given, that of before, or the median."""
    known, given = origin_of(vi_map), options.given_origin
    if known is not None and given is not None and known != given:
        lat, lon, alt = known
        raise UserError(
            f"--gps_origin={options.origin}: the map has another origin ({lat!r},{lon!r},{alt!r}): leave "
            "the flag out"
        )
    if known is not None:
        return known
    if given is not None:
        return given
    if before is not None:
        return before
    lat, lon, alt = (
        float(np.median(values))
        for values in (track.latitude_deg, track.longitude_deg, track.altitude_m)
    )
    return lat, lon, alt


def _matches(stamps: I64, times: I64, options: GpsOptions, source: str) -> tuple[I64, I64]:
    """Return the fixes to use and the place of the vertex of each; a vertex gets its nearest fix."""
    if len(stamps) < 2:
        raise UserError(f"{source}: the mission has fewer than two vertices to attach positions to")
    gap_ns = round(options.max_gap_s * 1e9)
    zeros = np.zeros((len(stamps), 1))
    covered = interpolation.interpolate_vectors(stamps, zeros, times, max_gap_ns=gap_ns)[1]
    fixes = np.flatnonzero(covered)
    place = trajectories.nearest(stamps, times[fixes])
    order = np.lexsort((np.abs(times[fixes] - stamps[place]), place))
    place, first = np.unique(place[order], return_index=True)
    fixes = fixes[order][first]
    if len(fixes) < 2:
        spans = [f"{t[0] * 1e-9:.3f} to {t[-1] * 1e-9:.3f} s" for t in (times, stamps)]
        raise UserError(
            f"{source}: {len(fixes)} fixes are at the time of the mission: fixes are from {spans[0]}, "
            f"vertices from {spans[1]}: give --gps_time_offset_s, or a larger --gps_max_gap_s"
        )
    return fixes, place


def _variance(options: GpsOptions) -> F64:
    horizontal, vertical = options.sigma_m, options.sigma_vertical_m or 2.0 * options.sigma_m
    return np.array([horizontal, horizontal, vertical, *[trajectories.UNKNOWN_SIGMA_RAD] * 3]) ** 2
