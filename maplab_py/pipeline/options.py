"""Options of a pipeline run."""

from pathlib import Path

from maplab_py.errors import FlagError
from maplab_py.options import Options, option


class PipelineOptions(Options):
    """Workers of a pipeline, and treatment of tasks that fail."""

    scheduler: str = "none"
    """Place of the tasks: none (one after another), local:N (N processes of this machine) or tcp://HOST:PORT
    (a Dask scheduler with its workers)."""
    retries: int = option(1, ge=0)
    """Further attempts at a task that failed other than by wrong usage."""
    resume: bool = False
    """Keep the tasks that an earlier run finished; run only the others."""
    redo_changed: bool = False
    """With --resume, run tasks again whose commands, flags or version have changed."""
    restart: bool = False
    """Replace the results of an earlier run."""
    results_folder: Path | None = None
    """Folder of results, logs and reports; empty = the file's name with _results."""
    task_memory_gb: float = option(0.0, ge=0)
    """A task that takes more is stopped and run once more alone; 0 = its share of the memory."""
    task_threads: int = option(0, ge=0)
    """Threads of a task; 0 = its share of the processors."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.local_workers()
        if self.resume and self.restart:
            raise FlagError("--resume and --restart contradict each other: give one of them")
        if self.redo_changed and not self.resume:
            raise FlagError("--redo_changed needs --resume")

    def local_workers(self) -> int:
        """Return N of `local:N`, 0 for other schedulers.

        Raises:
            FlagError: The scheduler is none of the three kinds.
        """
        kind, _, rest = self.scheduler.partition(":")
        if self.scheduler == "none" or (kind in ("tcp", "tls") and len(rest) > 2):
            return 0
        if kind == "local" and rest.isdigit() and int(rest) > 0:
            return int(rest)
        raise FlagError(f"--scheduler={self.scheduler}: wants none, local:N or tcp://HOST:PORT")
