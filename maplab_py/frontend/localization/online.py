"""Localisation of the odometry, frame by frame: when to match, what to believe, what to report."""

import collections
import dataclasses
import time
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from maplab_py.algorithms.localization.localizer import Outcome
from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.window.localized import MapPose
from maplab_py.estimation.window.map_tracks import MapMatches
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.localization import agreement, map_source, track_check
from maplab_py.frontend.localization.estimators import MapEstimator, make_estimator
from maplab_py.frontend.localization.keypoints import FrameKeypoints, frame_keypoints
from maplab_py.frontend.localization.matcher import Answer, MapMatcher
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.vertex_keypoints import check_descriptors_exist
from maplab_py.geometry import se3
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.vision.features.extractors import KINDS
from maplab_py.vision.features.options import DESCRIPTORS, NETWORKS

_EARLY = 0.95
"""A frame may be matched this share of the interval after the one before."""
_PROBABLY_RIGHT = 30
"""Matches of an answer that the next frame is to confirm: wrong answers have up to 11 by binary descriptors
(Tango), up to 14 by XFeat (rendered rooms)."""
_HISTORY = 200
"""Frames back to which a late answer is used."""


@dataclasses.dataclass(eq=False)
class LocalizationCounts:
    """Counts of a run."""

    frames: int = 0
    localized_frames: int = 0
    queries: int = 0
    answers_by_index: int = 0
    answers_by_tracking: int = 0
    matches: int = 0
    starts: int = 0  # of T_G_M
    disagreeing: int = 0  # answers that the estimate contradicts
    late: int = 0  # answers to frames that nobody knows any more
    refused: dict[str, int] = dataclasses.field(default_factory=dict)  # by reason
    first_localized_ns: int = -1


@dataclasses.dataclass(frozen=True, eq=False)
class LocalizedFrame:
    """Localisation of a frame."""

    time_ns: int
    pose: MapPose | None  # None while it is not known
    answer: Answer | None  # to this frame, or to the one before if a network has described it
    stage_ms: dict[str, float]  # elapsed time


@dataclasses.dataclass(frozen=True, eq=False)
class MapEvent:
    """Message to an estimator after a frame: to start at a pose, or an answer to use."""

    time_ns: int
    answers: tuple[Answer, ...]
    start: Answer | None  # T_G_M starts at its pose; None = it goes on


@dataclasses.dataclass(frozen=True, eq=False)
class _Remembered:
    """Pose of a frame when it was estimated."""

    T_M_I: F64  # (7,)
    T_G_I: F64 | None  # (7,)
    path_m: float  # length of the path up to it


@dataclasses.dataclass(frozen=True, eq=False)
class _Waiting:
    """A frame whose keypoints are being described."""

    seen: Future[FrameKeypoints]
    T_M_I: F64  # (7,)
    pose: MapPose | None  # in the map then


