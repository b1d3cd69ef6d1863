"""Commands that measure the accuracy of a map."""

from __future__ import annotations

import dataclasses
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.algorithms.evaluation import reports
from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.map_update.options import ChangeReport
from maplab_py.console.session.session import MEASURED
from maplab_py.plugin import (
    ALL_MISSIONS,
    CommandContext,
    MissionChoice,
    UserError,
    check_writable,
    command,
)

if TYPE_CHECKING:
    from maplab_py.algorithms.dense.grid import Mesh
    from maplab_py.vimap import VIMap

_CHANGED = "appeared", "vanished"


@command(
    "evaluate_trajectory",
    example="evaluate_trajectory --ground_truth=V1_01_easy.csv --alignment=se3",
    see_also=("export_trajectory_to_csv",),
    completes={"baseline": "snapshot"},
    reads=("ground_truth",),
)
def evaluate_trajectory(
    context: CommandContext,
    ground_truth: Path,
    *,
    options: TrajectoryEvaluationOptions = TrajectoryEvaluationOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
    baseline: str = "",
) -> reports.TrajectoryEvaluationReport:
    """Compare the vertices with a ground-truth trajectory: APE, Sim(3) APE and scale, RPE.

    The RMSE of the last evaluation of this map in the session, against the same ground truth with
    the same options, is subtracted.

    Args:
        ground_truth: TUM, EuRoC or CSV file with stamped poses or positions, or the truth.npz of `simulate`.
        baseline: Snapshot of the map to subtract the errors of; empty = the last evaluation.
    """
    from maplab_py.algorithms.evaluation import trajectory_evaluation
    from maplab_py.interop.trajectories import read_trajectory

    reference = context.snapshot(baseline) if baseline else None
    if ground_truth.suffix == ".npz":
        from maplab_py.simulation.truth import Truth

        truth = Truth.load(ground_truth).trajectory(str(ground_truth))
    else:
        truth = read_trajectory(ground_truth, options.time_unit, needs_orientation=False)
        if truth.note:
            context.terminal.note(truth.note)

    def errors_of(vi_map: VIMap) -> reports.TrajectoryEvaluationReport:
        missions = chosen.rows(vi_map)
        return trajectory_evaluation.evaluate_trajectory(
            vi_map, truth, options, missions=missions, progress=context.progress
        )

    report = errors_of(context.vi_map)
    key = ("evaluate_trajectory", context.map_key, str(ground_truth), options, chosen)
    before = context.session.results.get(key)
    context.session.results[key] = report
    accuracy = f"RMSE {report.ape_m.rmse:.4f} m of {report.matched} vertices against {ground_truth}"
    if chosen == ALL_MISSIONS:
        value = (weakref.ref(context.vi_map), f"{accuracy} ({report.alignment})")
        context.session.results[MEASURED, context.map_key] = value
    if reference is not None:
        errors = errors_of(reference).as_baseline(f"snapshot '{baseline}'")
    elif isinstance(before, reports.TrajectoryEvaluationReport):
        errors = before.as_baseline("the last evaluation")
    else:
        return report
    return dataclasses.replace(report, baseline=errors)


@command(
    "compare_maps",
    example="compare_maps before_optvi",
    see_also=("import_colmap", "evaluate_trajectory"),
    writes_files=True,
)
def compare_maps(
    context: CommandContext,
    other_map: str,
    *,
    changes: bool = False,
    change_meshes: Path | None = None,
    overwrite: bool = False,
) -> reports.MapComparisonReport | ChangeReport:
    """Show how the selected map and another one differ; rows are matched by their ids.

    Poses and landmarks are compared in G. An observation is a keypoint with its landmark.

    Args:
        other_map: Key of a map in memory, or folder of a map.
        changes: Place the other map in the selected one as a later session, and list the regions that
            vanished, appeared or moved.
        change_meshes: Folder that gets appeared.ply and vanished.ply, the surfaces where space was free or
            is free now (with --changes; both maps need `tsdf` and `esdf`).
    """
    other = map_of_key_or_folder(context, other_map)
    files = [change_meshes / f"{kind}.ply" for kind in _CHANGED] if change_meshes else []
    check_writable(*files, overwrite=overwrite)
    if files and not changes:
        raise UserError("--change_meshes wants --changes")
    if changes:
        from maplab_py.algorithms.map_update.update import changes_since
        from maplab_py.interop.mesh_files import write_mesh

        whole, report = changes_since(context.vi_map, other, progress=context.progress)
        meshes = changed_meshes(context, whole, other, other_map) if files else ()
        if files and not meshes:
            raise UserError(
                "--change_meshes wants grids and distance fields of both maps: tsdf and esdf make them"
            )
        for file, mesh in zip(files, meshes, strict=True):
            write_mesh(mesh.p, mesh.faces, file, overwrite=overwrite)
        return report
    from maplab_py.algorithms.evaluation import map_comparison

    return map_comparison.compare_maps(context.vi_map, other)


