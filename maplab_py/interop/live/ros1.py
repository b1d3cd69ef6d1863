"""Topics of ROS 1 with the standard library: XML-RPC to the master and to nodes, TCPROS for messages.

Sources: wiki.ros.org, "ROS/Master_API", "ROS/Slave_API", "ROS/TCPROS".
"""

import contextlib
import http.client
import os
import socket
import struct
import threading
import time
import xmlrpc.client
from collections.abc import Iterable
from functools import partial
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

from maplab_py.errors import MaplabError, UserError
from maplab_py.interop.live import transport as transports
from maplab_py.interop.live.options import NetworkOptions
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.interop.recordings.bag_kinds import full_type

# Source: wiki.ros.org, "ROS/TCPROS", "ROS/Connection Header"

_MAX_HEADER_BYTES = 1_000_000  # with the definition of the message


class ConnectionProblem(MaplabError):
    """A peer says something that is not TCPROS, or refuses."""


def header_bytes(fields: dict[str, str]) -> bytes:
    """Return a connection header."""
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    content = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(content)) + content


def parse_header(content: bytes) -> dict[str, str]:
    """Return the fields of a connection header, without its length.

    Raises:
        ConnectionProblem: It is damaged.
    """
    fields, at = {}, 0
    while at < len(content):
        if at + 4 > len(content):
            raise ConnectionProblem("the connection header is damaged")
        size = struct.unpack_from("<I", content, at)[0]
        line = content[at + 4 : at + 4 + size]
        key, separator, value = line.partition(b"=")
        if len(line) < size or not separator:
            raise ConnectionProblem("the connection header is damaged")
        fields[key.decode(errors="replace")] = value.decode(errors="replace")
        at += 4 + size
    return fields


def receive_header(connection: socket.socket) -> dict[str, str]:
    """Receive a connection header.

    Raises:
        ConnectionProblem: It is damaged or too large, or the connection ends.
        OSError: The connection fails.
    """
    return parse_header(receive_block(connection, "connection header", _MAX_HEADER_BYTES))


def receive_block(
    connection: socket.socket, kind: str = "message", limit: int = transports.MAX_MESSAGE_BYTES
) -> bytes:
    """Receive a message, or what else has its length before it.

    Raises:
        ConnectionProblem: It is too large, or the connection ends.
        OSError: The connection fails.
    """
    size = struct.unpack("<I", _receive(connection, 4))[0]
    if size > limit:
        raise ConnectionProblem(f"a {kind} of {size:,} bytes is refused (at most {limit:,})")
    return bytes(_receive(connection, size))


