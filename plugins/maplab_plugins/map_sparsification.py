"""Commands that sparsify a map."""

from pathlib import Path

from maplab_py.algorithms.keyframing.options import KeyframingOptions, KeyframingReport
from maplab_py.algorithms.sparsification.options import SparsificationOptions, SparsificationReport
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, UserError, command


@command("keyframe_heuristic", "kfh", example="kfh --kf_every_nth_vertex=5 --dry_run")
def keyframe_heuristic(
    context: CommandContext,
    *,
    options: KeyframingOptions = KeyframingOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> KeyframingReport:
    """Keep keyframes and remove the vertices between them; IMU and odometry edges are joined."""
    from maplab_py.algorithms.keyframing.heuristic import keyframe

    return context.apply(keyframe, options, missions=chosen.rows(context.vi_map))


@command(
    "landmark_sparsify",
    "lsparsify",
    example="lsparsify --num_landmarks_to_keep=10000",
    see_also=("keyframe_heuristic", "map_size", "localize"),
)
def landmark_sparsify(
    context: CommandContext,
    num_landmarks_to_keep: int,
    *,
    options: SparsificationOptions = SparsificationOptions(),
    coverage_csv: Path | None = None,
    overwrite: bool = False,
) -> SparsificationReport:
    """Keep the landmarks that localisation needs most and remove all others.

    Args:
        num_landmarks_to_keep: Number of good landmarks to keep; bad landmarks are always removed.
        coverage_csv: File that gets the landmarks every keyframe sees before and after.
    """
    from maplab_py.algorithms.sparsification.sparsify import sparsify
    from maplab_py.output_files import check_writable, write_text
    from maplab_py.vimap.ids import to_hex_list

    if num_landmarks_to_keep <= 0:
        raise UserError(f"--num_landmarks_to_keep={num_landmarks_to_keep}: wants a number above 0")
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
    context.commit(result)
    return report
