"""Commands that thin out a map."""

from __future__ import annotations

from pathlib import Path

from maplab_py.algorithms.keyframing.options import KeyframingOptions, KeyframingReport
from maplab_py.algorithms.sparsification.options import SparsificationOptions, SparsificationReport
from maplab_py.plugin import CommandContext, UserError, command

_KEYFRAMING = KeyframingOptions()
_SPARSIFICATION = SparsificationOptions()


@command("keyframe_heuristic", "kfh", example="kfh --kf_every_nth_vertex=5 --dry_run")
def keyframe_heuristic(
    context: CommandContext,
    *,
    options: KeyframingOptions = _KEYFRAMING,
    map_mission: str = "",
    map_mission_list: str = "",
    dry_run: bool = False,
) -> KeyframingReport:
    """Keep keyframes and remove the vertices between them; IMU and odometry edges are joined.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
        dry_run: Only report what would go; the map stays as it is.
    """
    from maplab_py.algorithms.keyframing.heuristic import keyframe

    missions = context.mission_rows(map_mission, map_mission_list)
    result, report = keyframe(
        context.vi_map, options, missions=missions, progress=context.progress, dry_run=dry_run
    )
    if not dry_run:
        context.commit(result)
    return report


@command(
    "landmark_sparsify",
    "lsparsify",
    example="lsparsify --num_landmarks_to_keep=10000",
    see_also=("keyframe_heuristic", "map_size", "localize"),
)
def landmark_sparsify(
    context: CommandContext,
    *,
    num_landmarks_to_keep: int = -1,
    options: SparsificationOptions = _SPARSIFICATION,
    coverage_csv: Path | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
) -> SparsificationReport:
    """Keep the landmarks that localisation needs most and remove all others.

    Args:
        num_landmarks_to_keep: How many good landmarks stay; bad ones go in any case.
        coverage_csv: File that gets the landmarks every keyframe sees before and after.
        overwrite: Replace the file if it exists.
        dry_run: Only report what would go; the map stays as it is.
    """
    from maplab_py.algorithms.sparsification.sparsify import sparsify
    from maplab_py.output_files import check_writable, write_text
    from maplab_py.vimap.ids import to_hex_list

    if num_landmarks_to_keep <= 0:
        raise UserError("say how many landmarks shall stay: --num_landmarks_to_keep=N, N > 0")
    if coverage_csv is not None:
        check_writable(coverage_csv, overwrite=overwrite)
    result, report, coverage = sparsify(
        context.vi_map, num_landmarks_to_keep, options, progress=context.progress
    )
    if coverage_csv is not None:
        names = to_hex_list(context.vi_map.vertices.id[coverage.vertex])
        columns = (coverage.before, coverage.after, coverage.wanted)
        rows = zip(names, *(column.tolist() for column in columns), strict=True)
        lines = [",".join(map(str, row)) + "\n" for row in rows]
        write_text(coverage_csv, ["vertex,before,after,wanted\n", *lines], overwrite=overwrite)
    if not dry_run:
        context.commit(result)
    return report
