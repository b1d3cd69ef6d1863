"""Topics over a WebSocket: client of foxglove_bridge and of others that speak its protocol.

Source: github.com/foxglove/ws-protocol, "docs/spec.md". Needs the library websockets (the extra `foxglove`).
"""

import contextlib
import importlib.util
import json
import socket
import struct
import threading
import time
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from maplab_py.errors import UserError
from maplab_py.interop.live import options, transport
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.interop.recordings.bag_kinds import full_type

SUBPROTOCOLS: Any = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Those of foxglove_bridge from 3.0 on, and before."""
MESSAGE_HEADER = struct.Struct("<BIQ")  # operation, subscription, time of the log
CLIENT_HEADER = struct.Struct("<BI")  # operation, channel of the client
MESSAGE_DATA = 1
_ENCODINGS = ("cdr", "ros1")
_CONNECT_S = 5.0
_RETRY_S = 1.0
_RECEIVE_S = 0.5


class _Channel(NamedTuple):
    """A topic as the server announces it."""

    id: int
    topic: str
    encoding: str
    type: str


class FoxgloveClient:
    """A connection to a server, made again when it breaks."""

    def __init__(self, network: options.NetworkOptions) -> None:
        """Connect.

        Raises:
            UserError: The library is missing, or nobody answers at the address.
        """
        if importlib.util.find_spec("websockets") is None:
            raise library_missing()
        self._url = network.foxglove_url
        self.name = f"Foxglove {self._url}"
        self.problems: list[str] = []
        self.is_ros_2 = True
        self._channels: dict[int, _Channel] = {}
        self._subscriptions: list[tuple[transport.Topic, transport.Take]] = []  # by number
        self._publications: list[tuple[str, str]] = []  # topic and type, by number
        self._capabilities: list[str] = []
        self._lock = threading.Lock()
        self._is_closed = threading.Event()
        self._has_topics = threading.Event()
        self._connection: Any = transport.answer_of(self._connected, network.live_wait_s)
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()
        self._has_topics.wait(network.live_wait_s)

    def topics(self) -> dict[str, transport.Topic]:
        """Return the topics that are published now, by name."""
        with self._lock:
            channels = sorted(self._channels.values(), key=lambda channel: channel.topic)
        return {
            channel.topic: transport.Topic(channel.topic, channel.type)
            for channel in channels
            if channel.encoding in _ENCODINGS
        }

    def subscribe(self, topic: transport.Topic, take: transport.Take) -> None:
        """Call a function with every message of a topic from now on."""
        with self._lock:
            self._subscriptions.append((topic, take))
        self._ask_for([len(self._subscriptions) - 1])

    def advertise(self, topic: str, kind: str) -> transport.Publish:
        """Announce messages of a type; return what sends them."""
        number = len(self._publications)
        self._publications.append((topic, kind))
        self._announce([number])
        if "clientPublish" not in self._capabilities:
            self.problems.append(f"{self.name} takes no messages, so {topic} is not published")

        def publish(data: bytes) -> None:
            if "clientPublish" in self._capabilities:
                self._send(CLIENT_HEADER.pack(MESSAGE_DATA, number) + data)

        return publish

    def subscribers(self, topic: str) -> int:  # noqa: ARG002
        """Return 1: the server does not tell."""
        return 1

    def close(self) -> None:
        """End the connection and the thread."""
        self._is_closed.set()
        if self._connection is not None:
            self._connection.close()
        self._thread.join()

    def _connected(self) -> Any:
        """Return a new connection.

        Raises:
            UserError: Nobody answers.
        """
        from websockets.exceptions import InvalidHandshake, InvalidURI
        from websockets.sync.client import connect

        try:
            return connect(
                self._url,
                subprotocols=SUBPROTOCOLS,
                max_size=transport.MAX_MESSAGE_BYTES,
                compression=None,
                open_timeout=_CONNECT_S,
                close_timeout=1.0,
                proxy=None,
            )
        except (OSError, InvalidHandshake, InvalidURI) as error:
            reason = getattr(error, "strerror", "") or " ".join(str(error).split())
            raise UserError(
                f"{self.name} does not answer ({reason}): start foxglove_bridge, or give --foxglove_url"
            ) from error

    def _run(self) -> None:
        """Receive, and connect again when the connection breaks."""
        while not self._is_closed.is_set():
            try:
                self._receive_all()
            except OSError as error:  # as websockets' ConnectionClosed is caught below
                self.problems.append(f"{self.name}: {error}")
            if self._is_closed.is_set():
                return
            self.problems.append(f"{self.name} has closed the connection: connecting again")
            with self._lock:
                self._channels.clear()
            while not self._is_closed.wait(_RETRY_S):
                try:
                    self._connection = self._connected()
                except UserError:
                    continue
                break

    def _receive_all(self) -> None:
        from websockets.exceptions import ConnectionClosed

        connection = self._connection
        is_linux = hasattr(socket, "TCP_QUICKACK")
        while not self._is_closed.is_set():
            try:
                message = connection.recv(timeout=_RECEIVE_S)
            except TimeoutError:
                continue
            except ConnectionClosed:
                return
            if is_linux:  # the servers wait for acknowledgements, which else come 40 ms late
                connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
            if isinstance(message, str):
                self._take_text(message)
            elif len(message) >= MESSAGE_HEADER.size:
                operation, number, _ = MESSAGE_HEADER.unpack_from(message)
                if operation == MESSAGE_DATA and number < len(self._subscriptions):
                    self._subscriptions[number][1](message[MESSAGE_HEADER.size :])

    def _take_text(self, text: str) -> None:
        """Take what the server says of itself and its channels."""
        try:
            content = json.loads(text)
            operation = content["op"]
            if operation == "serverInfo":
                self._capabilities = list(content.get("capabilities", ()))
                self._announce(range(len(self._publications)))
            elif operation == "advertise":
                channels = [_channel(entry) for entry in content["channels"]]
                self._take_channels(channels)
            elif operation == "unadvertise":
                with self._lock:
                    for number in content["channelIds"]:
                        self._channels.pop(number, None)
            elif operation == "status" and content.get("level", 0) > 0:
                self.problems.append(f"{self.name}: {content.get('message', '')}")
        except (ValueError, KeyError, TypeError) as error:
            self.problems.append(f"{self.name}: a message is damaged ({error})")

    def _take_channels(self, channels: list[_Channel]) -> None:
        with self._lock:
            self._channels |= {channel.id: channel for channel in channels}
            encodings = {c.encoding for c in self._channels.values() if c.encoding in _ENCODINGS}
        if encodings:
            self.is_ros_2 = "cdr" in encodings
            self._has_topics.set()
        names = {channel.topic for channel in channels}
        numbers = [n for n, (topic, _) in enumerate(self._subscriptions) if topic.name in names]
        self._ask_for(numbers)

    def _ask_for(self, numbers: list[int]) -> None:
        """Subscribe to channels of the subscriptions with these numbers."""
        with self._lock:
            by_topic = {channel.topic: channel.id for channel in self._channels.values()}
            wanted = [
                {"id": number, "channelId": by_topic[self._subscriptions[number][0].name]}
                for number in numbers
                if self._subscriptions[number][0].name in by_topic
            ]
        if wanted:
            self._send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def _announce(self, numbers: Any) -> None:
        """Announce the publications with these numbers."""
        channels = [
            {
                "id": number,
                "topic": self._publications[number][0],
                "encoding": "cdr" if self.is_ros_2 else "ros1",
                "schemaName": self._publications[number][1],
            }
            for number in numbers
        ]
        if channels and "clientPublish" in self._capabilities:
            self._send(json.dumps({"op": "advertise", "channels": channels}))

    def _send(self, message: str | bytes) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            self._connection.send(message)
        except (ConnectionClosed, OSError):
            time.sleep(0)  # the receiving thread connects again, and asks again


def _channel(entry: dict[str, Any]) -> _Channel:
    """Return a channel as the server announces it; schemas of ROS 1 have names of two parts."""
    kind = full_type(str(entry["schemaName"]))
    return _Channel(int(entry["id"]), str(entry["topic"]), str(entry["encoding"]), kind)


def library_missing() -> UserError:
    """Return the error that says what to install."""
    return UserError(
        "topics of Foxglove are read with the library websockets: install it with "
        "`pip install 'maplab-py[foxglove]'`"
    )


_MAX_REQUEST_BYTES = 1 << 20


class FoxgloveServer:
    """Channels that clients subscribe to."""

    is_ros_2 = True

    def __init__(self, network: options.NetworkOptions) -> None:
        """Listen at the port of `foxglove_url`.

        Raises:
            UserError: The library is missing, or the port is taken.
        """
        try:
            from websockets.sync.server import serve
        except ImportError as error:
            raise library_missing() from error
        host, port = (
            transport.listening_address(network),
            urlsplit(network.foxglove_url).port or 8765,
        )
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

    def topics(self) -> dict[str, transport.Topic]:
        """Return nothing: a server sees no topics of others."""
        return {}

    def subscribe(self, topic: transport.Topic, take: transport.Take) -> None:
        """Refuse: a server has nothing to receive.

        Raises:
            UserError: Always.
        """
        raise UserError(f"{self.name}: {topic.name} cannot be received by a server ({take})")

    def advertise(self, topic: str, kind: str) -> transport.Publish:
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
