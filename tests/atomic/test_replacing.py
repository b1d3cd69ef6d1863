"""Where writes go: through links, never onto devices, and never over what another process holds."""

import os
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.atomic import PendingFile, recover, replaced_file, replaced_folder, write_file
from maplab_py.atomic.system import opened_locked
from maplab_py.cancellation import CancelToken, obeying
from maplab_py.errors import Cancelled, UserError
from maplab_py.output_files import check_writable, write_text
from tests.support.data import REPOSITORY

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links, devices and locks of POSIX")

HOLDER = (
    "import sys; from pathlib import Path; from maplab_py.atomic import replaced_folder\n"
    "with replaced_folder(Path(sys.argv[1])) as new:\n"
    "    (new / 'file').write_text('unfinished'); print('ready', flush=True); sys.stdin.read()\n"
)


def fill(folder: Path, text: str) -> None:
    with replaced_folder(folder) as new:
        (new / "file").write_text(text)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process in the middle of a save to the folder `map`."""
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path / "map")],
        cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout is not None
    assert child.stdin is not None
    assert child.stdout.readline() == "ready\n"
    yield child
    child.kill()
    child.wait()
    child.stdout.close()
    child.stdin.close()


def test_links_are_written_through(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk/file").write_text("old")
    fill(tmp_path / "disk/map", "old")
    for name in ("file", "map", "missing"):
        (tmp_path / name).symlink_to(f"disk/{name}")
    write_text(tmp_path / "file", ["new"], overwrite=True)
    write_text(tmp_path / "missing", ["new"])
    fill(tmp_path / "map", "new")
    assert all((tmp_path / name).is_symlink() for name in ("file", "map", "missing"))
    for name in ("file", "map/file", "missing"):
        assert (tmp_path / "disk" / name).read_text() == "new"
    assert names(tmp_path) == ["disk", "file", "map", "missing"]
    assert names(tmp_path / "disk") == ["file", "map", "missing"]


def test_what_is_neither_file_nor_folder_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        (tmp_path / "device").symlink_to("/dev/null")
        for name in ("pipe", "socket", "device"):
            for write in (
                lambda path: write_text(path, ["x"], overwrite=True),
                lambda path: write_file(path, [b"x"]),
                lambda path: check_writable(path, overwrite=True),
                lambda path: fill(path, "x"),
            ):
                with pytest.raises(UserError, match=f"{name} is neither a file nor a folder"):
                    write(tmp_path / name)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert stat.S_ISFIFO(os.stat(tmp_path / "pipe").st_mode)
    assert names(tmp_path) == ["device", "pipe", "socket"]


def test_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(UserError, match="Too many levels of symbolic links"):
        write_file(tmp_path / "a", [b"x"])


def test_a_file_keeps_its_permissions_and_long_names_work(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 255)
    write_file(path, [b"old"])
    path.chmod(0o640)
    write_file(path, [b"new"])
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    fill(tmp_path / ("y" * 255), "new")
    assert len(names(tmp_path)) == 2


def test_nobody_deletes_what_a_living_writer_has(
    tmp_path: Path, holder: subprocess.Popen[str]
) -> None:
    before = names(tmp_path)
    assert before == [".map.lock", ".map.saving"]
    recover(tmp_path / "map")
    with pytest.raises(UserError, match="another program is saving"):
        fill(tmp_path / "map", "mine")
    assert names(tmp_path) == before
    holder.communicate()  # it may end its save
    assert (tmp_path / "map/file").read_text() == "unfinished"
    assert names(tmp_path) == ["map"]


def test_a_writer_in_another_pid_namespace_is_left_alone(tmp_path: Path) -> None:
    """As in a container, where the writer's process number means somebody else or nobody."""
    unshare = ["unshare", "--pid", "--fork", "--kill-child"]
    try:
        works = subprocess.run([*unshare, "true"], check=False, capture_output=True).returncode == 0
    except FileNotFoundError:
        works = False
    if not works:
        pytest.skip("unshare cannot make a pid namespace here")
    with subprocess.Popen(
        [*unshare, sys.executable, "-c", HOLDER, str(tmp_path / "map")],
        cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        recover(tmp_path / "map")
        assert (tmp_path / ".map.saving/file").read_text() == "unfinished"
        child.communicate()
    assert child.returncode == 0
    assert (tmp_path / "map/file").read_text() == "unfinished"


def test_what_a_killed_writer_has_left_is_deleted(
    tmp_path: Path, holder: subprocess.Popen[str]
) -> None:
    holder.kill()
    holder.wait()
    assert names(tmp_path) == [".map.lock", ".map.saving"]
    recover(tmp_path / "map")
    assert names(tmp_path) == []


def test_a_file_that_another_writes_is_waited_for(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from maplab_py.atomic import replaced_file\n"
        "with replaced_file(Path(sys.argv[1])) as file:\n"
        "    file.write(b'first'); print('ready', flush=True); sys.stdin.read()\n"
    )
    path = tmp_path / "file"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)],
        cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        assert child.stdin is not None
        assert child.stdout.readline() == "ready\n"
        child.stdin.close()
        with replaced_file(path) as file:
            assert path.read_bytes() == b"first"
            file.write(b"second")
    assert path.read_bytes() == b"second"
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("locked", ["map", "map/inner", "."])
def test_a_read_only_folder_is_refused_without_a_copy(tmp_path: Path, locked: str) -> None:
    """As a user without privileges, whom permissions stop."""
    if os.geteuid() == 0 and not hasattr(os, "setresuid"):
        pytest.skip("root cannot become somebody else here")
    place = tmp_path / "place"
    place.mkdir()
    fill(place / "map", "old")
    (place / "map/inner").mkdir()
    program = (
        "import os, sys; from pathlib import Path; sys.path.append(sys.argv[2])\n"
        "from tests.atomic.test_replacing import fill\n"
        "from maplab_py.errors import UserError\n"
        "if os.geteuid() == 0: os.setresuid(65534, 65534, 65534)\n"
        "try: fill(Path(sys.argv[1]), 'new')\n"
        "except UserError as error: print(error)\n"
    )
    user = 65534 if os.geteuid() == 0 else os.geteuid()
    for folder in (place, place / "map", place / "map/inner"):
        os.chown(folder, user, -1)
    for folder in (tmp_path, *tmp_path.parents[:2]):
        folder.chmod(0o755)
    (place / locked).chmod(0o555)
    done = subprocess.run(
        [sys.executable, "-c", program, str(place / "map"), str(REPOSITORY)],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
    )  # fmt: skip
    (place / locked).chmod(0o755)
    assert "read-only" in done.stdout or "Permission denied" in done.stdout, done.stderr
    assert len(done.stdout.splitlines()) == 1
    assert names(place) == ["map"]
    assert (place / "map/file").read_text() == "old"


