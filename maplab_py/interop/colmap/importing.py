"""Import COLMAP models as maps: times of images, poses that hold, and place in metres."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path, PurePosixPath

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.geometry.alignment import apply_similarity, umeyama
from maplab_py.input_files import read_foreign_text
from maplab_py.interop.colmap import features, reading, to_map, undistortion
from maplab_py.interop.colmap.model import ColmapModel, SideFile, has_model, picked
from maplab_py.interop.colmap.options import ColmapImportOptions, ColmapImportReport
from maplab_py.interop.stamps import IMAGES, parse_stamps
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.vimap import VIMap, to_hex_list


def import_colmap(
    folder: Path,
    options: ColmapImportOptions | None = None,
    *,
    database: Path | None = None,
    map_key: str = "",
    progress: Progress = SILENT,
) -> tuple[VIMap, ColmapImportReport]:
    """Read the model of a folder as a map: a mission of each rig, without IMU.

    Raises:
        UserError: A flag is wrong, maplab lacks a camera model, or a name has no time stamp.
        MapError: A file is missing, damaged, or does not fit the others.
    """
    options = options or ColmapImportOptions()
    if options.align_to and (options.scale or options.gravity):
        raise UserError("--align_to gives scale and gravity: leave --scale and --gravity out")
    model, notes = with_poses(reading.read_model(folder), options.colmap_poses)
    recorded_uv = model.images.uv
    if options.undistort and not all(has_model(camera) for camera in model.cameras):
        if options.images:
            raise UserError(
                "--undistort changes the cameras, and --images are as recorded: let COLMAP undistort the "
                "images (image_undistorter) and import its model"
            )
        model = undistortion.perspective_model(model, folder)
    side = SideFile.read(folder)
    row_of = {name: row for row, name in enumerate(side.image_name.tolist())}
    known = np.array([row_of.get(name, -1) for name in model.images.name], dtype=np.int64)
    stamped = known if options.timestamps_from == "name" else np.full_like(known, -1)
    times_ns, new = picked(side.image_time_ns, stamped, np.zeros_like(known)), stamped < 0
    times_ns[new] = image_times(tuple(np.array(model.images.name)[new].tolist()), options)
    bodies = to_map.body_frames(model, times_ns, side, known)
    placing = _place(model, bodies, options)
    is_metric = np.full(len(bodies.mission_rig), placing.is_metric, dtype=np.bool_)
    if not options.scale and not options.gravity:
        is_metric |= picked(side.is_metric != 0, bodies.mission_row, np.zeros_like(is_metric))
    edge_sigma = options.colmap_odometry_sigma_m, np.deg2rad(options.colmap_odometry_sigma_deg)
    imported = to_map.map_of_model(
        model,
        bodies,
        times_ns,
        side,
        T_G_W=placing.T_G_W,
        scale=placing.scale,
        is_metric=is_metric,
        sigma_px=options.colmap_keypoint_sigma_px,
        edge_sigma=np.repeat(edge_sigma, 3),
    )
    vi_map, attached = imported.vi_map, 0
    names = [model.images.name[row] for row in imported.images.tolist()]
    if database is not None:
        uv = recorded_uv[imported.keypoints]
        vi_map, said = features.with_features(vi_map, names, uv, database, progress=progress)
        notes += said
    if options.images:
        vi_map, attached = features.with_images(
            vi_map, names, Path(options.images), link=options.link_images, progress=progress
        )
    if not is_metric.all():
        notes.append(
            "scale or gravity are arbitrary: optvi will refuse inertial terms; give --align_to=TRAJECTORY, "
            "or --scale and --gravity"
        )
    if len(side.image_name):
        notes.append("ids, times and body frames come from maplab.npz beside the model")
    return vi_map, ColmapImportReport(
        map_key=map_key,
        missions=tuple(to_hex_list(vi_map.missions.id)),
        vertices=len(vi_map.vertices),
        frames=len(vi_map.frames),
        landmarks=len(vi_map.landmarks),
        observations=len(vi_map.observations),
        points_without_observation=imported.unobserved_points,
        images_as_resources=attached,
        scale=placing.scale,
        aligned_vertices=placing.matched,
        alignment_rmse_m=placing.rmse_m if placing.matched else None,
        notes=tuple(notes),
    )


def _place(model: ColmapModel, bodies: to_map.BodyFrames, options: ColmapImportOptions) -> Placing:
    if options.align_to:
        trajectory = read_trajectory(Path(options.align_to))
        return _place_by_trajectory(bodies, trajectory)
    if not np.isfinite(options.scale) or options.scale < 0.0:
        raise UserError(
            f"--scale={options.scale:g}: wants metres per unit of the model, or 0 = unknown"
        )
    T_G_W = se3.identity()
    if options.gravity:
        direction = _direction(se3.inverse(model.images.T_C_W), options.gravity)
        T_G_W = se3.make(_turn_to_down(direction), np.zeros(3))
    return Placing(T_G_W, options.scale or 1.0, bool(options.scale and options.gravity))


_NS_PER_S = 1_000_000_000
_MAX_FILE_BYTES = 1_000_000_000
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_FEWEST_DIGITS = 9
"""Shorter whole numbers in names count images."""


def image_times(names: tuple[str, ...], options: ColmapImportOptions) -> I64:
    """Return the times (N,) [ns] of images by their names.

    By name it is the last number in the file's name; by order images follow their names without folders,
    which equal frames share.

    Raises:
        UserError: A name has no time stamp, or the file is not given or lacks an image.
        MapError: The file is damaged.
    """
    if options.timestamps_from == "order":
        stems = np.array([PurePosixPath(name).name for name in names])
        _, row = np.unique(stems, return_inverse=True)
        return np.asarray((row + 1) * round(options.order_interval_s * _NS_PER_S), dtype=np.int64)
    if options.timestamps_from == "file":
        if not options.timestamps_file:
            raise UserError("--timestamps_from=file needs the file: give --timestamps_file=FILE")
        file = Path(options.timestamps_file)
        times = read_times(file, options.time_unit)
        missing = [name for name in names if name not in times]
        if missing:
            raise UserError(f"{file}: has no time stamp of image {missing[0]}: add a line for it")
        return np.array([times[name] for name in names], dtype=np.int64)
    tokens = []
    for name in names:
        numbers = _NUMBER.findall(PurePosixPath(name).stem) or [""]
        tokens.append(numbers[-1])
        if "." not in tokens[-1] and not _FEWEST_DIGITS <= len(tokens[-1]) < 20:
            raise UserError(
                f"image {name}: its name has no time stamp: give --timestamps_from=order, or =file with "
                "--timestamps_file"
            )
    return _times_ns(names, tokens, "names of images", None, options.time_unit)


def read_times(file: Path, time_unit: str = "") -> dict[str, int]:
    """Return the times [ns] of images by name: lines `name stamp` or `name,stamp`.

    Raises:
        MapError: The file cannot be read, a line is wrong, or the unit is open; names the line.
    """
    text = read_foreign_text(file, _MAX_FILE_BYTES)
    stamps: dict[str, tuple[int, str]] = {}
    header = ""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.replace('"', "").strip()
        match = re.fullmatch(
            r"(.+?)[\s,;]+([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)", content
        )
        is_header = not (stamps or header or match) and re.search("time|stamp", content.lower())
        if not content or content.startswith("#") or is_header:
            header = header or content
            continue
        if match is None:
            raise MapError(f"{file}:{number}: wants an image name and a time stamp")
        if match[1] in stamps:
            raise MapError(f"{file}:{number}: image {match[1]} is there twice")
        stamps[match[1]] = (number, match[2])
    if not stamps:
        raise MapError(f"{file}: there are no rows in the file: write or copy it again")
    lines, tokens = zip(*stamps.values(), strict=True)
    times_ns = _times_ns(tuple(stamps), tokens, str(file), lines, time_unit, header)
    return dict(zip(stamps, times_ns.tolist(), strict=True))


def _times_ns(
    names: tuple[str, ...],
    tokens: Sequence[str],
    source: str,
    lines: Sequence[int] | None,
    time_unit: str,
    header: str = "",
) -> I64:
    """Return times whose unit follows from the folder with the most images, in the order of time."""
    if not tokens:
        return np.zeros(0, dtype=np.int64)
    if not time_unit:
        folders = [str(PurePosixPath(name).parent) for name in names]
        largest = max(sorted(set(folders)), key=folders.count)
        rows = [row for row, folder in enumerate(folders) if folder == largest]
        rows.sort(key=lambda row: Decimal(tokens[row]))
        part = [tokens[row] for row in rows]
        places = [row + 1 if lines is None else lines[row] for row in rows]
        time_unit = parse_stamps(part, IMAGES, source, places, header=header).unit
    return parse_stamps(tokens, IMAGES, source, lines, unit=time_unit).times_ns


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


def with_poses(model: ColmapModel, choice: str = "") -> tuple[ColmapModel, list[str]]:
    """Return the model with the poses of frames that hold, and notes on what differs.

    Args:
        model: Model, whose images and whose frames with their rigs both have poses.
        choice: images, frames, or empty = the images that differ from what rigs and frames say.
    """
    images, frames = model.images, model.frames
    T_C_R = np.full((len(model.cameras), 7), np.nan)
    for rig in model.rigs:
        T_C_R[list(rig.cameras)] = rig.T_C_R
    frame, place, T_S_R = images.frame, model.place_in_rig[images.camera], T_C_R[images.camera]
    T_R_W = se3.compose(se3.inverse(T_S_R), images.T_C_W)
    apart = se3.local(frames.T_R_W[frame], T_R_W)
    turned, moved = (np.linalg.norm(apart[:, k : k + 3], axis=1) for k in (3, 0))
    spread = float(np.sqrt(np.sum(np.var(frames.T_R_W[:, 4:], axis=0))))
    differs = (turned > _SAME_RAD) | (moved > _SAME_SHARE * max(spread, 1.0))
    if not differs.any():
        return model, []
    said = (
        f"the poses of {counted(int(differs.sum()), 'image')} differ from those of rigs and frames by up to "
        f"{np.degrees(turned[differs].max()):.3g} deg and {moved[differs].max():.3g} units"
    )
    if choice == "frames":
        return model, [f"{said}: those of the frames are taken"]
    known = np.isfinite(T_R_W).all(axis=1) & (differs | (choice == "images"))
    rows = np.flatnonzero(known)
    rows = rows[np.lexsort((place[rows], frame[rows]))]
    changed, first = np.unique(frame[rows], return_index=True)
    poses = frames.T_R_W.copy()
    poses[changed] = T_R_W[rows[first]]
    said += ": those of the images are taken"
    if not choice:
        said += ", --colmap_poses=frames takes the others"
    return dataclasses.replace(model, frames=dataclasses.replace(frames, T_R_W=poses)), [said]


def _place_by_trajectory(bodies: to_map.BodyFrames, trajectory: Trajectory) -> Placing:
    """Align body positions with a trajectory, interpolated at their times, by a similarity."""
    stamps, first = np.unique(trajectory.times_ns, return_index=True)
    T_G_I, valid = interpolation.interpolate_poses(
        stamps, trajectory.T_R_B[first], bodies.time_ns, max_gap_ns=_LONGEST_GAP_NS
    )
    if np.count_nonzero(valid) < _MIN_MATCHED:
        raise UserError(
            f"--align_to={trajectory.source}: {np.count_nonzero(valid)} frames lie in its time span, at "
            f"least {_MIN_MATCHED} are needed: check --timestamps_from, and the clock of its stamps"
        )
    p_G, T_W_R, p_R_I = T_G_I[valid, 4:], bodies.T_W_R[valid], bodies.T_R_I[valid, 4:]
    T_G_W, scale = umeyama(p_G, T_W_R[:, 4:], with_scale=True)
    rounds = _LEVER_ROUNDS if np.any(p_R_I) else 0
    for _ in range(rounds):  # the body's lever arm is not scaled
        q_G_R = so3.multiply(T_G_W[:4], T_W_R[:, :4])
        T_G_W, scale = umeyama(p_G - so3.rotate(q_G_R, p_R_I), T_W_R[:, 4:], with_scale=True)
    error = se3.transform(apply_similarity(T_G_W, scale, T_W_R), p_R_I) - p_G
    rmse = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return Placing(T_G_W, scale, True, int(np.count_nonzero(valid)), rmse)


def _direction(T_W_C: F64, gravity: str) -> F64:
    """Return the unit vector of "x,y,z" in W, or for `UPRIGHT` the mean of the images' downward axes."""
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
    q = np.append(np.cross(direction, down), 1.0 + direction @ down)
    is_opposite = float(np.linalg.norm(q)) < 1e-12
    return np.array([1.0, 0.0, 0.0, 0.0]) if is_opposite else so3.normalize(q)
