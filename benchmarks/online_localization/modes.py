"""All modes of localisation over the same frames, tracks and matches, from one run of the front-end."""

import dataclasses
import time

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.localization.estimators import MapEstimator, make_estimator
from maplab_py.frontend.localization.map_source import SearchedMap
from maplab_py.frontend.localization.online import LocalizationCounts, OnlineLocalization
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.starting import MakeStarter
from maplab_py.geometry import se3
from maplab_py.interop.recordings.protocol import Event, ImuBatch, Recording, TrackedFrameSet
from maplab_py.interop.recordings.stream import EventStream

BASELINES = ("swl", "pose", "odo")
MODES = ("vil", *BASELINES)


@dataclasses.dataclass(frozen=True, eq=False)
class ModeResult:
    """Estimated poses in the map of the frames at which a mode was localised."""

    times_ns: I64  # (N,)
    T_G_I: F64  # (N, 7)
    T_M_I: F64  # (N, 7)
    covariance: F64  # (N, 6, 6)


@dataclasses.dataclass(frozen=True, eq=False)
class Comparison:
    """What a run has given."""

    results: dict[str, ModeResult]
    counts: LocalizationCounts
    answered_ns: I64  # (A,) frames with an answer of the map that was used
    frames: int
    estimated: int  # frames with an odometry
    cpu_ms: dict[str, F64]  # processor times of frames: window of odo and vil, matching, swl


def compare(
    recording: Recording,
    searched: SearchedMap,
    options: OnlineLocalizationOptions,
    *,
    make_starter: MakeStarter | None = None,
    odometry_options: OdometryOptions | None = None,
) -> Comparison:
    """Run the odometry with VIL and, beside it, the odometry without a map with the baselines."""
    return compare_all(
        recording,
        [(searched, options)],
        make_starter=make_starter,
        odometry_options=odometry_options,
    )[0]


def compare_all(
    recording: Recording,
    cases: list[tuple[SearchedMap, OnlineLocalizationOptions]],
    *,
    make_starter: MakeStarter | None = None,
    odometry_options: OdometryOptions | None = None,
) -> list[Comparison]:
    """Compare the modes in several maps or with several options; they share the odometry without a map."""
    odometry_options = odometry_options or OdometryOptions()
    device = recording.device
    plain = Odometry(device, odometry_options, make_starter=make_starter)
    runs = [
        _Case(
            Odometry(device, odometry_options, make_starter=make_starter, map_rule=options.rule),
            OnlineLocalization(searched, device, options, odometry_options.window),
            {
                mode: make_estimator(mode, device, options.rule, odometry_options.window)
                for mode in BASELINES
            },
        )
        for searched, options in cases
    ]
    frames = estimated = 0
    odo_ms: list[float] = []
    for event in EventStream(recording):
        of_plain, spent_ms = pushed(plain, event)
        odo_ms += spent_ms
        frames += len(of_plain)
        estimated += sum(update.state is not None for update in of_plain)
        for case in runs:
            case.push(event, of_plain, plain.smoother)
    return [case.result(frames, estimated, odo_ms) for case in runs]


def pushed(odometry: Odometry, event: Event) -> tuple[list[OdometryUpdate], list[float]]:
    """Return the updates of an event, and the processor time of each [ms]."""
    began = time.process_time()
    if isinstance(event, ImuBatch):
        updates = odometry.push_imu(event)
    else:
        assert isinstance(event, TrackedFrameSet)
        updates = odometry.push_frames(event)
    spent_ms = 1e3 * (time.process_time() - began)
    return updates, [spent_ms / len(updates) for _ in updates]


