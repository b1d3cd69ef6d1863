"""The latest frames before the estimator has started, and some of them to start from."""

import collections
import dataclasses
import itertools
from typing import Self

import numpy as np

from maplab_py.array_types import F64, I32, I64, mask_of
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.window.frame import WindowFrame
from maplab_py.frontend.imu_buffer import joined_samples
from maplab_py.sensors import Imu


@dataclasses.dataclass(frozen=True, eq=False)
class ObservedFrames:
    """F frames in the order of time, and their N observations."""

    time_ns: I64  # (F,)
    frame: I32  # (N,) ascending
    camera: I32  # (N,)
    track_id: I64  # (N,)
    uv_px: F64  # (N, 2)
    sigma_px: F64  # (N,)

    @classmethod
    def of(cls, frames: list[WindowFrame]) -> Self:
        """Join the observations of frames, which may be none."""
        counts = [len(frame.track_id) for frame in frames]
        none = np.zeros(0)
        return cls(
            time_ns=np.array([frame.time_ns for frame in frames], dtype=np.int64),
            frame=np.repeat(np.arange(len(frames), dtype=np.int32), counts),
            camera=np.concatenate([none, *(frame.camera for frame in frames)]).astype(np.int32),
            track_id=np.concatenate(
                [none.astype(np.int64), *(frame.track_id for frame in frames)]
            ).astype(np.int64),
            uv_px=np.concatenate([np.zeros((0, 2)), *(frame.uv_px for frame in frames)]),
            sigma_px=np.concatenate([none, *(frame.sigma_px for frame in frames)]),
        )

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclasses.dataclass(frozen=True, eq=False)
class Segment(ObservedFrames):
    """F frames that get states, the inertial edges between them, and the frames that get none."""

    inertial: InertialData  # (F - 1) edges
    between: ObservedFrames  # at times of inertial samples

    def samples(self, edge: int) -> tuple[I64, F64]:
        """Return times (S,) and samples (S, 6) of an edge."""
        rows = slice(*self.inertial.sample_start[edge : edge + 2].tolist())
        return self.inertial.timestamp_ns[rows], self.inertial.accel_gyro[rows]


class History:
    """The latest frames."""

    def __init__(self, longest_s: float) -> None:
        """Keep the frames of so many seconds."""
        self._longest_ns = round(longest_s * 1e9)
        self._frames: collections.deque[WindowFrame] = collections.deque()

    def __len__(self) -> int:
        return len(self._frames)

    def push(self, frame: WindowFrame) -> None:
        """Add a frame; if its samples do not begin at the frame before, that is forgotten."""
        frames = self._frames
        times_ns = frame.imu_times_ns
        if frames and (
            len(times_ns) < 2
            or times_ns[0] != frames[-1].time_ns
            or times_ns[-1] != frame.time_ns
            or frame.time_ns <= frames[-1].time_ns
        ):
            frames.clear()
        frames.append(frame)
        while frame.time_ns - frames[0].time_ns > self._longest_ns:
            frames.popleft()

    @property
    def duration_s(self) -> float:
        """Time from the first to the last frame."""
        if not self._frames:
            return 0.0
        return (self._frames[-1].time_ns - self._frames[0].time_ns) * 1e-9

    def latest(self, duration_s: float) -> list[WindowFrame]:
        """Return the frames of the last so many seconds, in the order of time."""
        since_ns = self._frames[-1].time_ns - round(duration_s * 1e9)
        return [frame for frame in self._frames if frame.time_ns >= since_ns]

    def samples(self, duration_s: float) -> tuple[I64, F64]:
        """Return the IMU samples (S,), (S, 6) between the frames of the last so many seconds."""
        return _joined(self.latest(duration_s)[1:])

    def segment(self, imu: Imu, interval_s: float) -> Segment:
        """Return frames about so far apart, the newest among them, and all samples between them."""
        frames = list(self._frames)
        chosen = [len(frames) - 1]
        # half the usual interval of images is tolerance for their jitter
        for row in range(len(frames) - 2, -1, -1):
            if (frames[chosen[-1]].time_ns - frames[row].time_ns) * 1e-9 >= interval_s - 5e-3:
                chosen.append(row)
        chosen.reverse()
        edges = [_joined(frames[a + 1 : b + 1]) for a, b in itertools.pairwise(chosen)]
        is_chosen = mask_of(len(frames), chosen)
        others = np.flatnonzero(~is_chosen[chosen[0] :]) + chosen[0]
        kept = ObservedFrames.of([frames[row] for row in chosen])
        between = ObservedFrames.of([frames[row] for row in others.tolist()])
        return Segment(
            kept.time_ns, kept.frame, kept.camera, kept.track_id, kept.uv_px, kept.sigma_px,
            InertialData.of_samples(imu, edges), between,
        )  # fmt: skip


def _joined(frames: list[WindowFrame]) -> tuple[I64, F64]:
    """Return the samples on the way to consecutive frames; the common ones are kept once."""
    return joined_samples([(frame.imu_times_ns, frame.accel_gyro) for frame in frames])
