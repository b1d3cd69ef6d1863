"""The command that makes a map of a recording: odometry and map building, frame by frame."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_plugins.map_update import add_evidence
from maplab_py.cancellation import ending_early
from maplab_py.errors import MapError
from maplab_py.frontend.run_options import DataSourceOptions, RunOptions
from maplab_py.interop.live.options import TRANSPORTS, LiveOptions, NetworkOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.plugin import (
    CommandContext,
    EstimationError,
    UserError,
    check_writable,
    command,
    key_of_folder,
)
from maplab_py.report import counted
from maplab_py.server.options import SubmapOutput

if TYPE_CHECKING:
    from maplab_py.frontend.finishing import FinishedRun
    from maplab_py.frontend.mapping import Mapping, Observer
    from maplab_py.frontend.odometry_update import OdometryUpdate
    from maplab_py.frontend.reports import MappingReport
    from maplab_py.interop.recordings.protocol import Recording
    from maplab_py.online_calibration.beside import CalibrationBeside
    from maplab_py.server.submap_sources import SubmapWriter
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.display.viewer import Viewer
    from maplab_py.vimap import VIMap

_DEFAULT_KEY = "rovioli"
_SECONDS_TO_DRAW = 20.0
"""Time that the viewer gets to draw the finished map."""


@command(
    "rovioli",
    example="rovioli walk --save_map_folder=walk_map",
    needs_map=False,
    guards_effects=True,
    reads=(
        "datasource_folder",
        "datasource_rosbag",
        "sensor_calibration_file",
        "imu_calibration_file",
        "vio_localization_map_folder",
    ),
    see_also=(
        "check_recording",
        "recording_info",
        "optimize_visual_inertial",
        "loopclosure_all_missions",
        "visualize",
        "evaluate_localization",
    ),
)
def rovioli(
    context: CommandContext,
    datasource_folder: Path | None = None,
    *,
    data: DataSourceOptions = DataSourceOptions(),
    source: SourceOptions = SourceOptions(),
    run: RunOptions = RunOptions(),
    submaps: SubmapOutput = SubmapOutput(),
    network: NetworkOptions = NetworkOptions(),
    live: LiveOptions = LiveOptions(),
    calibration: OnlineCalibrationOptions = OnlineCalibrationOptions(),
    map_key: str = "",
    rovioli_visualize_map: bool = False,
    keep_viewer: bool = False,
    map_publish_interval_s: float = 2.0,
) -> MappingReport:
    """Make a map from a recording: camera images and IMU samples in, a map with landmarks out.

    The estimator smooths a window of frames with the IMU samples. It starts by itself, at rest or in
    motion, and starts again, with a new mission, if the estimate diverges. With
    --vio_localization_map_folder it tells where it is in that map. The new map stays in memory and is
    saved to --save_map_folder; with --submap_spool it goes to a map server in parts. Ctrl-C ends the
    recording: the map so far is finished, kept, and saved; a second one cancels. Of a running robot
    (ros2, ros1, foxglove) it publishes /maplab/odometry, /maplab/pose_in_map and /tf.

    Args:
        datasource_folder: EuRoC or TUM-VI folder, ROS bag, or map folder.
        map_key: Key of the map in memory; empty = the name of --save_map_folder, or rovioli.
        rovioli_visualize_map: Show the map, its landmarks and the image in the viewer as they grow.
        keep_viewer: Show the map likewise, and wait at the end until Ctrl-C.
        map_publish_interval_s: Time between two pictures in the viewer.
    """
    from maplab_plugins.live import live_run
    from maplab_py.frontend.data_source import open_source
    from maplab_py.frontend.finishing import finish
    from maplab_py.frontend.mapping import Mapping, load_kernels

    _check_output(context, run)
    key = _new_key(context, map_key, folder := run.output.save_map_folder)
    is_shown, is_live = rovioli_visualize_map or keep_viewer, data.type in TRANSPORTS
    # runs of hours: the map is at the server, and what is there need not stay in memory
    writer = _writer(submaps, forgets=is_live and folder is None)
    beside = _calibration_beside(run, calibration)
    pictures = _pictures(context, key, map_publish_interval_s, beside) if is_shown else None
    observers: list[Observer] = [each for each in (pictures, writer, beside) if each is not None]
    recording: Recording
    with contextlib.ExitStack() as stack:
        is_to_end = stack.enter_context(ending_early())
        on_estimate: Callable[[OdometryUpdate, Mapping], None] | None = None
        if is_live:
            _check_live(datasource_folder, data, run)
            load_kernels()
            live_source = stack.enter_context(
                live_run(context, data.type, source, network, live, run.stream)
            )
            recording, status = live_source.recording, live_source.recording.status
            on_estimate = live_source.publish
        else:
            recording, status = open_source(datasource_folder, data, source), str
        if beside is not None:
            stack.callback(beside.close)
            recording, status = beside.recalibrated(recording), beside.with_status(status)
        make = functools.partial(
            Mapping, options=run, observer=_Several(observers), on_estimate=on_estimate, status=status,
            keeps_states=not is_live or run.output.export_estimated_poses_to_csv is not None,
        )  # fmt: skip
        is_repeatable = None if is_live else writer is None
        mapping = _run(context, make, recording, is_to_end, is_repeatable=is_repeatable)
        name, progress = recording.name, context.progress
        if writer is not None:
            writer.finish(mapping)
        if beside is not None:
            beside.finish(mapping, progress, is_to_end)
        finished = finish(mapping, name, map_key=key, progress=progress, is_to_end=is_to_end)
    _tell_end(context, finished, mapping)
    is_at_server = writer is not None and _tell_pushed(context, writer, submaps)
    _keep_map(context, key, finished, _evidence_map(run), is_at_server=is_at_server)
    if pictures is not None:
        pictures.after_run(finished, context if keep_viewer else None)
    return finished.report


def _writer(submaps: SubmapOutput, *, forgets: bool) -> SubmapWriter | None:
    from maplab_py.server.submap_sources import SubmapWriter

    return None if submaps.submap_spool is None else SubmapWriter(submaps, forgets=forgets)


def _new_key(context: CommandContext, map_key: str, folder: Path | None) -> str:
    """Return the key of the new map; raises UserError where there is a map of that key."""
    key = map_key or (key_of_folder(folder) if folder is not None else _DEFAULT_KEY)
    context.maps.check_new_key(key)
    return key


def _evidence_map(run: RunOptions) -> str:
    """Return the folder of the map that gets evidence, empty without one.

    Raises:
        UserError: There is no map to give it to, or none to take it from.
    """
    from maplab_py.storage.native import is_map_folder

    if not run.evidence.gather_evidence:
        return ""
    folder = run.localization.map_folder
    if folder is None or not is_map_folder(folder) or not run.output.run_map_builder:
        raise UserError(
            "--gather_evidence wants the folder of a map (not of a summary map) as "
            "--vio_localization_map_folder, and the new map (--rovioli_run_map_builder)"
        )
    return str(folder)


def _calibration_beside(
    run: RunOptions, options: OnlineCalibrationOptions
) -> CalibrationBeside | None:
    """Return what calibrates beside the odometry, None unless it is wanted.

    Raises:
        UserError: There is no map to take segments from.
    """
    from maplab_py.online_calibration.beside import CalibrationBeside

    if not options.is_on:
        return None
    if not run.output.run_map_builder:
        raise UserError("--self_calibrate needs a map: leave --rovioli_run_map_builder=false out")
    localization = run.localization
    if options.apply == "now" and (
        run.odometry.window_states or (localization.map_folder and localization.mode == "vil")
    ):
        raise UserError(
            "--sc_apply=now cannot be combined with a calibration that the window estimates "
            "(--vio_estimate) or with localisation in it (--vio_localization_mode=vil): use "
            "--sc_apply=next_start, or another mode"
        )
    return CalibrationBeside(options)


def _tell_pushed(context: CommandContext, writer: SubmapWriter, submaps: SubmapOutput) -> bool:
    """Say what has gone to the server; return whether all of the map has."""
    if writer.pushed:
        where = f"{submaps.submap_spool}/incoming/{submaps.robot_name}"
        context.terminal.note(f"pushed {counted(writer.pushed, 'submap')} to {where}")
    return writer.pushed > 0 and writer.is_whole


def _run(
    context: CommandContext,
    make: Callable[[Recording], Mapping],
    recording: Recording,
    is_to_end: Callable[[], bool],
    *,
    is_repeatable: bool | None,
) -> Mapping:
    """Run over a recording; one that is live (None) can be neither checked nor repeated.

    Raises:
        UserError: No map can be made of the recording.
        EstimationError: The odometry has not started.
    """
    from maplab_py.frontend.checked_run import run_checked

    progress = context.progress
    if is_repeatable is not None:
        return run_checked(
            make, recording, progress, is_to_end=is_to_end, is_repeatable=is_repeatable
        )
    mapping = make(recording)
    mapping.run(progress, is_to_end=is_to_end)
    return mapping


def _check_output(context: CommandContext, run: RunOptions) -> None:
    """Refuse a map folder or files of poses that cannot be written; say if a map is saved nowhere.

    Raises:
        UserError: One of them exists already, or its folder does not; or evidence cannot be kept.
    """
    from maplab_py.storage.native import check_parent, check_target

    _evidence_map(run)
    output, folder = run.output, run.output.save_map_folder
    if folder is None and output.run_map_builder and not context.terminal.is_prompt:
        context.terminal.note(
            "the map stays in memory: --save_map_folder=FOLDER, or save, keeps it"
        )
    if folder is not None:
        check_target(folder, overwrite=output.overwrite_existing_map, flag="overwrite_existing_map")
        check_parent(folder)
    poses = output.export_estimated_poses_to_csv, output.export_localized_poses_to_csv
    check_writable(*poses, overwrite=output.overwrite_existing_map)


def _check_live(folder: Path | None, data: DataSourceOptions, run: RunOptions) -> None:
    """Refuse what only recordings have.

    Raises:
        UserError: A flag contradicts the live source.
    """
    for flag, is_given in (
        ("datasource_folder", folder is not None),
        ("datasource_rosbag", data.rosbag is not None),
        ("map_mission", bool(data.map_mission)),
        ("vio_rosbag_start_s", bool(run.stream.start_s)),
        ("vio_rosbag_end_s", bool(run.stream.end_s)),
        ("vio_rosbag_realtime_playback_rate", bool(run.realtime_playback_rate)),
    ):
        if is_given:
            raise UserError(f"--datasource_type={data.type} is live: leave out --{flag}")


class _Several:
    """Several observers of a run."""

    def __init__(self, observers: list[Observer]) -> None:
        self._observers = observers

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Tell all of them."""
        for observer in self._observers:
            observer.after_frame(update, mapping)


