"""Import COLMAP models as maps."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from maplab_py.array_types import I64, Mask
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.colmap.additions import with_features, with_images
from maplab_py.interop.colmap.camera_models import MODELS, has_model
from maplab_py.interop.colmap.child_process import run_job, write_job_model
from maplab_py.interop.colmap.image_times import image_times
from maplab_py.interop.colmap.model import ColmapModel
from maplab_py.interop.colmap.options import ColmapImportOptions, ColmapImportReport
from maplab_py.interop.colmap.perspective import perspective_model
from maplab_py.interop.colmap.placing import (
    Placing,
    place_by_flags,
    place_by_trajectory,
    with_poses,
)
from maplab_py.interop.colmap.reading import read_model
from maplab_py.interop.colmap.side_file import SideFile
from maplab_py.interop.colmap.to_map import BodyFrames, body_frames, map_of_model, side_images
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex_list
from maplab_py.vimap.scale_marks import is_metric


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
    model, differing = with_poses(read_model(folder), options.colmap_poses)
    notes, recorded_uv = [differing] if differing else [], model.images.uv
    if options.undistort and not all(has_model(camera) for camera in model.cameras):
        if options.images:
            raise UserError(
                "--undistort changes the cameras, and --images are as recorded: let COLMAP undistort the "
                "images (image_undistorter) and import its model"
            )
        model = _perspective(model, folder)
    side = SideFile.read(folder)
    times_ns = _times(model, side, options)
    bodies = body_frames(model, times_ns, side)
    placing = _place(model, bodies, options)
    imported = map_of_model(
        model,
        bodies,
        times_ns,
        side,
        T_G_W=placing.T_G_W,
        scale=placing.scale,
        is_metric=_metric_missions(bodies, side, placing, options),
        sigma_px=options.colmap_keypoint_sigma_px,
        edge_sigma=np.repeat(
            [options.colmap_odometry_sigma_m, np.deg2rad(options.colmap_odometry_sigma_deg)], 3
        ),
    )
    vi_map, attached = imported.vi_map, 0
    names = [model.images.name[row] for row in imported.images.tolist()]
    if database is not None:
        uv = recorded_uv[imported.keypoints]
        vi_map, said = with_features(vi_map, names, uv, database, progress=progress)
        notes += said
    if options.images:
        vi_map, attached = with_images(
            vi_map, names, Path(options.images), link=options.link_images, progress=progress
        )
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
        notes=(*notes, *_notes(vi_map, side)),
    )


def _times(model: ColmapModel, side: SideFile | None, options: ColmapImportOptions) -> I64:
    """Return the times (N,) of images; the side file has those of its images."""
    known = np.full(len(model.images.id), -1, dtype=np.int64)
    if side is not None and options.timestamps_from == "name":
        known = side_images(model, side)
    times_ns = np.zeros(len(known), dtype=np.int64)
    if side is not None:
        times_ns[known >= 0] = side.image_time_ns[known[known >= 0]]
    new = np.flatnonzero(known < 0)
    file = Path(options.timestamps_file) if options.timestamps_file else None
    names = tuple(model.images.name[row] for row in new.tolist())
    times_ns[new] = image_times(
        names,
        options.timestamps_from,
        file,
        interval_s=options.order_interval_s,
        time_unit=options.time_unit,
    )
    return times_ns


def _place(model: ColmapModel, bodies: BodyFrames, options: ColmapImportOptions) -> Placing:
    if options.align_to:
        trajectory = read_trajectory(Path(options.align_to))
        return place_by_trajectory(bodies.time_ns, bodies.T_W_R, bodies.T_R_I, trajectory)
    return place_by_flags(se3.inverse(model.images.T_C_W), options.scale, options.gravity)


def _metric_missions(
    bodies: BodyFrames, side: SideFile | None, placing: Placing, options: ColmapImportOptions
) -> Mask:
    """Return the missions (M,) whose scale and gravity are known."""
    metric = np.full(len(bodies.mission_rig), placing.is_metric, dtype=np.bool_)
    if side is not None and not options.scale and not options.gravity:
        rows = bodies.mission_row
        metric |= (rows >= 0) & (side.is_metric[rows] != 0)
    return metric


def _perspective(model: ColmapModel, folder: Path) -> ColmapModel:
    """Return the model with perspective cameras where maplab has no model of a camera."""
    for camera in model.cameras:
        if MODELS[camera.model].name == "EQUIRECTANGULAR":
            raise UserError(
                f"{folder}: camera {camera.id} is EQUIRECTANGULAR: no perspective image shows it"
            )
    with tempfile.TemporaryDirectory(prefix="maplab-colmap-") as name:
        work = Path(name)
        write_job_model(model, work)
        return perspective_model(model, work, lambda: run_job("undistort", work, folder))


def _notes(vi_map: VIMap, side: SideFile | None) -> tuple[str, ...]:
    notes = []
    if not all(is_metric(vi_map, row) for row in range(len(vi_map.missions))):
        notes.append(
            "scale or gravity are arbitrary: optvi will refuse inertial terms; give --align_to=TRAJECTORY, "
            "or --scale and --gravity"
        )
    if side is not None:
        notes.append("ids, times and body frames come from maplab.npz beside the model")
    return tuple(notes)
