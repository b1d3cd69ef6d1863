"""Read the model of a folder, in either format."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from maplab_py.errors import MapError, UserError
from maplab_py.interop.colmap.binary_reading import REMEDY, read_binary
from maplab_py.interop.colmap.checking import check_model
from maplab_py.interop.colmap.child import BINARY, TEXT
from maplab_py.interop.colmap.child_process import run_job
from maplab_py.interop.colmap.model import FILES, ColmapModel

_ANNOUNCED = re.compile(r"# Number of \w+: (\d+)")
_HEADER_BYTES = 4096


def read_model(folder: Path) -> ColmapModel:
    """Read and check a model; binary files come before text files, as in COLMAP.

    Raises:
        UserError: The folder has no model.
        MapError: A file is missing, damaged, or does not fit the others.
    """
    if not folder.is_dir():
        raise UserError(f"--colmap_folder={folder}: no such folder")
    if (folder / "images.bin").exists() or (folder / "cameras.bin").exists():
        model = read_binary(folder)
    elif (folder / "images.txt").exists():
        model = _read_text(folder)
    else:
        inner = sorted(path.parent.name for path in folder.glob("*/images.bin"))
        hint = f"; it has models in {', '.join(inner)}" if inner else ""
        raise UserError(
            f"--colmap_folder={folder}: has no COLMAP model (cameras, images, points3D as .bin or .txt){hint}"
        )
    check_model(model, folder)
    return model


def _read_text(folder: Path) -> ColmapModel:
    """Let pycolmap convert the text, and compare the result with what the files announce."""
    with tempfile.TemporaryDirectory(prefix="maplab-colmap-") as name:
        work = Path(name)
        (work / TEXT).mkdir()
        for kind in FILES:
            path = folder / f"{kind}.txt"
            if path.is_file():
                (work / TEXT / path.name).symlink_to(path.resolve())
            elif kind not in ("rigs", "frames"):
                raise MapError(f"cannot read {path}: it is not there; {REMEDY}")
        run_job("write_binary", work, folder)
        model = read_binary(work / BINARY)
    counts = {
        "cameras": len(model.cameras),
        "rigs": len(model.rigs),
        "frames": len(model.frames.id),
        "images": len(model.images.id),
        "points3D": len(model.points.id),
    }
    for kind, count in counts.items():
        path = folder / f"{kind}.txt"
        wanted = _announced(path)
        if wanted is not None and wanted != count:
            raise MapError(
                f"{path}: is damaged: it announces {wanted} records and has {count}; {REMEDY}"
            )
    return model


def _announced(path: Path) -> int | None:
    """Return the number of records that the head of a text file tells, None if it does not."""
    if not path.is_file():
        return None
    with path.open("rb") as stream:
        match = _ANNOUNCED.search(stream.read(_HEADER_BYTES).decode("utf-8", errors="replace"))
    return int(match[1]) if match else None
