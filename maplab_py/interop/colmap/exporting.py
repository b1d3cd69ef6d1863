"""Export maps as COLMAP models, with a database of keypoints, descriptors and matches."""

import dataclasses
import re
import tempfile
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.distinct import distinct
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.colmap import model as colmap
from maplab_py.interop.colmap import pycolmap_files, records, undistortion
from maplab_py.interop.colmap.options import ColmapExportOptions, ColmapExportReport
from maplab_py.interop.colmap.pycolmap_files import DATABASE
from maplab_py.output_files import check_writable, copy_file, write_bytes
from maplab_py.sensors import Camera, projection
from maplab_py.vimap import LandmarkQuality, MissionSensor, VIMap, edits, from_hex, is_valid
from maplab_py.vimap.descriptors import type_name, type_of_name, types_of
from maplab_py.vimap.queries import is_metric, mission_labels, mission_sensor_id
from maplab_py.vimap.table import ragged_rows


def export_colmap(
    vi_map: VIMap,
    folder: Path,
    options: ColmapExportOptions | None = None,
    *,
    missions: I64 | None = None,
    overwrite: bool = False,
) -> ColmapExportReport:
    """Write a COLMAP model of some missions (rows, None = all), with a side file of the map's ids.

    Raises:
        UserError: A file exists and `overwrite` is not set, the folder has a model in the other format,
            nothing can be written, or COLMAP lacks a camera model.
        MapError: pycolmap fails.
    """
    options = options or ColmapExportOptions()
    names = _check_folder(folder, options, overwrite=overwrite)
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    lost = 0
    if options.colmap_feature_type:
        vi_map = _of_type(vi_map, options.colmap_feature_type)
    if options.undistort:
        vi_map, lost = undistortion.undistorted(vi_map, rows)
    exported = model_of_map(vi_map, rows, quality=options.quality)
    model = exported.model
    with tempfile.TemporaryDirectory(prefix="maplab-colmap-") as work:
        if options.colmap_format == "text":
            pycolmap_files.write_text_model(model, Path(work), folder, overwrite=overwrite)
        else:
            for file, content in records.binary_files(model).items():
                write_bytes(folder / file, content, overwrite=overwrite)
        write_bytes(folder / colmap.FILE_NAME, [exported.side_file.content()], overwrite=overwrite)
        if options.colmap_database:
            pycolmap_files.write_database(
                model,
                vi_map,
                exported.frames,
                exported.keypoints,
                Path(work),
                has_priors=options.colmap_pose_priors,
            )
            copy_file(Path(work) / DATABASE, folder / DATABASE, overwrite=overwrite)
    return ColmapExportReport(
        folder=folder,
        cameras=len(model.cameras),
        rigs=len(model.rigs),
        frames=len(model.frames.id),
        images=len(model.images.id),
        points=len(model.points.id),
        observations=exported.observations,
        mean_reprojection_error_px=exported.mean_error_px,
        observations_lost_by_undistortion=lost,
        files=tuple(folder / file for file in names),
    )


def _of_type(vi_map: VIMap, name: str) -> VIMap:
    """Return the map with the keypoints of a feature type alone.

    Raises:
        UserError: It has none, or there is no such type.
    """
    feature_type = type_of_name(name, "colmap_feature_type")
    other = vi_map.feature_type != feature_type
    if other.all():
        types = ", ".join(type_name(kind) for kind in sorted(types_of(vi_map.frames))) or "none"
        raise UserError(
            f"--colmap_feature_type={name}: the map has no such keypoints; its types: {types}"
        )
    return edits.remove_keypoints(vi_map, other)


def _check_folder(
    folder: Path, options: ColmapExportOptions, *, overwrite: bool
) -> tuple[str, ...]:
    """Return the names of the files to write."""
    if options.colmap_pose_priors and not options.colmap_database:
        raise UserError("--colmap_pose_priors needs the database: give --colmap_database too")
    is_text = options.colmap_format == "text"
    suffix, other = (".txt", ".bin") if is_text else (".bin", ".txt")
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--colmap_folder={folder} is a file: name a folder")
    for kind in colmap.FILES:
        if (folder / f"{kind}{other}").exists():
            raise UserError(
                f"--colmap_folder={folder}: holds {kind}{other}, a model in the other format, which COLMAP "
                "could read instead: choose another folder"
            )
    names = [f"{kind}{suffix}" for kind in colmap.FILES] + [colmap.FILE_NAME]
    names += [DATABASE] if options.colmap_database else []
    check_writable(*(folder / file for file in names), overwrite=overwrite)
    return tuple(names)


_GREY = 128
_UNKNOWN_ERROR_PX = -1.0


@dataclasses.dataclass(frozen=True, eq=False)
class MapRig:
    """Cameras of some missions, all on the same IMU."""

    id: str  # of the NCAMERA
    cameras: tuple[Camera, ...]
    T_I_C: F64  # (n, 7)
    missions: I64  # rows


