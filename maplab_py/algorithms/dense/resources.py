"""Images and depth of the frames of a map, read from its resources."""

from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.images import as_8_bits, as_grey, bits_of, sampled
from maplab_py.sensors import Camera, CameraRig
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, queries, to_hex

IMAGES = (0, 4)
"""Resource types of recorded images: grey, colour."""
RAW_DEPTH_MAPS, COLOUR_CLOUDS = 8, 17
DEPTH_MAPS = (8, 9)
"""Resource types of depth maps: raw, optimised."""
CLOUDS = (16, 17, 21)
"""Resource types of clouds: plain, with colours, with intensities."""
_MM = np.float32(1e-3)


def mission_rig(vi_map: VIMap, mission: int) -> CameraRig | None:
    """Return the camera rig of a mission (row), None when it has none."""
    rig_id = queries.mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
    return vi_map.sensors.camera_rig(rig_id) if rig_id else None


class FrameResources:
    """Cameras, poses and depth maps of frames."""

    def __init__(self, vi_map: VIMap, map_folder: Path) -> None:
        """Serve a map whose resources are in its folder."""
        self.vi_map = vi_map
        self._store = ResourceStore(vi_map, map_folder)
        self._mounting = lru_cache(maxsize=None)(self._mission_cameras)

    def mission(self, frame: int) -> int:
        """Return the mission (row) of a frame (row)."""
        return int(self.vi_map.vertices.mission[self.vi_map.frames.vertex[frame]])

    def camera(self, frame: int) -> Camera:
        """Return the camera of a frame.

        Raises:
            MapError: It is not in sensors.yaml.
        """
        return self._mount(frame)[0]

    def T_G_C(self, frame: int) -> F64:
        """Return the pose (7,) of a frame's camera; see `camera`."""
        vertex = self.vi_map.frames.vertex[frame]
        return se3.compose(self.vi_map.T_G_I[vertex], self._mount(frame)[1])

    def depth(self, row: int) -> F32:
        """Return a depth map (H, W) [m] (row of a resource) of a frame.

        Raises:
            MapError: The file is missing, or no depth image of the size of the camera's images.
        """
        image: Any = self._store.load(row)
        name = f"depth map {to_hex(self.vi_map.resources.id[row])}"
        if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype != np.uint16:
            raise MapError(f"{name}: it is no image of one channel of 16 bits: remove_resources")
        camera = self.camera(int(self.vi_map.resources.owner[row]))
        check_size(name, image, camera)
        return image.astype(np.float32) * _MM

    def content(self, row: int) -> Any:
        """Return the content of a resource; see `ResourceStore.load`."""
        return self._store.load(row)

    def _mount(self, frame: int) -> tuple[Camera, F64]:
        index = int(self.vi_map.frames.camera_index[frame])
        cameras, T_I_C = self._mounting(self.mission(frame))
        if index >= len(cameras):
            raise MapError(
                f"frame {to_hex(self.vi_map.frames.id[frame])}: camera {index} is not in sensors.yaml"
            )
        return cameras[index], T_I_C[index]

    def _mission_cameras(self, mission: int) -> tuple[tuple[Camera, ...], F64]:
        rig_id = queries.mission_sensor_id(self.vi_map, mission, MissionSensor.NCAMERA)
        imu_id = queries.mission_sensor_id(self.vi_map, mission, MissionSensor.IMU)
        if not rig_id:
            return (), np.zeros((0, 7))
        sensors = self.vi_map.sensors
        return sensors.camera_rig(rig_id).cameras, sensors.T_I_C(imu_id, rig_id)


def check_size(name: str, image: Any, camera: Camera) -> None:
    """Check that an image has the size that its camera was calibrated for.

    Raises:
        MapError: It has another one.
    """
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise MapError(
            f"{name} has {image.shape[1]} x {image.shape[0]} pixels, the images of its camera "
            f"{camera.width_px} x {camera.height_px}: import images of the calibrated size"
        )


class FrameImages:
    """The recorded images of frames."""

    def __init__(self, vi_map: VIMap, map_folder: Path) -> None:
        """Find the images; of a frame with grey and colour the grey one counts."""
        self._store = ResourceStore(vi_map, map_folder)
        table = vi_map.resources
        rows = np.flatnonzero(
            queries.resources_of(vi_map, IMAGES) & (table.owner_kind == ResourceOwner.FRAME)
        )
        rows = rows[np.argsort(table.type[rows], kind="stable")[::-1]]
        self._row = dict(zip(table.owner[rows].tolist(), rows.tolist(), strict=True))

    def __contains__(self, frame: int) -> bool:
        return frame in self._row

    def image(self, frame: int) -> U8 | None:
        """Return the image (H, W) or (H, W, 3) BGR of 8 bits of a frame (row), None when it has none.

        Raises:
            MapError: The file is missing or no image.
        """
        row = self._row.get(frame)
        if row is None:
            return None
        image = np.asarray(self._store.load(row))
        return image if image.dtype == np.uint8 else as_8_bits(image, self._bits)

    @cached_property
    def _bits(self) -> int:
        """Bits of the cameras whose images are stored with 16."""
        rows = list(self._row.values())
        images = (np.asarray(self._store.load(rows[k])) for k in sampled(len(rows)))
        return bits_of(image for image in images if image.dtype == np.uint16)

    def grey(self, frame: int, camera: Camera) -> U8:
        """Return the image (H, W) of 8 bits of a frame that has one.

        Raises:
            MapError: The file is missing, no image, or of another size than the camera's images.
        """
        image: Any = self.image(frame)
        check_size("an image", image, camera)
        return as_grey(image, 8)


def chosen_missions(vi_map: VIMap, missions: Any) -> list[int]:
    """Return the chosen missions (rows), None = all.

    Raises:
        UserError: The map has none.
    """
    if not len(vi_map.missions):
        raise UserError("the map has no missions")
    return list(range(len(vi_map.missions))) if missions is None else list(missions)
