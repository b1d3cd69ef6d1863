"""Estimators of the pose in the map: tightly coupled (VIL), and the baselines of Paper I.

All see the same answers. VIL changes the odometry, the others read it: T_G_I = T_G_M T_M_I.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.window.alignment import aligned
from maplab_py.estimation.window.localized import LocalizedSmoother, MapPose, composition_jacobian
from maplab_py.estimation.window.map_terms import MAP_GATE_CHI2, MapTerms, contradicted_unless_most
from maplab_py.estimation.window.map_tracks import MapMatches, MapTracks
from maplab_py.estimation.window.options import MapRule, WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.localization.matcher import Answer
from maplab_py.geometry import se3
from maplab_py.interop.recordings.protocol import RecordedSensors


class MapEstimator:
    """Estimates T_G_M from matches; unless a mode does, it does not change the odometry."""

    def __init__(self) -> None:
        self.T_G_M: F64 | None = None
        self.covariance = np.full((6, 6), np.inf)  # of T_G_M
        self.associated: MapTracks | None = None
        """The tracks that observe the map now; None where matches are not kept."""

    def start(self, T_G_M: F64, smoother: FixedLagSmoother) -> None:  # noqa: ARG002
        """Begin at T_G_M (7,), or begin again there."""
        self.T_G_M = T_G_M

    def add(self, answer: Answer, matches: MapMatches, smoother: FixedLagSmoother) -> None:
        """Take an answer of a frame; its matches are those that shall be associated."""

    def stop(self, smoother: FixedLagSmoother | None) -> None:  # noqa: ARG002
        """Forget everything; the odometry has started again if there is no smoother."""
        self.T_G_M = None
        self.covariance = np.full((6, 6), np.inf)

    def pose(self, smoother: FixedLagSmoother) -> MapPose | None:
        """Return where the newest frame is, with its covariance given T_M_I; None while it is not known."""
        if self.T_G_M is None:
            return None
        T_M_I = smoother.states.T_M_I[-1]
        covariance = self.covariance
        if np.isfinite(covariance).all():
            J = composition_jacobian(self.T_G_M, T_M_I)[:, 6:]
            covariance = J @ covariance @ J.T
        return MapPose(self.T_G_M, se3.compose(self.T_G_M, T_M_I), covariance)


class TightEstimator(MapEstimator):
    """VIL: the smoother has T_G_M among its states."""

    def start(self, T_G_M: F64, smoother: FixedLagSmoother) -> None:
        """See `MapEstimator`."""
        localized = _localized(smoother)
        localized.start_base_frame(T_G_M)
        self.associated = localized.map_tracks

    def add(self, answer: Answer, matches: MapMatches, smoother: FixedLagSmoother) -> None:  # noqa: ARG002
        """See `MapEstimator`."""
        _localized(smoother).associate(matches)

    def stop(self, smoother: FixedLagSmoother | None) -> None:
        """See `MapEstimator`."""
        self.associated = None
        if smoother is not None:
            _localized(smoother).stop_base_frame()

    def pose(self, smoother: FixedLagSmoother) -> MapPose | None:
        """Return the joint estimate."""
        return _localized(smoother).map_pose


class SlidingWindowEstimator(MapEstimator):
    """SWL: T_G_M over the window's matches, all poses fixed, whenever there is an answer."""

    def __init__(self, device: RecordedSensors, rule: MapRule, options: WindowOptions) -> None:
        """Take the cameras, and the weights of the tight estimator."""
        super().__init__()
        self._cameras, self._T_I_C = device.cameras, device.T_I_C
        self._rule, self._options = rule, options
        self._tracks = self.associated = MapTracks(estimates_landmarks=False)

    def start(self, T_G_M: F64, smoother: FixedLagSmoother) -> None:
        """See `MapEstimator`."""
        super().start(T_G_M, smoother)
        self._tracks.clear()

    def add(self, answer: Answer, matches: MapMatches, smoother: FixedLagSmoother) -> None:  # noqa: ARG002
        """See `MapEstimator`."""
        if self.T_G_M is None:
            return
        exact = dataclasses.replace(matches, covariance_G=None)
        self._tracks.forget(smoother.tracks)
        self._tracks.add(exact, smoother.tracks)
        states = dataclasses.replace(smoother.states, T_G_M=self.T_G_M[None])
        terms, used = self._terms(smoother)
        far = contradicted_unless_most(terms.errors_px(states), terms.observations, self._options)
        if far.any():
            self._tracks.refuse(used[far])
            terms, used = self._terms(smoother)
        if not len(used):
            return
        rule = self._rule
        sigma = np.repeat([rule.base_sigma_m, rule.base_sigma_rad], 3)
        try:
            self.T_G_M, self.covariance = aligned(terms, states, sigma)
        except EstimationError:
            return
        states = dataclasses.replace(states, T_G_M=self.T_G_M[None])
        start = terms.observations.start
        mean2 = np.add.reduceat(terms.errors_px(states) ** 2, start[:-1]) / np.diff(start)
        self._tracks.refuse(used[~(mean2 <= MAP_GATE_CHI2 * rule.sigma_px**2)])

    def _terms(self, smoother: FixedLagSmoother) -> tuple[MapTerms, I64]:
        """Return the observations of the map in the window, and their associations (rows)."""
        rule = self._rule
        observations, used = self._tracks.observations(smoother.tracks, rule.sigma_px)
        terms = MapTerms(
            observations, self._cameras, self._T_I_C,
            huber_sigmas=self._options.huber_sigmas, tilt_sigma_rad=rule.tilt_sigma_rad,
        )  # fmt: skip
        return terms, used

    def stop(self, smoother: FixedLagSmoother | None) -> None:
        """See `MapEstimator`."""
        super().stop(smoother)
        self._tracks = self.associated = MapTracks(estimates_landmarks=False)


