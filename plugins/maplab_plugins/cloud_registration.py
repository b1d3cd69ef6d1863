"""Loop closures between point clouds; maplab's lidar loop closure plugin."""

from pathlib import Path

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions, CloudClosureReport
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, command


@command(
    "register_point_clouds",
    "lc_lidar",
    example="register_point_clouds --lidar_lc_max_distance_m=8",
    see_also=("import_point_clouds", "lc_report", "remove_loopclosure", "relax"),
)
def register_point_clouds(
    context: CommandContext,
    *,
    missions: MissionChoice = ALL_MISSIONS,
    options: CloudClosureOptions = CloudClosureOptions(),
) -> CloudClosureReport:
    """Register clouds of sensors with one another and add the relative poses as loop closure edges.

    Clouds that the map has near one another are registered by generalized ICP from the map's present
    poses. Pairs that overlap too little, do not fit, or do not fix the position are refused, as are
    those that gravity, odometry or neighbouring closures contradict. All pairs are recorded (lc_report).
    """
    from maplab_py.algorithms.cloud_registration.workflow import close_cloud_loops

    return context.apply(
        close_cloud_loops,
        context.map_folder or Path(),
        options,
        missions=missions.rows(context.vi_map),
    )