@dataclasses.dataclass(frozen=True, eq=False)
class ExportedModel:
    """A model with the rows of the map that it was made of."""

    model: colmap.ColmapModel
    side_file: colmap.SideFile
    frames: I64  # (N,) rows of the images
    keypoints: I64  # (K,) rows
    observations: int
    mean_error_px: float  # of observations in front of their cameras


def model_of_map(
    vi_map: VIMap, missions: I64 | None = None, *, quality: str = "not_bad"
) -> ExportedModel:
    """Return the COLMAP model of some missions (rows, None = all); W is the map's frame G.

    Each vertex with images is a frame; R is the first camera of the rig. Landmarks that no chosen
    frame observes are left out.

    Raises:
        UserError: There are no frames, or COLMAP lacks a camera model.
    """
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    rigs = map_rigs(vi_map, rows)
    chosen = np.isin(vi_map.vertices.mission[vi_map.frames.vertex], rows)
    chosen &= is_valid(vi_map.missions.sensor_id[:, MissionSensor.NCAMERA])[
        vi_map.vertices.mission[vi_map.frames.vertex]
    ]
    frames = np.flatnonzero(chosen & vi_map.frames.is_valid & is_valid(vi_map.frames.id))
    if not len(frames):
        raise UserError("the missions have no images that COLMAP could use: choose others")
    cameras, colmap_rigs = _sensors(rigs)
    rig_of_mission = np.zeros(len(vi_map.missions), dtype=np.int64)
    for row, rig in enumerate(rigs):
        rig_of_mission[rig.missions] = row
    of_frame = vi_map.frames.vertex[frames].astype(np.int64)
    vertex, frame_row = np.unique(of_frame, return_inverse=True)
    rig_row = rig_of_mission[vi_map.vertices.mission[vertex]]
    T_I_R = np.array([rig.T_I_C[0] for rig in rigs])
    T_W_R = se3.compose(vi_map.T_G_I[vertex], T_I_R[rig_row])
    first_camera = np.cumsum([0, *(len(rig.cameras) for rig in rigs)])
    index = vi_map.frames.camera_index[frames].astype(np.int64)
    camera_row = first_camera[rig_row[frame_row]] + index
    T_I_C = np.concatenate([rig.T_I_C for rig in rigs])[camera_row]
    T_W_C = se3.compose(vi_map.T_G_I[vertex[frame_row]], T_I_C)
    keypoints = ragged_rows(vi_map.keypoint_start, frames)
    landmarks, point = _exported_landmarks(vi_map, keypoints, quality)
    images = colmap.ColmapImages(
        id=np.arange(1, len(frames) + 1),
        camera=camera_row,
        frame=frame_row,
        T_C_W=se3.inverse(T_W_C),
        name=image_names(vi_map, frames),
        keypoint_count=vi_map.frames.keypoint_count[frames].astype(np.int64),
        uv=vi_map.keypoints.uv_px[keypoints] + colmap.PIXEL_CENTRE,
        point=point,
    )
    error, mean_error = _errors(vi_map, rigs, images, landmarks)
    model = colmap.ColmapModel(
        cameras,
        colmap_rigs,
        colmap.ColmapFrames(np.arange(1, len(vertex) + 1), rig_row, se3.inverse(T_W_R)),
        images,
        colmap.ColmapPoints(
            landmarks + 1,
            vi_map.p_G[landmarks],
            np.full((len(landmarks), 3), _GREY, dtype=np.uint8),
            error,
        ),
    )
    side_file = _side_file(vi_map, rigs, frames, vertex, images, landmarks)
    observations = int(np.count_nonzero(point != colmap.NO_POINT))
    return ExportedModel(model, side_file, frames, keypoints, observations, mean_error)


def map_rigs(vi_map: VIMap, missions: I64) -> list[MapRig]:
    """Return the camera rigs of missions (rows), each with the IMU that it is mounted on."""
    pairs: dict[tuple[str, str], list[int]] = {}
    for mission in missions.tolist():
        rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
        if rig_id:
            imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
            pairs.setdefault((rig_id, imu_id), []).append(mission)
    sensors = vi_map.sensors
    return [
        MapRig(
            rig_id,
            sensors.camera_rig(rig_id).cameras,
            sensors.T_I_C(imu_id, rig_id),
            np.array(rows, dtype=np.int64),
        )
        for (rig_id, imu_id), rows in pairs.items()
    ]


def image_names(vi_map: VIMap, frames: I64) -> tuple[str, ...]:
    """Return names <mission>/cam<index>/<time stamp in ns>.png of frames (rows), all different.

    Stamps have 19 digits, so that nobody takes those of a clock that started at zero for us or ms.
    """
    labels = [re.sub(r"[^\w.-]", "_", label) for label in mission_labels(vi_map)]
    folders = [
        label if labels.count(label) == 1 else f"{label}_{row}" for row, label in enumerate(labels)
    ]
    table = vi_map.frames
    names: list[str] = []
    used: set[str] = set()
    vertices = table.vertex[frames]
    missions = vi_map.vertices.mission[vertices].tolist()
    stamp_ns = table.timestamp_ns[frames]  # simulated frames may have none
    stamps = np.where(stamp_ns > 0, stamp_ns, vi_map.vertices.timestamp_ns[vertices]).tolist()
    indices = table.camera_index[frames].tolist()
    for row, (mission, index, stamp) in enumerate(zip(missions, indices, stamps, strict=True)):
        name = f"{folders[mission]}/cam{index}/{stamp:019d}.png"
        if name in used:  # frames of equal times
            name = f"{folders[mission]}/cam{index}/{row}_{stamp:019d}.png"
        used.add(name)
        names.append(name)
    return tuple(names)


