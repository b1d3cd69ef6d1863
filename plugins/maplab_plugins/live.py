"""Commands that read and write the topics of running robots, and the live source of rovioli."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from maplab_py.interop.live.options import LiveOptions, NetworkOptions
from maplab_py.plugin import CommandContext, command

if TYPE_CHECKING:
    from maplab_py.frontend.mapping import Mapping
    from maplab_py.frontend.odometry_update import OdometryUpdate
    from maplab_py.interop.live.listing import LiveTopics
    from maplab_py.interop.live.publishing import PosePublisher
    from maplab_py.interop.live.source import LiveRecording
    from maplab_py.interop.recordings.options import SourceOptions, StreamOptions

_NETWORK = NetworkOptions()
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
    network: NetworkOptions = _NETWORK,
    listen_s: float = 3.0,
) -> LiveTopics:
    """List the topics of running robots: types, publishers, rates, sizes.

    Args:
        transport: ros2, ros1 or foxglove.
        listen_s: Count messages for so long [s].
    """
    from maplab_py.interop.live.listing import list_topics

    return list_topics(transport, network, listen_s, progress=context.progress)


class LiveRun:
    """A live recording, and the publisher of its poses; observes the run."""

    def __init__(self, recording: LiveRecording, publisher: PosePublisher | None) -> None:
        """Publish poses of a recording; None = nothing is published."""
        self.recording, self._publisher = recording, publisher

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Publish the state of a frame."""
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
                state.v_M_I[0],
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
    from maplab_py.interop.live.opening import open_transport
    from maplab_py.interop.live.publishing import PosePublisher
    from maplab_py.interop.live.source import LiveRecording
    from maplab_py.interop.recordings.opening import given_device

    device = given_device(source, f"--datasource_type={kind}: a live source")
    with open_transport(kind, network) as transport:
        recording = LiveRecording(
            transport,
            device,
            source,
            live,
            wait_s=network.live_wait_s,
            tolerance_ns=stream.nframe_sync_tolerance_ns,
            tell=context.progress.line,
        )
        publisher = PosePublisher(transport, live) if live.publish else None
        yield LiveRun(recording, publisher)
