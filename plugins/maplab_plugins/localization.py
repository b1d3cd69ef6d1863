"""Localisation of images in a map, full or summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maplab_plugins.map_update import add_evidence, tell_evidence
from maplab_py.algorithms.localization.options import LocalizationOptions, LocalizationReport
from maplab_py.algorithms.loop_closure.options import FeatureTypeOptions
from maplab_py.algorithms.map_update.options import EvidenceOptions
from maplab_py.input_files import SizeOptions
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, UserError, command

if TYPE_CHECKING:
    from maplab_py.algorithms.localization.database import LocalizationMap
    from maplab_py.algorithms.localization.localization import Localizations, Reference
    from maplab_py.console.session.session import Session
    from maplab_py.vimap import VIMap


def map_values(session: Session) -> list[tuple[str, str]]:
    """Return the maps in memory other than the selected one, and the map folders at hand."""
    from maplab_py.storage.native import is_map_folder

    keys = [
        (entry.key, "map in memory")
        for entry in session.maps
        if entry.key != session.maps.selected_key
    ]
    folders = sorted(path for path in Path().iterdir() if path.is_dir() and is_map_folder(path))
    return keys + [(str(path), "map folder") for path in folders]


@command(
    "localize",
    example="localize --localization_map=office_summary --localization_csv=poses.csv",
    see_also=("generate_summary_map_and_save_to_disk", "landmark_sparsify"),
    writes_files=True,
    completes={"localization_map": map_values},
    reads=("localization_map",),
)
def localize(
    context: CommandContext,
    localization_map: str = "",
    *,
    options: LocalizationOptions = LocalizationOptions(),
    features: FeatureTypeOptions = FeatureTypeOptions(),
    evidence: EvidenceOptions = EvidenceOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
    sequence_length: int = 1,
    success_error_m: float = 0.5,
    ground_truth: Path | None = None,
    truth: Path | None = None,
    localization_csv: Path | None = None,
    localization_json: Path | None = None,
    overwrite: bool = False,
    size: SizeOptions = SizeOptions(),
) -> LocalizationReport:
    """Localise the images of the selected map in another map, one by one.

    Only --gather_evidence changes a map.

    Descriptors of one feature type are matched, in a summary map those that it was made from, else
    those of --lc_feature_type; keypoints with others are left out.

    Errors are against --ground_truth or --truth, else against the poses that the selected map has.

    Args:
        localization_map: Where to localise: key of a map in memory, folder of a map, or a summary
            map; empty = the other missions of the selected map.
        sequence_length: Vertices whose images make up one query, placed by their relative poses.
        success_error_m: Position error in metres below which an answer counts as success.
        ground_truth: TUM, EuRoC or CSV file with stamped poses of the queries.
        truth: The file truth.npz of `simulate`.
        localization_csv: File that gets one line per query.
        localization_json: File that gets the report.
    """

    from maplab_py.algorithms.localization.localization import (
        csv_lines,
        describe,
        localize_missions,
    )
    from maplab_py.output_files import check_writable, write_text

    if sequence_length < 1:
        raise UserError(f"--sequence_length={sequence_length}: at least 1")
    if ground_truth is not None and truth is not None:
        raise UserError("give --ground_truth or --truth, not both")
    check_writable(localization_csv, localization_json, overwrite=overwrite)
    query = context.vi_map
    missions = chosen.rows(context.vi_map)
    database, searched = _database(context, localization_map, missions, features, size)
    if evidence.gather_evidence and searched is None:
        raise UserError(f"--gather_evidence wants a map: {localization_map} is a summary map")
    localizations = localize_missions(
        database,
        query,
        options,
        missions=missions,
        sequence_length=sequence_length,
        progress=context.progress,
    )
    if evidence.gather_evidence:
        _add_evidence(context, localization_map, missions)
    reference, T_R_G = _reference(query, localizations, database, searched, ground_truth, truth)
    report = describe(
        database, localizations, reference=reference, T_R_G=T_R_G, success_error_m=success_error_m
    )
    if localization_csv is not None:
        lines = csv_lines(query, localizations, reference, T_R_G)
        write_text(localization_csv, lines, overwrite=overwrite)
    if localization_json is not None:
        text = report.as_json(indent=2) + "\n"
        write_text(localization_json, [text], overwrite=overwrite)
    return report


def _add_evidence(context: CommandContext, name: str, missions: NDArray[np.int64] | None) -> None:
    """Add what the queries saw and missed to the map in which they are localised."""
    from maplab_py.algorithms.map_update.update import gather_all
    from maplab_py.vimap.edits import remove_missions

    if name:
        is_left_out = np.zeros(len(context.vi_map.missions), dtype=np.bool_)
        if missions is not None:
            is_left_out[np.setdiff1d(np.arange(len(is_left_out)), missions)] = True
        add_evidence(context, name, remove_missions(context.vi_map, is_left_out))
        return
    report = context.apply(gather_all, missions=missions)
    tell_evidence(context, report, context.map_key)


def _database(
    context: CommandContext,
    name: str,
    queries: NDArray[np.int64] | None,
    features: FeatureTypeOptions,
    size: SizeOptions,
) -> tuple[LocalizationMap, VIMap | None]:
    """Return what to search in, and the full map if it is one."""
    from maplab_py.algorithms.localization.database import database_of_map, database_of_summary
    from maplab_py.storage.native import is_map_folder, load_map
    from maplab_py.storage.summary_map import read_summary_map, summary_map_file

    kind: dict[str, Any] = {"feature_type": features.type_number, "sizes": features.sizes}
    if not name:
        session_map = context.vi_map
        others = np.setdiff1d(
            np.arange(len(session_map.missions)), [] if queries is None else queries
        )
        if queries is None or len(others) == 0:
            raise UserError(
                "say where to localise, --localization_map=..., or which of the map's missions are "
                "the queries, --map_mission=..."
            )
        return database_of_map(session_map, missions=others, **kind), session_map
    if name in context.maps:
        vi_map = context.maps.get(name).vi_map
        return database_of_map(vi_map, **kind), vi_map
    path, megabytes = Path(name), size.proto_max_size_megabytes
    if is_map_folder(path):
        vi_map, _ = load_map(path, max_size_megabytes=megabytes, progress=context.progress)
        return database_of_map(vi_map, **kind), vi_map
    if summary_map_file(path) is not None:
        return database_of_summary(read_summary_map(path, max_size_megabytes=megabytes)), None
    raise UserError(
        f"--localization_map={name} is neither a map in memory nor a map folder nor a summary map"
    )


def _reference(
    query: VIMap,
    localizations: Localizations,
    database: LocalizationMap,
    searched: VIMap | None,
    ground_truth: Path | None,
    truth: Path | None,
) -> tuple[Reference, NDArray[np.float64] | None]:
    from maplab_py.algorithms.localization import localization
    from maplab_py.interop.trajectories import read_trajectory
    from maplab_py.simulation.truth import true_poses

    if truth is not None:
        return true_poses(query, localizations, database, truth)
    if ground_truth is None:
        return localization.trajectory_of_queries(query, localizations)
    recorded = read_trajectory(ground_truth)
    return localization.ground_truth(
        str(ground_truth), recorded.times_ns, recorded.T_R_B, query, localizations, searched
    )
