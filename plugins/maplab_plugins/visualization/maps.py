"""Commands that show the selected map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from maplab_plugins.evaluation import changed_meshes, map_of_key_or_folder
from maplab_plugins.visualization.following import ViewerOptions, ViewReport, images_of, show
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, Report, UserError, command
from maplab_py.report import counted
from maplab_py.viewer.options import PlaybackOptions, VisualizationOptions

if TYPE_CHECKING:
    from maplab_py.viewer.building import Arrangement
    from maplab_py.vimap import VIMap


class DifferenceReport(Report):
    """Distances of vertices between two states."""

    compared_with: str
    vertices: int
    not_in_both: int
    mean_m: float
    largest_m: float
    view: ViewReport


@command(
    "visualize",
    "v",
    example="visualize --vis_color_landmarks_by_height",
    see_also=("visualize_sequentially", "save_view", "export_view", "viewer_keep", "viewer_stop"),
    guards_effects=True,
)
def visualize(
    context: CommandContext,
    *,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
    ground_truth: Path | None = None,
    informative_segments: Path | None = None,
) -> ViewReport:
    """Show the selected map in the browser; the page follows the map from then on.

    The page is served on this machine only. From elsewhere forward the port:
    ssh -L 8080:localhost:8080 HOST. The page shows and never changes the map.

    Args:
        ground_truth: True trajectory to lay beside the map's: TUM, EuRoC, or CSV with named columns.
        informative_segments: CSV with the columns mission, start_ns, end_ns, information: pieces of
            missions to colour by their information.
    """
    truth = segments = None
    if ground_truth is not None:
        from maplab_py.interop.trajectories import read_trajectory

        truth = read_trajectory(ground_truth, needs_orientation=False)
    if informative_segments is not None:
        from maplab_py.viewer.layers.references import read_segments

        segments = read_segments(informative_segments, context.vi_map)
    return show(context, display, options, truth=truth, segments=segments)


@command("visualize_sequentially", "vs", see_also=("visualize",), guards_effects=True)
def visualize_sequentially(
    context: CommandContext,
    *,
    chosen: MissionChoice = ALL_MISSIONS,
    options: VisualizationOptions = VisualizationOptions(),
    playback: PlaybackOptions = PlaybackOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Play the missions in the browser: the map grows as it was recorded."""
    vi_map = _only(context.vi_map, chosen.rows(context.vi_map))
    return show(context, display, options, vi_map=vi_map, playback=playback, plays=True)


