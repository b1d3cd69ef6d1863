"""Messages to a worker and back: folder names, lines of commands, flags and numbers."""

import dataclasses
from enum import Enum
from pathlib import Path


class Ending(Enum):
    """Outcome of a task."""

    DONE = "done"
    FAILED = "failed"  # may be tried again
    REFUSED = "refused"  # wrong usage: trying again would not help
    OVER_MEMORY = "over_memory"
    LOST = "lost"  # its worker was lost more often than allowed
    CANCELLED = "cancelled"


@dataclasses.dataclass(frozen=True)
class Order:
    """A task as a worker gets it."""

    title: str  # stage and name
    # commands; `<RESULT_FOLDER>` stands for the hidden folder that an attempt writes to
    script: str
    flags: tuple[str, ...]  # lasting flags, `--name=value`
    inputs: tuple[Path, ...]  # map folders that it reads
    folder: Path  # folder in which the program runs; relative paths in commands are relative to it
    # folder that the new result replaces; None where the commands save their input
    result: Path | None
    log: Path  # file to which its notes and errors are appended
    reports: Path  # file to which its reports are written, one line of JSON per command
    version: str  # version of maplab-py that must run it
    memory_gb: float  # it is stopped when it takes more [GB]; 0 = no limit
    threads: int  # threads that it may use; 0 = the processors divided by `tasks_per_host`
    tasks_per_host: int  # tasks that run on a machine at the same time
    keep_going: bool  # go on after a command that fails
    discard: bool  # the maps may be left unsaved


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of an order."""

    title: str  # stage and name of the task
    ending: Ending  # how it ended
    error: str = ""  # one line, empty where it is done
    seconds: float = 0.0  # run time [s]
    peak_gb: float = 0.0  # largest resident memory [GB]; 0 where the system does not tell
    worker: str = ""  # who ran it