class PoseEstimator(MapEstimator):
    """ROVIOLI's loose coupling: T_G_M from the poses of single images with their covariances."""

    def __init__(self) -> None:
        super().__init__()
        self._poses: dict[int, tuple[F64, F64]] = {}

    def start(self, T_G_M: F64, smoother: FixedLagSmoother) -> None:
        """See `MapEstimator`."""
        super().start(T_G_M, smoother)
        self._poses = {}

    def add(self, answer: Answer, matches: MapMatches, smoother: FixedLagSmoother) -> None:  # noqa: ARG002
        """Take the mean of all answers to frames in the window, weighted by information."""
        if self.T_G_M is None or answer.T_G_I is None or answer.covariance is None:
            return
        if np.isfinite(answer.covariance).all():
            self._poses[answer.time_ns] = answer.T_G_I, answer.covariance
        times_ns = smoother.times_ns.tolist()
        self._poses = {t: pose for t, pose in self._poses.items() if t in times_ns}
        if not self._poses:
            return
        information, right = np.zeros((6, 6)), np.zeros(6)
        for time_ns, (T_G_I, covariance) in self._poses.items():
            T_M_I = smoother.states.T_M_I[times_ns.index(time_ns)]
            J = _alignment_jacobian(T_G_I, T_M_I)
            weight = np.linalg.inv(J @ covariance @ J.T)
            T_G_M = se3.compose(T_G_I, se3.inverse(T_M_I))
            information += weight
            right += weight @ se3.local(self.T_G_M, T_G_M)
        self.covariance = np.asarray(np.linalg.inv(information))
        self.T_G_M = se3.retract(self.T_G_M, self.covariance @ right)

    def stop(self, smoother: FixedLagSmoother | None) -> None:
        """See `MapEstimator`."""
        super().stop(smoother)
        self._poses = {}


class OdometryEstimator(MapEstimator):
    """ODO: aligned once, at the first matches; drift stays."""

    def start(self, T_G_M: F64, smoother: FixedLagSmoother) -> None:
        """See `MapEstimator`."""
        if self.T_G_M is None:
            super().start(T_G_M, smoother)


def make_estimator(
    mode: str, device: RecordedSensors, rule: MapRule, options: WindowOptions
) -> MapEstimator:
    """Return the estimator of a mode: vil, swl, pose or odo."""
    if mode == "swl":
        return SlidingWindowEstimator(device, rule, options)
    makers: dict[str, type[MapEstimator]] = {
        "vil": TightEstimator, "pose": PoseEstimator, "odo": OdometryEstimator
    }  # fmt: skip
    return makers[mode]()


def _localized(smoother: FixedLagSmoother) -> LocalizedSmoother:
    if not isinstance(smoother, LocalizedSmoother):
        raise EstimationError("mode vil needs a localised smoother: see Odometry(map_rule=...)")
    return smoother


def _alignment_jacobian(T_G_I: F64, T_M_I: F64) -> F64:
    """Return the Jacobian (6, 6) of T_G_M = T_G_I T_M_I^-1 by the tangent of T_G_I."""
    return composition_jacobian(T_G_I, se3.inverse(T_M_I))[:, 6:]
