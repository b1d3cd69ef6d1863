"""Processor times of an update at 30,000 landmarks, one thread (thesis, table 4.2).

Map and session are those of `benchmarks.localization`. Medians over the localised frames: rays of
the keypoints, matching and RANSAC of the index, tracking of the map, the window without a map (ODO), with
it (VIL), and the alignment over the window's matches (SWL). All match alike, so a complete update is
matching, RANSAC and VIL, or matching, RANSAC, ODO and SWL.
"""

import time
from unittest import mock

import numba
import numpy as np

from benchmarks.localization import maps
from benchmarks.online_localization.modes import pushed
from maplab_py.algorithms.localization.localizer import Localizer
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.frontend.localization.estimators import make_estimator
from maplab_py.frontend.localization.keypoints import frame_keypoints
from maplab_py.frontend.localization.map_source import SearchedMap, of_summary
from maplab_py.frontend.localization.matcher import MapMatcher
from maplab_py.frontend.localization.online import OnlineLocalization
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.trajectories import Trajectory
from maplab_py.vimap import VIMap
from tests.frontend.known_start import KnownStart
from tests.support.machine import slowness

_FILLING_FRAMES = 15
"""Localised frames that are not counted: the window fills up."""
STAGES = ("rays", "matching", "ransac", "tracking", "odo", "vil", "use", "swl")
"""Of VIL the window, and the use of an answer; SWL uses an answer and estimates."""


class Stopwatch:
    """Times [ms] by stage."""

    def __init__(self) -> None:
        """Start without times."""
        self._spent: dict[str, list[float]] = {stage: [] for stage in STAGES}
        self._began = 0.0

    def start(self) -> None:
        """Begin a stage."""
        self._began = time.process_time()

    def stop(self, stage: str) -> None:
        """Add the time since the start."""
        self.add(stage, 1e3 * (time.process_time() - self._began))

    def add(self, stage: str, spent_ms: float) -> None:
        """Add a time."""
        self._spent[stage].append(spent_ms)

    def medians(self) -> dict[str, float]:
        """Return the median of every stage."""
        return {stage: float(np.median(spent)) for stage, spent in self._spent.items()}


def measure(searched: SearchedMap, session: VIMap, options: OnlineLocalizationOptions) -> Stopwatch:
    """Localise a session whose states are true."""
    v = session.vertices
    start = KnownStart(
        Trajectory(v.timestamp_ns, v.T_M_I, v.v_M, v.gyro_bias, v.accel_bias), with_biases=True
    )
    recording = MapRecording(session, 0)
    device, window = recording.device, OdometryOptions().window
    plain = Odometry(device, make_starter=start)
    tight = Odometry(device, make_starter=start, map_rule=options.rule)
    localization = OnlineLocalization(searched, device, options)
    aligned = make_estimator("swl", device, options.rule, window)
    localizer, matcher = (
        Localizer(searched.database, LocalizationOptions()),
        MapMatcher(searched, options),
    )
    watch, localized = Stopwatch(), 0
    for event in EventStream(recording):
        of_plain, _ = pushed(plain, event)
        of_tight, _ = pushed(tight, event)
        for first, second in zip(of_plain, of_tight, strict=True):
            frame = localization.after_frame(second, tight.smoother)
            smoother = plain.smoother
            if smoother is None:
                continue
            for map_event in localization.events:
                watch.start()
                localization.apply(map_event, smoother, aligned)
                if localized > _FILLING_FRAMES:
                    watch.stop("swl")
            if frame.pose is None or second.state is None:
                continue
            localized += 1
            if localized > _FILLING_FRAMES:
                watch.add("odo", first.stage_ms["window"])
                watch.add("vil", second.stage_ms["window"])
                if "use" in frame.stage_ms:
                    watch.add("use", frame.stage_ms["use"])
                watch.start()
                seen = frame_keypoints(second, device)
                watch.stop("rays")
                answer = localizer.localize(seen.query(second.state.T_M_I[0, :4]))
                watch.add("matching", 1e3 * answer.matching_s)
                watch.add("ransac", 1e3 * answer.ransac_s)
                watch.start()
                matcher.track(seen, frame.pose.T_G_I, frame.pose.covariance)
                watch.stop("tracking")
    return watch


def main() -> None:
    """Measure both kinds of landmarks; print times, and times of an ordinary machine."""
    numba.set_num_threads(1)
    vi_map, session = maps()
    searched = of_summary(
        make_summary_map(vi_map, SummaryMapOptions(covariances=True)), "map", with_covariances=True
    )
    for uncertainty in ("none", "none", "map"):  # the first compiles
        options = OnlineLocalizationOptions(
            landmark_uncertainty=uncertainty, max_frequency_hz=100.0
        )
        factor = slowness()
        with mock.patch("time.perf_counter", time.process_time):
            ms = measure(searched, session, options).medians()
        factor = 0.5 * (factor + slowness())
        matching = ms["matching"] + ms["ransac"]
        ratio = (matching + ms["vil"] + ms["use"]) / (matching + ms["odo"] + ms["swl"])
        for what, by in (("here", 1.0), (f"ordinary machine ({factor:.2f} times faster)", factor)):
            times = ", ".join(f"{stage} {spent / by:.1f}" for stage, spent in ms.items())
            print(f"{len(searched.database.p_G)} landmarks, {uncertainty}, {what}: {times} ms")
        print(f"VIL complete / (ODO + SWL) complete: {ratio:.2f}", flush=True)
