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
    """A task as a worker gets it.

    Attributes:
        title: Stage and name.
        script: Commands; `<RESULT_FOLDER>` stands for the hidden folder that an attempt writes to.
        flags: Lasting flags, `--name=value`.
        inputs: Map folders that it reads.
        folder: Folder in which the program runs; relative paths in commands are relative to it.
        result: Folder that the new result replaces; None where the commands save their input.
        log: File to which its notes and errors are appended.
        reports: File to which its reports are written, one line of JSON per command.
        version: Version of maplab-py that must run it.
        memory_gb: It is stopped when it takes more [GB]; 0 = no limit.
        threads: Threads that it may use; 0 = the processors divided by `tasks_per_host`.
        tasks_per_host: Tasks that run on a machine at the same time.
        keep_going: Go on after a command that fails.
        discard: The maps may be left unsaved.
    """

    title: str
    script: str
    flags: tuple[str, ...]
    inputs: tuple[Path, ...]
    folder: Path
    result: Path | None
    log: Path
    reports: Path
    version: str
    memory_gb: float
    threads: int
    tasks_per_host: int
    keep_going: bool
    discard: bool


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of an order.

    Attributes:
        title: Stage and name of the task.
        ending: How it ended.
        error: One line, empty where it is done.
        seconds: Run time [s].
        peak_gb: Largest resident memory [GB]; 0 where the system does not tell.
        worker: Who ran it.
    """

    title: str
    ending: Ending
    error: str = ""
    seconds: float = 0.0
    peak_gb: float = 0.0
    worker: str = ""
