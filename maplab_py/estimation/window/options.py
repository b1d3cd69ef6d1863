"""Options of the fixed-lag smoother."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.options import Options, option

CALIBRATED = ("extrinsics", "time_offset", "intrinsics", "line_delay")
"""Groups of numbers of a calibration that can be estimated."""
_RIG_KEYFRAMES, _MONO_KEYFRAMES = 7, 12
_OUTLIER_MEDIANS, _LEAST_GATE_SIGMAS = 8.0, 0.5
"""Errors beyond so many medians are outliers within the gate, too, if they exceed so many deviations."""


class WindowOptions(Options, prefix="vio_"):
    """Size of the window, choice of keyframes and landmarks, and convergence criteria."""

    num_keyframes: int = 0
    """Keyframes in the window; 0 = 7 of several cameras, and 12 of a single camera, which sees distances by
    its motion only."""
    num_recent_frames: int = option(3, ge=1)
    """Frames in the window that follow the last keyframe."""
    landmark_policy: str = option("all", choices=("all", "thesis"))
    """Tracks that are estimated: all with parallax, or as in the thesis terminated and long ones only, the
    best of them by score."""
    max_landmarks: int = option(300, ge=10)
    """Landmarks that the newest frame sees; the longest tracks are taken. Landmarks whose tracks have ended
    stay beside them until the frame leaves in which they are anchored."""
    min_parallax_deg: float = 0.7
    """Smallest angle between the rays of a landmark that is triangulated."""
    expected_depth_share: float = 4.0
    """Standard deviation of the inverse depth of a landmark without that parallax, as a multiple of the
    median inverse depth."""
    min_depth_m: float = option(0.1, gt=0)
    """Smallest depth of a new landmark."""
    max_depth_m: float = option(100.0, gt=0)
    """Largest depth of a new landmark."""
    keyframe_parallax_deg: float = 2.0
    """Median parallax to the last keyframe that makes a keyframe."""
    keyframe_tracked_share: float = 0.7
    """Share of the last keyframe's tracks; with fewer a frame becomes a keyframe."""
    huber_sigmas: float = option(1.345, gt=0)
    """Scale of the Huber loss of reprojection errors."""
    gate_chi2: float = option(9.21, gt=0)
    """Largest squared error of an observation in standard deviations (99 %: 9.21)."""
    prediction_sigma_px: float = 2.0
    """Uncertainty of a predicted place, for gates of new observations."""
    num_iterations: int = option(5, ge=1)
    """Largest number of iterations of an update."""
    function_tolerance: float = 1e-3
    """Relative decrease of the cost that ends an update."""
    max_joined_s: float = 2.0
    """Longest inertial interval that is joined when a frame is dropped."""
    rest_sigma_m: float = 1e-3
    """Change of place over an interval at rest."""
    rest_sigma_rad: float = 5e-4
    """Turn over an interval at rest."""
    rest_sigma_mps: float = 3e-3
    """Velocity at rest, and while surely turning on the spot."""
    turning_sigma_mps: float = 0.05
    """Velocity while only turning."""
    turning_min_radps: float = 0.1
    """Smallest angular velocity of a sure turn on the spot; slow flights without turns look alike."""
    turning_max_sigma_mps: float = 0.02
    """Largest standard deviation of the velocity, which must be zero within it, for a sure turn on the
    spot."""
    turning_max_mps: float = 0.15
    """Speed up to which the estimate agrees with only turning."""
    thesis_landmarks_per_update: int = 50
    """Tracks that enter an update (landmark_policy thesis)."""
    thesis_persistent_landmarks: int = 15
    """Landmarks that stay until their track ends (landmark_policy thesis)."""
    thesis_num_keyframes: int = 5
    """Keyframes in the window (landmark_policy thesis)."""
    thesis_track_length: int = 6
    """Frames after which a track enters though it goes on (landmark_policy thesis)."""

    def keyframes_kept(self, cameras: int) -> int:
        """Return the number of keyframes in the window, by the policy and the number of cameras."""
        if self.follows_thesis:
            return self.thesis_num_keyframes
        return self.num_keyframes or (_RIG_KEYFRAMES if cameras > 1 else _MONO_KEYFRAMES)

    def largest_error_px(self, sigma_px: F64, median_px: float) -> F64:
        """Return the largest errors (O,) of observations with these deviations, in a window with this median.

        Tracks of sharp images fit much better than their deviations say; those on people who walk slowly
        would stay within the gate.
        """
        usual_px = np.maximum(_OUTLIER_MEDIANS * median_px, _LEAST_GATE_SIGMAS * sigma_px)
        return np.asarray(np.minimum(np.sqrt(self.gate_chi2) * sigma_px, usual_px))

    @property
    def follows_thesis(self) -> bool:
        """Whether landmarks enter and leave as in the thesis."""
        return self.landmark_policy == "thesis"


@dataclasses.dataclass(frozen=True)
class MapRule:
    """Weights of observations of the map."""

    sigma_px: float = 1.0  # of a keypoint (Paper I)
    tilt_sigma_rad: float = float(np.radians(0.5))
    base_sigma_m: float = float(np.sqrt(20.0))  # of T_G_M before anything is observed
    base_sigma_rad: float = float(np.sqrt(np.radians(90.0)))
    estimates_landmarks: bool = False  # with the map's covariances; else they are exact
