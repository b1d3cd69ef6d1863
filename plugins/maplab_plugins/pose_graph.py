"""Commands that exchange pose graphs and loop closures with other programs."""

import dataclasses
from pathlib import Path

from maplab_py.algorithms.relaxation.options import RelaxationOptions, RelaxationReport
from maplab_py.plugin import CommandContext, Message, command
from maplab_py.report import counted


@command(
    "relax_external",
    example="relax_external --relax_external_loop_closures_file=closures.yaml",
    see_also=("relax",),
)
def relax_external(
    context: CommandContext,
    relax_external_loop_closures_file: Path,
    *,
    options: RelaxationOptions = RelaxationOptions(),
    map_mission_list: str = "",
) -> RelaxationReport:
    """Relax the trajectories over loop closures from a file and the edges of the map.

    Args:
        relax_external_loop_closures_file: YAML list of loop closures as maplab reads it: times and
            poses of both ends, T_from_to, covariance, switch variable.
        map_mission_list: Missions that may move, separated by commas; empty = all.
    """
    from maplab_py.algorithms.relaxation.relaxation import relax
    from maplab_py.interop.external_closures import read_external_closures

    edges, notes = read_external_closures(context.vi_map, relax_external_loop_closures_file)
    result, report = relax(
        context.vi_map,
        options,
        loop_closures=edges,
        missions=context.mission_rows("", map_mission_list),
        progress=context.progress,
    )
    context.commit(result)
    return dataclasses.replace(report, notes=(*notes, *report.notes))


@command(
    "import_g2o",
    example="import_g2o graph.g2o",
    needs_map=False,
    see_also=("export_g2o",),
    reads=("file",),
)
def import_g2o(context: CommandContext, file: Path, *, map_key: str = "") -> Message:
    """Make a map of a pose graph: odometry along each robot, every other edge a loop closure.

    Args:
        file: Text file in g2o's format, with SE(3) or planar poses and edges, compressed with gzip or
            not. A file of edges alone starts from the poses along the odometry.
        map_key: Name of the map in memory; by default the file's name.
    """
    from maplab_py.algorithms.relaxation.graph_files import map_of_graph
    from maplab_py.interop.g2o import read_g2o

    graph = read_g2o(file)
    vi_map = map_of_graph(graph)
    key = map_key or Path(file.name.removesuffix(".gz")).stem
    repaired = ""
    if graph.num_repaired:
        edges = counted(graph.num_repaired, "edge")
        repaired = (
            f"; {edges} without a positive definite information: raised its smallest eigenvalues"
        )
    if len(graph.fixed):
        repaired += f"; FIX of {counted(len(graph.fixed), 'pose')} is not kept"
    context.maps.add(key, vi_map)
    return Message(
        f"map '{key}': {counted(len(vi_map.missions), 'mission')}, "
        f"{counted(len(vi_map.vertices), 'vertex', 'vertices')}, "
        f"{counted(len(vi_map.transformation_edges), 'odometry edge')}, "
        f"{counted(len(vi_map.loop_closure_edges), 'loop closure edge')}{repaired}"
    )


@command(
    "export_g2o",
    example="export_g2o graph.g2o",
    see_also=("import_g2o", "relax"),
    writes_files=True,
)
def export_g2o(
    context: CommandContext,
    file: Path,
    *,
    options: RelaxationOptions = RelaxationOptions(),
    overwrite: bool = False,
) -> Message:
    """Write the pose graph that relax works on: trajectories with their drift, and loop closures.

    Args:
        file: Text file to write.
    """
    from maplab_py.algorithms.relaxation.graph_files import graph_of_map
    from maplab_py.interop.g2o import write_g2o

    graph = graph_of_map(context.vi_map, options)
    write_g2o(graph, file, overwrite=overwrite)
    return Message(
        f"wrote {counted(len(graph.id), 'pose')} and {counted(len(graph.first), 'edge')} to {file}"
    )
