"""Options of layers and colours, with maplab's flag names where it has them."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.vimap.descriptors import type_of_name

_RULES = {
    "height": "color_landmarks_by_height",
    "observations": "color_landmarks_by_number_of_observations",
    "missions": "color_landmarks_by_observer_datasets",
    "quality": "color_landmarks_by_quality",
    "time": "color_landmarks_by_time",
    "type": "color_by_landmark_type",
    "camera": "color_landmarks_by_first_observer_frame",
    "pixels": "color_landmarks_by_pixels",
    "mission": "color_by_mission",
}
"""Options of the rules that colour landmarks; a special rule beats the mission's."""
COLOURINGS = ("mission", *(rule for rule in _RULES if rule != "mission"), "grey")

MeshColouring = Literal["auto", "shaded", "colour", "height", "distance"]
"""Rules for the colours of meshes, see `mesh_sources.coloured_mesh`."""


class VisualizationOptions(Options, prefix="vis_"):
    """Layers of a map and their style."""

    color_by_mission: bool = True
    """Colour landmarks by mission."""
    color_landmarks_by_height: bool = False
    """Colour landmarks by height."""
    color_landmarks_by_number_of_observations: bool = False
    """Colour landmarks by the number of their observations."""
    color_landmarks_by_observer_datasets: bool = False
    """Colour landmarks by the number of missions that observe them."""
    color_landmarks_by_quality: bool = False
    """Colour landmarks by quality."""
    color_landmarks_by_time: bool = False
    """Colour landmarks by when they were first observed."""
    color_by_landmark_type: bool = False
    """Colour landmarks by feature type."""
    color_landmarks_by_first_observer_frame: bool = False
    """Colour landmarks by the camera of the frame that observed them first."""
    color_landmarks_by_pixels: bool = False
    """Colour landmarks by the pixels of the images that the map keeps."""
    color_paths_by_time: bool = False
    """Colour trajectories by the time since the beginning of their mission."""
    color_only_missions: str = ""
    """Colour the landmarks of these missions alone by the rule, the others by mission: ids or their
    beginnings, separated by commas; empty = all."""
    color_by_height_offset_m: float = 0.0
    """Height of the first colour."""
    color_by_height_period_m: float = 0.0
    """Height after which colours repeat; 0 = over the height of the map."""
    color_landmarks_by_time_period_seconds: float = 0.0
    """Time after which colours repeat; 0 = over the length of the mission."""
    color_missions_by_name: bool = False
    """Missions of one name have one colour, as those of a robot in a server's map."""
    color_salt: int = 1
    """Another number gives the missions other colours."""
    landmark_gray_level: int = option(150, ge=0, le=255)
    """Grey of landmarks that no rule colours."""
    check_landmark_constrained: bool = True
    """Hide landmarks of bad quality at first; the panel can show them."""
    show_only_landmark_type: str = ""
    """Show landmarks of this feature type only: Binary, SuperPoint, R2D2, SIFT, LIDARSuperPoint or a number;
    empty = all."""
    landmarks_min_observers: int = 0
    """Leave out landmarks that fewer vertices observe."""
    landmarks_max_observers: int = option(5, ge=1)
    """This many observers, and more, have the last colour."""
    landmarks_min_number_of_observer_missions: int = 0
    """Leave out landmarks that fewer missions observe."""
    max_points: int = option(1_000_000, ge=1)
    """Draw at most this many landmarks, and as many points of dense clouds."""
    max_refused_closures: int = option(200, ge=0)
    """Draw at most this many refused closures, those nearest to acceptance first."""
    refused_closures_reason: str = ""
    """Draw refused closures whose reason contains this text only, such as inliers; empty = all."""
    lc_edge_covariances: bool = False
    """Show the covariance of the position of each loop closure edge as an ellipsoid."""
    abs_6dof_constraint_covariances: bool = False
    """Show the covariance of the position of each absolute pose as an ellipsoid."""
    coverage: bool = False
    """Show the uncertainty of the path as a tube, poorly seen volume as fog, and where to walk next."""
    covariance_scale: float = option(3.0, gt=0)
    """Half axes of the ellipsoids and tubes of covariances, in standard deviations."""
    scale: float = option(1.0, gt=0)
    """Size of points, frusta and axes."""
    frustum_every_nth: int = 0
    """Draw every n-th camera; 0 = as suits the mission."""
    offset_x_m: float = 0.0
    """Shift of the whole drawing along x."""
    offset_y_m: float = 0.0
    """Shift of the whole drawing along y."""
    offset_z_m: float = 0.0
    """Shift of the whole drawing along z."""
    offset_landmarks_by_first_observer_frame_m: float = 0.0
    """Shift landmarks along x by this times the index of the camera that saw them first."""
    spatially_distribute_missions_meters: float = option(
        0.0, flag="spatially_distribute_missions_meters"
    )
    """Shift every mission by this much against the one before, along x."""

    def __post_init__(self) -> None:
        super().__post_init__()
        reason = self.refused_closures_reason
        if reason and not any(reason.lower() in verdict.value for verdict in Verdict):
            known = ", ".join(verdict.value for verdict in Verdict)
            raise FlagError(
                f"--vis_refused_closures_reason={reason}: no reason contains this text (there are: {known})"
            )
        if self.show_only_landmark_type:
            type_of_name(self.show_only_landmark_type, "vis_show_only_landmark_type")

    @property
    def landmark_colouring(self) -> str:
        """The rule that colours landmarks, one of `COLOURINGS`."""
        return next((rule for rule, name in _RULES.items() if getattr(self, name)), "grey")

    def with_colouring(self, colouring: str, only_missions: str = "") -> VisualizationOptions:
        """Return the options with another rule (one of `COLOURINGS`) for landmarks."""
        rules: dict[str, Any] = {name: rule == colouring for rule, name in _RULES.items()}
        return dataclasses.replace(self, color_only_missions=only_missions, **rules)


class PlaybackOptions(Options, prefix="vis_seq_"):
    """Playback of missions."""

    landmark_fadeout: bool = True
    """Landmarks just observed glow and fade."""
    synchronize_missions_on_distance: bool = True
    """Play missions by the distance travelled instead of by time."""
    synchronize_missions_on_distance_percent: bool = True
    """Let all missions begin and end together."""
    vertex_frequency: float = option(10.0, gt=0, le=60, unit="Hz")
    """Steps shown per second."""
    steps: int = option(200, ge=2, le=2000)
    """Steps from the beginning to the end."""


class PointCloudOptions(Options, prefix="vis_pointcloud_"):
    """Selection of dense clouds."""

    visualize_every_nth: int = option(1, ge=1)
    """Show every n-th cloud or depth map."""
    color_random: bool = False
    """Give every cloud a different colour."""
    reproject_depth_maps_with_undistorted_camera: bool = False
    """The depth maps are of undistorted images."""
    export_accumulated_pc_to_ply_path: str = ""
    """Write all points that are shown to this PLY file, in G."""
