"""Commands that draw a map into a file: PNG, SVG or PDF."""

from pathlib import Path

from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.plugin import CommandContext, Report, command


class Plot(Report):
    """A figure that was written."""

    file: Path
    what: str


@command(
    "plot_trajectory",
    example="plot_trajectory --plot_file=top.png --overwrite",
    see_also=("plot_errors", "plot_coobservability"),
    writes_files=True,
)
def plot_trajectory(
    context: CommandContext,
    *,
    plot_file: Path = Path("trajectory.png"),
    plot_landmarks: bool = True,
    ground_truth: Path | None = None,
    map_mission_list: str = "",
    overwrite: bool = False,
) -> Plot:
    """Draw the missions from above, with their landmarks.

    Args:
        plot_landmarks: Draw the landmarks too, bad landmarks in another colour.
        ground_truth: Draw this trajectory too (TUM, EuRoC or CSV), aligned with the vertices.
        map_mission_list: Missions to draw, separated by commas; empty = all.
    """
    from maplab_py.plotting import figure, maps

    figure.check_plot_file(plot_file, overwrite=overwrite)
    missions = context.mission_rows("", map_mission_list)
    truth = None
    if ground_truth is not None:
        from maplab_py.interop.trajectories import read_trajectory
        from maplab_py.plotting.time_series import truth_in_global_frame

        recorded = read_trajectory(ground_truth, needs_orientation=False)
        truth = truth_in_global_frame(context.vi_map, recorded, missions)
    drawn = maps.trajectories(context.vi_map, missions, landmarks=plot_landmarks, p_G_truth=truth)
    figure.write_figure(drawn, plot_file)
    return Plot(plot_file, "trajectories from above")


@command(
    "plot_errors",
    example="plot_errors --ground_truth=V1_01_easy.csv --plot_file=errors.png",
    see_also=("evaluate_trajectory",),
    writes_files=True,
    reads=("ground_truth",),
)
def plot_errors(
    context: CommandContext,
    *,
    ground_truth: Path,
    options: TrajectoryEvaluationOptions = TrajectoryEvaluationOptions(),
    plot_file: Path = Path("errors.png"),
    map_mission_list: str = "",
    overwrite: bool = False,
) -> Plot:
    """Draw the errors of the vertices over time, as evaluate_trajectory measures them.

    Args:
        ground_truth: TUM, EuRoC or CSV file with stamped poses.
        map_mission_list: Missions to draw, separated by commas; empty = all.
    """
    from maplab_py.interop.trajectories import read_trajectory
    from maplab_py.plotting import figure, time_series

    figure.check_plot_file(plot_file, overwrite=overwrite)
    context.progress.step(0, 2, "compare with ground truth")
    drawn, rmse_m = time_series.errors_over_time(
        context.vi_map,
        read_trajectory(ground_truth, options.time_unit, needs_orientation=False),
        options,
        context.mission_rows("", map_mission_list),
    )
    context.progress.step(1, 2, "draw")
    figure.write_figure(drawn, plot_file)
    return Plot(plot_file, f"errors over time, RMSE {rmse_m:.4f} m")


@command("plot_landmarks", example="plot_landmarks --plot_file=landmarks.png", writes_files=True)
def plot_landmarks(
    context: CommandContext,
    *,
    plot_file: Path = Path("landmarks.png"),
    map_mission_list: str = "",
    overwrite: bool = False,
) -> Plot:
    """Draw observation counts, distances and quality of the landmarks.

    Args:
        map_mission_list: Missions whose landmarks count, separated by commas; empty = all.
    """
    from maplab_py.plotting import figure, maps

    figure.check_plot_file(plot_file, overwrite=overwrite)
    missions = context.mission_rows("", map_mission_list)
    figure.write_figure(maps.landmark_histograms(context.vi_map, missions), plot_file)
    return Plot(plot_file, "landmark histograms")


@command(
    "plot_coobservability",
    example="plot_coobservability --plot_file=shared.png",
    see_also=("mission_coobservability_stats",),
    writes_files=True,
)
def plot_coobservability(
    context: CommandContext,
    *,
    plot_file: Path = Path("coobservability.png"),
    overwrite: bool = False,
) -> Plot:
    """Draw how many landmarks each pair of missions shares."""
    from maplab_py.plotting import figure, maps

    figure.check_plot_file(plot_file, overwrite=overwrite)
    figure.write_figure(maps.coobservability(context.vi_map), plot_file)
    return Plot(plot_file, "co-observability matrix")


@command(
    "plot_vi_states_of_mission",
    example="plot_vi_states_of_mission --map_mission=59f0 --plot_file=states.png",
    see_also=("export_trajectory_to_csv",),
    writes_files=True,
)
def plot_vi_states_of_mission(
    context: CommandContext,
    *,
    map_mission: str = "",
    plot_file: Path = Path("vi_states.png"),
    overwrite: bool = False,
) -> Plot:
    """Draw position, velocity and biases of a mission over time."""
    from maplab_py.plotting import figure, time_series

    figure.check_plot_file(plot_file, overwrite=overwrite)
    row = context.mission_row(map_mission)
    figure.write_figure(time_series.inertial_states(context.vi_map, row), plot_file)
    return Plot(plot_file, "states of a mission")
