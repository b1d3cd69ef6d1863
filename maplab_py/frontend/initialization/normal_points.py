"""Normal points: observations averaged with those of the same tracks in neighbouring frames.

Frames without states of their own add what they saw at no cost for the solver. Where states and landmarks
are approximately known, an observation of such a frame is moved to the nearest frame of the segment by the
difference of both projections. That difference hardly depends on what is still unknown: it does not change
with the scale, and an error of the velocity cancels between the neighbours before and after.

Source: the normal points of satellite laser ranging (A. T. Sinclair, Data Screening and Normal Point
Formation, 1997).
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.estimation.imu.preintegration import propagate
from maplab_py.estimation.window.calibration import WindowCalibration
from maplab_py.estimation.window.cameras import CameraPoses
from maplab_py.estimation.window.states import WindowStates
from maplab_py.frontend.initialization.segment import ObservedFrames, Segment
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, Imu, projection


def with_normal_points(
    segment: Segment,
    states: WindowStates,
    track_id: I64,
    p_M: F64,
    rig: WindowCalibration,
    gate_chi2: float,
) -> Segment:
    """Return a segment whose observations of landmarks are averaged with those of the frames between.

    Args:
        segment: Frames.
        states: Their approximate states (F).
        track_id: Tracks (L,) that are landmarks, ascending; observations of others stay as they are.
        p_M: Their approximate places (L, 3).
        rig: The cameras.
        gate_chi2: Largest squared difference of two observations of a mean in standard deviations.

    Returns:
        The segment with the weighted means and their standard deviations, and no frames between.
    """
    between = segment.between
    if not len(between.frame) or not len(track_id):
        return segment
    edge = np.searchsorted(segment.time_ns, between.time_ns, side="right") - 1
    T_M_I, share = _poses_between(segment, states, edge)
    nearest = (edge + (share > 0.5)).astype(np.int32)[between.frame]
    names = _names(segment, segment.frame, track_id, len(rig.cameras))
    target, has_target = _places(names, _names(between, nearest, track_id, len(rig.cameras)))
    rows = np.flatnonzero(has_target)
    target, camera, near = target[rows], between.camera[rows], nearest[rows]
    p_M = p_M[np.searchsorted(track_id, between.track_id[rows])]
    there = CameraPoses.of(T_M_I, rig.T_I_C).to_camera(between.frame[rows], camera, p_M)
    here = CameraPoses.of(states.T_M_I, rig.T_I_C).to_camera(near, camera, p_M)
    shift, is_visible = _differences(rig.cameras, camera, there, here)
    moved = between.uv_px[rows] + shift
    variance = between.sigma_px[rows] ** 2
    apart2 = np.sum((moved - segment.uv_px[target]) ** 2, axis=1)
    is_close = is_visible & (apart2 <= gate_chi2 * (variance + segment.sigma_px[target] ** 2))
    target, moved, weight = target[is_close], moved[is_close], 1.0 / variance[is_close]
    count = len(segment.frame)
    sums = segment.sigma_px**-2.0 + np.bincount(target, weight, count)
    uv_px = segment.uv_px.copy()
    for axis in range(2):
        offset = moved[:, axis] - segment.uv_px[target, axis]
        uv_px[:, axis] += np.bincount(target, weight * offset, count) / sums
    return dataclasses.replace(
        segment, uv_px=uv_px, sigma_px=sums**-0.5, between=ObservedFrames.of([])
    )


def _poses_between(segment: Segment, states: WindowStates, edge: I64) -> tuple[F64, F64]:
    """Return poses T_M_I (B, 7) of the frames between, and where they are on their edges, 0 to 1.

    Poses are integrated from the frame before; what is missing at the frame behind is distributed evenly.
    """
    data, motion = segment.inertial, states.motion[:-1]
    imu: Imu = data.imus[0]
    gravity_M = np.array([0.0, 0.0, -imu.gravity_magnitude_mps2])
    T_M_I, _ = propagate(
        data, states.T_M_I[:-1], motion[:, :3], motion[:, 3:6], motion[:, 6:], gravity_M
    )
    missing = se3.local(T_M_I[data.sample_start[1:] - 1], states.T_M_I[1:])
    time_ns = segment.between.time_ns
    begin_ns, end_ns = segment.time_ns[edge], segment.time_ns[edge + 1]
    share = (time_ns - begin_ns) / (end_ns - begin_ns)
    sample = np.searchsorted(data.timestamp_ns, time_ns)
    return se3.retract(T_M_I[sample], share[:, None] * missing[edge]), share


def _names(seen: ObservedFrames, frame: I32, track_id: I64, cameras: int) -> I64:
    """Return a number (N,) for each frame (N,), camera and landmark; -1 where a track is none."""
    row = np.minimum(np.searchsorted(track_id, seen.track_id), len(track_id) - 1)
    name = (frame.astype(np.int64) * cameras + seen.camera) * len(track_id) + row
    return np.where(track_id[row] == seen.track_id, name, -1)


def _places(names: I64, wanted: I64) -> tuple[I64, Mask]:
    """Return where wanted names (M,) are among names (N,), and whether they are there."""
    order = np.argsort(names, kind="stable")
    place = order[np.minimum(np.searchsorted(names[order], wanted), len(names) - 1)]
    return place, (wanted >= 0) & (names[place] == wanted)


def _differences(
    cameras: tuple[Camera, ...], camera: I32, there: F64, here: F64
) -> tuple[F64, Mask]:
    """Return by how much projections (M, 2) differ between points (M, 3) in cameras, here less there."""
    shift, is_visible = np.zeros((len(camera), 2)), np.zeros(len(camera), dtype=np.bool_)
    for number, model in enumerate(cameras):
        rows = np.flatnonzero(camera == number)
        uv_there, in_there = projection.project(model, there[rows])
        uv_here, in_here = projection.project(model, here[rows])
        shift[rows], is_visible[rows] = uv_here - uv_there, in_here & in_there
    return shift, is_visible
