"""Whole workflows as one command."""

import dataclasses
from pathlib import Path

from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.summary.options import SummaryMapOptions, WorkflowReport
from maplab_py.plugin import CommandContext, UserError, command


@command(
    "create_localization_summary_map",
    "clsm",
    example="clsm --summary_map_save_path=office_summary --num_landmarks_to_keep=10000",
    see_also=("generate_summary_map_and_save_to_disk", "localize"),
    writes_files=True,
)
def create_localization_summary_map(
    context: CommandContext,
    *,
    keyframing: KeyframingOptions = KeyframingOptions(),
    loop_options: LoopClosureOptions = LoopClosureOptions(),
    sparsification: SparsificationOptions = SparsificationOptions(),
    summary: SummaryMapOptions = SummaryMapOptions(),
    num_landmarks_to_keep: int = 0,
    summary_map_save_path: Path | None = None,
    overwrite: bool = False,
) -> WorkflowReport:
    """Create a localisation map from raw sessions: tracks, keyframes, optimisation, anchors, loops.

    Places are recognised by descriptors of one feature type; keypoints with others are left out.

    Runs itl, rtl, kfh, elq with two observers, optvi, aam when there are several missions, relax,
    lc, optvi and elq, then lsparsify and summary_map if asked to.

    Args:
        num_landmarks_to_keep: Number of landmarks to keep at the end; 0 = all.
        summary_map_save_path: Folder that gets the summary map; empty = write none.
        overwrite: Replace the summary map if it exists.
    """
    from maplab_py.algorithms.summary.summary import make_summary_map
    from maplab_py.algorithms.summary.workflow import WorkflowOptions, make_localization_map
    from maplab_py.storage.summary_map import FILE_NAME, write_summary_map

    if num_landmarks_to_keep < 0:
        raise UserError(f"--num_landmarks_to_keep={num_landmarks_to_keep} is negative")
    folder = summary_map_save_path
    if folder is not None and (folder / FILE_NAME).exists() and not overwrite:
        raise UserError(f"{folder / FILE_NAME} exists: give --overwrite to replace it")
    options = WorkflowOptions(keyframing, loop_options, sparsification, num_landmarks_to_keep)
    result, report = make_localization_map(context.vi_map, options, progress=context.progress)
    if folder is not None:
        file = write_summary_map(make_summary_map(result, summary), folder, overwrite=overwrite)
        report = dataclasses.replace(report, summary_map=str(file))
    context.commit(result)
    return report
