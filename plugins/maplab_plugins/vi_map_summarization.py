"""Summary maps: the content of a map that localisation needs, in one small file."""

from pathlib import Path

from maplab_py.algorithms.loop_closure.options import FeatureTypeOptions
from maplab_py.algorithms.summary import options as summary_options
from maplab_py.input_files import SizeOptions
from maplab_py.plugin import CommandContext, check_writable, command, write_bytes


@command(
    "generate_summary_map_and_save_to_disk",
    "summary_map",
    example="summary_map --summary_map_save_path=office_summary",
    see_also=("create_localization_summary_map", "landmark_sparsify", "localize"),
    writes_files=True,
)
def generate_summary_map_and_save_to_disk(
    context: CommandContext,
    summary_map_save_path: Path,
    *,
    options: summary_options.SummaryMapOptions = summary_options.SummaryMapOptions(),
    features: FeatureTypeOptions = FeatureTypeOptions(),
    overwrite: bool = False,
) -> summary_options.SummaryMapReport:
    """Write the good landmarks of the selected map and their descriptors to a summary map.

    Descriptors of one feature type are projected; observations with others are left out.

    Args:
        summary_map_save_path: Folder that gets the file localization_summary_map.
    """
    from maplab_py.algorithms.summary.summary import make_summary_map
    from maplab_py.storage.summary_map import FILE_NAME, summary_map_bytes

    file = summary_map_save_path / FILE_NAME
    check_writable(file, overwrite=overwrite)
    summary = make_summary_map(
        context.vi_map,
        options,
        feature_type=features.type_number,
        sizes=features.sizes,
        progress=context.progress,
    )
    data = summary_map_bytes(summary)
    write_bytes(file, [data], overwrite=overwrite)
    return summary_options.SummaryMapReport(
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
    reads=("summary_map",),
)
def print_summary_map(
    _: CommandContext, summary_map: Path, *, size: SizeOptions = SizeOptions()
) -> summary_options.SummaryMapContent:
    """Check a summary map and show its content.

    Args:
        summary_map: The file, or the folder that holds it.
    """
    from maplab_py.algorithms.summary.summary import describe
    from maplab_py.storage.summary_map import read_summary_map, summary_map_file

    summary = read_summary_map(summary_map, max_size_megabytes=size.proto_max_size_megabytes)
    return describe(summary, summary_map_file(summary_map) or summary_map)
