"""Run pycolmap in a child process."""

import logging
from pathlib import Path

from maplab_py.cancellation import check_cancelled, cleaned_up
from maplab_py.child_processes import Service, ServiceEnded, processors
from maplab_py.errors import MapError
from maplab_py.interop.colmap import child, writing
from maplab_py.interop.colmap.model import ColmapModel

logger = logging.getLogger(__name__)

_FAILURES = {
    "write_text": "the model cannot be written as text: give --colmap_format=binary",
    "undistort": "a camera of the model cannot be undistorted: let COLMAP undistort it (image_undistorter)",
    "database": "the database cannot be written: leave out --colmap_database",
}


def write_job_model(model: ColmapModel, folder: Path) -> None:
    """Write a model for a job: the folder `binary` below the job's folder, which is temporary."""
    (folder / child.BINARY).mkdir()
    for name, content in writing.binary_files(model).items():
        with (folder / child.BINARY / name).open("wb") as stream:
            stream.writelines(content)


def run_job(job: str, folder: Path, source: Path) -> None:
    """Run a job of `child` on a folder, until it ends or the command is cancelled.

    Args:
        job: Name of a function of `child`.
        folder: Folder with the job's files.
        source: What the user named, for messages.

    Raises:
        MapError: pycolmap refuses the files, or dies.
    """
    log = folder / f"{job}.log"
    with log.open("wb") as errors:
        service = Service("maplab_py.interop.colmap.child", threads=processors(), stderr=errors)
    with cleaned_up(service.end):
        try:
            refusal, failure = service.ask((job, folder), _is_cancelled)
        except ServiceEnded as end:
            refusal, failure = "", str(end)
    if refusal or failure:
        text = log.read_text(errors="replace").strip()
        logger.info("pycolmap cannot do %s of %s: %s %s", job, source, refusal or failure, text)
        raise MapError(f"{source}: {refusal or _FAILURES[job]}")


def _is_cancelled() -> bool:
    check_cancelled()
    return False
