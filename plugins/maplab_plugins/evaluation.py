"""Commands that measure how good a map is."""

from __future__ import annotations

from pathlib import Path

from maplab_py.algorithms.evaluation.options import (
    TrajectoryEvaluationOptions,
    TrajectoryEvaluationReport,
)
from maplab_py.plugin import CommandContext, command


@command(
    "evaluate_trajectory",
    example="evaluate_trajectory --ground_truth=V1_01_easy.csv --alignment=se3",
    see_also=("export_trajectory_to_csv",),
)
def evaluate_trajectory(
    context: CommandContext,
    *,
    ground_truth: Path,
    options: TrajectoryEvaluationOptions = TrajectoryEvaluationOptions(),  # noqa: B008
    map_mission: str = "",
    map_mission_list: str = "",
) -> TrajectoryEvaluationReport:
    """Compare the vertices with a ground-truth trajectory: APE, Sim(3) APE and scale, RPE.

    Args:
        ground_truth: TUM, EuRoC or CSV file with stamped poses, or the truth.npz of `simulate`.
        map_mission: Mission id or unambiguous prefix; empty = all missions together.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.evaluation import trajectory_evaluation
    from maplab_py.interop.trajectories import read_trajectory

    if ground_truth.suffix == ".npz":
        from maplab_py.simulation.truth import Truth

        truth = Truth.load(ground_truth).trajectory(str(ground_truth))
    else:
        truth = read_trajectory(ground_truth)
    return trajectory_evaluation.evaluate_trajectory(
        context.vi_map,
        truth,
        options,
        missions=context.mission_rows(map_mission, map_mission_list),
        progress=context.progress,
    )
