"""The end of a run: landmarks, localisation map, files, report."""

import dataclasses
import tempfile
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.recording_check.doctor import check_map
from maplab_py.algorithms.recording_check.findings import cause
from maplab_py.algorithms.scale_check import scale_doubts
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import sparsify
from maplab_py.algorithms.summary.workflow import WorkflowOptions, make_localization_map
from maplab_py.algorithms.vi_optimization import calibration_choice, optimization
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import Cancelled, EstimationError, MaplabError, UserError
from maplab_py.frontend.localization import record
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.reports import LocalizationSummary, MappingReport
from maplab_py.frontend.run_options import OutputOptions
from maplab_py.interop.trajectories import write_euroc
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.storage.mission_names import with_folder_names
from maplab_py.storage.native import DiskCopy, save_map
from maplab_py.vimap import LandmarkQuality, VIMap

_SAME_DELAY_S = 5e-4
"""Delays that differ by less count as known."""


@dataclasses.dataclass(frozen=True, eq=False)
class FinishedRun:
    """Outcome of a run."""

    report: MappingReport
    vi_map: VIMap | None  # None without a map builder, and if there are too few vertices
    disk_copy: DiskCopy | None  # of the map in the folder, None if it was not saved


def finish(
    mapping: Mapping,
    recording_name: str,
    *,
    map_key: str = "",
    progress: Progress = SILENT,
    is_to_end: Callable[[], bool] = lambda: False,
) -> FinishedRun:
    """Make the map of a run, save what is to be saved, and report.

    A run that ended early is saved, too. What fails here is told in the report; the map stays in memory,
    and one that cannot be saved to its folder is saved in that for temporary files.

    Args:
        mapping: A run that has ended.
        recording_name: For the report.
        map_key: Name of the map in memory, for the report.
        is_to_end: Tells whether to end now with what there is: the map is then not optimised.

    Raises:
        Cancelled: The run was cancelled.
    """
    output = mapping.options.output
    problems = [mapping.problem] if mapping.problem else []
    notes = [*mapping.statistics.notes, *_calibration_notes(mapping), *_stream_notes(mapping)]
    notes += [*_tie_notes(mapping), *_localization_notes(mapping)]
    vi_map: VIMap | None = None
    doubts: tuple[str, ...] = ()
    disk_copy: DiskCopy | None = None
    saved_folder: Path | None = None
    try:
        if mapping.builder is not None:
            vi_map, _ = mapping.builder.finish(progress=progress)
            doubts = scale_doubts(vi_map)
            first = cause(check_map(vi_map) if mapping.doubts is None else mapping.doubts)
            notes += [] if first is None else [f"this recording shows: {first.line}"]
            if _has_wrong_calibration(vi_map, mapping, progress, is_to_end):
                vi_map, doubts, words = _adjusted(vi_map, doubts, progress)
                notes += words
            if output.optimize_map_to_localization_map:
                try:
                    vi_map = localization_map(
                        vi_map, output, progress=_UntilEnd(progress, is_to_end)
                    )
                except _EndRequested:
                    notes.append("ended early: the map is not optimised to a localisation map")
        if output.export_estimated_poses_to_csv is not None:
            write_euroc(
                mapping.trajectory(),
                output.export_estimated_poses_to_csv,
                overwrite=output.overwrite_existing_map,
            )
        if output.export_localized_poses_to_csv is not None:
            mapping.localized.write(
                output.export_localized_poses_to_csv, overwrite=output.overwrite_existing_map
            )
        if vi_map is not None and output.save_map_folder is not None:
            saved_folder, disk_copy, problem = _saved(vi_map, output.save_map_folder, output)
            vi_map = with_folder_names(vi_map, saved_folder)  # as when it is loaded
            problems += [problem] if problem else []
    except Cancelled:
        raise
    except MaplabError as error:
        if vi_map is None:
            raise
        problems.append(f"{error} (the map is in memory as '{map_key}': save it)")
    odometry, first_ns = mapping.odometry, mapping.statistics.first_ns
    scale_sigma, since_ns = odometry.scale_knowledge
    since_s = None if since_ns is None else (since_ns - first_ns) * 1e-9
    notes += scale_verdict(scale_sigma, since_s, doubts)
    report = _report(mapping, recording_name, vi_map, notes, "; ".join(problems))
    report = dataclasses.replace(report, map_key=map_key, map_folder=saved_folder)
    return FinishedRun(report, vi_map, disk_copy)


def localization_map(vi_map: VIMap, output: OutputOptions, *, progress: Progress = SILENT) -> VIMap:
    """Return the localisation map of a map, with the share of good landmarks that shall be kept.

    Raises:
        EstimationError: Nothing can be optimised.
    """
    result, _ = make_localization_map(vi_map, WorkflowOptions(), progress=progress)
    share = output.localization_map_keep_landmark_fraction
    if share:
        keep = max(1, round(share * _good(result)))
        result, _, _ = sparsify(result, keep, SparsificationOptions(), progress=progress)
    return result


