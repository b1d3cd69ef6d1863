"""Summary maps: what localisation needs of a map, in one small file."""

from __future__ import annotations

from pathlib import Path

from maplab_py.algorithms.summary.options import (
    SummaryMapContent,
    SummaryMapOptions,
    SummaryMapReport,
)
from maplab_py.plugin import CommandContext, UserError, check_writable, command, write_bytes

_SUMMARY = SummaryMapOptions()


@command(
    "generate_summary_map_and_save_to_disk",
    "summary_map",
    example="summary_map --summary_map_save_path=office_summary",
    see_also=("create_localization_summary_map", "landmark_sparsify", "localize"),
    writes_files=True,
)
def generate_summary_map_and_save_to_disk(
    context: CommandContext,
    *,
    summary_map_save_path: Path | None = None,
    options: SummaryMapOptions = _SUMMARY,
    overwrite: bool = False,
) -> SummaryMapReport:
    """Write the good landmarks of the selected map and their descriptors to a summary map.

    Args:
        summary_map_save_path: Folder that gets the file localization_summary_map.
        overwrite: Replace the file if it exists.
    """
    from maplab_py.algorithms.summary.summary import make_summary_map
    from maplab_py.storage.summary_map import FILE_NAME, summary_map_bytes

    if summary_map_save_path is None:
        raise UserError("no place to write to: give --summary_map_save_path=FOLDER")
    file = summary_map_save_path / FILE_NAME
    check_writable(file, overwrite=overwrite)
    summary = make_summary_map(context.vi_map, options, progress=context.progress)
    data = summary_map_bytes(summary)
    write_bytes(file, [data], overwrite=overwrite)
    return SummaryMapReport(
        landmarks=len(summary.p_G),
        observations=len(summary.descriptors),
        observers=len(summary.p_G_observer),
        descriptor_dimensions=summary.descriptors.shape[1],
        megabytes=len(data) * 1e-6,
        file=file,
    )


@command(
    "print_summary_map",
    example="print_summary_map office_summary",
    needs_map=False,
    see_also=("generate_summary_map_and_save_to_disk",),
)
def print_summary_map(context: CommandContext, summary_map: Path) -> SummaryMapContent:  # noqa: ARG001
    """Check a summary map and say what is in it.

    Args:
        summary_map: The file, or the folder that holds it.
    """
    import numpy as np

    from maplab_py.storage.summary_map import read_summary_map, summary_map_file

    summary = read_summary_map(summary_map)
    file = summary_map_file(summary_map) or summary_map
    sigma = None
    if summary.landmark_covariance is not None and len(summary.p_G):
        variance = np.trace(summary.landmark_covariance, axis1=1, axis2=2)
        sigma = float(np.sqrt(np.median(variance)))
    extent = np.ptp(summary.p_G_observer, axis=0) if len(summary.p_G_observer) else np.zeros(3)
    return SummaryMapContent(
        landmarks=len(summary.p_G),
        observations=len(summary.descriptors),
        observers=len(summary.p_G_observer),
        descriptor_dimensions=summary.descriptors.shape[1],
        has_ids=summary.landmark_id is not None,
        has_projection=summary.projection is not None,
        cameras=_camera_count(summary.sensors),
        median_position_sigma_m=sigma,
        extent_m=(float(extent[0]), float(extent[1]), float(extent[2])),
        megabytes=file.stat().st_size * 1e-6,
    )


def _camera_count(sensors: object) -> int:
    from maplab_py.sensors import CameraRig, SensorSet

    if not isinstance(sensors, SensorSet):
        return 0
    rigs = [s for s in sensors.sensors.values() if isinstance(s, CameraRig)]
    return sum(len(rig.cameras) for rig in rigs)
