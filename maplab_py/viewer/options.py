"""Options of layers and colours, with maplab's flag names where it has them."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.errors import FlagError
from maplab_py.options import option
from maplab_py.vimap.descriptors import type_of_name

COLOURINGS = (
    "mission",
    "height",
    "observations",
    "missions",
    "quality",
    "time",
    "type",
    "camera",
    "grey",
)

MeshColouring = Literal["auto", "shaded", "colour", "height", "distance"]
"""Rules for the colours of meshes, see `mesh_sources.coloured_mesh`."""


@dataclasses.dataclass(frozen=True)
class VisualizationOptions:
    """Layers of a map and their style."""

    flag_prefix: ClassVar[str] = "vis_"

    color_by_mission: bool = option(True, help="Colour landmarks by mission.")
    color_landmarks_by_height: bool = option(False, help="Colour landmarks by height.")
    color_landmarks_by_number_of_observations: bool = option(
        False, help="Colour landmarks by the number of their observations."
    )
    color_landmarks_by_observer_datasets: bool = option(
        False, help="Colour landmarks by the number of missions that observe them."
    )
    color_landmarks_by_quality: bool = option(False, help="Colour landmarks by quality.")
    color_landmarks_by_time: bool = option(
        False, help="Colour landmarks by when they were first observed."
    )
    color_by_landmark_type: bool = option(False, help="Colour landmarks by feature type.")
    color_landmarks_by_first_observer_frame: bool = option(
        False, help="Colour landmarks by the camera of the frame that observed them first."
    )
    color_only_missions: str = option(
        "",
        help="Colour the landmarks of these missions alone by the rule, the others by mission: "
        "ids or their beginnings, separated by commas; empty = all.",
    )
    color_by_height_offset_m: float = option(0.0, help="Height of the first colour.", unit="m")
    color_by_height_period_m: float = option(
        0.0, help="Height after which colours repeat; 0 = over the height of the map.", unit="m"
    )
    color_landmarks_by_time_period_seconds: float = option(
        0.0, help="Time after which colours repeat; 0 = over the length of the mission.", unit="s"
    )
    color_missions_by_name: bool = option(
        False, help="Missions of one name have one colour, as those of a robot in a server's map."
    )
    color_salt: int = option(1, help="Another number gives the missions other colours.")
    landmark_gray_level: int = option(150, help="Grey of landmarks that no rule colours.")
    check_landmark_constrained: bool = option(
        True, help="Hide landmarks of bad quality at first; the panel can show them."
    )
    show_only_landmark_type: str = option(
        "",
        help="Show landmarks of this feature type only: Binary, SuperPoint, R2D2, SIFT, LIDARSuperPoint or "
        "a number; empty = all.",
    )
    landmarks_min_observers: int = option(
        0, help="Leave out landmarks that fewer vertices observe."
    )
    landmarks_max_observers: int = option(
        5, help="This many observers, and more, have the last colour."
    )
    landmarks_min_number_of_observer_missions: int = option(
        0, help="Leave out landmarks that fewer missions observe."
    )
    max_points: int = option(
        300_000, help="Draw at most this many landmarks, and as many points of dense clouds."
    )
    max_refused_closures: int = option(
        200, help="Draw at most this many refused closures, those nearest to acceptance first."
    )
    refused_closures_reason: str = option(
        "",
        help="Draw refused closures whose reason contains this text only, such as inliers; empty = all.",
    )
    lc_edge_covariances: bool = option(
        False, help="Show the covariance of the position of each loop closure edge as an ellipsoid."
    )
    abs_6dof_constraint_covariances: bool = option(
        False, help="Show the covariance of the position of each absolute pose as an ellipsoid."
    )
    covariance_scale: float = option(
        3.0, help="Half axes of the ellipsoids of covariances, in standard deviations."
    )
    scale: float = option(1.0, help="Size of points, frusta and axes.")
    frustum_every_nth: int = option(0, help="Draw every n-th camera; 0 = as suits the mission.")
    offset_x_m: float = option(0.0, help="Shift of the whole drawing along x.", unit="m")
    offset_y_m: float = option(0.0, help="Shift of the whole drawing along y.", unit="m")
    offset_z_m: float = option(0.0, help="Shift of the whole drawing along z.", unit="m")
    offset_landmarks_by_first_observer_frame_m: float = option(
        0.0,
        help="Shift landmarks along x by this times the index of the camera that saw them first.",
        unit="m",
    )
    spatially_distribute_missions_meters: float = option(
        0.0,
        help="Shift every mission by this much against the one before, along x.",
        unit="m",
        flag="spatially_distribute_missions_meters",
    )

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("max_points", "landmarks_max_observers"):
            if getattr(self, name) < 1:
                raise ValueError(f"--vis_{name}={getattr(self, name)}: must be 1 or greater")
        if self.max_refused_closures < 0:
            raise ValueError(
                f"--vis_max_refused_closures={self.max_refused_closures}: must be 0 or greater"
            )
        reason = self.refused_closures_reason
        if reason and not any(reason.lower() in verdict.value for verdict in Verdict):
            known = ", ".join(verdict.value for verdict in Verdict)
            raise ValueError(
                f"--vis_refused_closures_reason={reason}: no reason contains this text (there are: {known})"
            )
        for name in ("scale", "covariance_scale"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"--vis_{name}={getattr(self, name):g}: must be greater than 0")
        if not 0 <= self.landmark_gray_level <= 255:
            raise ValueError(
                f"--vis_landmark_gray_level={self.landmark_gray_level}: must be 0 to 255"
            )
        if self.show_only_landmark_type:
            try:
                type_of_name(self.show_only_landmark_type)
            except FlagError as error:
                raise ValueError(f"--vis_show_only_landmark_type: {error}") from None

    @property
    def landmark_colouring(self) -> str:
        """The rule that colours landmarks, one of `COLOURINGS`; a special rule beats the mission's."""
        rules = (
            (self.color_landmarks_by_height, "height"),
            (self.color_landmarks_by_number_of_observations, "observations"),
            (self.color_landmarks_by_observer_datasets, "missions"),
            (self.color_landmarks_by_quality, "quality"),
            (self.color_landmarks_by_time, "time"),
            (self.color_by_landmark_type, "type"),
            (self.color_landmarks_by_first_observer_frame, "camera"),
            (self.color_by_mission, "mission"),
        )
        return next((name for is_wanted, name in rules if is_wanted), "grey")

    def with_colouring(self, colouring: str, only_missions: str = "") -> VisualizationOptions:
        """Return the options with another rule (one of `COLOURINGS`) for landmarks."""
        return dataclasses.replace(
            self,
            color_only_missions=only_missions,
            color_landmarks_by_height=colouring == "height",
            color_landmarks_by_number_of_observations=colouring == "observations",
            color_landmarks_by_observer_datasets=colouring == "missions",
            color_landmarks_by_quality=colouring == "quality",
            color_landmarks_by_time=colouring == "time",
            color_by_landmark_type=colouring == "type",
            color_landmarks_by_first_observer_frame=colouring == "camera",
            color_by_mission=colouring == "mission",
        )


