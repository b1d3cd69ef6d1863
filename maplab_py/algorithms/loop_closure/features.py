"""What place recognition sees of a map: descriptors, rays and the landmarks worth finding."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.closure_report import TrainingReport
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import back_project
from maplab_py.vimap import LandmarkQuality, MissionSensor, VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vision.descriptors import pack_words
from maplab_py.vision.index import DescriptorSet
from maplab_py.vision.projection import DIMENSIONS, DescriptorProjection, learn_projection

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_TILE_PX = 4.0
_TILES = 1 << 20  # more than an image is high


@dataclasses.dataclass(frozen=True, eq=False)
class MapFeatures:
    """Keypoints with descriptors, ready to be matched; one row each."""

    keypoint: I64  # (N,) keypoint rows of the map
    vertex: I64  # (N,)
    descriptors: DescriptorSet  # labels are landmark rows
    in_database: Mask  # (N,) observes a landmark that may be found
    origin_I: F64  # (N, 3) camera centre in the body frame [m]
    ray_I: F64  # (N, 3) unit rays in the body frame
    rad_per_px: F64  # (N,) angle that a pixel covers there
    descriptor_bits: int

    def __len__(self) -> int:
        return len(self.keypoint)


def map_features(
    vi_map: VIMap,
    missions: I64,
    *,
    projection: DescriptorProjection | None = None,
    dimensions: int = DIMENSIONS,
) -> tuple[MapFeatures, DescriptorProjection]:
    """Collect the features of some missions; learn the projection from their tracks unless given.

    A projection for descriptors of another length is learned anew, too.

    Only descriptors of the most frequent length are used. Features of good landmarks that two or
    more keypoints observe form the database.

    Raises:
        EstimationError: There are no descriptors, or too few tracks to learn from.
    """
    frames = vi_map.frames
    wanted = np.isin(vi_map.vertices.mission[frames.vertex], missions) & frames.is_valid
    sizes = np.where(wanted, frames.descriptor_size, 0)
    by_size = np.bincount(sizes, weights=frames.keypoint_count, minlength=1)
    by_size[0] = 0.0
    size = int(np.argmax(by_size))
    if size == 0 or by_size[size] == 0:
        raise EstimationError("the map has no descriptors: places cannot be recognised")
    keypoint = np.flatnonzero((sizes == size)[vi_map.keypoint_frame])
    origin, ray, rad_per_px, seen = keypoint_rays(vi_map, keypoint)
    keypoint, origin, ray = keypoint[seen], origin[seen], ray[seen]
    raw = np.ascontiguousarray(vi_map.keypoints.descriptor[keypoint, :size])
    landmark = vi_map.keypoints.landmark[keypoint].astype(np.int64)
    if projection is None or projection.descriptor_size != size:
        projection = learn_projection(raw, landmark, dimensions=dimensions)
    vertex = vi_map.keypoint_vertex[keypoint].astype(np.int64)
    descriptors = DescriptorSet(
        projected=projection.project(raw),
        words=pack_words(raw),
        label=landmark,
        session=np.ascontiguousarray(vi_map.vertices.mission[vertex]),
        time_ns=np.ascontiguousarray(vi_map.vertices.timestamp_ns[vertex]),
    )
    features = MapFeatures(
        keypoint=keypoint,
        vertex=vertex,
        descriptors=descriptors,
        in_database=np.append(findable_landmarks(vi_map), False)[landmark],
        origin_I=origin,
        ray_I=ray,
        rad_per_px=rad_per_px[seen],
        descriptor_bits=8 * size,
    )
    return features, projection


def train_projection(
    vi_map: VIMap, missions: I64 | None, dimensions: int
) -> tuple[DescriptorProjection, TrainingReport]:
    """Learn a projection from the tracks of some missions (rows; None = all).

    Raises:
        EstimationError: There are no descriptors, or too few tracks to learn from.
    """
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    features, projection = map_features(vi_map, rows, dimensions=dimensions)
    d = features.descriptors
    order = np.argsort(d.label, kind="stable")
    order = order[d.label[order] >= 0]
    label, points = d.label[order], d.projected[order]
    pairs = np.flatnonzero(label[1:] == label[:-1])
    same = np.linalg.norm(points[pairs + 1] - points[pairs], axis=1)
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    other = np.linalg.norm(shuffled - points, axis=1)
    return projection, TrainingReport(
        descriptors=len(points),
        tracks=len(np.unique(label)),
        descriptor_size=projection.descriptor_size,
        dimensions=len(projection.matrix),
        same_distance=float(np.median(same)),
        other_distance=float(np.median(other)),
    )


def findable_landmarks(vi_map: VIMap) -> Mask:
    """Tell which landmarks (L,) may be found: good ones with two or more observations."""
    observed = np.diff(vi_map.observation_start) >= 2
    return np.asarray(observed & (vi_map.landmarks.quality == LandmarkQuality.GOOD))


def keypoint_rays(vi_map: VIMap, keypoints: I64) -> tuple[F64, F64, F64, Mask]:
    """Return camera centres and rays in I, the angle of a pixel [rad], and which rays exist."""
    frame = vi_map.keypoint_frame[keypoints]
    mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]]
    camera_index = vi_map.frames.camera_index[frame]
    origin, ray = np.zeros((len(keypoints), 3)), np.zeros((len(keypoints), 3))
    rad_per_px, valid = np.ones(len(keypoints)), np.zeros(len(keypoints), dtype=np.bool_)
    uv = vi_map.keypoints.uv_px[keypoints]
    for row in np.unique(mission):
        ids = vi_map.missions.sensor_id[row]
        ncamera = to_hex(ids[MissionSensor.NCAMERA])
        T_I_C = vi_map.sensors.T_I_C(to_hex(ids[MissionSensor.IMU]), ncamera)
        for index, camera in enumerate(vi_map.sensors.camera_rig(ncamera).cameras):
            mine = np.flatnonzero((mission == row) & (camera_index == index))
            bearing, angle, ok = _bearings(camera, uv[mine])
            origin[mine] = T_I_C[index, 4:]
            ray[mine] = so3.rotate(T_I_C[index, :4], bearing)
            rad_per_px[mine], valid[mine] = angle, ok
    return origin, ray, rad_per_px, valid


def _bearings(camera: Camera, uv: F64) -> tuple[F64, F64, Mask]:
    """Return unit rays in C, the angle that one pixel covers (geometric mean), and validity.

    The angle hardly changes from pixel to pixel: it is that of the middle of a small tile.
    """
    bearing, ok = back_project(camera, uv)
    tile = np.floor(np.nan_to_num(uv) / _TILE_PX).astype(np.int64)
    first = tile.min(axis=0, initial=0)
    key = (tile - first) @ np.array([_TILES, 1])
    key, of_keypoint = np.unique(key, return_inverse=True)
    middle = (np.stack(np.divmod(key, _TILES), axis=1) + first + 0.5) * _TILE_PX
    ray, ok_middle = back_project(camera, middle)
    right, ok_right = back_project(camera, middle + np.array([1.0, 0.0]))
    below, ok_below = back_project(camera, middle + np.array([0.0, 1.0]))
    area = np.linalg.norm(np.cross(right - ray, below - ray), axis=1)
    is_sound = ok_middle & ok_right & ok_below & (area > 0.0)
    angle = np.sqrt(np.where(is_sound, area, 1.0))
    return bearing, angle[of_keypoint], ok & is_sound[of_keypoint]


def points_in_mission(vi_map: VIMap, landmarks: I64, mission: I64) -> F64:
    """Return landmark positions (N, 3) in the frames M of the given missions (N,).

    Landmarks stored in another mission come over the base frames.
    """
    return se3.transform(se3.inverse(vi_map.T_G_M)[mission], vi_map.p_G[landmarks])
