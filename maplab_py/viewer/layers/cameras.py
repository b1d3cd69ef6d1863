"""Camera frusta, rays of observations, and the mounting of sensors."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, mask_of
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, CameraRig, SensorSet, projection
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_segments, omission_notes
from maplab_py.viewer.scene import WHOLE_MAP, Axes, Layer, Part
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id

_FRUSTA_PER_MISSION = 250
FRUSTUM_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
"""Lines of a frustum: point 0 is the centre, points 1 to 4 go round the image."""


@dataclasses.dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera of a mission."""

    camera: Camera
    T_I_C: F64  # (7,)
    index: int


def mission_cameras(vi_map: VIMap, mission: int) -> list[MountedCamera]:
    """Return the cameras of a mission (row); none when it has no rig or the rig is not mounted."""
    rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    try:
        T_I_C = vi_map.sensors.T_I_C(imu_id, rig_id)
        cameras = vi_map.sensors.camera_rig(rig_id).cameras
    except MapError:
        return []
    return [MountedCamera(c, T_I_C[i], i) for i, c in enumerate(cameras)]


def frustum_points(camera: Camera, depth_m: float) -> F64:
    """Return the centre and the image corners (5, 3) of a camera in C, the corners at a depth.

    With a lens of more than 90 degrees the corners are nearer. A corner that the camera model
    cannot undistort is moved towards the middle of the image.
    """
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * size
    rays = np.zeros((4, 3))
    for inset in (0.0, 0.05, 0.1, 0.2, 0.3, 0.4):
        uv = corners + inset * (0.5 * size - corners) * 2.0
        rays, valid = projection.back_project(camera, uv)
        if valid.all() and (rays[:, 2] > 0.05).all():
            break
    reach = rays / np.maximum(rays[:, 2:], 0.2)
    reach /= max(1.0, float(np.abs(reach[:, :2]).max()))  # a wide lens is as large as others
    return np.concatenate([np.zeros((1, 3)), depth_m * reach])


def frusta(drawing: Drawing) -> Layer:
    """Cameras along each mission, every n-th one."""
    vi_map = drawing.vi_map
    parts: dict[str, Part] = {}
    for mission, mission_id in enumerate(drawing.mission_ids):
        start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
        every = drawing.options.frustum_every_nth or max(1, (stop - start) // _FRUSTA_PER_MISSION)
        rows = np.arange(start, stop, every)
        cameras = mission_cameras(vi_map, mission)
        if not len(rows) or not cameras:
            continue
        colour = colours.mixed(drawing.mission_colours[mission], colours.REFERENCE, 0.3)
        ends = np.concatenate(
            [frustum_lines(drawing, rows, c, 0.02 * drawing.unit_m) for c in cameras]
        )
        owners = np.repeat(np.tile(rows, len(cameras)), len(FRUSTUM_EDGES))
        parts[mission_id] = make_segments(ends[:, 0], ends[:, 1], colour, owners, 1.0)
    return Layer("frusta", "Cameras", parts, len(vi_map.frames), is_visible=False)


def frustum_lines(drawing: Drawing, vertices: I64, camera: MountedCamera, depth_m: float) -> F64:
    """Return the lines (8 N, 2, 3) of one camera's frusta at vertices (N,), in the scene."""
    T = drawing.vi_map.T_G_I[vertices].copy()
    T[:, 4:] = drawing.p_vertices[vertices]
    corners = frustum_points(camera.camera, depth_m)
    p = se3.transform(se3.compose(T, camera.T_I_C)[:, None], corners[None])
    return np.asarray(p[:, FRUSTUM_EDGES].reshape(-1, 2, 3))


def observer_rays(drawing: Drawing, landmark: int) -> tuple[F64, F64, I64]:
    """Return lines from the observing cameras (N, 3) to a landmark (N, 3), and their vertices (N,)."""
    vi_map = drawing.vi_map
    start, stop = vi_map.observation_start[landmark : landmark + 2]
    keypoints = vi_map.observations[start:stop]
    centres, vertices = camera_centres(drawing, keypoints)
    return centres, np.broadcast_to(drawing.p_landmarks[landmark], centres.shape), vertices


def camera_centres(drawing: Drawing, keypoints: I64) -> tuple[F64, I64]:
    """Return the camera centres (N, 3) of keypoints in the scene, and their vertices (N,)."""
    vi_map = drawing.vi_map
    vertices = vi_map.keypoint_vertex[keypoints].astype(np.int64)
    index = vi_map.frames.camera_index[vi_map.keypoint_frame[keypoints]]
    T = vi_map.T_G_I[vertices].copy()
    T[:, 4:] = drawing.p_vertices[vertices]
    mission = vi_map.vertices.mission[vertices]
    for row in np.unique(mission).tolist():
        for camera in mission_cameras(vi_map, row):
            camera_frames = (mission == row) & (index == camera.index)
            T[camera_frames] = se3.compose(T[camera_frames], camera.T_I_C)
    return T[:, 4:], vertices


def landmark_observers(drawing: Drawing, landmarks: I64, limit: int) -> Layer:
    """Rays from every observing camera to each of some landmarks, at most `limit` of them.

    The number of landmarks is what gives way: every n-th one keeps all its rays.
    """
    vi_map = drawing.vi_map
    counts = np.diff(vi_map.observation_start)
    every = max(1, -(-int(counts[landmarks].sum()) // max(limit, 1)))
    chosen = mask_of(len(vi_map.landmarks), landmarks[::every])
    keypoints = vi_map.observations[chosen[vi_map.keypoints.landmark[vi_map.observations]]]
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    centres, vertices = camera_centres(drawing, keypoints)
    mission = vi_map.vertices.mission[vertices]
    pale = colours.mixed(drawing.mission_colours, colours.REFERENCE, 0.55)[mission]
    ends = centres, drawing.p_landmarks[landmark]
    parts = drawing.segments(mission, *ends, pale, landmark, 0.75)
    total, title = int(counts[landmarks].sum()), "Landmark observers"
    drawn = sum(len(part) for part in parts.values())
    notes = omission_notes(title, drawn, (total - drawn, f"as at most {limit:,} rays are drawn"))
    return Layer("observers", title, parts, total, notes=notes)


def sensor_axes(sensors: SensorSet) -> Layer:
    """Every sensor as axes at its pose on its base sensor; cameras of a rig one each."""
    labels, poses = [], []
    for sensor_id, sensor in sensors.sensors.items():
        T_B_S = sensors.T_B_S(sensor_id)
        kind = getattr(sensor, "sensor_type", type(sensor).__name__)
        if isinstance(sensor, CameraRig):
            for row, camera in enumerate(sensor.cameras):
                labels.append(f"camera {row} {camera.id[:8]}")
                poses.append(se3.compose(T_B_S, sensor.T_B_C[row]))
            continue
        labels.append(f"{kind} {sensor_id[:8]}")
        poses.append(T_B_S)
    T = np.array(poses).reshape(-1, 7)
    reach = float(np.abs(T[:, 4:]).max()) if len(T) else 0.0
    axes = Axes(T, max(0.35 * reach, 0.03), tuple(labels))
    return Layer("sensors", "Sensors", {WHOLE_MAP: axes}, len(T))
