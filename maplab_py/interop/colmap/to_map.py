"""A map of a COLMAP model: a mission of each rig, odometry between its frames, landmarks."""

import dataclasses
import hashlib

import numpy as np

from maplab_py.array_types import F64, I64, U64, Mask
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import alignment, se3
from maplab_py.interop.colmap.model import (
    PIXEL_CENTRE,
    ColmapModel,
    SideFile,
    map_camera,
    picked,
    rows_of,
)
from maplab_py.sensors import CameraRig, SensorSet, sensor_set
from maplab_py.vimap import MissionSensor, VIMap, from_hex, ragged_rows, random_ids, tables, to_hex
from maplab_py.vimap.descriptors import no_blocks
from maplab_py.vimap.queries import ARBITRARY_SCALE

_PRESENT = tables.FrameField.SIGMA | tables.FrameField.SCALE | tables.FrameField.LANDMARK_ID


@dataclasses.dataclass(frozen=True, eq=False)
class ImportedModel:
    """A map with the rows of the model that its tables were made of."""

    vi_map: VIMap
    images: I64  # (F,) rows of the model's images, by frame of the map
    keypoints: I64  # (K,) rows of the model's keypoints
    unobserved_points: int


@dataclasses.dataclass(frozen=True, eq=False)
class BodyFrames:
    """Frames of the model in the order of the map's vertices."""

    frame: I64  # (V,) rows
    mission: I64  # (V,) numbers from 0
    time_ns: I64  # (V,)
    T_W_R: F64  # (V, 7) in units of the model
    T_R_I: F64  # (V, 7) in metres
    mission_rig: I64  # (M,) rows of rigs
    mission_row: I64  # (M,) rows of the side file's missions, -1 = none
    side_vertex: I64  # (V,) rows of the side file's vertices, -1 = none
    side_image: I64  # (N,) rows of the side file's images that the model's are, -1 = none
    T_I_R: F64  # (R, 7) by rig row


def body_frames(model: ColmapModel, times_ns: I64, side: SideFile, side_image: I64) -> BodyFrames:
    """Put the frames that have images into missions: those of the side file, else one of each rig.

    Args:
        times_ns: Times (N,) of its images.
        side_image: Rows (N,) of the side file's images that they are, -1 = none.

    Raises:
        UserError: Two frames of a mission have the same time.
    """
    order = np.argsort(model.images.frame, kind="stable")
    frame, first = np.unique(model.images.frame[order], return_index=True)
    time_ns = np.minimum.reduceat(times_ns[order], first)
    none = np.full(len(frame), -1, dtype=np.int64)
    rig, rig_ids = model.frames.rig[frame], np.array([rig.id for rig in model.rigs])
    side_vertex = picked(side.image_vertex, side_image[order[first]], none)
    time_ns = picked(side.vertex_time_ns, side_vertex, time_ns)
    side_mission = picked(side.vertex_mission, side_vertex, none)
    T_I_R = picked(side.T_I_R, rows_of(side.rig, rig_ids), se3.identity(len(rig_ids)))
    groups, mission = np.unique(
        np.stack([side_mission < 0, side_mission, rig], axis=1), axis=0, return_inverse=True
    )
    mission = mission.reshape(-1)
    order = np.lexsort((frame, time_ns, mission))
    frame, mission, time_ns, rig = frame[order], mission[order], time_ns[order], rig[order]
    same = np.flatnonzero((mission[1:] == mission[:-1]) & (time_ns[1:] == time_ns[:-1]))
    if len(same):
        raise UserError(
            f"frames {model.frames.id[frame[same[0]]]} and {model.frames.id[frame[same[0] + 1]]} have the "
            f"same time {time_ns[same[0]]} ns: give each image its time (--timestamps_from)"
        )
    return BodyFrames(
        frame=frame,
        mission=mission,
        time_ns=time_ns,
        T_W_R=se3.inverse(model.frames.T_R_W[frame]),
        T_R_I=se3.inverse(T_I_R[rig]),
        mission_rig=groups[:, 2],
        mission_row=groups[:, 1],
        side_vertex=side_vertex[order],
        side_image=side_image,
        T_I_R=T_I_R,
    )


