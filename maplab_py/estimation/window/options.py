"""Options of the fixed-lag smoother."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.estimation.window.standstill import StandstillSigmas
from maplab_py.options import option

CALIBRATED = ("extrinsics", "time_offset", "intrinsics", "line_delay")
"""Groups of numbers of a calibration that can be estimated."""
_RIG_KEYFRAMES, _MONO_KEYFRAMES = 7, 12


@dataclasses.dataclass(frozen=True)
class WindowOptions:
    """Size of the window, choice of keyframes and landmarks, and when an update is good enough."""

    flag_prefix: ClassVar[str] = "vio_"

    num_keyframes: int = option(
        0,
        help="Keyframes in the window; 0 = 7 of several cameras, and 12 of a single camera, which sees "
        "distances by its motion only.",
    )
    num_recent_frames: int = option(3, help="Frames in the window that follow the last keyframe.")
    landmark_policy: str = option(
        "all",
        choices=("all", "thesis"),
        help="Which tracks are estimated: all with parallax, or as in the thesis terminated and "
        "long ones only, the best of them by score.",
    )
    max_landmarks: int = option(
        300,
        help="Landmarks that the newest frame sees; the longest tracks are taken. Landmarks whose tracks "
        "have ended stay beside them until the frame leaves in which they are anchored.",
    )
    min_parallax_deg: float = option(
        0.7, unit="deg", help="Smallest angle between the rays of a landmark that is triangulated."
    )
    expected_depth_share: float = option(
        4.0,
        help="Standard deviation of the inverse depth of a landmark without that parallax, as a "
        "multiple of the median inverse depth.",
    )
    min_depth_m: float = option(0.1, unit="m", help="Smallest depth of a new landmark.")
    max_depth_m: float = option(100.0, unit="m", help="Largest depth of a new landmark.")
    keyframe_parallax_deg: float = option(
        2.0, unit="deg", help="Median parallax to the last keyframe that makes a keyframe."
    )
    keyframe_tracked_share: float = option(
        0.7, help="Share of the last keyframe's tracks; with fewer a frame becomes a keyframe."
    )
    huber_sigmas: float = option(1.345, help="Scale of the Huber loss of reprojection errors.")
    gate_chi2: float = option(
        9.21, help="Largest squared error of an observation in standard deviations (99 %: 9.21)."
    )
    prediction_sigma_px: float = option(
        2.0, unit="px", help="Uncertainty of a predicted place, for gates of new observations."
    )
    num_iterations: int = option(5, help="Largest number of iterations of an update.")
    function_tolerance: float = option(
        1e-3, help="Relative decrease of the cost that ends an update."
    )
    keep_first_estimates: bool = option(
        True, help="Evaluate Jacobians of frames in the prior where they entered it."
    )
    max_joined_s: float = option(
        2.0, unit="s", help="Longest inertial interval that is joined when a frame is dropped."
    )
    rest_sigma_m: float = option(1e-3, unit="m", help="Change of place over an interval at rest.")
    rest_sigma_rad: float = option(5e-4, unit="rad", help="Turn over an interval at rest.")
    rest_sigma_mps: float = option(
        3e-3, unit="m/s", help="Velocity at rest, and while surely turning on the spot."
    )
    turning_sigma_mps: float = option(0.05, unit="m/s", help="Velocity while only turning.")
    turning_min_radps: float = option(
        0.1,
        unit="rad/s",
        help="Smallest angular velocity of a sure turn on the spot; slow flights without turns look alike.",
    )
    turning_max_sigma_mps: float = option(
        0.02,
        unit="m/s",
        help="Largest standard deviation of the velocity, which must be zero within it, for a sure turn "
        "on the spot.",
    )
    turning_max_mps: float = option(
        0.15, unit="m/s", help="Speed up to which the estimate agrees with only turning."
    )
    thesis_landmarks_per_update: int = option(
        50, help="Tracks that enter an update (landmark_policy thesis)."
    )
    thesis_persistent_landmarks: int = option(
        15, help="Landmarks that stay until their track ends (landmark_policy thesis)."
    )
    thesis_num_keyframes: int = option(5, help="Keyframes in the window (landmark_policy thesis).")
    thesis_track_length: int = option(
        6, help="Frames after which a track enters though it goes on (landmark_policy thesis)."
    )

    def keyframes_kept(self, cameras: int) -> int:
        """Return the number of keyframes in the window, by the policy and the number of cameras."""
        if self.follows_thesis:
            return self.thesis_num_keyframes
        return self.num_keyframes or (_RIG_KEYFRAMES if cameras > 1 else _MONO_KEYFRAMES)

    @property
    def follows_thesis(self) -> bool:
        """Whether landmarks enter and leave as in the thesis."""
        return self.landmark_policy == "thesis"

    @property
    def standstill(self) -> StandstillSigmas:
        """Largest motion of a body at rest."""
        return StandstillSigmas(
            self.rest_sigma_m, self.rest_sigma_rad, self.rest_sigma_mps, self.turning_sigma_mps
        )
