"""Recordings with one planted fault each, over any sound recording."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from maplab_py.geometry import se3, so3
from maplab_py.interop.images import Pixels
from maplab_py.interop.recordings import protocol
from maplab_py.sensors import Camera


@dataclasses.dataclass(eq=False)
class EditedImage:
    """Content of an image whose pixels are changed."""

    plain: protocol.CameraImage
    edit: Callable[[Pixels], Pixels]
    encoding: str = "edited"
    bits: int = 8

    def size_px(self) -> tuple[int, int]:
        return self.plain.data.size_px()

    def check(self) -> None:
        self.plain.data.check()

    def decode(self) -> Pixels:
        return self.edit(self.plain.grey())


@dataclasses.dataclass(eq=False)
class FaultyRecording:
    """A recording whose items and calibration are changed."""

    plain: protocol.Recording
    device: protocol.RecordedSensors
    edit_imu: Callable[[np.ndarray], np.ndarray] = lambda values: values
    edit_image: Callable[[int, int, protocol.CameraImage], protocol.CameraImage | None] | None = (
        None
    )
    imu_shift_ns: int = 0
    repeat_ns: int = 0  # every sample is given again so much later; 0 = it is not
    notes: tuple[str, ...] = ()
    kind: str = "edited recording"

    @property
    def name(self) -> str:
        return self.plain.name

    @property
    def start_ns(self) -> int:
        return self.plain.start_ns + min(self.imu_shift_ns, 0)

    @property
    def end_ns(self) -> int:
        return self.plain.end_ns

    def parts(self) -> tuple[protocol.PartSpan, ...]:
        return self.plain.parts()

    def items(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[protocol.Item]:
        """Yield the changed items in the order of time."""
        imu, others = [], []
        counts = [0] * len(self.device.cameras)
        for item in self.plain.items():
            if isinstance(item, protocol.ImuBatch):
                values, times_ns = self.edit_imu(item.accel_gyro.copy()), item.times_ns
                is_saturated = item.is_saturated
                if self.repeat_ns:
                    times_ns = (times_ns[:, None] + [0, self.repeat_ns]).ravel()
                    values, is_saturated = (np.repeat(c, 2, axis=0) for c in (values, is_saturated))
                imu.append(protocol.ImuBatch(times_ns + self.imu_shift_ns, values, is_saturated))
            elif isinstance(item, protocol.CameraImage) and self.edit_image is not None:
                edited = self.edit_image(item.camera, counts[item.camera], item)
                counts[item.camera] += 1
                others += [edited] if edited is not None else []
            else:
                others.append(item)
        merged = sorted([*imu, *others], key=lambda item: item.time_ns)
        for item in merged:
            if (start_ns is None or item.time_ns >= start_ns) and (
                end_ns is None or item.time_ns < end_ns
            ):
                yield item


def sound(recording: protocol.Recording) -> FaultyRecording:
    return FaultyRecording(recording, recording.device)


def with_imu(recording: protocol.Recording, accel: np.ndarray, gyro: np.ndarray) -> FaultyRecording:
    """Multiply accelerations and rates by matrices (3, 3)."""

    def edit(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values[:, :3] @ accel.T, values[:, 3:] @ gyro.T], axis=1)

    return dataclasses.replace(sound(recording), edit_imu=edit)


def with_clock(recording: protocol.Recording, shift_s: float) -> FaultyRecording:
    """Let the IMU's stamps be later."""
    return dataclasses.replace(sound(recording), imu_shift_ns=round(shift_s * 1e9))


def with_noise_figures(recording: protocol.Recording, accel: float, gyro: float) -> FaultyRecording:
    """Multiply the noise densities of the calibration."""
    imu = recording.device.imu
    assert imu is not None
    changed = dataclasses.replace(
        imu,
        acc_noise_density=accel * imu.acc_noise_density,
        gyro_noise_density=gyro * imu.gyro_noise_density,
    )
    return FaultyRecording(recording, recording.device.with_sensor(changed))


def with_rig(
    recording: protocol.Recording,
    *,
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    move_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rows: tuple[int, ...] = (),
    camera: Callable[[Camera], Camera] = lambda camera: camera,
) -> FaultyRecording:
    """Turn and move cameras on the body, or change their models, in the calibration; () = all rows."""
    device = recording.device
    rig, T = device.rig, device.rig.T_B_C.copy()
    rows = rows or tuple(range(len(rig.cameras)))
    wrong = np.concatenate([so3.exp(np.radians(turn_deg)), np.zeros(3)])
    cameras = list(rig.cameras)
    for row in rows:
        T[row] = se3.compose(T[row], wrong)
        T[row, 4:] += move_m
        cameras[row] = camera(cameras[row])
    changed = dataclasses.replace(rig, cameras=tuple(cameras), T_B_C=T)
    known = {**device.sensors.sensors, rig.id: changed}
    sensors = dataclasses.replace(device.sensors, sensors=known)
    return FaultyRecording(recording, dataclasses.replace(device, sensors=sensors))


def with_pixels(recording: protocol.Recording, edit: Callable[[Pixels], Pixels]) -> FaultyRecording:
    """Change the pixels of all images."""

    def changed(camera: int, count: int, image: protocol.CameraImage) -> protocol.CameraImage:
        return dataclasses.replace(image, data=EditedImage(image, edit), bits=8)

    return dataclasses.replace(sound(recording), edit_image=changed)


def with_repeats(recording: protocol.Recording, every: int) -> FaultyRecording:
    """Show each of every so many images until the next; 0 = the first for ever."""
    kept: dict[int, protocol.CameraImage] = {}

    def changed(camera: int, count: int, image: protocol.CameraImage) -> protocol.CameraImage:
        if count == 0 or (every and count % every == 0):
            kept[camera] = image
        return dataclasses.replace(image, data=kept[camera].data)

    return dataclasses.replace(sound(recording), edit_image=changed)


def with_swapped_images(recording: protocol.Recording) -> FaultyRecording:
    """Exchange the images of the first two cameras."""

    def changed(camera: int, count: int, image: protocol.CameraImage) -> protocol.CameraImage:
        return dataclasses.replace(image, camera=1 - camera)

    return dataclasses.replace(sound(recording), edit_image=changed)


def focal(factor: float) -> Callable[[Camera], Camera]:
    """Return a change of the focal length of a camera."""

    def changed(camera: Camera) -> Camera:
        intrinsics = camera.intrinsics.copy()
        intrinsics[-4:-2] *= factor
        return dataclasses.replace(camera, intrinsics=intrinsics)

    return changed


AXES = {
    "swap xy": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "flip z": np.diag([1.0, 1.0, -1.0]),
    "turn x": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
