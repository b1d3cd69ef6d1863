"""Recordings of which a sensor fails at a time."""

import dataclasses
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from maplab_py.geometry import so3
from maplab_py.interop.images import Pixels
from maplab_py.interop.recordings.protocol import CameraImage, ImuBatch, Item, Recording
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import back_project, project
from tests.algorithms.recording_check.faults import EditedImage, FaultyRecording

Edit = Callable[[Pixels], Pixels]


@dataclasses.dataclass(eq=False)
class FailingRecording(FaultyRecording):
    """A recording of which a sensor fails at a time, and mostly is whole again later."""

    from_ns: int = 0
    to_ns: int = 2**62
    camera: int = -1
    edit_pixels: Edit | None = None  # None: the image before is repeated
    edit_samples: Callable[[np.ndarray], np.ndarray] | None = None

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        last: CameraImage | None = None
        for item in self.plain.items(start_ns, end_ns):
            fails = self.from_ns <= item.time_ns < self.to_ns
            if isinstance(item, ImuBatch) and self.edit_samples is not None:
                yield self._samples(item)
            elif isinstance(item, CameraImage) and item.camera == self.camera:
                if fails and self.edit_pixels is not None:
                    edited = EditedImage(item, self.edit_pixels)
                    yield dataclasses.replace(item, data=edited, bits=8)
                elif fails and last is not None:
                    yield dataclasses.replace(item, data=last.data)
                else:
                    last = item
                    yield item
            else:
                yield item

    def _samples(self, batch: ImuBatch) -> ImuBatch:
        assert self.edit_samples is not None
        rows = (batch.times_ns >= self.from_ns) & (batch.times_ns < self.to_ns)
        values = batch.accel_gyro.copy()
        values[rows] = self.edit_samples(values[rows])
        return ImuBatch(batch.times_ns, values, batch.is_saturated)


def failing(
    recording: Recording, kind: str, from_ns: int, to_ns: int = 2**62, camera: int = 0
) -> FailingRecording:
    """Return a recording with a failure, such as "camera covered" or "gyroscope stuck"."""
    sensor, failure = kind.split(" ", 1)
    plain = FailingRecording(recording, recording.device, from_ns=from_ns, to_ns=to_ns)
    if sensor == "camera":
        edit = _PIXELS.get(failure)
        if failure == "shifted":
            edit = _turned(recording.device.cameras[camera])
        return dataclasses.replace(plain, camera=camera, edit_pixels=edit)
    first = 0 if sensor == "accelerometer" else 3

    def edited(values: np.ndarray) -> np.ndarray:
        values[:, first : first + 3] = _SAMPLES[failure](values[:, first : first + 3], first == 3)
        return values

    return dataclasses.replace(plain, edit_samples=edited)


def covered(pixels: Pixels) -> Pixels:
    """Return what a covered camera sees."""
    noise = np.random.default_rng(int(pixels.sum(dtype=np.int64))).normal(6.0, 1.5, pixels.shape)
    return np.clip(noise, 0.0, 255.0).astype(np.uint8)


def blurred(pixels: Pixels) -> Pixels:
    """Return what a camera out of focus sees."""
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), 4.0))


_PIXELS: dict[str, Edit] = {"covered": covered, "out of focus": blurred}
_SHIFT_DEG = (1.2, -1.2, 1.0)


def _turned(camera: Camera) -> Edit:
    """Return what a camera sees that has turned by 2 deg on its mounting."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(np.float64)
    rays, _ = back_project(camera, np.stack([u, v], axis=-1))
    uv, _ = project(camera, rays @ so3.to_matrix(so3.exp(np.radians(_SHIFT_DEG))).T)
    x, y = uv[..., 0].astype(np.float32), uv[..., 1].astype(np.float32)
    return lambda pixels: np.asarray(
        cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    )


def _stuck(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    values[:, 1] = 0.05 if is_gyro else 0.6  # of every batch the same
    return values


def _limited(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    limit = 0.25 if is_gyro else 7.0
    return np.clip(values, -limit, limit)


def _scaled(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    return values * (1.25 if is_gyro else 1.08)


def _biased(values: np.ndarray, is_gyro: bool) -> np.ndarray:
    values[:, 2] += 0.1 if is_gyro else 0.6
    return values


_SAMPLES: dict[str, Callable[[np.ndarray, bool], np.ndarray]] = {
    "stuck": _stuck, "saturated": _limited, "scaled": _scaled, "biased": _biased,
}  # fmt: skip
KINDS = (
    *(f"camera {failure}" for failure in ("covered", "shifted", "out of focus", "frozen")),
    *(f"{sensor} {failure}" for sensor in ("gyroscope", "accelerometer") for failure in _SAMPLES),
)
"""Twelve kinds of failures."""
