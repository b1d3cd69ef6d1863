"""Simulated missions that odometry replays, and their truth."""

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.protocol import Item, RecordedSensors
from maplab_py.interop.trajectories import Trajectory
from maplab_py.simulation.scenario import MotionOptions, Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map
from maplab_py.vimap import VIMap
from tests.support.noiseless import without_noise

MOVING = (MotionOptions(kind="room_scan", duration_s=8.0, turns=0.3),)
REST_FIRST = (MotionOptions(kind="stationary", duration_s=2.0), *MOVING)


def scenario(phases: tuple[MotionOptions, ...], cameras: int) -> Scenario:
    """Return a room with one session of these pieces of motion."""
    room = load_scenario("stereo_room")
    session = SessionOptions(phases=phases)
    # at rest a tracker repeats itself: independent noise of 0.8 px would look like motion
    rests = any(phase.kind == "stationary" for phase in phases)
    measurement = dataclasses.replace(
        room.measurement, frame_rate_hz=10.0, keypoint_sigma_px=0.15 if rests else 0.8
    )
    return dataclasses.replace(
        room, sessions=(session,), cameras=room.cameras[:cameras], measurement=measurement
    )


@functools.cache
def replayed(
    phases: tuple[MotionOptions, ...] = MOVING, cameras: int = 2, *, is_perfect: bool = False
) -> tuple[VIMap, Trajectory]:
    """Return a simulated mission, and the truth in its mission frame."""
    chosen = scenario(phases, cameras)
    data = simulate(without_noise(chosen) if is_perfect else chosen)
    vi_map, truth = data.maps[0], true_map(data.maps[0], data.truth)
    v = truth.vertices
    return vi_map, Trajectory(v.timestamp_ns, v.T_M_I, v.v_M, v.gyro_bias, v.accel_bias)


@dataclasses.dataclass(eq=False)
class EditedRecording:
    """A replay whose items a test changes."""

    plain: MapRecording
    items_of: tuple[Item, ...]
    kind: str = "edited mission"
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.plain.name

    @property
    def device(self) -> RecordedSensors:
        return self.plain.device

    @property
    def start_ns(self) -> int:
        return self.plain.start_ns

    @property
    def end_ns(self) -> int:
        return self.plain.end_ns

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        for item in self.items_of:
            if isinstance(item, Exception):
                raise item
            yield item


def position_errors(truth: Trajectory, times_ns: np.ndarray, T_M_I: np.ndarray) -> np.ndarray:
    """Return the distances (N,) to the truth in the same mission frame, without alignment."""
    rows = np.searchsorted(truth.times_ns, times_ns)
    np.testing.assert_array_equal(truth.times_ns[rows], times_ns)
    return np.linalg.norm(T_M_I[:, 4:] - truth.T_R_B[rows, 4:], axis=1)
