"""Connecting to the topics of a robot."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from maplab_py.errors import UserError
from maplab_py.interop.live.options import TRANSPORTS, NetworkOptions
from maplab_py.interop.live.transport import Transport


@contextlib.contextmanager
def open_transport(
    kind: str, network: NetworkOptions, *, is_server: bool = False
) -> Iterator[Transport]:
    """Connect to ROS 2, ROS 1 or Foxglove, as one of `TRANSPORTS` says.

    Args:
        kind: One of `TRANSPORTS`.
        network: Where.
        is_server: Be the server of Foxglove, in place of its client.

    Raises:
        UserError: The transport is unknown, a library is missing, or nobody answers.
    """
    if kind not in TRANSPORTS:
        raise UserError(f"transport {kind}: wants one of {', '.join(TRANSPORTS)}")
    transport: Transport
    if kind == "ros2":
        from maplab_py.interop.live.ros2 import Ros2

        transport = Ros2(network)
    elif kind == "ros1":
        from maplab_py.interop.live.ros1 import Ros1

        transport = Ros1(network)
    elif is_server:
        from maplab_py.interop.live.foxglove import FoxgloveServer

        transport = FoxgloveServer(network)
    else:
        from maplab_py.interop.live.foxglove import FoxgloveClient

        transport = FoxgloveClient(network)
    try:
        yield transport
    finally:
        transport.close()