def changed_meshes(
    context: CommandContext, whole: VIMap, session: VIMap, name: str
) -> tuple[Mesh, ...]:
    """Return the surfaces that appeared and vanished; none where a map has no voxels.

    Args:
        context: The earlier map is selected.
        whole: Both maps as one.
        session: The later one.
        name: Its key or folder.
    """
    from maplab_py.algorithms.dense.changes import changed_surfaces, has_voxels
    from maplab_py.algorithms.map_update.update import at_places_of

    vi_map = context.vi_map
    if not (has_voxels(vi_map) and has_voxels(session)):
        return ()
    folder = context.maps.get(name).folder if name in context.maps else Path(name)
    later = at_places_of(whole, session), folder or Path()
    return changed_surfaces((vi_map, context.map_folder or Path()), later)


def map_of_key_or_folder(context: CommandContext, name: str) -> VIMap:
    """Return another map: of a key in memory, or of a folder.

    Raises:
        UserError: There is none.
    """
    from maplab_py.storage.native import is_map_folder, load_map
    from maplab_py.vimap.merge import at_folder

    if name in context.maps:
        entry = context.maps.get(name)
        return at_folder(entry.vi_map, entry.folder)
    if is_map_folder(Path(name)):
        return at_folder(load_map(Path(name), progress=context.progress)[0], Path(name))
    known = ", ".join(context.maps.keys)
    raise UserError(
        f"'{name}' is neither a map in memory ({known}) nor the folder of a map: name one of them"
    )


@command(
    "evaluate_localization",
    example="evaluate_localization --localization_csv=vil.csv --ground_truth=V1_01_easy.csv",
    needs_map=False,
    see_also=("rovioli", "localize", "evaluate_trajectory"),
    reads=("ground_truth",),
)
def evaluate_localization(
    context: CommandContext,
    *,
    localization_csv: str = "",
    ground_truth: Path,
    map_folder: Path | None = None,
    map_ground_truth: Path | None = None,
) -> reports.LocalizationEvaluationReport:
    """Compare poses in a map with ground truth, without aligning them.

    Poses are taken to be in the frame of the ground truth. When --map_folder is given, that map is
    aligned with the ground truth first, by its own vertices.

    Args:
        localization_csv: Files of rovioli --export_localized_poses_to_csv, or other trajectories,
            separated by commas.
        ground_truth: TUM, EuRoC or CSV file with stamped poses of the recording.
        map_folder: The map in which the recording was localised.
        map_ground_truth: Ground truth of the map's recordings, in the same frame; empty =
            --ground_truth.
    """
    from maplab_py.algorithms.evaluation import localization_evaluation as evaluation
    from maplab_py.geometry import se3
    from maplab_py.interop.trajectories import read_trajectory
    from maplab_py.storage.native import load_map

    names = [name.strip() for name in localization_csv.split(",") if name.strip()]
    if not names:
        raise UserError("no poses: give --localization_csv=FILE, the file of rovioli")
    truth = read_trajectory(ground_truth, needs_orientation=False)
    T_R_G, alignment = se3.identity(), "none: the map has the frame of the ground truth"
    if map_folder is not None:
        of_map = (
            truth
            if map_ground_truth is None
            else read_trajectory(map_ground_truth, needs_orientation=False)
        )
        vi_map, _ = load_map(map_folder, progress=context.progress)
        T_R_G, alignment = evaluation.alignment_of_map(vi_map, of_map), "vertices of the map"
    files = tuple(
        evaluation.localization_errors(evaluation.read_localized(Path(name)), truth, T_R_G)
        for name in names
    )
    return reports.LocalizationEvaluationReport(str(ground_truth), alignment, files)
