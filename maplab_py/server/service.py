"""JSON over HTTP: status, stop, deletion and look-ups. On loopback, or with a token elsewhere."""

from __future__ import annotations

import json
import os
import secrets
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import parse_qsl, urlsplit

from maplab_py.atomic import write_file
from maplab_py.errors import MaplabError, UserError
from maplab_py.report import to_json

LOOPBACK = "127.0.0.1"
_MAX_BODY = 100_000
_LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")

Answer = Callable[[dict[str, str]], Any]
"""Takes the parameters of a request; returns a report or plain values."""


class Service:
    """Answers requests in threads of its own while the block lasts.

    Attributes:
        url: Where it listens.
        token: What requests must carry; empty on loopback.
    """

    def __init__(
        self,
        reads: dict[str, Answer],
        writes: dict[str, Answer],
        *,
        address: str,
        port: int,
        file: Path,
    ) -> None:
        """Prepare.

        Args:
            reads: Answers to GET by name.
            writes: Answers to POST by name.
            address: Address to listen at.
            port: Its port, 0 = any.
            file: Gets address, token and process, readable to the user alone.

        Raises:
            UserError: It cannot listen there.
        """
        self.token = "" if address == LOOPBACK else secrets.token_urlsafe(24)
        handler = type(
            "_BoundHandler", (_Handler,), {"reads": reads, "writes": writes, "token": self.token}
        )
        try:
            self._server = ThreadingHTTPServer((address, port), handler)
        except (OSError, OverflowError) as error:
            raise UserError(
                f"--serve_address={address} --serve_port={port}: cannot listen there ({error})"
            ) from error
        self._server.daemon_threads = True
        self.url = f"http://{address}:{self._server.server_address[1]}"
        self._file = file
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )

    def __enter__(self) -> Self:
        """Start to answer."""
        content = {"url": self.url, "token": self.token, "process": os.getpid()}
        write_file(self._file, [b""])
        self._file.chmod(0o600)  # the permissions stay when the content comes
        write_file(self._file, [json.dumps(content).encode()])
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()
        self._file.unlink(missing_ok=True)


class _Handler(BaseHTTPRequestHandler):
    reads: dict[str, Answer]
    writes: dict[str, Answer]
    token: str
    timeout = 30.0

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        self._answer(self.reads, parts.path, dict(parse_qsl(parts.query)))

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        is_json = self.headers.get_content_type() == "application/json"
        if not is_json or not length.isdigit() or int(length) > _MAX_BODY:
            self._send(400, {"error": "a JSON object is expected"})
            return
        try:
            content = json.loads(self.rfile.read(int(length)))
            parameters = {str(key): str(value) for key, value in content.items()}
        except (ValueError, AttributeError):
            self._send(400, {"error": "a JSON object is expected"})
            return
        self._answer(self.writes, urlsplit(self.path).path, parameters)

    def _answer(self, answers: dict[str, Answer], path: str, parameters: dict[str, str]) -> None:
        if not self._is_allowed():
            self._send(403, {"error": "not allowed: the token is missing or wrong"})
            return
        answer = answers.get(path.strip("/"))
        if answer is None:
            names = ", ".join(sorted((*self.reads, *self.writes)))
            self._send(404, {"error": f"{path}: there is only {names}"})
            return
        try:
            self._send(200, to_json(answer(parameters)))
        except KeyError as error:
            self._send(400, {"error": f"the parameter {error.args[0]} is missing"})
        except (MaplabError, ValueError) as error:
            self._send(400, {"error": str(error)})

    def _is_allowed(self) -> bool:
        if self.token:
            given = self.headers.get("Authorization", "").removeprefix("Bearer ")
            return secrets.compare_digest(given.encode(), self.token.encode())
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        return host in _LOCAL_NAMES  # no page of another name that resolves to this machine

    def _send(self, status: int, content: Any) -> None:
        data = json.dumps(content).encode()
        try:
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)
        except OSError:  # the other side has gone
            self.close_connection = True

    def log_message(self, format: str, *arguments: Any) -> None:
        """Write nothing."""
