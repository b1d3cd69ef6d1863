"""Requests to the server of a spool, as the commands send them."""

import json
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from maplab_py.errors import MaplabError, UserError
from maplab_py.server.spool import Spool

_TIMEOUT_S = 600.0
"""Requests that change the map wait until it is published."""


class NotRunning(UserError):
    """No server works on a spool."""


def ask(spool: Spool, name: str, **parameters: str) -> dict[str, Any]:
    """Return the answer to a question; see `Service`.

    Raises:
        NotRunning: No server works on the spool.
        UserError: The server refuses the request; the message is its own.
    """
    return _send(spool, f"{name}?{urllib.parse.urlencode(parameters)}", None)


def order(spool: Spool, name: str, **parameters: str) -> dict[str, Any]:
    """Let the server do something, and return its answer; errors as `ask`."""
    return _send(spool, name, json.dumps(parameters).encode())


def _send(spool: Spool, path: str, body: bytes | None) -> dict[str, Any]:
    spool.check_exists()
    stopped = f"no server works on --spool={spool.root}: start one with maplab serve"
    try:
        known = json.loads(spool.address.read_text(encoding="utf-8"))
        url, token = str(known["url"]), str(known["token"])
    except (OSError, ValueError, KeyError):
        raise NotRunning(stopped) from None
    headers = {"Content-Type": "application/json"}
    if token:
        headers["Authorization"] = f"Bearer {token}"
    request = urllib.request.Request(f"{url}/{path}", data=body, headers=headers)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # never through a proxy
    try:
        with opener.open(request, timeout=_TIMEOUT_S) as answer:
            content: dict[str, Any] = json.load(answer)
            return content
    except urllib.error.HTTPError as error:
        try:
            reason = str(json.load(error)["error"])
        except (ValueError, KeyError, OSError):
            reason = str(error)
        raise UserError(reason) from None
    except (urllib.error.URLError, ConnectionError):
        raise NotRunning(stopped) from None
    except (OSError, ValueError) as error:
        raise MaplabError(f"the server of --spool={spool.root} broke off: {error}") from None
