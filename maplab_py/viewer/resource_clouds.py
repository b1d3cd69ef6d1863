"""Dense clouds, depth maps and images that a map keeps as resources."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64, U8, Mask
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import interpolation, se3
from maplab_py.interop.ply import parse_ply
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import Distortion, projection
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.storage.resources.types import RESOURCE_TYPES
from maplab_py.viewer import colours, scene
from maplab_py.viewer.layers.cameras import mission_cameras
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.options import PointCloudOptions
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, mission_sensor_id, to_hex

_MM = 1e-3
_MAX_DEPTH_PIXELS = 20_000
_MAX_PIXEL_IMAGES = 150
"""Images that are read to colour landmarks: half a second."""


def type_number(name: str) -> int:
    """Return the number of a resource type; KeyError when the format has none of this name."""
    return {kind.name: kind.number for kind in RESOURCE_TYPES}[name]


def resource_rows(vi_map: VIMap, name: str, missions: I64 | None = None) -> I64:
    """Return the resources (N,) of a type that belong to some missions (rows, None = all).

    Raises:
        UserError: There is none.
    """
    rows = np.flatnonzero(vi_map.resources.type == type_number(name))
    if missions is not None:
        owners = np.array([_mission_of(vi_map, row) for row in rows.tolist()], dtype=np.int64)
        rows = rows[np.isin(owners, missions)]
    if not len(rows):
        raise UserError(f"the map has no resources of type '{name}' (see: resource_statistics)")
    return rows


def load_clouds(
    vi_map: VIMap,
    folder: Path,
    name: str,
    options: PointCloudOptions,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[Cloud, ...]:
    """Load all clouds or depth maps of a type, in G.

    Clouds of an image are in the frame of its camera, those of a sensor in the sensor's frame at
    their time, those of a mission in the mission's frame.

    Raises:
        UserError: There is none.
        MapError: A file is missing or damaged, or a sensor is not mounted.
    """
    store = ResourceStore(vi_map, folder)
    rows = resource_rows(vi_map, name, missions)[:: options.visualize_every_nth]
    rng = np.random.default_rng(0)
    clouds = []
    for done, row in enumerate(rows.tolist()):
        progress.step(done, len(rows), "loading clouds")
        if "depth" in name or "disparity" in name:
            cloud = _of_depth_map(vi_map, store, row, options)
        else:
            cloud = _of_ply(vi_map, store, row)
        title = name.replace("_", " ")
        colour = cloud.colours
        if options.color_random:
            colour = np.tile(rng.integers(60, 220, 3).astype(np.uint8), (len(cloud.p_G), 1))
        clouds.append(dataclasses.replace(cloud, title=title, colours=colour))
    return tuple(clouds)


def _of_ply(vi_map: VIMap, store: ResourceStore, row: int) -> Cloud:
    content = parse_ply(store.load(row), to_hex(vi_map.resources.id[row]))
    T_G_S = resource_pose(vi_map, row)
    return Cloud(
        "", se3.transform(T_G_S, content.p), content.colours, content.intensity, content.faces,
        _mission_id(vi_map, row), _vertex_of(vi_map, row),
    )  # fmt: skip


def _of_depth_map(
    vi_map: VIMap, store: ResourceStore, row: int, options: PointCloudOptions
) -> Cloud:
    """Return the points of a depth map: millimetres along the optical axis, 0 = unknown."""
    depth = np.asarray(store.load(row))
    name = to_hex(vi_map.resources.id[row])
    if depth.ndim != 2 or vi_map.resources.owner_kind[row] != ResourceOwner.FRAME:
        raise MapError(f"resource {name}: a depth map is an image of one channel that a frame owns")
    frame = int(vi_map.resources.owner[row])
    mission = int(vi_map.vertices.mission[vi_map.frames.vertex[frame]])
    index = int(vi_map.frames.camera_index[frame])
    mounted = next((c for c in mission_cameras(vi_map, mission) if c.index == index), None)
    if mounted is None:
        raise MapError(f"resource {name}: its camera is not in sensors.yaml")
    camera = mounted.camera
    if options.reproject_depth_maps_with_undistorted_camera:
        camera = dataclasses.replace(
            camera, distortion=Distortion.NONE, distortion_parameters=np.zeros(0)
        )
    step = max(1, int(np.ceil(np.sqrt(depth.size / _MAX_DEPTH_PIXELS))))
    v, u = np.nonzero(depth[::step, ::step])
    uv = step * np.stack([u, v], axis=1)
    scale = np.array([camera.width_px / depth.shape[1], camera.height_px / depth.shape[0]])
    rays, valid = projection.back_project(camera, uv * scale)
    z = _MM * depth[uv[:, 1], uv[:, 0]].astype(np.float64)
    keep = valid & (rays[:, 2] > 0.0)
    p_C = rays[keep] / rays[keep, 2:] * z[keep, None]
    return Cloud(
        "", se3.transform(resource_pose(vi_map, row), p_C), mission_id=_mission_id(vi_map, row),
        vertex=_vertex_of(vi_map, row),
    )  # fmt: skip


def resource_pose(vi_map: VIMap, row: int) -> F64:
    """Return the pose (7,) in G of the frame that a resource's points are in.

    Raises:
        MapError: The owner does not exist, or its sensor has no extrinsics.
    """
    resources = vi_map.resources
    kind, owner = int(resources.owner_kind[row]), int(resources.owner[row])
    mission = _mission_of(vi_map, row)
    if kind == ResourceOwner.FRAME:
        vertex, index = int(vi_map.frames.vertex[owner]), int(vi_map.frames.camera_index[owner])
        for camera in mission_cameras(vi_map, mission):
            if camera.index == index:
                return se3.compose(vi_map.T_G_I[vertex], camera.T_I_C)
        raise MapError(f"resource {to_hex(resources.id[row])}: its camera is not in sensors.yaml")
    if kind == ResourceOwner.SENSOR:
        mission_vertices = slice(*vi_map.vertex_start[mission : mission + 2].tolist())
        times = vi_map.vertices.timestamp_ns[mission_vertices]
        T_G_I, _ = interpolation.interpolate_poses(
            times, vi_map.T_G_I[mission_vertices], resources.timestamp_ns[row : row + 1]
        )
        imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
        T_I_S = vi_map.sensors.T_I_S(imu_id, to_hex(resources.sensor_id[row]))
        return se3.compose(T_G_I[0], T_I_S)
    return vi_map.T_G_M[mission] if mission >= 0 else se3.identity()


def _mission_of(vi_map: VIMap, row: int) -> int:
    kind, owner = int(vi_map.resources.owner_kind[row]), int(vi_map.resources.owner[row])
    if kind == ResourceOwner.FRAME:
        return int(vi_map.vertices.mission[vi_map.frames.vertex[owner]])
    return owner


def _mission_id(vi_map: VIMap, row: int) -> str:
    mission = _mission_of(vi_map, row)
    return to_hex(vi_map.missions.id[mission]) if mission >= 0 else scene.WHOLE_MAP


def _vertex_of(vi_map: VIMap, row: int) -> int:
    """Return the vertex (row) at which a resource was recorded, -1 when it belongs to no time."""
    kind, owner = int(vi_map.resources.owner_kind[row]), int(vi_map.resources.owner[row])
    if kind == ResourceOwner.FRAME:
        return int(vi_map.frames.vertex[owner])
    if kind != ResourceOwner.SENSOR:
        return -1
    start, stop = vi_map.vertex_start[owner : owner + 2].tolist()
    times = vi_map.vertices.timestamp_ns[start:stop]
    place = int(np.searchsorted(times, vi_map.resources.timestamp_ns[row], side="right")) - 1
    return start + max(place, 0) if stop > start else -1


IMAGE_TYPES = (
    "raw_images", "raw_color_images", "undistorted_images", "undistorted_color_images",
    "rectified images", "rectified_color_images",
)  # fmt: skip
"""Types that show what a camera saw, the preferred first."""
DEPTH_TYPES = ("optimized_depth_maps", "raw_depth_maps")
"""Types of depth, the preferred first."""


class VertexImages:
    """The images of vertices, from the map's resources."""

    def __init__(
        self, vi_map: VIMap, folder: Path, name: str = "", *, with_depth: bool = False
    ) -> None:
        """Find the images of a type.

        Args:
            name: Type; empty = the first type of images that the map has.
            with_depth: Show the depth map of a vertex below its image.
        """
        self._vi_map, self._folder, self._name = vi_map, folder, name
        self._store = ResourceStore(vi_map, folder)
        self._row_of_vertex = _first_of_vertices(vi_map, (name,) if name else IMAGE_TYPES)
        self._frame_of_row = vi_map.resources.owner
        self._depth_of_vertex: dict[int, int] = {}
        self._pixels: tuple[U8, Mask] | None = None
        if with_depth:
            self._depth_of_vertex = _first_of_vertices(vi_map, DEPTH_TYPES)

    def __len__(self) -> int:
        return len(self._row_of_vertex.keys() | self._depth_of_vertex.keys())

    def __call__(self, vertex: int) -> U8 | None:
        """Return the picture (H, W, 3) RGB of a vertex (row), None when it has none that can be read."""
        image = self.image(vertex)
        depth = self._load(self._depth_of_vertex.get(vertex))
        parts = [] if image is None else [image]
        if depth is not None and depth.ndim == 2:
            parts.append(depth_picture(depth, parts[0].shape[1] if parts else depth.shape[1]))
        return np.concatenate(parts) if parts else None

    def image(self, vertex: int) -> U8 | None:
        """Return the image (H, W, 3) RGB of a vertex (row) without its depth."""
        image = self._load(self._row_of_vertex.get(vertex))
        return None if image is None else as_rgb(image)

    def frame(self, vertex: int) -> int:
        """Return the frame (row) that the image of a vertex (row) belongs to, -1 = it has none."""
        row = self._row_of_vertex.get(vertex)
        return -1 if row is None else int(self._frame_of_row[row])

    def of_map(self, vi_map: VIMap) -> VertexImages:
        """Return the images of another state of the map, whose vertices may have other rows."""
        with_depth = bool(self._depth_of_vertex)
        images = VertexImages(vi_map, self._folder, self._name, with_depth=with_depth)
        if vi_map.keypoints.landmark is self._vi_map.keypoints.landmark:
            images._pixels = self._pixels
        return images

    def pixels(self) -> tuple[U8, Mask]:
        """Return colours (L, 3) of landmarks where images show them, and which landmarks (L,) have one.

        Of many images every n-th is read: most landmarks are in several.
        """
        if self._pixels is None:
            self._pixels = self._read_pixels()
        return self._pixels

    def _read_pixels(self) -> tuple[U8, Mask]:
        vi_map = self._vi_map
        vertices = np.array(sorted(self._row_of_vertex), dtype=np.int64)
        vertices = vertices[:: max(1, -(-len(vertices) // _MAX_PIXEL_IMAGES))]
        colour = np.zeros((len(vi_map.landmarks), 3), dtype=np.uint8)
        is_known = np.zeros(len(vi_map.landmarks), dtype=np.bool_)
        for vertex in vertices.tolist():
            image, frame = self.image(vertex), self.frame(vertex)
            if image is None:
                continue
            keypoints = np.arange(*vi_map.keypoint_start[frame : frame + 2])
            landmark = vi_map.keypoints.landmark[keypoints]
            new = (landmark >= 0) & ~is_known[landmark]
            u, v = np.floor(vi_map.keypoints.uv_px[keypoints]).astype(np.int64).T
            new &= (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
            u, v = u[new], v[new]
            colour[landmark[new]] = image[v, u]
            is_known[landmark[new]] = True
        return colour, is_known

    def _load(self, row: int | None) -> U8 | None:
        if row is None:
            return None
        try:
            return np.asarray(self._store.load(row))
        except MapError:
            return None


def _first_of_vertices(vi_map: VIMap, names: tuple[str, ...]) -> dict[int, int]:
    """Return the first resource (row) of every vertex (row), of the first type that the map has."""
    owned = vi_map.resources.owner_kind == ResourceOwner.FRAME
    for name in names:
        rows = np.flatnonzero(owned & (vi_map.resources.type == type_number(name)))
        if len(rows):
            vertices = vi_map.frames.vertex[vi_map.resources.owner[rows]]
            return dict(zip(vertices.tolist()[::-1], rows.tolist()[::-1], strict=True))
    return {}


def depth_picture(depth_mm: NDArray[np.uint8] | NDArray[np.uint16], width_px: int) -> U8:
    """Return a depth map (H, W) [mm] in colours (h, width_px, 3), with its range; unknown is black."""
    import cv2

    known = depth_mm > 0
    z = np.where(known, depth_mm, 1).astype(np.float64)
    low, high = np.percentile(z[known], [1.0, 99.0]) if known.any() else (1.0, 1.0)
    part = (z - low) / max(high - low, 1.0)
    picture = np.where(known[..., None], colours.ramp(part, colours.SEQUENTIAL[::-1]), 0)
    size = width_px, max(1, round(depth_mm.shape[0] * width_px / depth_mm.shape[1]))
    picture = cv2.resize(picture.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    text = f"depth {low * _MM:.2g} to {high * _MM:.2g} m" if known.any() else "no depth"
    scale = width_px / 700.0
    place = round(12 * scale), round(28 * scale)
    for colour, thickness in (((0, 0, 0), 4.0), ((255, 255, 255), 1.5)):
        line = max(1, round(thickness * scale))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, line)
    return np.asarray(picture, dtype=np.uint8)


def as_rgb(image: NDArray[np.uint8] | NDArray[np.uint16]) -> U8:
    """Return an image (H, W[, 3] BGR), depths included, as RGB (H, W, 3)."""
    if image.dtype != np.uint8:
        largest = max(float(image.max(initial=0)), 1.0)
        image = np.round(image / largest * 255.0).astype(np.uint8)
    if image.ndim == 2:
        return np.repeat(image[:, :, None], 3, axis=2).astype(np.uint8)
    return np.ascontiguousarray(image[:, :, 2::-1], dtype=np.uint8)