def map_of_model(
    model: ColmapModel,
    bodies: BodyFrames,
    times_ns: I64,
    side: SideFile,
    *,
    T_G_W: F64,
    scale: float,
    is_metric: Mask,
    sigma_px: float,
    edge_sigma: F64,
) -> ImportedModel:
    """Return the map of a model whose world W lies in G by a similarity.

    Args:
        bodies: Its frames by mission.
        times_ns: Times (N,) of its images.
        T_G_W: Pose (7,) of the model.
        scale: Metres per unit of the model.
        is_metric: Missions (M,) whose scale and gravity are known; others are marked.
        sigma_px: Standard deviation of keypoints [px].
        edge_sigma: Standard deviations (6,) of odometry edges, position [m], then rotation [rad].

    Raises:
        MapError: A rig lacks a pose of a camera that has images.
        UserError: maplab lacks a camera model.
    """
    digest = hashlib.blake2b("\n".join(model.images.name).encode(), digest_size=16)
    for column in (times_ns, model.images.T_C_W, model.images.uv, model.point_id):
        digest.update(np.ascontiguousarray(column).tobytes())
    rng = np.random.default_rng(int.from_bytes(digest.digest(), "little"))
    T_G_I = se3.compose(alignment.apply_similarity(T_G_W, scale, bodies.T_W_R), bodies.T_R_I)
    sensors, sensor_id = _sensors(model, bodies, side, scale, is_metric, rng)
    frames, images = _frames(model, bodies, times_ns, side, rng)
    keypoints = ragged_rows(model.images.keypoint_start, images)
    landmarks, landmark_of, unobserved = _landmarks(
        model,
        side,
        bodies,
        frames,
        keypoints,
        se3.transform(T_G_W, scale * model.points.p_W),
        T_G_I,
        rng,
    )
    count = len(bodies.frame)
    missions = len(bodies.mission_rig)
    vi_map = VIMap(
        sensors=sensors,
        missions=_missions(bodies, side, sensor_id, rng),
        baseframes=tables.BaseFrames.filled(
            missions, id=random_ids(missions, rng), is_known=is_metric
        ),
        vertices=tables.Vertices.filled(
            count,
            id=_restored(random_ids(count, rng), bodies.side_vertex, side.vertex_id),
            mission=bodies.mission,
            T_M_I=T_G_I,
            timestamp_ns=bodies.time_ns,
            nframe_id=random_ids(count, rng),
        ),
        frames=frames,
        keypoints=tables.Keypoints.filled(
            len(keypoints),
            uv_px=model.images.uv[keypoints] - PIXEL_CENTRE,
            sigma_px=np.full(len(keypoints), sigma_px),
            landmark=landmark_of,
        ),
        landmarks=landmarks,
        transformation_edges=_edges(bodies, T_G_I, sensor_id, edge_sigma, rng),
    )
    return ImportedModel(vi_map, images, keypoints, unobserved)


def _sensors(
    model: ColmapModel,
    bodies: BodyFrames,
    side: SideFile,
    scale: float,
    is_metric: Mask,
    rng: np.random.Generator,
) -> tuple[SensorSet, U64]:
    """Return the sensors, and their ids (M, kinds, 2) by mission."""
    camera_id, rig_id = (
        _restored(random_ids(len(parts), rng), rows_of(known, np.array([p.id for p in parts])), ids)
        for parts, known, ids in (
            (model.cameras, side.camera, side.camera_id),
            (model.rigs, side.rig, side.rig_id),
        )
    )
    sensors: dict[str, CameraRig | sensor_set.OtherSensor] = {}
    extrinsics: dict[str, sensor_set.Extrinsics] = {}
    sensor_id = np.zeros((len(bodies.mission_rig), len(MissionSensor), 2), dtype=np.uint64)
    odometry_ids = random_ids(len(bodies.mission_rig), rng)
    for mission, row in enumerate(bodies.mission_rig.tolist()):
        rig, name = model.rigs[row], to_hex(rig_id[row])
        T_C_R = rig.T_C_R * np.repeat([1.0, scale], [4, 3])
        if not np.isfinite(T_C_R).all():
            raise MapError(
                f"rig {rig.id}: a camera has no pose on the rig: let COLMAP estimate it (rig_configurator)"
            )
        cameras = tuple(
            map_camera(model.cameras[camera], to_hex(camera_id[camera])) for camera in rig.cameras
        )
        T_I_C = se3.compose(bodies.T_I_R[row], se3.inverse(T_C_R))
        sensors[name] = CameraRig(name, cameras, T_I_C)
        extrinsics[name] = sensor_set.Extrinsics(name, se3.identity())
        odometry = to_hex(odometry_ids[mission])
        keys = {"id": odometry, "sensor_type": "ODOMETRY_6DOF", "topic": "colmap"}
        marks = {} if is_metric[mission] else {ARBITRARY_SCALE: True}
        sensors[odometry] = sensor_set.OtherSensor(odometry, "ODOMETRY_6DOF", {**keys, **marks})
        extrinsics[odometry] = sensor_set.Extrinsics(name, se3.identity())
        sensor_id[mission, MissionSensor.NCAMERA] = from_hex(name)
        sensor_id[mission, MissionSensor.ODOMETRY_6DOF] = from_hex(odometry)
    return SensorSet(sensors, extrinsics), sensor_id