def test_a_removed_file_leaves_its_hidden_name_to_the_next_writer(tmp_path: Path) -> None:
    """A command that nobody waits for ends while the next one writes the same file."""
    abandoned = PendingFile(tmp_path / "file")
    abandoned.remove()
    following = PendingFile(tmp_path / "file")
    following.write([b"new"])
    with pytest.raises(Cancelled):
        abandoned.publish()
    abandoned.discard()
    assert names(tmp_path) == [".file.saving"]
    following.publish()
    following.discard()
    assert (tmp_path / "file").read_bytes() == b"new"
    assert names(tmp_path) == ["file"]


def test_a_file_that_cannot_be_renamed_stays_locked_until_it_is_deleted(tmp_path: Path) -> None:
    pending = PendingFile(tmp_path / "file")
    pending.write([b"new"])
    (tmp_path / "file").mkdir()
    with pytest.raises(UserError, match=r"file: cannot be written \(Is a directory\)"):
        pending.publish()
    assert opened_locked(tmp_path / ".file.saving") is None
    pending.discard()
    assert names(tmp_path) == ["file"]


def test_new_content_of_a_private_file_is_private_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(0o600)
    with replaced_file(path):
        assert stat.S_IMODE((tmp_path / ".file.saving").stat().st_mode) == 0o600


def test_ctrl_c_ends_the_wait_for_another_writer(tmp_path: Path) -> None:
    pending = PendingFile(tmp_path / "file")
    token = CancelToken()
    token.cancelled = True
    with obeying(token), pytest.raises(Cancelled):
        PendingFile(tmp_path / "file")
    pending.discard()
    assert names(tmp_path) == []
