"""Commands that look at recordings before a map is made of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.interop.recordings.options import SourceOptions, StreamOptions
from maplab_py.plugin import CommandContext, command

if TYPE_CHECKING:
    from maplab_py.algorithms.recording_check.findings import RecordingCheck
    from maplab_py.interop.recordings.summary import RecordingReport


@command(
    "recording_info",
    example="recording_info MH_01_easy --check_images",
    see_also=("simulate",),
    needs_map=False,
    reads=("recording",),
)
def recording_info(
    context: CommandContext,
    recording: Path,
    *,
    source: SourceOptions = SourceOptions(),
    stream: StreamOptions = StreamOptions(),
    check_images: bool = False,
) -> RecordingReport:
    """Show what is in a recording: rates, durations, gaps, and what would be left out.

    Args:
        recording: EuRoC or TUM-VI folder, ROS 1 bag, or file or folder of a ROS 2 bag.
        check_images: Check size and completeness of all images, and list those whose files are missing.
    """
    from maplab_py.interop.recordings import reader_choice, summary

    if check_images:  # which lists all images that are missing
        reading = dataclasses.replace(source.reading, skip_missing_images=True)
        source = dataclasses.replace(source, reading=reading)
    return summary.summarise(
        reader_choice.open_recording(recording, source),
        stream,
        check_images=check_images,
        progress=context.progress,
    )


@command(
    "check_recording",
    example="check_recording MH_01_easy",
    see_also=("recording_info", "rovioli", "import_calibration"),
    needs_map=False,
    reads=("recording",),
    writes_files=True,
)
def check_recording(
    context: CommandContext,
    recording: Path,
    *,
    source: SourceOptions = SourceOptions(),
    stream: StreamOptions = StreamOptions(),
    apply: Path | None = None,
    overwrite: bool = False,
) -> RecordingCheck:
    """Find what is wrong with a recording or its calibration before a map is made of it.

    Units, axes, signs, clocks, extrinsics, scale and noise of the IMU, light, sharpness and texture of the
    images, and the geometry of the cameras are compared with each other. Causes come before effects in
    the table: mend the first, and check again. The status is 1 if no map can be made of the recording.

    Args:
        recording: EuRoC or TUM-VI folder, ROS 1 bag, or file or folder of a ROS 2 bag.
        apply: Write here, as sensors.yaml, the calibration with what could be determined.
    """
    from maplab_py.algorithms.recording_check import correction, doctor
    from maplab_py.interop.recordings.reader_choice import open_recording
    from maplab_py.output_files import check_writable, write_text
    from maplab_py.sensors.sensors_yaml import write_sensors

    check_writable(apply, overwrite=overwrite)
    opened = open_recording(recording, source)
    diagnosis = doctor.diagnose(opened, stream, progress=context.progress)
    checked = doctor.report(diagnosis, opened)
    if apply is None:
        return checked
    device, changes = correction.correct(diagnosis)
    write_text(apply, [write_sensors(device.sensors)], overwrite=overwrite)
    return dataclasses.replace(checked, sensors_file=apply, notes=(*checked.notes, *changes))