class _Case:
    """VIL and the baselines in one map."""

    def __init__(
        self,
        tight: Odometry,
        localization: OnlineLocalization,
        estimators: dict[str, MapEstimator],
    ) -> None:
        self._tight, self._localization, self._estimators = tight, localization, estimators
        self._rows: dict[str, list[tuple[int, F64, F64, F64]]] = {mode: [] for mode in MODES}
        self._spent: dict[str, list[float]] = {name: [] for name in ("vil window", "match", "swl")}
        self._answered_ns: list[int] = []

    def push(
        self, event: Event, of_plain: list[OdometryUpdate], smoother: FixedLagSmoother | None
    ) -> None:
        """Take an event, and what the odometry without a map has made of it."""
        of_tight, spent_ms = pushed(self._tight, event)
        self._spent["vil window"] += spent_ms
        for plain, tight in zip(of_plain, of_tight, strict=True):
            began = time.process_time()
            frame = self._localization.after_frame(tight, self._tight.smoother)
            if frame.answer is not None:
                if self._localization.events:
                    self._answered_ns.append(tight.time_ns)
                self._spent["match"].append(1e3 * (time.process_time() - began))
            if plain.state is None or smoother is None:
                continue
            self._tell_baselines(smoother)
            if frame.pose is not None and tight.state is not None:
                pose, T_M_I = frame.pose, tight.state.T_M_I[0]
                self._rows["vil"].append((tight.time_ns, pose.T_G_I, T_M_I, pose.covariance))
            _add_baselines(self._rows, self._estimators, smoother, plain.time_ns)

    def result(self, frames: int, estimated: int, odo_ms: list[float]) -> Comparison:
        """Return what all modes have estimated."""
        times = {name: np.array(values) for name, values in self._spent.items()}
        return Comparison(
            {mode: _result(values) for mode, values in self._rows.items()},
            self._localization.counts, np.array(self._answered_ns, dtype=np.int64), frames, estimated,
            {"odo window": np.array(odo_ms), **times},
        )  # fmt: skip

    def _tell_baselines(self, smoother: FixedLagSmoother) -> None:
        for map_event in self._localization.events:
            for mode, estimator in self._estimators.items():
                began = time.process_time()
                self._localization.apply(map_event, smoother, estimator)
                if mode == "swl":
                    self._spent["swl"].append(1e3 * (time.process_time() - began))


def _add_baselines(
    rows: dict[str, list[tuple[int, F64, F64, F64]]],
    estimators: dict[str, MapEstimator],
    smoother: FixedLagSmoother,
    time_ns: int,
) -> None:
    for mode, estimator in estimators.items():
        pose = estimator.pose(smoother)
        if pose is not None:
            rows[mode].append((time_ns, pose.T_G_I, smoother.states.T_M_I[-1], pose.covariance))


def _result(rows: list[tuple[int, F64, F64, F64]]) -> ModeResult:
    times = np.array([row[0] for row in rows], dtype=np.int64)
    T_G_I = np.array([row[1] for row in rows]).reshape(-1, 7)
    T_M_I = np.array([row[2] for row in rows]).reshape(-1, 7)
    return ModeResult(times, T_G_I, T_M_I, np.array([row[3] for row in rows]).reshape(-1, 6, 6))


@dataclasses.dataclass(frozen=True)
class PoseErrors:
    """Errors of poses in the map, without alignment."""

    localized_share: float
    median_m: float
    std_m: float
    rmse_m: float
    largest_m: float
    median_deg: float
    step_m: float  # 95th percentile of the error's change between outputs
    nees_position: float  # mean; 3 is expected


def pose_errors(result: ModeResult, times_ns: I64, T_G_I: F64, frames: int) -> PoseErrors:
    """Compare with the truth (T, 7) in the frame of the map at the same times (T,), ascending."""
    row = np.searchsorted(times_ns, result.times_ns)
    row = np.minimum(row, len(times_ns) - 1)
    known = times_ns[row] == result.times_ns
    if not known.any():
        return PoseErrors(0.0, *([float("nan")] * 7))
    delta = se3.local(T_G_I[row[known]], result.T_G_I[known])
    error = np.linalg.norm(delta[:, :3], axis=1)
    covariance = result.covariance[known][:, :3, :3]
    finite = np.isfinite(covariance).all(axis=(1, 2))
    nees = np.array(
        [
            d @ np.linalg.solve(C, d)
            for d, C in zip(delta[finite, :3], covariance[finite], strict=True)
        ]
    )
    steps = np.linalg.norm(np.diff(delta[:, :3], axis=0), axis=1)
    return PoseErrors(
        localized_share=float(np.count_nonzero(known)) / max(frames, 1),
        median_m=float(np.median(error)),
        std_m=float(np.std(error)),
        rmse_m=float(np.sqrt(np.mean(error**2))),
        largest_m=float(error.max()),
        median_deg=float(np.degrees(np.median(np.linalg.norm(delta[:, 3:], axis=1)))),
        step_m=float(np.percentile(steps, 95.0)) if len(steps) else 0.0,
        nees_position=float(nees.mean()) if len(nees) else float("nan"),
    )
