"""The viewer beside a real prompt."""

import re
import socket
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from maplab_py.storage.native import save_map
from tests.e2e.support import Console, run_program
from tests.vimap.builders import walk_map


@pytest.fixture
def console(tmp_path: Path) -> Iterator[Console]:
    save_map(walk_map(), tmp_path / "walk")
    console = Console(tmp_path)
    console.wait_for_prompt()
    yield console
    console.close()


def _is_served(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _visit(port: int, origin: str | None = None) -> None:
    """Open a page and leave it as a killed browser does."""
    protocol = f"viser-v{viser.__version__}"
    url = f"ws://127.0.0.1:{port}"
    with connect(url, origin=origin, subprotocols=[protocol], close_timeout=0.1) as page:
        page.recv(timeout=5.0)
        page.socket.shutdown(socket.SHUT_RDWR)


def test_the_prompt_stays_clean_and_the_server_ends_with_it(console: Console) -> None:
    console.enter("load walk")
    console.wait_for_prompt("maplab <walk>:/$")
    console.enter("visualize --viewer_port=0")
    console.wait_for(lambda screen: re.search(r"visualize: \d+\.\d\d s", screen) is not None)
    console.wait_for_prompt("maplab <walk>:/$")
    found = re.search(r"http://127\.0\.0\.1:(\d+)", console.text)
    assert found is not None
    port = int(found[1])
    console.enter("clear_nothing")
    console.wait_for_text("unknown command 'clear_nothing'")
    console.wait_for_prompt("maplab <walk>:/$")
    quiet = console.wait_until_still()
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10.0) as answer:
        assert b"<html" in answer.read()[:500].lower()
    _visit(port)
    with pytest.raises(InvalidStatus):
        _visit(port, origin="https://evil.example")
    with socket.create_connection(("127.0.0.1", port)) as nonsense:
        nonsense.sendall(b"no http\r\n\r\n")
        nonsense.settimeout(20.0)
        while nonsense.recv(4096):  # the server refuses and closes the connection
            pass
    console.wait_until_still()
    console.type("ms")
    console.wait_for(lambda _: console.last_line.endswith("$ ms"))
    console.wait_until_still()
    # what pages do has left no trace between the last output and the prompt
    prompt = "maplab <walk>:/$"
    assert console.text.rpartition(prompt)[0] == quiet.rpartition(prompt)[0]
    assert f"viewer http://127.0.0.1:{port}" in console.text.rpartition(prompt)[2]
    console.enter("")
    console.wait_for_prompt("maplab <walk>:/$")
    assert _is_served(port)
    console.enter("quit")
    assert console.status() == 0
    assert not _is_served(port)


def test_scripts_export_a_view(tmp_path: Path) -> None:
    save_map(walk_map(), tmp_path / "walk")
    done = run_program(
        tmp_path, "-c", "load walk; v --viewer_port=0; export_view --file=walk.html", "--json"
    )
    assert done.returncode == 0, done.stderr
    assert all(line.startswith("{") for line in done.stdout.splitlines())
    assert "Traceback" not in done.stderr
    assert "viser" not in done.stdout + done.stderr
    assert (tmp_path / "walk.html").stat().st_size > 100_000
