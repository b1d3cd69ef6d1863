"""What of the cameras' calibration a window estimates beside the motion."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.estimation.window.calibration import CalibrationEstimate, WindowCalibration
from maplab_py.estimation.window.options import CALIBRATED, WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.geometry import se3
from maplab_py.sensors import Camera
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)
FAULTS = {
    "extrinsics": [0.01, -0.01, 0.01, 0.03, -0.02, 0.03],  # 2.7 deg and 17 mm
    "time_offset": 0.008,
    "intrinsics": 0.01,
}


@pytest.fixture(scope="module")
def tracks() -> SimulatedTracks:
    return simulated(scenario(duration_s=6.0, keypoints=80))


def with_fault(tracks: SimulatedTracks, kind: str) -> tuple[tuple[Camera, ...], F64]:
    """Return cameras and poses with a wrong calibration of one kind."""
    cameras, T_I_C = tracks.cameras, tracks.T_I_C
    if kind == "extrinsics":
        return cameras, se3.retract(T_I_C, np.tile(FAULTS[kind], (len(T_I_C), 1)))
    if kind == "time_offset":
        return tuple(dataclasses.replace(c, image_delay_s=FAULTS[kind]) for c in cameras), T_I_C
    scale = np.array([1.0 + FAULTS[kind]] * 2 + [1.0] * 2)
    return tuple(dataclasses.replace(c, intrinsics=c.intrinsics * scale) for c in cameras), T_I_C


def estimate_by(tracks: SimulatedTracks, calibration: WindowCalibration) -> CalibrationEstimate:
    smoother = FixedLagSmoother(
        calibration.cameras, calibration.T_I_C, tracks.imu, WindowOptions(), calibration
    )
    smoother.start(tracks.frames[0], tracks.start_state(SIGMA))
    for frame in tracks.frames[1:]:
        smoother.add(frame)
    values = smoother.states.calibration
    return CalibrationEstimate(calibration, values, smoother.calibration_sigma(), 0.0)


@pytest.mark.parametrize("kind", list(FAULTS))
def test_a_fault_is_found_within_its_deviations(tracks: SimulatedTracks, kind: str) -> None:
    calibration = WindowCalibration.of(*with_fault(tracks, kind), (kind,))
    found = estimate_by(tracks, calibration)
    cameras, T_I_C = found.cameras()
    assert found.differs
    assert all(word for word in found.words())
    assert (found.sigma < 0.5 * calibration.sigma).any()
    if kind == "extrinsics":
        off, before = (np.abs(se3.local(tracks.T_I_C, of)) for of in (T_I_C, calibration.T_I_C))
        assert np.degrees(off[:, 3:].max()) < 0.3
        assert off[:, 3:].max() < 0.2 * before[:, 3:].max()
        assert (off.reshape(-1) <= 4.0 * found.sigma).all()
    elif kind == "time_offset":
        assert cameras[0].image_delay_s == pytest.approx(0.0, abs=5e-4)
    else:
        ratio = cameras[0].intrinsics[:2] / tracks.cameras[0].intrinsics[:2]
        np.testing.assert_allclose(ratio, 1.0, atol=3e-3)


def test_nothing_is_found_where_nothing_is_wrong(tracks: SimulatedTracks) -> None:
    found = estimate_by(tracks, WindowCalibration.of(tracks.cameras, tracks.T_I_C, CALIBRATED))
    assert (np.abs(found.values) <= 4.0 * found.sigma).all()


def test_cameras_share_their_delays_and_have_names_and_units(tracks: SimulatedTracks) -> None:
    camera = tracks.cameras[0]
    T_I_C = np.tile(tracks.T_I_C[:1], (2, 1))
    calibration = WindowCalibration.of((camera, camera), T_I_C, CALIBRATED)
    names = calibration.names()
    assert names.count("image delay") == names.count("line delay") == 1
    assert len(set(names)) == len(names) == len(calibration) == len(calibration.units())
    assert sum(" position " in name or " rotation " in name for name in names) == 12


def test_known_cameras_have_no_states_and_backwards_the_opposite_lateness(
    tracks: SimulatedTracks,
) -> None:
    late = dataclasses.replace(tracks.cameras[0], image_delay_s=0.01, line_delay_ns=50_000)
    known = WindowCalibration.of((late,), tracks.T_I_C[:1])
    assert len(known) == 0
    assert known.has_lateness
    assert not WindowCalibration.of(tracks.cameras, tracks.T_I_C).has_lateness
    nothing = np.zeros(0)
    forward = known.of_kernels(nothing).timing_s
    np.testing.assert_allclose(forward, [[0.01, 5e-5]])
    np.testing.assert_allclose(known.reversed_at(nothing).of_kernels(nothing).timing_s, -forward)


def test_a_delay_that_was_measured_before_is_where_the_window_begins(
    tracks: SimulatedTracks,
) -> None:
    rolling = dataclasses.replace(tracks.cameras[0], image_delay_s=0.001, line_delay_ns=50_000)
    calibration = WindowCalibration.of((rolling,), tracks.T_I_C[:1], ("time_offset",))
    begun = calibration.with_delay(-0.056)
    timing_s = begun.of_kernels(begun.mean).timing_s[0]
    assert timing_s @ [1.0, 0.5 * rolling.height_px] == pytest.approx(-0.056)
    assert timing_s[1] == pytest.approx(5e-5)
    assert calibration.with_delay(0.0) is calibration
    known = WindowCalibration.of((rolling,), tracks.T_I_C[:1])
    assert known.with_delay(-0.056) is known