def _has_wrong_calibration(
    vi_map: VIMap, mapping: Mapping, progress: Progress, is_to_end: Callable[[], bool]
) -> bool:
    """Tell whether the calibration or the stamps were mended, or the residuals of the map contradict them."""
    if is_to_end() or not mapping.options.odometry.apply_calibration:
        return False
    failures = mapping.odometry.watch.failures
    if any(each.is_used or not each.sensor.startswith("camera ") for each in failures):
        return False
    try:
        is_mended = mapping.is_mended or _applied_delay_s(mapping) != 0.0
        return is_mended or optimization.contradicted_calibration(vi_map, progress)
    except EstimationError:  # nothing in the map can be optimised
        return False


def _adjusted(
    vi_map: VIMap, doubts: tuple[str, ...], progress: Progress
) -> tuple[VIMap, tuple[str, ...], list[str]]:
    """Optimise the map of a recording whose calibration is wrong, with the calibration of the cameras free.

    Most vertices have left the window before it knew the calibration.

    Returns:
        Map, doubts of its scale, and a note; as they are if it contradicts the accelerometers then.
    """
    names = [field.name for field in dataclasses.fields(VIOptimizationOptions)]
    free: dict[str, Any] = {name: False for name in names if name.startswith("fix_ncamera_")}
    options = VIOptimizationOptions(**free)
    try:
        result, report = optimization.optimize(vi_map, options, progress=progress)
    except EstimationError as error:
        return vi_map, doubts, [f"not optimised with its calibration free: {error}"]
    left = scale_doubts(result)
    if len(left) > len(doubts):
        return vi_map, doubts, [f"not optimised with its calibration free: {left[0]}"]
    note = (
        "the map was optimised with the calibration of the cameras free, since the recording's was wrong: "
        f"{', '.join(calibration_choice.describe_freed(options, report))}; reprojection error "
        f"{report.median_reprojection_before_px:.2f} px before, {report.median_reprojection_after_px:.2f} px "
        "after (--vio_apply_calibration=false keeps it)"
    )
    return result, left, [note]


class _EndRequested(Cancelled):
    """The user wants the result as it is."""


class _UntilEnd:
    """Progress of work that is left out when the user wants the end."""

    def __init__(self, progress: Progress, is_to_end: Callable[[], bool]) -> None:
        self._progress, self._is_to_end = progress, is_to_end

    def step(self, done: float, total: float, what: str = "") -> None:
        self._progress.step(done, total, what)
        self.check()

    def line(self, text: str) -> None:
        self._progress.line(text)

    def check(self) -> None:
        self._progress.check()
        if self._is_to_end():
            raise _EndRequested("ended")


def _saved(vi_map: VIMap, folder: Path, output: OutputOptions) -> tuple[Path, DiskCopy, str]:
    """Save a map; return where, its copy there, and the problem if it had to be somewhere else.

    A program that only runs this command ends with it, and the map in memory, too. So a map that cannot be
    saved where the user wants it (full disk) is saved in the folder for temporary files.

    Raises:
        UserError: It cannot be saved there, either.
    """
    try:
        saved = save_map(vi_map, folder, overwrite=output.overwrite_existing_map)
        return folder, DiskCopy(folder.resolve(), saved.fingerprint), ""
    except UserError as error:
        rescue = Path(tempfile.gettempdir()) / f"maplab-{uuid.uuid4().hex[:8]}" / folder.name
        try:
            saved = save_map(vi_map, rescue, repair=True)
        except UserError:
            raise error from None
        repaired = f" ({'; '.join(saved.notes)})" if saved.notes else ""
        problem = f"{error}; the map is saved to {rescue} instead{repaired}"
        return rescue, DiskCopy(rescue.resolve(), saved.fingerprint), problem


def _stream_notes(mapping: Mapping) -> list[str]:
    """Return what was left out of the recording, or looks wrong in it."""
    read, notes = mapping.stream.statistics, list(mapping.recording_notes)
    if count := read.dropped_before_imu + mapping.odometry.frames_before_imu:
        notes.append(f"{counted(count, 'frame')} before the first IMU sample left out")
    if (count := mapping.odometry.waiting_frames) and not mapping.is_ended_early:
        notes.append(f"{counted(count, 'frame')} after the last IMU sample left out")
    if any(read.unmatched_images):
        notes.append(
            f"{counted(sum(read.unmatched_images), 'image')} without a partner in the other cameras: "
            "check the trigger, or raise --vio_nframe_sync_tolerance_ns"
        )
    if read.imu_gaps:
        notes.append(
            f"{read.imu_gaps} intervals between IMU samples are longer than "
            f"{mapping.options.stream.imu_gap_s:g} s: check the driver of the IMU"
        )
    if read.saturated_samples:
        notes.append(
            f"{read.saturated_samples} IMU samples are saturated: move more gently, or set a larger "
            "range of the sensor"
        )
    return notes