@dataclasses.dataclass(frozen=True)
class PlaybackOptions:
    """Playback of missions."""

    flag_prefix: ClassVar[str] = "vis_seq_"

    landmark_fadeout: bool = option(True, help="Landmarks just observed glow and fade.")
    synchronize_missions_on_distance: bool = option(
        True, help="Play missions by the distance travelled instead of by time."
    )
    synchronize_missions_on_distance_percent: bool = option(
        True, help="Let all missions begin and end together."
    )
    vertex_frequency: float = option(10.0, help="Steps shown per second.", unit="Hz")
    steps: int = option(200, help="Steps from the beginning to the end.")

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not 2 <= self.steps <= 2000:
            raise ValueError(f"--vis_seq_steps={self.steps}: must be 2 to 2000")
        if not 0.0 < self.vertex_frequency <= 60.0:
            raise ValueError(
                f"--vis_seq_vertex_frequency={self.vertex_frequency:g}: must be above 0, at most 60"
            )


@dataclasses.dataclass(frozen=True)
class PointCloudOptions:
    """Selection of dense clouds."""

    flag_prefix: ClassVar[str] = "vis_pointcloud_"

    visualize_every_nth: int = option(1, help="Show every n-th cloud or depth map.")
    color_random: bool = option(False, help="Give every cloud a different colour.")
    reproject_depth_maps_with_undistorted_camera: bool = option(
        False, help="The depth maps are of undistorted images."
    )
    export_accumulated_pc_to_ply_path: str = option(
        "", help="Write all points that are shown to this PLY file, in G."
    )

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.visualize_every_nth < 1:
            raise ValueError(
                f"--vis_pointcloud_visualize_every_nth={self.visualize_every_nth}: must be at least 1"
            )
