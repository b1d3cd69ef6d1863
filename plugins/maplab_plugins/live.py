"""Commands that read and write the topics of running robots, and the live source of rovioli."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.cancellation import ending_early
from maplab_py.interop.live import bag_recording, playing
from maplab_py.interop.live.options import LiveOptions, NetworkOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.plugin import CommandContext, command

if TYPE_CHECKING:
    from maplab_py.frontend.mapping import Mapping
    from maplab_py.frontend.odometry_update import OdometryUpdate
    from maplab_py.interop.live.bag_recording import RecordedBag
    from maplab_py.interop.live.connection import LiveTopics
    from maplab_py.interop.live.playing import PlayedRecording
    from maplab_py.interop.live.publishing import PosePublisher
    from maplab_py.interop.live.source import LiveRecording
    from maplab_py.interop.recordings.options import StreamOptions

_LIVE = LiveOptions()


@command(
    "live_topics",
    example="live_topics ros2 --ros_domain_id=0",
    needs_map=False,
    see_also=("rovioli", "record_bag", "play_recording", "bag_info"),
)
def live_topics(
    context: CommandContext,
    transport: str = "ros2",
    *,
    network: NetworkOptions = NetworkOptions(),
    listen_s: float = 3.0,
) -> LiveTopics:
    """List the topics of running robots: types, publishers, rates, sizes.

    Args:
        transport: ros2, ros1 or foxglove.
        listen_s: Count messages for so long [s].
    """
    from maplab_py.interop.live.connection import list_topics

    return list_topics(transport, network, listen_s, progress=context.progress)


@command(
    "play_recording",
    example="play_recording walk ros2 --play_rate=0.5",
    needs_map=False,
    acts_outside=True,
    see_also=("live_topics", "record_bag", "rovioli"),
)
def play_recording(
    context: CommandContext,
    recording: Path,
    transport: str = "ros2",
    *,
    source: SourceOptions = SourceOptions(),
    network: NetworkOptions = NetworkOptions(),
    options: playing.PlayingOptions = playing.PlayingOptions(),
) -> PlayedRecording:
    """Publish images and IMU samples of a recording as topics of ROS 2, ROS 1 or Foxglove.

    Topics are those of the calibration, else /imu0, /cam0/image_raw, /cam1/image_raw, ...; stamps are those
    of the recording. Ctrl-C ends it.

    Args:
        recording: EuRoC or TUM-VI folder, or ROS bag.
        transport: ros2, ros1 or foxglove (then this command is the server, at --foxglove_url).
    """
    from maplab_py.interop.live.playing import play_recording as play
    from maplab_py.interop.recordings.reader_choice import open_recording

    opened = open_recording(recording, source)
    with ending_early() as is_to_end:
        return play(
            opened, transport, network, options, progress=context.progress, is_to_end=is_to_end
        )


@command(
    "record_bag",
    example="record_bag ros2 walk_bag --record_topics=/imu0,/cam0/image_raw",
    needs_map=False,
    writes_files=True,
    see_also=("live_topics", "play_recording", "bag_info", "rovioli"),
)
def record_bag(
    context: CommandContext,
    transport: str,
    bag: Path,
    *,
    network: NetworkOptions = NetworkOptions(),
    options: bag_recording.RecordingOptions = bag_recording.RecordingOptions(),
    live_silence_s: float = _LIVE.silence_s,
    overwrite: bool = False,
) -> RecordedBag:
    """Write the topics of a robot to a bag while they arrive, byte by byte.

    Messages of ROS 2 go to a folder (mcap), those of ROS 1 to a file .bag. Ctrl-C ends the recording, and
    the bag is complete.

    Args:
        transport: ros2, ros1 or foxglove.
        bag: File .bag of ROS 1, or folder of a ROS 2 bag.
        live_silence_s: End when nothing has arrived for so long [s]; 0 = only Ctrl-C ends.
        overwrite: Replace a bag that exists.
    """
    from maplab_py.interop.live.bag_recording import record_bag as record

    with ending_early() as is_to_end:
        return record(
            transport,
            bag,
            network,
            options,
            silence_s=live_silence_s,
            overwrite=overwrite,
            progress=context.progress,
            is_to_end=is_to_end,
        )


class LiveRun:
    """A live recording, and the publisher of its poses."""

    def __init__(self, recording: LiveRecording, publisher: PosePublisher | None) -> None:
        """Publish poses of a recording; None = nothing is published."""
        self.recording, self._publisher = recording, publisher

    def publish(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Publish the state of a frame as soon as it is known."""
        from maplab_py.interop.live.publishing import Estimate

        state = update.state
        if state is not None and self._publisher is not None:
            frame, interval = mapping.localized_frame, update.interval
            pose = frame.pose if frame is not None else None
            w_I = 0.0 * state.gyro_bias[0]
            if interval is not None:
                w_I = interval.accel_gyro[-1, 3:] - state.gyro_bias[0]
            estimate = Estimate(
                update.time_ns,
                state.T_M_I[0],
                state.v_M[0],
                w_I,
                None if update.window is None else update.window.covariance,
                None if pose is None else pose.T_G_M,
            )
            self._publisher.publish(estimate)
            self._publisher.publish_landmarks(update.time_ns, mapping.odometry.landmarks()[1])
        self.recording.processed(update.time_ns)


@contextlib.contextmanager
def live_run(
    context: CommandContext,
    kind: str,
    source: SourceOptions,
    network: NetworkOptions,
    live: LiveOptions,
    stream: StreamOptions,
) -> Iterator[LiveRun]:
    """Connect to the topics of a robot, for rovioli.

    Raises:
        UserError: There is no calibration, or a topic is missing or of another type.
    """
    from maplab_py.interop.live import connection, publishing
    from maplab_py.interop.live.source import LiveRecording
    from maplab_py.interop.recordings.reader_choice import given_device

    device = given_device(source, f"--datasource_type={kind}: a live source")
    with connection.open_transport(kind, network) as transport:
        recording = LiveRecording(
            transport,
            device,
            source,
            live,
            wait_s=network.live_wait_s,
            tolerance_ns=stream.nframe_sync_tolerance_ns,
            tell=context.progress.line,
        )
        publisher = publishing.PosePublisher(transport, live) if live.publish else None
        yield LiveRun(recording, publisher)
