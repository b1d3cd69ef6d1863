"""Manipulation of the pose graph: uncertainties, switch variables, disturbed vertices."""

from maplab_py.algorithms.pose_graph_manipulation import edges, layout
from maplab_py.plugin import ALL_MISSIONS, CommandContext, Message, MissionChoice, command
from maplab_py.report import counted


@command(
    "assign_edge_uncertainties",
    "aeu",
    example="aeu --edge_type=loop_closure --translation_std_dev_meters=0.1 "
    "--orientation_std_dev_degrees=1",
)
def assign_edge_uncertainties(
    context: CommandContext,
    *,
    edge_type: edges.EdgeType,
    translation_std_dev_meters: float = -1.0,
    orientation_std_dev_degrees: float = -1.0,
) -> Message:
    """Give all edges of one type the same covariance.

    Args:
        edge_type: loop_closure, odometry, wheel_odometry or transformation.
        translation_std_dev_meters: Standard deviation of the position along each axis in metres.
        orientation_std_dev_degrees: Standard deviation of the orientation about each axis in
            degrees.
    """
    result, count = edges.assign_covariance(
        context.vi_map,
        edge_type,
        position_sigma_m=translation_std_dev_meters,
        orientation_sigma_deg=orientation_std_dev_degrees,
    )
    context.commit(result)
    kind = edge_type.value.replace("_", " ")
    return Message(f"set the covariance of {counted(count, f'{kind} edge')}")


@command(
    "assign_switch_variable_values_for_loop-closure_edges",
    "asvv",
    example="asvv --lc_switch_variable_value=0.5",
    see_also=("assign_switch_variable_uncertainties_for_loop-closure_edges", "relax"),
)
def assign_switch_variable_values(
    context: CommandContext, *, lc_switch_variable_value: float = 1.0
) -> Message:
    """Set the switch variable of all loop closure edges.

    Args:
        lc_switch_variable_value: Value between 0 (the edge has no effect) and 1 (full effect).
    """
    result, count = edges.assign_switch_variables(context.vi_map, value=lc_switch_variable_value)
    context.commit(result)
    return Message(
        f"set the switch variable of {counted(count, 'loop closure edge')} to {lc_switch_variable_value:g}"
    )


@command(
    "assign_switch_variable_uncertainties_for_loop-closure_edges",
    "asvuflce",
    example="asvuflce --lc_switch_variable_variance=1e-2",
    see_also=("assign_switch_variable_values_for_loop-closure_edges", "relax"),
)
def assign_switch_variable_uncertainties(
    context: CommandContext, *, lc_switch_variable_variance: float = 1e-8
) -> Message:
    """Set the variance of the prior on the switch variables of loop closure edges.

    Args:
        lc_switch_variable_variance: Variance of the prior.
    """
    result, count = edges.assign_switch_variables(
        context.vi_map, variance=lc_switch_variable_variance
    )
    context.commit(result)
    return Message(
        f"set the switch variance of {counted(count, 'loop closure edge')} to {lc_switch_variable_variance:g}"
    )


@command("artificially_disturb_vertices")
def artificially_disturb_vertices(
    context: CommandContext,
    *,
    options: layout.DisturbanceOptions = layout.DisturbanceOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> layout.DisturbanceReport:
    """Disturb all vertices by a random walk, to test what corrects it."""
    return context.apply(layout.disturb_vertices, options, missions=chosen.rows(context.vi_map))