class OnlineLocalization:
    """Localises an odometry in a map.

    The odometry never stops because of the map: what goes wrong here ends localisation, with one line
    in `problem`.
    """

    def __init__(
        self,
        searched: map_source.SearchedMap,
        device: RecordedSensors,
        options: OnlineLocalizationOptions,
        window: WindowOptions | None = None,
        features: str = "",
    ) -> None:
        """Index the map.

        Args:
            searched: The map.
            device: Sensors of the recording.
            window: Of the odometry.
            features: Descriptors of images that are matched; empty = those that the tracks are to get.
        """
        self.counts = LocalizationCounts()
        self.events: list[MapEvent] = []  # of the last frame
        self.notes = map_source.calibration_notes(searched, device)
        self.problem = ""
        self.options, self.map_name = options, searched.name
        self.map_landmarks = len(searched.database.p_G)
        self._map, self._device, self._T_I_C = searched, device, device.T_I_C
        self._matcher = MapMatcher(searched, options)
        self.estimator: MapEstimator = make_estimator(
            options.mode, device, options.rule, window or WindowOptions()
        )
        self._filter = agreement.AgreementFilter(
            options.min_num_estimates, options.max_mean_error_px
        )
        self._poses: collections.OrderedDict[int, _Remembered] = collections.OrderedDict()
        self._mission = -1
        self._next_ns = -(1 << 62)
        self.features = features
        self._thread: ThreadPoolExecutor | None = None
        self._waiting: _Waiting | None = None

    def after_frame(
        self, update: OdometryUpdate, smoother: FixedLagSmoother | None
    ) -> LocalizedFrame:
        """Match a frame that the odometry has estimated, if it is time, and return its pose."""
        self.counts.frames += 1
        self.events = []
        if update.state is None or smoother is None:
            return LocalizedFrame(update.time_ns, None, None, {})
        if update.mission != self._mission:
            self._start_again(update.mission)
        pose = self.estimator.pose(smoother)
        self._remember(update.time_ns, update.state.T_M_I[0], pose)
        spent_ms: dict[str, float] = {"match": 0.0}
        answer = self._used(smoother, spent_ms)
        if not self.problem and update.time_ns >= self._next_ns:
            began = time.perf_counter()
            interval_ns = 1e9 / self.options.max_frequency_hz
            self._next_ns = update.time_ns + int(_EARLY * interval_ns)
            self._ask(update, self.estimator.pose(smoother) or pose)
            spent_ms["match"] += 1e3 * (time.perf_counter() - began)
            if self.features not in NETWORKS:
                answer = self._used(smoother, spent_ms)
        if answer is not None:
            pose = self.estimator.pose(smoother) or pose
        if pose is not None:
            self.counts.localized_frames += 1
            if self.counts.first_localized_ns < 0:
                self.counts.first_localized_ns = update.time_ns
        return LocalizedFrame(update.time_ns, pose, answer, spent_ms)

    @property
    def p_G(self) -> F64:
        """Landmarks (L, 3) of the map."""
        return self._matcher.p_G

    def take(self, answer: Answer, smoother: FixedLagSmoother) -> bool:
        """Use an answer, which may be late; tell whether it was used.

        Answers join the frame that they belong to. Those to frames that are no longer known are
        dropped and counted.
        """
        remembered = self._poses.get(answer.time_ns)
        if remembered is None or not np.isin(answer.track_id, smoother.tracks.id).any():
            self.counts.late += 1
            return False
        T_G_I = remembered.T_G_I
        verdict = self._filter.judge(
            answer, remembered.T_M_I, T_G_I, self._matcher.p_G, path_m=remembered.path_m
        )
        if verdict is agreement.Verdict.WAIT:
            self.counts.disagreeing += T_G_I is not None
            if T_G_I is None and answer.T_G_I is not None and len(answer) >= _PROBABLY_RIGHT:
                self._next_ns = answer.time_ns
            return False
        answers: tuple[Answer, ...] = (answer,)
        start = None
        if verdict is agreement.Verdict.START:
            answers, start = tuple(self._filter.take()), answer
        event = MapEvent(answer.time_ns, answers, start)
        self.events.append(event)
        self.apply(event, smoother, self.estimator)
        return True

    def apply(self, event: MapEvent, smoother: FixedLagSmoother, estimator: MapEstimator) -> None:
        """Tell an estimator of an event, be it this one's or another one's that is compared with it."""
        if event.start is not None:
            assert event.start.T_G_I is not None  # only poses agree
            estimator.start(self._base_frame(event.start, event.start.T_G_I, smoother), smoother)
            self.counts.starts += estimator is self.estimator
        for answer in event.answers:
            matches = self._chosen(answer, estimator, smoother)
            if estimator is self.estimator:
                self.counts.matches += len(matches)
            estimator.add(answer, matches, smoother)

    # -- inside -----------------------------------------------------------------------------------

    def _ask(self, update: OdometryUpdate, pose: MapPose | None) -> None:
        """Describe the keypoints of a frame, in a thread if a network does.

        Then its answer is waited for at the next frame, always, so that results do not depend on time.
        """
        assert update.state is not None
        self.counts.queries += 1
        seen: Future[FrameKeypoints] = Future()
        if self.features in NETWORKS and update.images:
            self._thread = self._thread or ThreadPoolExecutor(1, "maplab-features")
            seen = self._thread.submit(frame_keypoints, update, self._device, self.features)
        else:
            try:
                seen.set_result(frame_keypoints(update, self._device, self.features))
            except UserError as error:
                seen.set_exception(error)
        self._waiting = _Waiting(seen, update.state.T_M_I[0], pose)

    def _used(self, smoother: FixedLagSmoother, spent_ms: dict[str, float]) -> Answer | None:
        """Match and use the frame that was described last; add the elapsed time."""
        began = time.perf_counter()
        answer = None if self.problem else self._waited_for()
        spent_ms["match"] += 1e3 * (time.perf_counter() - began)
        if answer is not None:
            began = time.perf_counter()
            self.take(answer, smoother)
            spent_ms["use"] = 1e3 * (time.perf_counter() - began)
        return answer

    def _waited_for(self) -> Answer | None:
        """Match the frame that was described last; remember why not when the map cannot be searched."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            return None
        try:
            return self._answer(waiting.seen.result(), waiting.T_M_I, waiting.pose)
        except (UserError, EstimationError) as error:
            self.problem = str(error)
            return None

    def _answer(self, seen: FrameKeypoints, T_M_I: F64, pose: MapPose | None) -> Answer | None:
        """Track the map where that is possible, else ask the index; few tracked matches are better
        than none.
        """
        tracked = None
        if pose is not None and self.options.map_tracking:
            tracked = self._matcher.track(seen, pose.T_G_I, _finite(pose.covariance))
            if tracked is not None and len(tracked) >= self.options.min_num_constraints:
                self.counts.answers_by_tracking += 1
                return tracked
        answer, outcome = self._matcher.find(seen, T_M_I[:4])
        if answer is not None:
            self.counts.answers_by_index += 1
            return answer
        reason = outcome if outcome is not Outcome.LOCALIZED else Outcome.FEW_MATCHES
        self.counts.refused[reason.value] = self.counts.refused.get(reason.value, 0) + 1
        self.counts.answers_by_tracking += tracked is not None
        return tracked

    def _chosen(
        self, answer: Answer, estimator: MapEstimator, smoother: FixedLagSmoother
    ) -> MapMatches:
        """Return new matches, so that at most as many tracks per camera observe the map as may do so.

        Tracks with most observations come first: all of these enter.
        """
        associated, tracks = estimator.associated, smoother.tracks
        most = self.options.max_num_constraints
        rows = np.flatnonzero(np.isin(answer.track_id, tracks.id))
        _, first = np.unique(answer.track_id[rows], return_index=True)
        rows, present = rows[np.sort(first)], 0
        if associated is not None:
            rows = rows[~associated.includes(answer.track_id[rows])]
            rows = rows[~np.isin(answer.landmark[rows], associated.matches.landmark)]
            present = int(np.count_nonzero(associated.includes(tracks.id[tracks.is_active])))
            rows = rows[self._observed_throughout(answer, rows, estimator, smoother)]
        counts = tracks.counts()[np.searchsorted(tracks.id, answer.track_id[rows])]
        rows = rows[np.argsort(-counts, kind="stable")]
        if most:
            room = max(most * len(self._device.cameras) - present, 0)
            rank = _rank_within(answer.camera[rows].astype(np.int64))
            rows = rows[rank < most][:room]
        landmark = answer.landmark[rows]
        covariance = None
        if self.options.rule.estimates_landmarks:
            assert self._map.covariance_G is not None  # the map was opened with them
            covariance = self._map.covariance_G[landmark]
        return MapMatches(answer.track_id[rows], landmark, self._matcher.p_G[landmark], covariance)

    def _observed_throughout(
        self, answer: Answer, rows: I64, estimator: MapEstimator, smoother: FixedLagSmoother
    ) -> Mask:
        """Tell which matches (rows) agree with all that their tracks observe in the window."""
        pose, bases = estimator.pose(smoother), []
        if pose is not None:
            bases.append(pose.T_G_M)
        if answer.T_G_I is not None:
            bases.append(self._base_frame(answer, answer.T_G_I, smoother))
        if not bases:
            return np.ones(len(rows), dtype=np.bool_)
        landmark = answer.landmark[rows]
        matches = MapMatches(answer.track_id[rows], landmark, self._matcher.p_G[landmark])
        return track_check.observed_throughout(
            matches, bases, smoother, self._device.cameras, self._T_I_C,
            sigma_px=self.options.keypoint_sigma_px,
        )  # fmt: skip

    def _base_frame(self, answer: Answer, T_G_I: F64, smoother: FixedLagSmoother) -> F64:
        """Return T_G_M (7,) by the pose (7,) of an answer's frame."""
        T_M_I = _pose_at(smoother, answer.time_ns)
        if T_M_I is None:
            T_M_I = self._poses[answer.time_ns].T_M_I
        return se3.compose(T_G_I, se3.inverse(T_M_I))

    def _remember(self, time_ns: int, T_M_I: F64, pose: MapPose | None) -> None:
        path_m = 0.0
        if self._poses:
            latest = next(reversed(self._poses.values()))
            path_m = latest.path_m + float(np.linalg.norm(T_M_I[4:] - latest.T_M_I[4:]))
        T_G_I = None if pose is None else pose.T_G_I
        self._poses[time_ns] = _Remembered(T_M_I, T_G_I, path_m)
        if len(self._poses) > _HISTORY:
            self._poses.popitem(last=False)

    def _start_again(self, mission: int) -> None:
        """Forget T_G_M and all answers: M is another frame now."""
        self._mission = mission
        self.estimator.stop(None)
        self._filter.clear()
        self._poses.clear()
        self._waiting = None


