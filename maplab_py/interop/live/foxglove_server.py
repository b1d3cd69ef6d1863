"""Server of the WebSocket protocol of Foxglove, for recordings that are played to viewers and to tests.

Source: github.com/foxglove/ws-protocol, "docs/spec.md". Needs the library websockets (the extra `foxglove`).
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from typing import Any
from urllib.parse import urlsplit

from maplab_py.errors import UserError
from maplab_py.interop.live.foxglove import (
    MESSAGE_DATA,
    MESSAGE_HEADER,
    SUBPROTOCOLS,
    library_missing,
)
from maplab_py.interop.live.options import NetworkOptions
from maplab_py.interop.live.transport import Publish, Take, Topic, listening_address
from maplab_py.interop.recordings.bag_files import message_types

_MAX_REQUEST_BYTES = 1 << 20


class FoxgloveServer:
    """Channels that clients subscribe to."""

    is_ros_2 = True

    def __init__(self, network: NetworkOptions) -> None:
        """Listen at the port of `foxglove_url`.

        Raises:
            UserError: The library is missing, or the port is taken.
        """
        try:
            from websockets.sync.server import serve
        except ImportError as error:
            raise library_missing() from error
        host, port = listening_address(network), urlsplit(network.foxglove_url).port or 8765
        self.name = f"Foxglove ws://{host}:{port}"
        self.problems: list[str] = []
        self._channels: list[dict[str, Any]] = []
        self._clients: dict[Any, dict[int, int]] = {}  # connection -> channel -> subscription
        self._lock = threading.Lock()
        try:
            self._server = serve(
                self._talk,
                host,
                port,
                subprotocols=SUBPROTOCOLS,
                compression=None,
                max_size=_MAX_REQUEST_BYTES,
            )
        except OSError as error:
            raise UserError(
                f"{self.name}: cannot listen there ({error.strerror}): give another port in "
                "--foxglove_url"
            ) from error
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def topics(self) -> dict[str, Topic]:
        """Return nothing: a server sees no topics of others."""
        return {}

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Refuse: a server has nothing to receive.

        Raises:
            UserError: Always.
        """
        raise UserError(f"{self.name}: {topic.name} cannot be received by a server ({take})")

    def advertise(self, topic: str, kind: str) -> Publish:
        """Announce messages of a type; return what sends them."""
        definition, _ = message_types(is_ros_2=True).generate_msgdef(kind, ros_version=2)
        number = len(self._channels)
        channel = {
            "id": number,
            "topic": topic,
            "encoding": "cdr",
            "schemaName": kind,
            "schemaEncoding": "ros2msg",
            "schema": definition,
        }
        with self._lock:
            self._channels.append(channel)
            clients = list(self._clients)
        for client in clients:
            self._send(client, json.dumps({"op": "advertise", "channels": [channel]}))

        def publish(data: bytes) -> None:
            with self._lock:
                wanted = [(c, of[number]) for c, of in self._clients.items() if number in of]
            for client, subscription in wanted:
                head = MESSAGE_HEADER.pack(MESSAGE_DATA, subscription, time.time_ns())
                self._send(client, head + data)

        return publish

    def subscribers(self, topic: str) -> int:
        """Return how many listen to an advertised topic."""
        number = next(c["id"] for c in self._channels if c["topic"] == topic)
        with self._lock:
            return sum(number in wanted for wanted in self._clients.values())

    def close(self) -> None:
        """End all connections and threads."""
        self._server.shutdown()
        self._thread.join()

    def _talk(self, client: Any) -> None:
        """Serve a client until it goes."""
        about = {"name": "maplab-py", "capabilities": [], "supportedEncodings": []}
        self._send(client, json.dumps({"op": "serverInfo", **about}))
        with self._lock:
            self._clients[client] = {}
            channels = list(self._channels)
        self._send(client, json.dumps({"op": "advertise", "channels": channels}))
        try:
            for message in client:
                if isinstance(message, str):
                    self._take(client, message)
        finally:
            with self._lock:
                self._clients.pop(client, None)

    def _take(self, client: Any, text: str) -> None:
        """Take a request; what is no request is passed over."""
        with contextlib.suppress(ValueError, KeyError, TypeError), self._lock:
            request, wanted = json.loads(text), self._clients[client]
            if request["op"] == "subscribe":
                wanted |= {int(s["channelId"]): int(s["id"]) for s in request["subscriptions"]}
            elif request["op"] == "unsubscribe":
                numbers = set(request["subscriptionIds"])
                for channel in [c for c, number in wanted.items() if number in numbers]:
                    del wanted[channel]

    def _send(self, client: Any, message: str | bytes) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed, OSError):
            client.send(message)
