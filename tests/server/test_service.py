"""Who may ask the service what."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from maplab_py.errors import UserError
from maplab_py.report import Message
from maplab_py.server.service import Service

READS = {"state": lambda given: {"given": given}}


def stopped(given: dict[str, str]) -> Message:
    if not given:
        raise UserError("nothing given")
    return Message(f"stopped {given['name']}")


def sent(url: str, body: bytes | None = None, **headers: str) -> tuple[int, Any]:
    request = urllib.request.Request(url, data=body, headers=headers)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=20.0) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def test_loopback_needs_no_token_but_its_own_name(tmp_path: Path) -> None:
    file = tmp_path / "server.json"
    with Service(READS, {"stop": stopped}, address="127.0.0.1", port=0, file=file) as service:
        assert json.loads(file.read_text())["url"] == service.url
        assert file.stat().st_mode & 0o077 == 0
        assert sent(f"{service.url}/state?a=1") == (200, {"given": {"a": "1"}})
        assert sent(f"{service.url}/state", Host="evil.example")[0] == 403
        assert sent(f"{service.url}/stop")[0] == 404  # only POST changes something
        kind = {"Content-Type": "application/json"}
        assert sent(f"{service.url}/stop", b'{"name": "it"}', **kind)[1] == {"text": "stopped it"}
        assert sent(f"{service.url}/stop", b"{}", **kind) == (400, {"error": "nothing given"})
        missing = sent(f"{service.url}/stop", b'{"other": 1}', **kind)
        assert missing == (400, {"error": "the parameter name is missing"})
        for body in (b"[]", b"{", b"\xff"):
            assert sent(f"{service.url}/stop", body, **kind)[0] == 400
        form = {"Content-Type": "application/x-www-form-urlencoded"}
        assert sent(f"{service.url}/stop", b"name=it", **form)[0] == 400
    assert not file.exists()


def test_another_address_needs_the_token(tmp_path: Path) -> None:
    file = tmp_path / "server.json"
    with Service(READS, {}, address="0.0.0.0", port=0, file=file) as service:
        url = service.url.replace("0.0.0.0", "127.0.0.1")
        assert sent(f"{url}/state")[0] == 403
        assert sent(f"{url}/state", Authorization="Bearer wrong")[0] == 403
        token = json.loads(file.read_text())["token"]
        assert len(token) >= 32
        assert sent(f"{url}/state", Authorization=f"Bearer {token}")[0] == 200


def test_an_address_that_is_not_of_this_machine_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--serve_address=192.0.2.1 .* cannot listen there"):
        Service(READS, {}, address="192.0.2.1", port=0, file=tmp_path / "server.json")