def _receive(connection: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    view, at = memoryview(data), 0
    while at < size:
        count = connection.recv_into(view[at:])
        if not count:
            raise ConnectionProblem("the publisher has closed the connection")
        at += count
    return data


_MASTER_TIMEOUT_S = 5.0
_PEER_TIMEOUT_S = 5.0
_WRITE_TIMEOUT_S = 0.2
_LOOK_EVERY_S = 1.0
"""The master is asked so often whether it still knows this node, and who publishes."""
_XMLRPC_ERRORS = (OSError, xmlrpc.client.Error, http.client.HTTPException, ValueError)
_SUCCESS = 1


class Ros1:
    """A node of ROS 1."""

    is_ros_2 = False

    def __init__(self, network: NetworkOptions) -> None:
        """Start a node.

        Raises:
            UserError: There is no master at the address.
        """
        self._uri = network.master
        self.name = f"ROS 1 master {self._uri}"
        self.problems: list[str] = []
        self._node = f"/maplab_{os.getpid()}_{time.monotonic_ns() % 10**9}"
        self._store = message_types(is_ros_2=False)
        self._subscriptions: dict[str, tuple[transports.Topic, transports.Take]] = {}
        self._publications: dict[str, _Publication] = {}
        self._connections: dict[tuple[str, str], socket.socket | None] = {}
        self._lock = threading.Lock()
        self._is_closed = threading.Event()
        self._had_master = True
        transports.answer_of(self.topics, network.live_wait_s)  # says whether there is a master
        host = transports.listening_address(network)
        self._server = socket.create_server((host, 0))
        self._rpc = SimpleXMLRPCServer((host, 0), logRequests=False, allow_none=True)
        self._api = f"http://{host}:{self._rpc.server_address[1]}/"
        for name in ("getPid", "publisherUpdate", "requestTopic", "paramUpdate", "shutdown"):
            self._rpc.register_function(getattr(self, f"_{name.lower()}"), name)
        for work in (self._rpc.serve_forever, self._accept, self._keep_registered):
            threading.Thread(target=work, name="ros1", daemon=True).start()

    def topics(self) -> dict[str, transports.Topic]:
        """Return the topics that are published now, by name."""
        types = dict(self._ask("getTopicTypes"))
        publishers = dict(self._ask("getSystemState")[0])
        return {
            name: transports.Topic(name, full_type(types[name]), len(nodes))
            for name, nodes in sorted(publishers.items())
            if name in types and set(nodes) != {self._node}
        }

    def subscribe(self, topic: transports.Topic, take: transports.Take) -> None:
        """Call a function with every message of a topic from now on."""
        self._subscriptions[topic.name] = topic, take
        self._connect(topic.name, self._register(topic))

    def advertise(self, topic: str, kind: str) -> transports.Publish:
        """Announce messages of a type; return what sends them."""
        definition, md5sum = self._store.generate_msgdef(kind, ros_version=1)
        publication = _Publication(self._node, topic, _ros1_type(kind), md5sum, definition)
        self._publications[topic] = publication
        self._ask("registerPublisher", topic, publication.type, self._api)
        return publication.send

    def subscribers(self, topic: str) -> int:
        """Return how many listen to an advertised topic."""
        return len(self._publications[topic].connections)

    def close(self) -> None:
        """End all connections and threads."""
        self._is_closed.set()
        with contextlib.suppress(UserError):
            for topic in self._subscriptions:
                self._ask("unregisterSubscriber", topic, self._api)
            for topic in self._publications:
                self._ask("unregisterPublisher", topic, self._api)
        self._rpc.shutdown()
        self._rpc.server_close()
        self._server.close()
        with self._lock:
            sockets = [*self._connections.values()]
        sockets += [c for p in self._publications.values() for c in p.connections]
        for connection in sockets:
            if connection is not None:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                connection.close()

    # -- the master -------------------------------------------------------------------------------

    def _ask(self, method: str, *arguments: str) -> Any:
        """Return the master's answer.

        Raises:
            UserError: It does not answer, or refuses.
        """
        try:
            with _proxy(self._uri, _MASTER_TIMEOUT_S) as master:
                code, message, value = getattr(master, method)(self._node, *arguments)
        except _XMLRPC_ERRORS as error:
            reason = getattr(error, "strerror", "") or " ".join(str(error).split())
            raise UserError(
                f"{self.name} does not answer ({reason}): start roscore, or give --ros_master_uri"
            ) from error
        if code != _SUCCESS:
            raise UserError(f"{self.name}: {method} {' '.join(arguments[:1])}: {message}")
        return value

    def _register(self, topic: transports.Topic) -> list[str]:
        kind = _ros1_type(topic.type)
        return list(self._ask("registerSubscriber", topic.name, kind, self._api))

    def _keep_registered(self) -> None:
        """Register again with a master that was restarted, and connect to publishers that were."""
        while not self._is_closed.wait(_LOOK_EVERY_S):
            try:
                for topic, _ in list(self._subscriptions.values()):
                    self._connect(topic.name, self._register(topic))
                if not self._had_master:
                    for publication in list(self._publications.values()):
                        arguments = publication.topic, publication.type, self._api
                        self._ask("registerPublisher", *arguments)
                    self.problems.append(f"{self.name} is there again")
                self._had_master = True
            except UserError as error:
                if self._had_master and not self._is_closed.is_set():
                    self.problems.append(f"{error}; what is connected goes on")
                self._had_master = False

    # -- what nodes and the master ask of this node -----------------------------------------------

    def _getpid(self, _caller: str) -> list[Any]:
        return [_SUCCESS, "", os.getpid()]

    def _paramupdate(self, _caller: str, _key: str, _value: Any) -> list[Any]:
        return [_SUCCESS, "", 0]

    def _shutdown(self, _caller: str, reason: str = "") -> list[Any]:
        self.problems.append(f"{self.name} asks to end ({reason}): another node has the same name")
        return [_SUCCESS, "", 0]

    def _publisherupdate(self, _caller: str, topic: str, uris: list[str]) -> list[Any]:
        self._connect(topic, uris)
        return [_SUCCESS, "", 0]

    def _requesttopic(self, _caller: str, topic: str, _protocols: list[Any]) -> list[Any]:
        if topic not in self._publications:
            return [0, f"{topic} is not published here", 0]
        host, port = self._server.getsockname()
        return [_SUCCESS, "", ["TCPROS", host, port]]

    # -- receiving --------------------------------------------------------------------------------

    def _connect(self, topic: str, uris: Iterable[str]) -> None:
        """Receive from publishers that are new, each in a thread."""
        if topic not in self._subscriptions:
            return
        for uri in uris:
            with self._lock:
                if (topic, uri) in self._connections or uri == self._api:
                    continue
                self._connections[topic, uri] = None
            receive = partial(self._receive, topic, uri)
            threading.Thread(target=receive, name=f"ros1 {topic}", daemon=True).start()

    def _receive(self, topic: str, uri: str) -> None:
        expected, take = self._subscriptions[topic]
        try:
            with self._opened(expected, uri) as connection:
                with self._lock:
                    self._connections[topic, uri] = connection
                while True:
                    take(receive_block(connection))
        except (*_XMLRPC_ERRORS, ConnectionProblem) as error:
            if not self._is_closed.is_set():
                reason = " ".join(str(error).split())
                if not self.problems or self.problems[-1] != f"{topic}: {reason}":
                    self.problems.append(f"{topic}: {reason}")
                self._is_closed.wait(_LOOK_EVERY_S)  # a publisher that refuses is not asked at once
        finally:
            with self._lock:
                self._connections.pop((topic, uri), None)

    def _opened(self, topic: transports.Topic, uri: str) -> socket.socket:
        """Return a connection to a publisher after the exchange of headers."""
        with _proxy(uri, _PEER_TIMEOUT_S) as publisher:
            answer: Any = publisher.requestTopic(self._node, topic.name, [["TCPROS"]])
        code, message, place = answer
        if code != _SUCCESS or not isinstance(place, list) or len(place) != 3:
            raise ConnectionProblem(f"its publisher refuses ({message})")
        connection = socket.create_connection((str(place[1]), int(place[2])), _PEER_TIMEOUT_S)
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            _, md5sum = self._store.generate_msgdef(topic.type, ros_version=1)
            request = {
                "callerid": self._node,
                "topic": topic.name,
                "type": _ros1_type(topic.type),
                "md5sum": md5sum,
                "tcp_nodelay": "1",
            }
            connection.sendall(header_bytes(request))
            header = receive_header(connection)
            if "error" in header:
                raise ConnectionProblem(f"its publisher refuses ({header['error']})")
            if header.get("md5sum") not in (md5sum, "*"):
                raise ConnectionProblem(f"its messages are not those of {topic.type}")
            connection.settimeout(None)
        except BaseException:
            connection.close()
            raise
        return connection

    # -- sending ----------------------------------------------------------------------------------

    def _accept(self) -> None:
        while not self._is_closed.is_set():
            try:
                connection, _ = self._server.accept()
            except OSError:
                return  # closed
            greet = partial(self._greet, connection)
            threading.Thread(target=greet, name="ros1 subscriber", daemon=True).start()

    def _greet(self, connection: socket.socket) -> None:
        """Exchange headers with a subscriber."""
        connection.settimeout(_PEER_TIMEOUT_S)
        try:
            request = receive_header(connection)
            publication = self._publications.get(request.get("topic", ""))
            if publication is None:
                connection.sendall(header_bytes({"error": "the topic is not published here"}))
            elif publication.accept(connection, request):
                return
        except (OSError, ConnectionProblem):
            pass
        connection.close()


class _Publication:
    """A topic that this node publishes."""

    def __init__(self, node: str, topic: str, kind: str, md5sum: str, definition: str) -> None:
        self.topic, self.type, self._md5sum = topic, kind, md5sum
        self._answer = {
            "callerid": node,
            "topic": topic,
            "type": kind,
            "md5sum": md5sum,
            "message_definition": definition,
            "latching": "0",
        }
        self.connections: list[socket.socket] = []

    def accept(self, connection: socket.socket, request: dict[str, str]) -> bool:
        """Answer a subscriber; return whether it is one from now on."""
        if request.get("md5sum") not in (self._md5sum, "*"):
            connection.sendall(header_bytes({"error": f"{self.topic} has the type {self.type}"}))
            return False
        connection.sendall(header_bytes(self._answer))
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(_WRITE_TIMEOUT_S)
        self.connections.append(connection)
        return True

    def send(self, data: bytes) -> None:
        """Send a message to all subscribers; one that does not keep up is disconnected."""
        block = struct.pack("<I", len(data)) + data
        for connection in list(self.connections):
            try:
                connection.sendall(block)
            except OSError:
                self.connections.remove(connection)
                connection.close()


def _proxy(uri: str, timeout_s: float) -> xmlrpc.client.ServerProxy:
    """Return a proxy that does not wait for ever."""
    transport = xmlrpc.client.Transport()
    connect = transport.make_connection

    def with_timeout(host: Any) -> http.client.HTTPConnection:
        connection = connect(host)
        connection.timeout = timeout_s
        return connection

    transport.make_connection = with_timeout  # type: ignore[method-assign]
    return xmlrpc.client.ServerProxy(uri, transport=transport)


def _ros1_type(kind: str) -> str:
    """Return sensor_msgs/Image for sensor_msgs/msg/Image."""
    return kind.replace("/msg/", "/")
