"""Scale, gravity and place of a model in metres, with gravity along -z."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.alignment import apply_similarity, umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.colmap.model import ColmapModel, SensorType
from maplab_py.interop.trajectories import Trajectory
from maplab_py.report import counted

_SAME_RAD, _SAME_SHARE = 2e-4, 1e-4
"""Differences between poses that rounded text makes; of positions: share of their spread."""
_LONGEST_GAP_NS = 500_000_000
_MIN_MATCHED = 3
_LEVER_ROUNDS = 10
UPRIGHT = "upright"


@dataclasses.dataclass(frozen=True, eq=False)
class Placing:
    """The similarity that takes a model's world W to the map's frame G."""

    T_G_W: F64  # (7,)
    scale: float
    is_metric: bool  # scale and gravity are known
    matched: int = 0  # vertices that the trajectory has
    rmse_m: float = float("nan")  # of their positions after the alignment


def with_poses(model: ColmapModel, choice: str = "") -> tuple[ColmapModel, str]:
    """Return the model with the poses of frames that hold, and a clause on what differs.

    Args:
        model: Model, whose images and whose frames with their rigs both have poses.
        choice: images, frames, or empty = the images that differ from what rigs and frames say.
    """
    images, frames = model.images, model.frames
    of_camera = {
        number: (row, pose)
        for rig in model.rigs
        for row, ((kind, number), pose) in enumerate(zip(rig.sensors, rig.T_S_R, strict=True))
        if kind == SensorType.CAMERA
    }
    sensor = np.array([of_camera[camera][0] for camera in images.camera.tolist()], dtype=np.int64)
    T_S_R = np.array([of_camera[camera][1] for camera in images.camera.tolist()]).reshape(-1, 7)
    order = np.argsort(frames.image_id, kind="stable")
    frame = frames.image_frame[order][np.searchsorted(frames.image_id[order], images.id)]
    T_R_W = se3.compose(se3.inverse(T_S_R), images.T_C_W)
    apart = se3.local(frames.T_R_W[frame], T_R_W)
    turned, moved = (np.linalg.norm(apart[:, k : k + 3], axis=1) for k in (3, 0))
    spread = float(np.sqrt(np.sum(np.var(frames.T_R_W[:, 4:], axis=0))))
    differs = (turned > _SAME_RAD) | (moved > _SAME_SHARE * max(spread, 1.0))
    if not differs.any():
        return model, ""
    said = (
        f"the poses of {counted(int(differs.sum()), 'image')} differ from those of rigs and frames by up to "
        f"{np.degrees(turned[differs].max()):.3g} deg and {moved[differs].max():.3g} units"
    )
    if choice == "frames":
        return model, f"{said}: those of the frames are taken"
    known = np.isfinite(T_R_W).all(axis=1) & (differs | (choice == "images"))
    rows = np.flatnonzero(known)
    rows = rows[np.lexsort((sensor[rows], frame[rows]))]
    changed, first = np.unique(frame[rows], return_index=True)
    poses = frames.T_R_W.copy()
    poses[changed] = T_R_W[rows[first]]
    said += ": those of the images are taken"
    if not choice:
        said += ", --colmap_poses=frames takes the others"
    return dataclasses.replace(model, frames=dataclasses.replace(frames, T_R_W=poses)), said


def place_by_trajectory(times_ns: I64, T_W_R: F64, T_R_I: F64, trajectory: Trajectory) -> Placing:
    """Align body positions with a trajectory, interpolated at their times, by a similarity.

    Args:
        times_ns: Times (N,).
        T_W_R: Poses (N, 7) of the rig, in units of the model.
        T_R_I: Poses (N, 7) of the body on the rig, in metres.
        trajectory: Poses of the body.

    Raises:
        UserError: Fewer than three vertices have a pose in the trajectory.
    """
    stamps, first = np.unique(trajectory.times_ns, return_index=True)
    T_G_I, valid = interpolate_poses(
        stamps, trajectory.T_R_B[first], times_ns, max_gap_ns=_LONGEST_GAP_NS
    )
    if np.count_nonzero(valid) < _MIN_MATCHED:
        raise UserError(
            f"--align_to={trajectory.source}: {np.count_nonzero(valid)} frames lie in its time span, at "
            f"least {_MIN_MATCHED} are needed: check --timestamps_from, and the clock of its stamps"
        )
    p_G, T_W_R, p_R_I = T_G_I[valid, 4:], T_W_R[valid], T_R_I[valid, 4:]
    T_G_W, scale = umeyama(p_G, T_W_R[:, 4:], with_scale=True)
    rounds = _LEVER_ROUNDS if np.any(p_R_I) else 0
    for _ in range(rounds):  # the body's lever arm is not scaled
        q_G_R = so3.multiply(T_G_W[:4], T_W_R[:, :4])
        T_G_W, scale = umeyama(p_G - so3.rotate(q_G_R, p_R_I), T_W_R[:, 4:], with_scale=True)
    error = se3.transform(apply_similarity(T_G_W, scale, T_W_R), p_R_I) - p_G
    rmse = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return Placing(T_G_W, scale, True, int(np.count_nonzero(valid)), rmse)


def place_by_flags(T_W_C: F64, scale: float, gravity: str) -> Placing:
    """Scale the model, and turn its direction of gravity to -z.

    Args:
        T_W_C: Poses (N, 7) of the cameras.
        scale: Metres per unit of the model; 0 = unknown.
        gravity: Direction "x,y,z" in W, `UPRIGHT` = mean of the images' downward axes, empty = unknown.

    Raises:
        UserError: A value is wrong.
    """
    if not np.isfinite(scale) or scale < 0.0:
        raise UserError(f"--scale={scale:g}: wants metres per unit of the model, or 0 = unknown")
    T_G_W = se3.identity()
    if gravity:
        T_G_W = se3.make(_turn_to_down(_direction(T_W_C, gravity)), np.zeros(3))
    return Placing(T_G_W, scale or 1.0, bool(scale and gravity))


def _direction(T_W_C: F64, gravity: str) -> F64:
    if gravity == UPRIGHT:
        down = so3.rotate(T_W_C[:, :4], np.array([0.0, 1.0, 0.0])).mean(axis=0)
    else:
        try:
            down = np.array([float(part) for part in gravity.split(",")])
        except ValueError:
            down = np.zeros(0)
    length = float(np.linalg.norm(down))
    if down.shape != (3,) or not np.isfinite(length) or length < 1e-6:
        raise UserError(
            f"--gravity={gravity}: wants a direction x,y,z in the model's frame, or {UPRIGHT}"
        )
    return np.asarray(down / length)


def _turn_to_down(direction: F64) -> F64:
    """Return the smallest rotation (4,) that takes a unit vector to -z."""
    down = np.array([0.0, 0.0, -1.0])
    axis = np.cross(direction, down)
    sine, cosine = float(np.linalg.norm(axis)), float(direction @ down)
    if sine < 1e-12:
        axis, sine = np.array([1.0, 0.0, 0.0]), 1.0
        angle = 0.0 if cosine > 0.0 else np.pi
    else:
        angle = float(np.arctan2(sine, cosine))
    return np.asarray(so3.exp(axis / sine * angle))