def _calibration_notes(mapping: Mapping) -> list[str]:
    """Return what of the calibration was doubted, and what was found in its place."""
    odometry, zero_ns = mapping.odometry, mapping.statistics.zero_ns
    notes, delays = list(odometry.notes), odometry.delays
    notes += odometry.watch.notes(zero_ns)
    if any(not each.sensor.startswith("camera") for each in odometry.watch.failures):
        notes.append(
            "where a part of the IMU was left out, the map has samples that follow from the images; after "
            "a failure calibrate again (self_calibrate), with a recording of whole sensors"
        )
    late_s = _applied_delay_s(mapping)
    if delays is not None and late_s:
        notes.append(
            f"the images were taken {1e3 * late_s:+.1f} +- {1e3 * delays.sigma_s:.1f} ms after "
            "their stamps, and are used so: put "
            f"--imu_to_camera_time_offset_ns={_offset_ns(mapping, late_s)}"
            " to have it from the beginning (--vio_estimate=none keeps the stamps)"
        )
    if odometry.calibration_estimate is not None:
        estimate = odometry.calibration_estimate
        words, differs = estimate.words(), estimate.differs
        notes.append(f"calibration by the images and the IMU, changes: {', '.join(words)}")
        if differs:
            of_map = (
                "the map has it (--vio_apply_calibration=false keeps the file's)"
                if mapping.options.odometry.apply_calibration
                else "the map keeps the file's"
            )
            notes.append(f"it differs from the file's by more than three deviations: {of_map}")
    return notes


def _applied_delay_s(mapping: Mapping) -> float:
    """Return the delay that the images got beyond the calibration's, 0 if it is as good as none."""
    delays = mapping.odometry.delays
    if delays is None or not delays.applied_s:
        return 0.0
    late_s = delays.delay_s - delays.known_s
    return late_s if abs(late_s) > _SAME_DELAY_S else 0.0


def _tie_notes(mapping: Mapping) -> list[str]:
    """Return how the missions after restarts are placed."""
    notes = []
    for number, tie in enumerate(mapping.builder.ties() if mapping.builder else ()):
        if tie is not None:
            use = (
                "" if tie.is_known else "; too unsure to look for places there: anchor_all_missions"
            )
            notes.append(f"mission {number + 1} is tied to mission {number} by {tie.words}{use}")
        elif number:
            notes.append(
                f"mission {number + 1} is not tied to mission {number}: lc and anchor_all_missions do so "
                "where they see the same places"
            )
    return notes


def scale_verdict(sigma: float, since_s: float | None, doubts: tuple[str, ...]) -> list[str]:
    """Return one verdict on the scale: the map's accelerations count more than the odometry's account.

    Args:
        sigma: Standard deviation by the odometry, as a share; 0 = it was known at the start.
        since_s: Since when the odometry knows it; None = not yet.
        doubts: What the map's accelerations say against it.
    """
    if doubts:
        return list(doubts)
    if sigma <= 0.0:
        return []
    if since_s is None:
        percent = f"{100 * sigma:.0f} %"
        return [f"the scale is not known to better than {percent}: change speed and direction more"]
    return [f"started before the scale was known: it can be trusted from {since_s:.1f} s on"]


def _offset_ns(mapping: Mapping, delay_s: float) -> int:
    """Return the time offset of the cameras with a delay."""
    return mapping.odometry.device.cameras[0].time_offset_ns + round(delay_s * 1e9)


def _localization_notes(mapping: Mapping) -> list[str]:
    localization = mapping.localization
    if localization is None:
        return []
    notes = list(localization.notes)
    if localization.features not in ("", mapping.options.odometry.tracking.descriptor_type):
        notes.append(f"images were described by {localization.features} for it, as the map is")
    if localization.problem:
        notes.append(f"localisation has ended: {localization.problem}")
    elif not localization.counts.localized_frames:
        notes.append(
            f"never localised in {localization.map_name}: check that it shows the same place, or "
            "lower --localization_min_inlier_count"
        )
    return notes


def _report(
    mapping: Mapping, recording_name: str, vi_map: VIMap | None, notes: list[str], problem: str
) -> MappingReport:
    statistics, output = mapping.statistics, mapping.options.output
    return MappingReport(
        recording=recording_name,
        duration_s=statistics.duration_s,
        frames=statistics.frames,
        estimated_frames=statistics.estimated_frames,
        distance_m=statistics.distance_m,
        real_time_factor=statistics.real_time_factor(),
        starts=tuple(statistics.starts),
        missions=0 if vi_map is None else len(vi_map.missions),
        vertices=0 if vi_map is None else len(vi_map.vertices),
        landmarks=0 if vi_map is None else len(vi_map.landmarks),
        good_landmarks=0 if vi_map is None else _good(vi_map),
        frame_times=statistics.stages(),
        map_key="",
        map_folder=None,
        poses_file=output.export_estimated_poses_to_csv,
        notes=tuple(notes),
        problem=problem,
        localization=_localization(mapping),
    )


def _localization(mapping: Mapping) -> LocalizationSummary | None:
    if mapping.localization is None:
        return None
    csv_file = mapping.options.output.export_localized_poses_to_csv
    zero_ns = mapping.statistics.zero_ns or mapping.statistics.first_ns
    return record.summarised(mapping.localization, zero_ns, csv_file)


def _good(vi_map: VIMap) -> int:
    return int(np.count_nonzero(vi_map.landmarks.quality == LandmarkQuality.GOOD))
