"""Update of the window against GTSAM's: `python -m benchmarks.frontend.window [--keypoints 150]`.

Both estimate the same simulated stereo session, every frame a keyframe: 7 keyframes and 3 recent frames
here, a lag of 10 frames there. The peer gets the landmarks that this project estimates, at the places
where it does, with the same observations (undistorted), Huber loss and inertial samples. Counted is
the processor time of one thread: of the peer `IncrementalFixedLagSmoother.update` alone; of this
project what does the same, to optimise and to marginalise, and all of `add`, which also predicts, gates
observations, triangulates, looks for outliers, decides on keyframes, and computes a covariance.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.estimation.window.frame import WindowFrame, WindowUpdate
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

_SIGMA = np.repeat([1e-3, 1e-3, 0.02, 1e-3, 0.02], 3)
_FOCAL_PX = 380.0  # of the ideal camera for undistorted pixels
_FRAME_S = 0.1
_INTEGRATION_VARIANCE, _LANDMARK_SIGMA_M = 1e-8, 5.0


@dataclasses.dataclass(frozen=True)
class Measured:
    """Medians over the updates with a full window."""

    landmarks: float
    observations: float
    ours_ms: float  # optimise and marginalise
    ours_all_ms: float  # all of `add`
    peer_ms: float
    ours_all_p90_ms: float
    peer_p90_ms: float
    ours_error_m: float  # at the end
    peer_error_m: float

    @property
    def ratio(self) -> float:
        """Ours over the peer's, of the same work."""
        return self.ours_ms / self.peer_ms

    @property
    def ratio_all(self) -> float:
        """All of ours over the peer's update."""
        return self.ours_all_ms / self.peer_ms


class GtsamSmoother:
    """GTSAM's incremental fixed-lag smoother, fed with what another smoother estimates."""

    def __init__(self, tracks: SimulatedTracks, num_frames: int, huber_sigmas: float) -> None:
        """Begin at the true first state."""
        import gtsam

        self._gtsam, self._tracks = gtsam, tracks
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.01)
        parameters.relinearizeSkip, parameters.findUnusedFactorSlots = 1, True
        self._smoother = gtsam.IncrementalFixedLagSmoother(
            (num_frames - 0.5) * _FRAME_S, parameters
        )
        self._T_I_C = [_pose(T_I_C) for T_I_C in tracks.T_I_C]
        self._calibration = gtsam.Cal3_S2(_FOCAL_PX, _FOCAL_PX, 0.0, 0.0, 0.0)
        sigma_px = float(tracks.frames[0].sigma_px[0])
        huber = gtsam.noiseModel.mEstimator.Huber.Create(huber_sigmas)
        isotropic = gtsam.noiseModel.Isotropic.Sigma(2, sigma_px)
        self._noise = gtsam.noiseModel.Robust.Create(huber, isotropic)
        self._imu_noise = _imu_noise(tracks)
        self._known: set[int] = set()
        self._row = 0
        self.update_ms: list[float] = []
        self.position = tracks.T_M_I[0, 4:]
        self._start()

    def _start(self) -> None:
        gtsam, tracks, (X, V, B) = self._gtsam, self._tracks, _symbols()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._bias = gtsam.imuBias.ConstantBias(tracks.accel_bias[0], tracks.gyro_bias[0])
        self._state = gtsam.NavState(_pose(tracks.T_M_I[0]), tracks.v_M[0])
        sigmas = gtsam.noiseModel.Diagonal.Sigmas
        pose_sigma = np.concatenate([_SIGMA[3:6], _SIGMA[:3]])
        graph.add(gtsam.PriorFactorPose3(X(0), self._state.pose(), sigmas(pose_sigma)))
        graph.add(gtsam.PriorFactorVector(V(0), tracks.v_M[0], sigmas(_SIGMA[6:9])))
        bias_sigma = np.concatenate([_SIGMA[12:], _SIGMA[9:12]])
        graph.add(gtsam.PriorFactorConstantBias(B(0), self._bias, sigmas(bias_sigma)))
        self._insert_state(values, 0)
        self._smoother.update(graph, values, self._stamps(0))

    def _insert_state(self, values: Any, row: int) -> None:
        X, V, B = _symbols()
        values.insert(X(row), self._state.pose())
        values.insert(V(row), self._state.velocity())
        values.insert(B(row), self._bias)

    def _stamps(self, row: int) -> dict[int, float]:
        return {symbol(row): row * _FRAME_S for symbol in _symbols()}

    def add(self, frame: WindowFrame, smoother: FixedLagSmoother) -> None:
        """Add a frame with the landmarks that a smoother has after this frame."""
        from gtsam.symbol_shorthand import L

        gtsam, (X, V, B), row = self._gtsam, _symbols(), self._row + 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        motion = self._preintegrated(frame)
        self._state = motion.predict(self._state, self._bias)
        keys = (X(row - 1), V(row - 1), X(row), V(row), B(row - 1), B(row))
        graph.add(gtsam.CombinedImuFactor(*keys, motion))
        self._insert_state(values, row)
        stamps = self._stamps(row)
        first_row = row + 1 - len(smoother.times_ns)
        ids, p_M = smoother.landmarks()
        rows = smoother.tracks.landmark_rows
        order, start = smoother.tracks.grouped(rows)
        seen = smoother.tracks.observations.take(order)
        for n, landmark in enumerate(ids.tolist()):
            is_new = landmark not in self._known
            if is_new:
                values.insert(L(landmark), p_M[n])
                sigma = gtsam.noiseModel.Isotropic.Sigma(3, _LANDMARK_SIGMA_M)
                graph.add(gtsam.PriorFactorPoint3(L(landmark), p_M[n], sigma))
            for o in range(start[n], start[n + 1]):
                frame_row = first_row + int(seen.frame[o])
                if is_new or frame_row == row:
                    uv = _FOCAL_PX * seen.ray_C[o, :2] / seen.ray_C[o, 2]
                    mounting = self._T_I_C[int(seen.camera[o])]
                    graph.add(
                        gtsam.GenericProjectionFactorCal3_S2(
                            uv, self._noise, X(frame_row), L(landmark), self._calibration, mounting
                        )
                    )
                    stamps[L(landmark)] = row * _FRAME_S
        began = time.process_time()
        self._smoother.update(graph, values, stamps)
        self.update_ms.append(1e3 * (time.process_time() - began))
        self._read(row)

    def _read(self, row: int) -> None:
        gtsam, (X, V, B) = self._gtsam, _symbols()
        result = self._smoother.calculateEstimate()
        self._state = gtsam.NavState(result.atPose3(X(row)), result.atVector(V(row)))
        self._bias, self._row = result.atConstantBias(B(row)), row
        live = [gtsam.Symbol(key) for key in list(result.keys())]
        self._known = {symbol.index() for symbol in live if symbol.chr() == ord("l")}
        self.position = self._state.pose().translation()

    def _preintegrated(self, frame: WindowFrame) -> Any:
        measured = self._gtsam.PreintegratedCombinedMeasurements(self._imu_noise, self._bias)
        step_s = np.diff(frame.imu_times_ns) * 1e-9
        mean = 0.5 * (frame.accel_gyro[1:] + frame.accel_gyro[:-1])
        for sample, dt in zip(mean, step_s.tolist(), strict=True):
            measured.integrateMeasurement(sample[:3], sample[3:], dt)
        return measured


