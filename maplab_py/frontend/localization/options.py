"""Options of localisation while a recording is read, with rovioli's flag names."""

from pathlib import Path

import numpy as np

from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.estimation.window.options import MapRule
from maplab_py.options import Options, option
from maplab_py.vision.features.options import DESCRIPTORS

MODES = ("vil", "swl", "pose", "odo")
LANDMARK_UNCERTAINTIES = ("none", "map")


class OnlineLocalizationOptions(Options, prefix="localization_"):
    """Localisation of the odometry in a map."""

    matching: LocalizationOptions = LocalizationOptions()
    map_folder: Path | None = option(None, flag="vio_localization_map_folder")
    """Map folder, or summary map, in which the recording is localised"""
    features: str = option("", choices=("", *DESCRIPTORS), flag="vio_localization_features")
    """Descriptors for localisation: of images that are matched with the map, and of the new map's vertices;
    brisk, or xfeat (a network, which runs beside the odometry); empty = those that the map has, and
    --feature_tracking_descriptor_type"""
    mode: str = option("vil", choices=MODES)
    """vil = matches and odometry in one estimate; swl = T_G_M over the window's matches, poses fixed; pose =
    T_G_M from poses of single images; odo = T_G_M from the first matches only"""
    max_frequency_hz: float = option(2.0, gt=0, flag="vio_max_localization_frequency_hz")
    """Largest rate at which images are matched with the map"""
    map_tracking: bool = True
    """Once localised, match landmarks near their predicted places before all others"""
    max_num_constraints: int = option(25, ge=0, flag="rovioli_max_num_localization_constraints")
    """Tracks per camera that observe the map at a time; 0 = any number"""
    min_num_constraints: int = option(5, ge=1, flag="rovioli_min_number_of_structure_constraints")
    """Matches that an answer must have to be used"""
    max_tilt_deg: float = option(
        5.0, gt=0, flag="rovioli_localization_max_gravity_misalignment_deg"
    )
    """Largest angle between gravity in the map and in the odometry"""
    init_position_covariance_msq: float = option(
        20.0, gt=0, unit="m^2", flag="rovioli_baseframe_init_position_covariance_msq"
    )
    """Variance of the position of T_G_M before anything is matched"""
    init_rotation_covariance_radsq: float = option(
        float(np.radians(90.0)),
        gt=0,
        unit="rad^2",
        flag="rovioli_baseframe_init_rotation_covariance_radsq",
    )
    """Variance of the orientation of T_G_M before anything is matched"""
    min_num_estimates: int = option(2, ge=1, flag="rovioli_min_num_baseframe_estimates_before_init")
    """Answers in a row that must agree before T_G_M is set, or set again; four times as many where they
    differ by more than the odometry drifts and have fewer than 80 matches together"""
    max_mean_error_px: float = option(
        20.0, gt=0, flag="rovioli_max_mean_localization_reprojection_error_px"
    )
    """Mean reprojection error at the estimated pose above which an answer disagrees"""
    keypoint_sigma_px: float = option(1.0, gt=0, flag="vil_keypoint_sigma_px")
    """Standard deviation of a keypoint that observes the map"""
    tilt_sigma_deg: float = option(0.5, gt=0, flag="vil_map_tilt_sigma_deg")
    """Standard deviation of the tilt of the map against the odometry"""
    landmark_uncertainty: str = option(
        "none", choices=LANDMARK_UNCERTAINTIES, flag="vil_landmark_uncertainty"
    )
    """none = landmarks of the map are exact; map = they are estimated, with the map's covariances (mode
    vil)"""

    @property
    def rule(self) -> MapRule:
        """Weights of the estimator's observations of the map."""
        return MapRule(
            sigma_px=self.keypoint_sigma_px,
            tilt_sigma_rad=float(np.radians(self.tilt_sigma_deg)),
            base_sigma_m=float(np.sqrt(self.init_position_covariance_msq)),
            base_sigma_rad=float(np.sqrt(self.init_rotation_covariance_radsq)),
            estimates_landmarks=self.landmark_uncertainty == "map" and self.mode == "vil",
        )
