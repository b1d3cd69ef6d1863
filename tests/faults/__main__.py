"""Run scenarios under every fault: `python -m tests.faults [SCENARIO ...]`.

Each run is a fork of this process, in a fresh copy of the old state. Printed is one line of JSON per
scenario: the calls, how many faults were injected, and every broken promise.
"""

import dataclasses
import errno
import gc
import json
import os
import re
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from maplab_py.errors import MaplabError
from tests.faults.scenarios import SCENARIOS, Scenario
from tests.faults.system_calls import KILLED, PATH_CALLS, SPACE_CALLS, Fault, SystemCalls

_OK, _REFUSED, _CRASHED = 0, 3, 4
_HIDDEN = re.compile(r"^\..*\.(saving|old|lock)$")
State = dict[str, str]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a run has ended."""

    status: int
    text: str  # message of a refusal, or a traceback
    calls: list[str]
    has_struck: bool


def run(act: Callable[[Path], object], folder: Path, fault: Fault) -> Outcome:
    """Run an action in a forked child with one fault."""
    reading, writing = os.pipe()
    gc.freeze()
    child = os.fork()
    if child == 0:
        os.close(reading)
        calls = SystemCalls(folder, fault)
        status, text = _OK, ""
        try:
            calls.install()
            act(folder)
        except MaplabError as error:
            status, text = _REFUSED, str(error)
        except BaseException:  # noqa: BLE001 - reported by the parent
            status, text = _CRASHED, traceback.format_exc()
        if fault.kind == "power":
            if status == _OK and calls.renamed_in:
                status, text = _CRASHED, "a rename was not flushed to disk"
            calls.lose_power()
        result = json.dumps([status, text, calls.names, calls.has_struck]).encode()
        with calls.real_open(writing, "wb") as pipe:
            pipe.write(result)
        os._exit(0)
    os.close(writing)
    with open(reading, "rb") as pipe:
        data = pipe.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == KILLED:
        return Outcome(KILLED, "", [], True)
    return Outcome(*json.loads(data))


def state_of(folder: Path, *, hidden: bool) -> State:
    """Return what is in a folder, hidden files of writers (only) or all others."""
    found = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if any(map(_HIDDEN.match, relative.parts)) == hidden:
            kind = "folder" if path.is_dir() else path.read_bytes().hex()
            found[str(relative)] = f"link {os.readlink(path)}" if path.is_symlink() else kind
    return found


def files_of(state: State) -> State:
    return {name: content for name, content in state.items() if content != "folder"}


class Explorer:
    """All faults of one scenario."""

    def __init__(self, scenario: Scenario, base: Path) -> None:
        self.scenario, self.base = scenario, base
        self.template, self.folder = base / "old", base / "here"
        self.template.mkdir()
        scenario.prepare(self.template)
        self.old = state_of(self.template, hidden=False)
        self.restore()
        self.scenario.save(self.folder)  # forks shall neither import nor load kernels
        if scenario.tidy is not None:
            scenario.tidy(self.folder)
        self.broken: list[str] = []
        self.injected = 0

    def restore(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.template, self.folder, symlinks=True)

    def explore(self, fault: Fault) -> list[str]:
        """Strike at each call in turn; return the calls of a run without fault."""
        self.restore()
        done = run(self.scenario.save, self.folder, dataclasses.replace(fault, at=0))
        self.new = state_of(self.folder, hidden=False)
        self.expect(done.status == _OK, fault, f"fails without a fault: {done.text}")
        self.expect(not state_of(self.folder, hidden=True), fault, "leaves files behind")
        self.expect(self.new != self.old or fault.at, fault, "changes nothing")
        for at, call in enumerate(done.calls, start=1):
            if _matters(fault, call):
                self.strike(dataclasses.replace(fault, at=at), call)
        return done.calls

    def strike(self, fault: Fault, call: str) -> None:
        self.restore()
        outcome = run(self.scenario.save, self.folder, fault)
        if not outcome.has_struck:
            return
        self.injected += 1
        where = f"at '{call}': "
        self.expect(outcome.status != _CRASHED, fault, where + outcome.text)
        if outcome.status != KILLED or fault.has_renameat2:  # else a load moves the old map back
            self.check_state(fault, outcome, where)
        if outcome.status == KILLED:
            if self.scenario.tidy is not None:
                run(self.scenario.tidy, self.folder, Fault("none", 0))
                self.check_state(fault, outcome, where + "after a load: ")
                self.expect_tidy(fault, where + "after a load: ")
            run(self.scenario.save, self.folder, Fault("none", 0))
            self.expect_tidy(fault, where + "after the next save: ")
            state = state_of(self.folder, hidden=False)
            self.expect(
                state == self.new or self.scenario.may_be_cut, fault, where + "cannot save again"
            )
        else:
            self.expect_tidy(fault, where)
        if outcome.status == _REFUSED:
            code = errno.ENOSPC if fault.kind == "full" else fault.code
            self.expect("\n" not in outcome.text, fault, where + "more than one line")
            self.expect(os.strerror(code) in outcome.text, fault, where + outcome.text)

    def check_state(self, fault: Fault, outcome: Outcome, where: str) -> None:
        state = state_of(self.folder, hidden=False)
        if outcome.status == KILLED:  # empty parent folders harm nobody
            is_old, is_new = files_of(state) == files_of(self.old), state == self.new
        else:
            is_old, is_new = state == self.old, state == self.new
        if self.scenario.may_be_cut:
            is_old = is_old or self.is_old_and_more(state)
            self.expect(is_old or is_new, fault, where + "old lines are lost")
            return
        if self.scenario.has_many_files:
            is_old = is_old or self.is_each_old_or_new(state)
        self.expect(is_old or is_new, fault, where + "neither old nor new")
        if outcome.status == _OK:
            self.expect(is_new, fault, where + "success is reported, but the old state is there")

    def is_old_and_more(self, state: State) -> bool:
        return all(state.get(name, "").startswith(text) for name, text in self.old.items())

    def is_each_old_or_new(self, state: State) -> bool:
        names = {*files_of(state), *files_of(self.old), *files_of(self.new)}
        return all(state.get(name) in (self.old.get(name), self.new.get(name)) for name in names)

    def expect_tidy(self, fault: Fault, where: str) -> None:
        left = list(state_of(self.folder, hidden=True))
        self.expect(not left, fault, f"{where}left behind: {left}")

    def expect(self, holds: object, fault: Fault, text: str) -> None:
        if not holds:
            self.broken.append(f"{fault.kind} {fault.at} ({os.strerror(fault.code)}): {text}")


def _matters(fault: Fault, call: str) -> bool:
    """Leave out what is the same as the fault at the next call, or cannot happen."""
    kind = call.split(maxsplit=1)[0]
    if fault.kind in ("kill", "power"):
        return kind not in ("open_old", "flock", "close", "fsync")
    if fault.kind == "full":
        return kind in SPACE_CALLS
    return fault.code == errno.EIO or kind in PATH_CALLS


def faults(scenario: Scenario) -> Iterator[Fault]:
    """Yield the kinds of fault; each strikes at every call."""
    yield Fault("kill", 0)
    if not scenario.may_be_cut:
        yield Fault("power", 0)
    for code in (errno.EIO, errno.EACCES):
        yield Fault("error", 0, code)
    yield Fault("full", 0)


def explore(name: str) -> dict[str, object]:
    scenario = SCENARIOS[name]()
    # flushing costs nothing in memory; what must be flushed is told by the calls
    place = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(dir=place) as base:
        explorer = Explorer(scenario, Path(base))
        calls: list[str] = []
        for fault in faults(scenario):
            calls = explorer.explore(fault)
            if scenario.swaps and fault.kind in ("kill", "error") and fault.code == errno.EIO:
                explorer.explore(dataclasses.replace(fault, has_renameat2=False))
    return {
        "scenario": name,
        "calls": calls,
        "injected": explorer.injected,
        "broken": explorer.broken,
    }


def once(step: str, name: str, folder: Path) -> None:
    """Do one step of a scenario without a fault; `calls` prints what is counted."""
    scenario = SCENARIOS[name]()
    if step == "prepare":
        scenario.prepare(folder)
    elif step == "save":
        scenario.save(folder)
    else:
        print(json.dumps(run(scenario.save, folder, Fault("none", 0)).calls))


def main() -> None:
    """Explore the scenarios that are named, or all; or do one step: STEP SCENARIO FOLDER."""
    if sys.argv[1:2] in (["prepare"], ["save"], ["calls"]):
        once(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
        return
    for name in sys.argv[1:] or SCENARIOS:
        print(json.dumps(explore(name)), flush=True)


main()