def _symbols() -> tuple[Any, Any, Any]:
    from gtsam.symbol_shorthand import B, V, X

    return X, V, B


def _pose(T: np.ndarray) -> Any:
    import gtsam

    x, y, z, w = T[:4]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), T[4:])


def _imu_noise(tracks: SimulatedTracks) -> Any:
    import gtsam

    imu, one = tracks.imu, np.eye(3)
    noise = gtsam.PreintegrationCombinedParams.MakeSharedU(imu.gravity_magnitude_mps2)
    noise.setGyroscopeCovariance(one * imu.gyro_noise_density**2)
    noise.setAccelerometerCovariance(one * imu.acc_noise_density**2)
    noise.setIntegrationCovariance(one * _INTEGRATION_VARIANCE)
    noise.setBiasAccCovariance(one * imu.acc_bias_random_walk_noise_density**2)
    noise.setBiasOmegaCovariance(one * imu.gyro_bias_random_walk_noise_density**2)
    return noise


def measure(keypoints: int, seconds: float) -> Measured:
    """Run both on one session."""
    options = WindowOptions(keyframe_parallax_deg=0.0, max_landmarks=10_000)
    tracks = simulated(
        scenario(duration_s=seconds, keypoints=keypoints, landmarks_per_room=20 * keypoints)
    )
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    smoother.start(tracks.frames[0], tracks.start_state(_SIGMA))
    num_frames = options.keyframes_kept(len(tracks.cameras)) + options.num_recent_frames
    peer = GtsamSmoother(tracks, num_frames, options.huber_sigmas)
    ours_ms, updates, observations = [], list[WindowUpdate](), []
    for frame in tracks.frames[1:]:
        began = time.process_time()
        updates.append(smoother.add(frame))
        ours_ms.append(1e3 * (time.process_time() - began))
        observations.append(len(smoother.tracks.grouped(smoother.tracks.landmark_rows)[0]))
        peer.add(frame, smoother)
    full = slice(num_frames, None)
    truth = tracks.T_M_I[-1, 4:]
    return Measured(
        landmarks=float(np.median([update.num_landmarks for update in updates[full]])),
        observations=float(np.median(observations[full])),
        ours_ms=float(
            np.median([u.stage_ms["optimise"] + u.stage_ms["slide"] for u in updates[full]])
        ),
        ours_all_ms=float(np.median(ours_ms[full])),
        peer_ms=float(np.median(peer.update_ms[full])),
        ours_all_p90_ms=float(np.percentile(ours_ms[full], 90)),
        peer_p90_ms=float(np.percentile(peer.update_ms[full], 90)),
        ours_error_m=float(np.linalg.norm(updates[-1].state.T_M_I[0, 4:] - truth)),
        peer_error_m=float(np.linalg.norm(peer.position - truth)),
    )


def main() -> None:
    """Measure, print and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keypoints", type=int, default=150, help="in each image")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--repeats", type=int, default=1, help="runs, of which the best counts")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    runs = [measure(arguments.keypoints, arguments.seconds) for _ in range(arguments.repeats)]
    best = min(runs, key=lambda run: run.ours_ms)
    result = {**dataclasses.asdict(best), "ratio": best.ratio, "ratio_all": best.ratio_all}
    result["ratios"] = [[run.ratio, run.ratio_all] for run in runs]
    for name, value in result.items():
        print(name.replace("_", " "), np.round(value, 4))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