@command("visualize_landmark_observers", guards_effects=True)
def visualize_landmark_observers(
    context: CommandContext,
    *,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show the rays from every observing camera to the good landmarks."""
    return show(context, display, options, shows_observers=True)


@command("visualize_sensor_extrinsics", guards_effects=True)
def visualize_sensor_extrinsics(
    context: CommandContext, *, display: ViewerOptions = ViewerOptions()
) -> ViewReport:
    """Show how the sensors are mounted: each as axes on its base sensor."""
    return show(context, display, title=f"{context.map_key}: sensors", shows_sensors=True)


@command("visualize_loop_closures", guards_effects=True)
def visualize_loop_closures(
    context: CommandContext,
    *,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show loop closures on the trajectories: edges by switch value, remembered ones by weight.

    A click on a closure shows the line of lc_report: query, target, inliers, correction, verdict.
    """
    from maplab_py.algorithms.loop_closure.closure_record import read_record
    from maplab_py.viewer.layers.closures import ACCEPTED
    from maplab_py.viewer.layers.covariances import LOOP_CLOSURES

    vi_map = context.vi_map
    if not len(vi_map.loop_closure_edges) and not len(read_record(vi_map).closures):
        raise UserError(
            f"map '{context.map_key}' has no loop closures: loopclosure_all_missions finds them",
            remedy="loopclosure_all_missions",
        )
    layers = "trajectories", "vertices", "loop_closures", LOOP_CLOSURES, ACCEPTED
    return show(context, display, options, only_layers=layers)


@command(
    "visualize_difference",
    example="visualize_difference --with_snapshot=before",
    see_also=("snapshot", "undo"),
    guards_effects=True,
)
def visualize_difference(
    context: CommandContext,
    *,
    with_map_key: str = "",
    with_snapshot: str = "",
    side_by_side: bool = False,
    swipe: bool = False,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> DifferenceReport:
    """Show the selected map over or beside another state of it or another map, or with a swipe line.

    Over each other lines show how far vertices have moved. Side by side, and left and right of the line,
    each mission has one colour, one camera looks at both, and the maps need not have anything in common.

    Args:
        with_map_key: Another map in memory; vertices correspond by id.
        with_snapshot: A snapshot of the selected map. With neither the state before the last
            command that changed it.
        side_by_side: Draw the other state or map beside the map instead of over it.
        swipe: Draw it left of a line that the page moves over both.
    """
    from maplab_py.viewer.layers.references import displacements

    if side_by_side and swipe:
        raise UserError("give --side_by_side or --swipe, not both")
    other, name = _other_state(context, with_map_key, with_snapshot)
    here, _, distance = displacements(context.vi_map, other)
    if not len(here) and not (side_by_side or swipe):
        raise UserError(
            f"{name} and map '{context.map_key}' have no vertex in common; "
            "--side_by_side and --swipe show both all the same"
        )
    arrangement: Arrangement = "beside" if side_by_side else "swipe" if swipe else "over"
    view = show(context, display, options, other=other, other_name=name, arrangement=arrangement)
    missing = len(context.vi_map.vertices) + len(other.vertices) - 2 * len(here)
    mean_m, largest_m = (distance.mean(), distance.max()) if len(here) else (np.nan, np.nan)
    return DifferenceReport(name, len(here), missing, float(mean_m), float(largest_m), view)


@command(
    "visualize_changes",
    example="visualize_changes tuesday",
    see_also=("compare_maps", "update_map"),
    guards_effects=True,
)
def visualize_changes(
    context: CommandContext,
    session: str,
    *,
    options: VisualizationOptions = VisualizationOptions(),
    display: ViewerOptions = ViewerOptions(),
) -> ViewReport:
    """Show what `compare_maps --changes` finds as boxes with dates, of dense maps also the surfaces.

    A click on a date shows the images before and after the change side by side.

    Args:
        session: Key of a map in memory, or folder of a map, of a later session.
    """
    from maplab_py.algorithms.map_update.update import changes_since
    from maplab_py.viewer.layers.changes import ChangeImages, mesh_clouds

    other = map_of_key_or_folder(context, session)
    whole, report = changes_since(context.vi_map, other, progress=context.progress)
    folder = context.maps.get(session).folder if session in context.maps else Path(session)
    images = ChangeImages(
        (context.vi_map, images_of(context.vi_map, context.map_folder)),
        (other, images_of(other, folder)),
        report.changes,
    )
    count = counted(len(report.changes), "change")
    dates = (date.replace("T", " ")[:-3] for date in (report.earlier, report.later))
    note = f"{count} from {' to '.join(dates)}; {report.note}".rstrip("; ")
    clouds = mesh_clouds(changed_meshes(context, whole, other, session))
    return show(
        context, display, options, image_of=images, changes=report.changes, note=note, clouds=clouds
    )


def _other_state(context: CommandContext, map_key: str, snapshot: str) -> tuple[VIMap, str]:
    """Return the map to compare with and what to call it."""
    entry = context.maps.selected
    if map_key and snapshot:
        raise UserError("give --with_map_key or --with_snapshot, not both")
    if map_key:
        return context.maps.get(map_key).vi_map, f"map '{map_key}'"
    if snapshot:
        if snapshot not in entry.snapshots:
            known = ", ".join(entry.snapshots) or "none"
            raise UserError(f"map '{entry.key}' has no snapshot '{snapshot}' (there are: {known})")
        return entry.snapshots[snapshot], f"snapshot '{snapshot}'"
    if not entry.past:
        raise UserError(
            f"map '{entry.key}' has not been changed: give --with_map_key or --with_snapshot"
        )
    step = entry.past[-1]
    return step.vi_map, f"before {step.command}"


def _only(vi_map: VIMap, missions: np.ndarray[tuple[int, ...], np.dtype[np.int64]] | None) -> VIMap:
    """Return the map of some missions only."""
    if missions is None:
        return vi_map
    from maplab_py.vimap.selection import keep_rows

    return keep_rows(vi_map, missions=missions)
