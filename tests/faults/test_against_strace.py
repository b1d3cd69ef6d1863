"""The injector counts every call that strace sees."""

import json
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from tests.support import data, programs

KINDS = {
    "openat": "open",
    "renameat2": "rename",
    "unlinkat": "unlink",
    "mkdirat": "mkdir",
    "linkat": "link",
    "symlinkat": "symlink",
    "utimensat": "utime",
    "fchmodat": "chmod",
    "pwrite64": "write",
    "writev": "write",
}
TRACED = (
    "openat,write,pwrite64,writev,fsync,rename,renameat2,mkdir,mkdirat,unlink,unlinkat,rmdir,link,"
    "linkat,symlink,symlinkat,ftruncate,chmod,fchmod,fchmodat,flock,utimensat"
)


def run(*words: str) -> str:
    done = subprocess.run(words, cwd=data.REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def traced_calls(log: str, folder: Path) -> Counter[str]:
    found: Counter[str] = Counter()
    for line in log.splitlines():
        match = re.match(r"^\d+ +(\w+)\((.*)", line)
        if match is None or not re.search(re.escape(str(folder)) + r'[/>"]', line):
            continue
        name, words = match.groups()
        if name == "openat" and "O_CREAT" not in words:
            continue
        kind = "rmdir" if "AT_REMOVEDIR" in words else KINDS.get(name, name)
        found[kind] += 1
    return found


@pytest.mark.skipif(shutil.which("strace") is None, reason="there is no strace")
@pytest.mark.parametrize("name", ["replaced map", "csv", "segment database"])
def test_no_call_is_missed(tmp_path: Path, name: str) -> None:
    program = programs.module_of_tests("tests.faults")
    log, folder, other = tmp_path / "log", tmp_path / "strace", tmp_path / "counted"
    probe = subprocess.run(["strace", "-o", str(log), "true"], check=False, capture_output=True)
    if probe.returncode != 0:
        pytest.skip("strace may not trace here")
    for place in (folder, other):
        place.mkdir()
        run(*program, "prepare", name, str(place))
    run("strace", "-f", "-y", "-o", str(log), "-e", f"trace={TRACED}", *program, "save", name,
        str(folder))  # fmt: skip
    calls = json.loads(run(*program, "calls", name, str(other)))
    counted = Counter(call.split(maxsplit=1)[0] for call in calls)
    for kind in ("open_old", "close"):  # reading changes nothing
        del counted[kind]
    traced = traced_calls(log.read_text(), folder)
    assert counted == traced
    assert counted["fsync"] > 0
