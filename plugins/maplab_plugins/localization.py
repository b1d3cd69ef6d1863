"""Localisation of images in a map, full or summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.localization.report import LocalizationReport
from maplab_py.plugin import CommandContext, UserError, command

if TYPE_CHECKING:
    from maplab_py.algorithms.localization.database import LocalizationMap
    from maplab_py.algorithms.localization.localization import Localizations, Reference
    from maplab_py.vimap import VIMap

_OPTIONS = LocalizationOptions()


@command(
    "localize",
    example="localize --localization_map=office_summary --localization_csv=poses.csv",
    see_also=("generate_summary_map_and_save_to_disk", "landmark_sparsify"),
    writes_files=True,
)
def localize(
    context: CommandContext,
    *,
    localization_map: str = "",
    options: LocalizationOptions = _OPTIONS,
    map_mission: str = "",
    map_mission_list: str = "",
    sequence_length: int = 1,
    success_error_m: float = 0.5,
    ground_truth: Path | None = None,
    truth: Path | None = None,
    localization_csv: Path | None = None,
    localization_json: Path | None = None,
    overwrite: bool = False,
) -> LocalizationReport:
    """Localise the images of the selected map in another map, one by one; no map is changed.

    Errors are against --ground_truth or --truth, else against the poses that the selected map has.

    Args:
        localization_map: Where to localise: key of a map in memory, folder of a map, or a summary
            map; empty = the other missions of the selected map.
        map_mission: Mission id or unambiguous prefix of the queries; empty = all missions.
        map_mission_list: Several missions of queries, separated by commas.
        sequence_length: Vertices whose images make up one query, placed by their relative poses.
        success_error_m: Position error in metres below which an answer counts as success.
        ground_truth: TUM, EuRoC or CSV file with stamped poses of the queries.
        truth: The file truth.npz of `simulate`.
        localization_csv: File that gets one line per query.
        localization_json: File that gets the report.
        overwrite: Replace files that exist.
    """
    import json

    from maplab_py.algorithms.localization.localization import describe, localize_missions
    from maplab_py.output_files import check_writable, write_text

    if sequence_length < 1:
        raise UserError(f"--sequence_length={sequence_length}: at least 1")
    if ground_truth is not None and truth is not None:
        raise UserError("give --ground_truth or --truth, not both")
    for path in (localization_csv, localization_json):
        if path is not None:
            check_writable(path, overwrite=overwrite)
    query = context.vi_map
    missions = context.mission_rows(map_mission, map_mission_list)
    database, searched = _database(context, localization_map, missions)
    found = localize_missions(
        database,
        query,
        options,
        missions=missions,
        sequence_length=sequence_length,
        progress=context.progress,
    )
    reference, T_R_G = _reference(query, found, database, searched, ground_truth, truth)
    report = describe(
        database, found, reference=reference, T_R_G=T_R_G, success_error_m=success_error_m
    )
    if localization_csv is not None:
        lines = _lines(query, found, reference, T_R_G)
        write_text(localization_csv, lines, overwrite=overwrite)
    if localization_json is not None:
        text = json.dumps(report.as_json(), indent=2) + "\n"
        write_text(localization_json, [text], overwrite=overwrite)
    return report


def _database(
    context: CommandContext, name: str, queries: NDArray[np.int64] | None
) -> tuple[LocalizationMap, VIMap | None]:
    """Return what to search in, and the full map if it is one."""
    from maplab_py.algorithms.localization.database import database_of_map, database_of_summary
    from maplab_py.storage.native import is_map_folder, load_map
    from maplab_py.storage.summary_map import read_summary_map, summary_map_file

    if not name:
        own = context.vi_map
        others = np.setdiff1d(np.arange(len(own.missions)), [] if queries is None else queries)
        if queries is None or len(others) == 0:
            raise UserError(
                "say where to localise, --localization_map=..., or which of the map's missions are "
                "the queries, --map_mission=..."
            )
        return database_of_map(own, missions=others), own
    if name in context.maps:
        vi_map = context.maps.get(name).vi_map
        return database_of_map(vi_map), vi_map
    path = Path(name)
    if is_map_folder(path):
        vi_map, _ = load_map(path, progress=context.progress)
        return database_of_map(vi_map), vi_map
    if summary_map_file(path) is not None:
        return database_of_summary(read_summary_map(path)), None
    raise UserError(
        f"--localization_map={name} is neither a map in memory nor a map folder nor a summary map"
    )


def _reference(
    query: VIMap,
    found: Localizations,
    database: LocalizationMap,
    searched: VIMap | None,
    ground_truth: Path | None,
    truth: Path | None,
) -> tuple[Reference, NDArray[np.float64] | None]:
    from maplab_py.algorithms.localization import reference
    from maplab_py.interop.trajectories import read_trajectory

    if truth is not None:
        return _simulated(query, found, database, truth)
    if ground_truth is None:
        return reference.own_trajectory(query, found)
    recorded = read_trajectory(ground_truth)
    return reference.ground_truth(
        str(ground_truth), recorded.times_ns, recorded.T_R_B, query, found, searched
    )


def _simulated(
    query: VIMap, found: Localizations, database: LocalizationMap, path: Path
) -> tuple[Reference, NDArray[np.float64] | None]:
    """Look poses of queries and of the map's observers up in the truth, by id."""
    from maplab_py.algorithms.localization.localization import Reference
    from maplab_py.geometry.alignment import umeyama
    from maplab_py.simulation.truth import Truth
    from maplab_py.vimap.ids import IdIndex

    truth = Truth.load(path)
    index = IdIndex(truth.vertex_id)
    row = index.rows(query.vertices.id[found.vertex])
    if not (row >= 0).any():
        raise UserError(f"{path} is of another data set: it knows none of the queries")
    reference = Reference(str(path), truth.T_G_I[row], row >= 0)
    if database.observer_id is None:
        raise UserError("the summary map has no ids: its place in the truth is not known")
    observer = index.rows(database.observer_id)
    known = observer >= 0
    if known.sum() < 3:
        raise UserError(f"{path} is of another data set: it knows none of the map's vertices")
    T_R_G, _ = umeyama(truth.T_G_I[observer[known], 4:], database.p_G_observer[known])
    return reference, T_R_G