class _Pictures:
    """Shows a run in the viewer: path, landmarks, image with keypoints, and the map it is localised in.

    Of a device that calibrates itself it shows the motion that is missing too.
    """

    def __init__(
        self, viewer: Viewer, title: str, interval_s: float, beside: CalibrationBeside | None
    ) -> None:
        """Show at most once in an interval."""
        from maplab_py.frontend.live_map import LiveLandmarks, LiveLocalization

        self._viewer, self._title, self._interval_s = viewer, title, interval_s
        self._beside = beside
        self._landmarks, self._localized = LiveLandmarks(), LiveLocalization()
        self._mission, self._next_s = -1, 0.0

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Take the landmarks of a frame, and show everything when it is time."""
        from maplab_py.frontend.live_map import live_map, picture_of_tracks
        from maplab_py.viewer.layers.paths import LocalizedRun

        if update.mission != self._mission:
            self._mission = update.mission
            self._landmarks.clear()
            self._localized.clear()
        localization, frame = mapping.localization, mapping.localized_frame
        if localization is not None and frame is not None:
            self._localized.add(frame, localization.p_G)
        if update.window is not None and update.window.is_keyframe:
            self._landmarks.update(*mapping.odometry.landmarks())
        now_s = time.perf_counter()
        if now_s < self._next_s or not self._viewer.pages or self._viewer.is_stopped:
            return
        self._next_s = now_s + self._interval_s
        self._viewer.show_image(picture_of_tracks(update))
        if self._beside is not None and (missing := self._beside.evaluation.missing) is not None:
            self._viewer.motion.show(missing.motion, missing.known_share)
        if mapping.builder is not None:
            with contextlib.suppress(EstimationError):  # there are too few vertices yet
                live = self._localized
                vi_map, run = live_map(mapping.builder, self._landmarks, live.T_G_M), None
                if localization is not None and live.T_G_M is not None:
                    run = LocalizedRun(localization.p_G, live.p_G_I, live.rays_G)
                self._viewer.follow(self._subject(vi_map, localized=run))

    def after_run(self, finished: FinishedRun, keep_in: CommandContext | None = None) -> None:
        """Show the finished map, and how to come back to it; wait, for the program may end now.

        A localised run stays as it is drawn, in the frame of the map that it is localised in.

        Args:
            finished: The run.
            keep_in: Keep the viewer in this context until Ctrl-C.
        """
        from maplab_plugins.visualization.output import keep

        vi_map, folder = finished.vi_map, finished.report.map_folder
        is_stopped = self._viewer.is_stopped
        if vi_map is not None and self._localized.T_G_M is None and not is_stopped:
            note = "finished; in memory only: save" if folder is None else f"saved: load {folder}"
            self._viewer.follow(self._subject(vi_map, note=note))
            self._viewer.wait(_SECONDS_TO_DRAW)
        if keep_in is not None and not is_stopped:
            keep(keep_in, self._viewer)

    def _subject(self, vi_map: VIMap, **more: Any) -> Subject:
        """Return the map to show, in the colours that were chosen in the page."""
        from maplab_plugins.visualization.following import in_colours
        from maplab_py.viewer.building import Subject

        shown = self._viewer.wanted
        subject = Subject(vi_map, self._title, **more)
        if shown is None or shown.title != self._title:
            return in_colours(subject)
        return subject.replace(options=shown.options)


def _pictures(
    context: CommandContext, title: str, interval_s: float, beside: CalibrationBeside | None
) -> _Pictures:
    from maplab_plugins.visualization.following import ViewerOptions, ensure_viewer

    viewer = ensure_viewer(context, ViewerOptions())
    context.terminal.note(f"viewer: {viewer.url}")
    return _Pictures(viewer, title, interval_s, beside)


def _keep_map(
    context: CommandContext,
    key: str,
    finished: FinishedRun,
    evidence_map: str,
    *,
    is_at_server: bool,
) -> None:
    """Add the map of a run, if it has one, to those in memory, and its evidence to another map."""
    if finished.vi_map is None:
        return
    context.maps.add(
        key,
        finished.vi_map,
        folder=finished.report.map_folder,
        is_saved=finished.disk_copy is not None or is_at_server,
        disk_copy=finished.disk_copy,
    )
    if evidence_map:
        try:
            add_evidence(context, evidence_map, finished.vi_map)
        except (EstimationError, MapError, UserError) as error:  # the new map stays
            context.terminal.note(f"no evidence for {evidence_map}: {error}")


def _tell_end(context: CommandContext, finished: FinishedRun, mapping: Mapping) -> None:
    """Say what has become of a recording if the user has ended it."""
    if not mapping.is_ended_early:
        return
    report = finished.report
    text = f"ended at {mapping.statistics.elapsed_s:.1f} s of the recording"
    if finished.vi_map is not None:
        text += f": the map of {report.vertices} vertices is in memory as '{report.map_key}'"
    if report.map_folder is not None:
        text += f", and saved to {report.map_folder}"
    context.terminal.note(text)