def opened_localization(
    options: OnlineLocalizationOptions, device: RecordedSensors, odometry: OdometryOptions
) -> OnlineLocalization | None:
    """Read and index the map; None when the options name no map.

    Raises:
        UserError: There is no map, or it cannot be searched.
        MapError: A file of it is damaged.
    """
    if options.map_folder is None:
        return None
    tracked = odometry.tracking.descriptor_type
    searched = map_source.open_map(
        options.map_folder,
        with_covariances=options.rule.estimates_landmarks,
        feature_type=KINDS[options.features or tracked].feature_type,
        is_free=not options.features,
    )
    kind, features = searched.database.projection.kind, options.features or tracked
    if not options.features:
        features = next(
            (
                name
                for name in (tracked, *DESCRIPTORS)
                if KINDS[name].feature_type == kind.feature_type
            ),
            tracked,
        )
    else:
        map_source.check_descriptors(searched, kind.size, KINDS[features].feature_type)
    check_descriptors_exist(features)
    return OnlineLocalization(searched, device, options, odometry.window, features)


def _finite(covariance: F64) -> F64:
    """Return a covariance, that of a well-known pose where there is none."""
    return covariance if np.isfinite(covariance).all() else np.diag(np.repeat([1e-4, 1e-5], 3))


def _pose_at(smoother: FixedLagSmoother, time_ns: int) -> F64 | None:
    """Return the pose (7,) of a frame in the window."""
    row = np.flatnonzero(smoother.times_ns == time_ns)
    return smoother.states.T_M_I[row[0]] if len(row) else None


def _rank_within(group: I64) -> I64:
    """Return how many entries of the same group (N,) come before each (N,)."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    rank = np.empty(len(group), dtype=np.int64)
    rank[order] = np.arange(len(group)) - first
    return rank