def _frames(
    model: ColmapModel,
    bodies: BodyFrames,
    times_ns: I64,
    side: SideFile,
    rng: np.random.Generator,
) -> tuple[tables.Frames, I64]:
    """Return the frames, and the rows of their images."""
    vertex_of = np.full(len(model.frames.id), -1, dtype=np.int64)
    vertex_of[bodies.frame] = np.arange(len(bodies.frame))
    vertex, index = vertex_of[model.images.frame], model.place_in_rig[model.images.camera]
    image = np.lexsort((index, vertex))
    vertex, index = vertex[image], index[image]
    twice = np.flatnonzero((vertex[1:] == vertex[:-1]) & (index[1:] == index[:-1]))
    if len(twice):
        name = model.images.name[image[twice[0] + 1]]
        raise MapError(f"image {name}: its frame has two images of the same camera")
    count = len(image)
    rows = bodies.side_image[image]
    table = tables.Frames.filled(
        count,
        id=_restored(random_ids(count, rng), rows, side.image_frame_id),
        vertex=vertex,
        camera_index=index,
        timestamp_ns=picked(side.image_time_ns, rows, times_ns[image]),
        keypoint_count=model.images.keypoint_count[image],
        present=np.full(count, int(_PRESENT)),
        descriptor_blocks=no_blocks(count),
    )
    return table, image


def _landmarks(
    model: ColmapModel,
    side: SideFile,
    bodies: BodyFrames,
    frames: tables.Frames,
    keypoints: I64,
    p_G: F64,
    T_G_I: F64,
    rng: np.random.Generator,
) -> tuple[tables.Landmarks, I64, int]:
    """Return landmarks in the order of point ids, rows (K,) of keypoints, and points left out."""
    point = model.images.point[keypoints]
    observing = np.flatnonzero(point >= 0)
    vertex = np.repeat(frames.vertex, frames.keypoint_count)[observing]
    rows, first = np.unique(point[observing], return_index=True)
    store = vertex[first]  # keypoints are in the order of vertices
    landmark = np.full(len(keypoints), -1, dtype=np.int64)
    landmark[observing] = np.searchsorted(rows, point[observing])
    known = _same_points(model, side, bodies.side_image, model.points.id[rows])
    good = np.full(len(rows), int(tables.LandmarkQuality.GOOD))
    table = tables.Landmarks.filled(
        len(rows),
        id=_restored(random_ids(len(rows), rng), known, side.landmark_id),
        vertex=store,
        p_I=se3.transform(se3.inverse(T_G_I[store]), p_G[rows]),
        quality=picked(side.landmark_quality, known, good),
    )
    return table, landmark, len(model.points.id) - len(rows)


def _same_points(model: ColmapModel, side: SideFile, side_image: I64, ids: I64) -> I64:
    """Return the rows of the side file's points (L,) by id, -1 unless their observation is there."""
    rows = rows_of(side.point, ids)
    image_of_row = np.full(len(side.image_name), -1, dtype=np.int64)
    image_of_row[side_image[side_image >= 0]] = np.flatnonzero(side_image >= 0)
    image = image_of_row[side.point_image]
    keypoint = side.point_keypoint
    inside = (image >= 0) & (keypoint >= 0) & (keypoint < model.images.keypoint_count[image])
    place = np.where(inside, model.images.keypoint_start[image] + keypoint, 0)
    same = np.flatnonzero(inside & (model.point_id[place] == side.point))
    return np.where(np.isin(rows, same), rows, -1)


def _missions(
    bodies: BodyFrames, side: SideFile, sensor_id: U64, rng: np.random.Generator
) -> tables.Missions:
    count = len(bodies.mission_rig)
    # the rows of a side file's mission that a model has put on two rigs: the first keeps the id
    rows, first = np.unique(bodies.mission_row, return_index=True)
    known = np.full(count, -1, dtype=np.int64)
    known[first[rows >= 0]] = rows[rows >= 0]
    return tables.Missions.filled(
        count,
        id=_restored(random_ids(count, rng), known, side.mission_id),
        baseframe=np.arange(count),
        root_vertex=np.searchsorted(bodies.mission, np.arange(count)),
        backbone=np.full(count, int(tables.Backbone.ODOMETRY)),
        sensor_id=sensor_id,
        name=picked(side.mission_name, known, np.full(count, "", dtype=object)),
    )


def _edges(
    bodies: BodyFrames, T_G_I: F64, sensor_id: U64, sigma: F64, rng: np.random.Generator
) -> tables.TransformationEdges:
    start = np.flatnonzero(bodies.mission[1:] == bodies.mission[:-1])
    count = len(start)
    return tables.TransformationEdges.filled(
        count,
        id=random_ids(count, rng),
        kind=np.full(count, int(tables.TransformationKind.ODOMETRY)),
        from_vertex=start,
        to_vertex=start + 1,
        T_A_B=se3.relative(T_G_I[start], T_G_I[start + 1]),
        covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        sensor_id=sensor_id[bodies.mission[start], MissionSensor.ODOMETRY_6DOF],
    )


def _restored(ids: U64, rows: I64, known: U64) -> U64:
    """Return ids (N, 2) with those of known rows (-1 = none), each used once."""
    taken, first = np.unique(rows, return_index=True)
    once = first[taken >= 0]
    restored = ids.copy()
    restored[once] = known[rows[once]]
    return restored
