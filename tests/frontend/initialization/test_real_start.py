"""The start on EuRoC MH_01, which is in motion from its first image, and on a handheld Tango."""

import numpy as np
import pytest

from maplab_py.array_types import F64, I64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.initialization.initializer import Initializer
from maplab_py.geometry import so3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import FrameSet, ImuBatch, Recording, TrackedFrameSet
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.sensors import Imu
from maplab_py.storage.native import load_map
from maplab_py.vision.tracking.replay import tracked_images_of
from maplab_py.vision.tracking.tracker import FrameTracker
from maplab_py.vision.tracking.tracks import TrackedImages
from tests.frontend.initialization.flights import body_velocity, tilt_error_deg
from tests.support.data import shared_data

FOLDER = "euroc_mh01_10s"


def all_samples(recording: Recording) -> tuple[I64, F64]:
    batches = [item for item in recording.items() if isinstance(item, ImuBatch)]
    times_ns = np.concatenate([batch.times_ns for batch in batches])
    return times_ns, np.concatenate([batch.accel_gyro for batch in batches])


def cut(samples: tuple[I64, F64], begin_ns: int, end_ns: int) -> tuple[I64, F64]:
    """Return the samples between two times, interpolated at both."""
    times_ns, values = samples
    inside = (times_ns > begin_ns) & (times_ns < end_ns)
    at = np.concatenate([[begin_ns], times_ns[inside], [end_ns]])
    since = (times_ns - begin_ns).astype(np.float64)
    columns = [np.interp((at - begin_ns).astype(np.float64), since, column) for column in values.T]
    return at, np.stack(columns, axis=1)


def turn(imu: Imu, interval: tuple[I64, F64]) -> F64:
    times_ns, values = interval
    start = np.array([0, len(times_ns)])
    data = InertialData(start, times_ns, values, (imu,), np.zeros(1, dtype=np.int64))
    return so3.to_matrix(integrate(data, np.zeros(3), np.zeros(3)).q_A_B[0])


def window_frame(images: TrackedImages, interval: tuple[I64, F64]) -> WindowFrame:
    cameras = images.cameras
    return WindowFrame(
        images.time_ns,
        *interval,
        np.repeat(np.arange(len(cameras), dtype=np.int32), [len(c) for c in cameras]),
        np.concatenate([c.track_id for c in cameras]),
        np.concatenate([c.uv_px for c in cameras]),
        np.concatenate([c.sigma_px for c in cameras]),
    )


def start_images(cameras: str, begin_s: float) -> tuple[StartState, int, float]:
    """Return state, its time and the duration of a start at some time of MH_01; biases are unknown."""
    recording = open_recording(
        shared_data(FOLDER), SourceOptions(rovio_active_camera_indices=cameras)
    )
    device, samples = recording.device, all_samples(recording)
    assert device.imu is not None
    tracker = FrameTracker(device.cameras, device.T_I_C)
    initializer = Initializer(device)
    first_ns = previous_ns = -1
    for event in EventStream(recording):
        if not isinstance(event, FrameSet):
            continue
        if event.time_ns < recording.start_ns + begin_s * 1e9:
            continue
        known = previous_ns >= 0
        first_ns = first_ns if known else event.time_ns
        interval = cut(samples, previous_ns if known else event.time_ns - 1, event.time_ns)
        R_I0_I1 = turn(device.imu, interval) if known else None
        images = tracker.track(event.time_ns, tuple(i.grey() for i in event.images), R_I0_I1)
        start = initializer.push(window_frame(images, interval))
        previous_ns = event.time_ns
        if start is not None:
            return start.state, start.frame.time_ns, (event.time_ns - first_ns) * 1e-9
    raise AssertionError(initializer.reason)


@pytest.mark.parametrize(("cameras", "most_s"), [("", 2.0), ("0", 4.0)], ids=["stereo", "mono"])
@pytest.mark.parametrize("begin_s", [0.5, 4.0])
def test_euroc(cameras: str, most_s: float, begin_s: float) -> None:
    state, time_ns, seconds = start_images(cameras, begin_s)
    truth = read_trajectory(shared_data(FOLDER) / "mav0/state_groundtruth_estimate0/data.csv")
    row = int(np.argmin(np.abs(truth.times_ns - time_ns)))
    assert seconds <= most_s
    assert tilt_error_deg(state.T_M_I[0], truth.T_R_B[row]) < 1.0
    assert truth.v_R is not None
    assert truth.gyro_bias is not None
    velocity = body_velocity(state.T_M_I[0], state.v_M[0])
    expected = body_velocity(truth.T_R_B[row], truth.v_R[row])
    assert np.linalg.norm(velocity - expected) < 0.01 + 0.03 * np.linalg.norm(expected)
    assert np.linalg.norm(truth.gyro_bias[row]) > 0.07
    assert np.linalg.norm(state.gyro_bias - truth.gyro_bias[row]) < 5e-3


def test_tango() -> None:
    """A replay: 8 Hz, handheld, an accelerometer bias of 0.8 m/s^2. The map is no exact truth."""
    vi_map = load_map(shared_data("maplab_maps/tango_handheld"))[0]
    recording = MapRecording(vi_map, 0)
    device, samples = recording.device, all_samples(recording)
    initializer, previous, start, row = Initializer(device), None, None, 60
    items = [item for item in recording.items() if isinstance(item, TrackedFrameSet)]
    while start is None and row < 120:
        images = tracked_images_of(items[row], previous, device.cameras, device.T_I_C)
        begin_ns = images.time_ns - 1 if previous is None else previous.time_ns
        start = initializer.push(window_frame(images, cut(samples, begin_ns, images.time_ns)))
        previous, row = images, row + 1
    assert start is not None
    state, row = start.state, row - 1 - len(start.later)
    assert tilt_error_deg(state.T_M_I[0], vi_map.vertices.T_M_I[row]) < 1.5
    bias = vi_map.vertices.accel_bias[row]
    assert np.linalg.norm(bias) > 0.7
    assert np.linalg.norm(state.accel_bias - bias) < 0.25