def _sensors(
    rigs: list[MapRig],
) -> tuple[tuple[colmap.ColmapCamera, ...], tuple[colmap.ColmapRig, ...]]:
    cameras: list[colmap.ColmapCamera] = []
    result = []
    for number, rig in enumerate(rigs, start=1):
        rows = tuple(range(len(cameras), len(cameras) + len(rig.cameras)))
        numbered = zip(rig.cameras, rows, strict=True)
        cameras += [colmap.colmap_camera(camera, row + 1) for camera, row in numbered]
        T_C_R = se3.compose(se3.inverse(rig.T_I_C), rig.T_I_C[0])
        result.append(colmap.ColmapRig(number, rows, T_C_R))
    return tuple(cameras), tuple(result)


def _exported_landmarks(vi_map: VIMap, keypoints: I64, quality: str) -> tuple[I64, I64]:
    """Return the rows of observed landmarks of a quality, and the point (K,) of each keypoint."""
    table = vi_map.landmarks
    wanted = {
        "good": table.quality == LandmarkQuality.GOOD,
        "not_bad": table.quality != LandmarkQuality.BAD,
        "all": np.ones(len(table), dtype=np.bool_),
    }[quality]
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    observed = landmark >= 0
    observed[observed] = wanted[landmark[observed]]
    rows = distinct(landmark[observed])
    return rows, np.where(observed, np.searchsorted(rows, landmark), colmap.NO_POINT)


def _errors(
    vi_map: VIMap, rigs: list[MapRig], images: colmap.ColmapImages, landmarks: I64
) -> tuple[F64, float]:
    """Return the mean reprojection error (L,) of each landmark [px], and that of all observations."""
    observing = np.flatnonzero(images.point != colmap.NO_POINT)
    image = images.keypoint_image[observing]
    point = images.point[observing]
    p_C = se3.transform(images.T_C_W[image], vi_map.p_G[landmarks[point]])
    error, seen = np.zeros(len(observing)), np.zeros(len(observing), dtype=np.bool_)
    cameras = [camera for rig in rigs for camera in rig.cameras]
    for row, camera in enumerate(cameras):
        mine = np.flatnonzero(images.camera[image] == row)
        uv, seen[mine] = projection.project(camera, p_C[mine])
        error[mine] = np.linalg.norm(uv + colmap.PIXEL_CENTRE - images.uv[observing[mine]], axis=1)
    count = np.bincount(point[seen], minlength=len(landmarks))
    total = np.bincount(point[seen], error[seen], minlength=len(landmarks))
    mean = np.where(count > 0, total / np.maximum(count, 1), _UNKNOWN_ERROR_PX)
    return mean, float(np.mean(error[seen])) if np.any(seen) else float("nan")


def _side_file(
    vi_map: VIMap,
    rigs: list[MapRig],
    frames: I64,
    vertex: I64,
    images: colmap.ColmapImages,
    landmarks: I64,
) -> colmap.SideFile:
    cameras = [camera.id for rig in rigs for camera in rig.cameras]
    used = np.unique(vi_map.vertices.mission[vertex])
    _, first = np.unique(images.point, return_index=True)  # each landmark has a point
    observing = first[images.point[first] != colmap.NO_POINT]
    image = images.keypoint_image[observing]
    return colmap.SideFile(
        mission_id=vi_map.missions.id[used],
        mission_name=np.array(vi_map.missions.name[used].tolist(), dtype=np.str_),
        is_metric=np.array([is_metric(vi_map, row) for row in used.tolist()], dtype=np.int64),
        vertex_id=vi_map.vertices.id[vertex],
        vertex_mission=np.searchsorted(used, vi_map.vertices.mission[vertex]),
        vertex_time_ns=vi_map.vertices.timestamp_ns[vertex],
        image_name=np.array(images.name, dtype=np.str_),
        image_vertex=np.searchsorted(vertex, vi_map.frames.vertex[frames]),
        image_frame_id=vi_map.frames.id[frames],
        image_time_ns=vi_map.frames.timestamp_ns[frames],
        point=landmarks + 1,
        point_image=image,
        point_keypoint=observing - images.keypoint_start[image],
        landmark_id=vi_map.landmarks.id[landmarks],
        landmark_quality=vi_map.landmarks.quality[landmarks].astype(np.int64),
        rig=np.arange(1, len(rigs) + 1),
        rig_id=np.array([from_hex(rig.id) for rig in rigs]),
        T_I_R=np.array([rig.T_I_C[0] for rig in rigs]),
        camera=np.arange(1, len(cameras) + 1),
        camera_id=np.array([from_hex(camera) for camera in cameras]),
    )