def _lines(
    query: VIMap,
    found: Localizations,
    reference: Reference,
    T_R_G: NDArray[np.float64] | None,
) -> list[str]:
    """Return the lines of the CSV file, one per query."""
    from maplab_py.algorithms.localization.localization import pose_errors
    from maplab_py.vimap.ids import to_hex_list

    nan = np.full(len(found.vertex), np.nan)
    position, orientation = (nan, nan) if T_R_G is None else pose_errors(found, reference, T_R_G)
    lines = [
        "vertex,timestamp_ns,outcome,keypoints,matches,inliers,"
        "q_x,q_y,q_z,q_w,p_x,p_y,p_z,position_error_m,orientation_error_deg,matching_ms,ransac_ms\n"
    ]
    names = to_hex_list(query.vertices.id[found.vertex])
    times = query.vertices.timestamp_ns[found.vertex].tolist()
    for row, answer in enumerate(found.answers):
        pose = (
            ",".join(f"{value:.9g}" for value in answer.T_G_I)
            if found.is_localized[row]
            else ",,,,,,"
        )
        errors = f"{position[row]:.6g},{orientation[row]:.6g}" if position[row] >= 0.0 else ","
        spent = f"{1e3 * answer.matching_s:.3f},{1e3 * answer.ransac_s:.3f}"
        counts = f"{answer.keypoints},{answer.matches},{answer.inliers}"
        lines.append(
            f"{names[row]},{times[row]},{answer.outcome.value},{counts},{pose},{errors},{spent}\n"
        )
    return lines
