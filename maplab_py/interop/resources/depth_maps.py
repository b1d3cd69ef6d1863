"""Depth maps of other programs as resources of frames.

A depth map of the format is a 16-bit image of the size of the camera's images: depth along the
optical axis in millimetres at the pixels of the camera's own, distorted image; 0 = unknown.
"""

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F32, NDArray
from maplab_py.errors import MapError, UserError, os_errors_as
from maplab_py.input_files import read_bytes
from maplab_py.interop.resources import matching
from maplab_py.options import Options, option
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import Camera
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import VIMap, to_hex

RAW_DEPTH_MAPS = 8
"""Number of the resource type of depth maps as measured."""
MM_PER_M = 1000.0
_MAX_FILE_BYTES = 200_000_000


class DepthImportOptions(Options):
    """Conversion of files to depth maps."""

    depth_scale: float = option(MM_PER_M, gt=0)
    """Value of a pixel at a depth of one metre"""
    image_tolerance_ms: float = option(1.0, ge=0)
    """Largest difference between the times of depth map and frame"""


def import_depth_maps(
    vi_map: VIMap,
    mission: int,
    camera: int,
    folder: Path,
    options: DepthImportOptions | None = None,
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, matching.ImportedResources]:
    """Attach depth images (16-bit PNG, named by time stamp) to the frames of a camera of a mission (row).

    Depths must be along the optical axis, at the pixels of the camera's distorted image.

    Args:
        camera: Index of the camera in its rig.
        folder: Has the files <time stamp in ns>.png.

    Raises:
        UserError: There are no files, no such camera, or no file belongs to a frame.
        MapError: A file is damaged, or of another size than the camera's images.
    """
    options = options or DepthImportOptions()
    cameras = matching.mission_rig(vi_map, mission).cameras
    if not 0 <= camera < len(cameras):
        raise UserError(f"--camera={camera}: the mission has cameras 0 to {len(cameras) - 1}")
    times, files = matching.stamped_files(folder, (".png",), "--depth_folder")
    offset_ns, kinds = cameras[camera].time_offset_ns, (RAW_DEPTH_MAPS,)
    tolerance_ms = options.image_tolerance_ms
    frames, chosen, had_some, without = matching.files_of_frames(
        vi_map, mission, camera, kinds, times + offset_ns, tolerance_ms
    )
    if not len(frames) and not had_some:
        raise UserError(
            f"--depth_folder={folder}: no file is within --image_tolerance_ms={tolerance_ms:g} of a frame of "
            f"camera {camera}"
        )
    new = NewResources(seed=vi_map.missions.id[mission].tobytes())
    for done, row in enumerate(chosen.tolist()):
        progress.step(done, len(chosen), "depth maps")
        depth_m = _read_depth(files[row], cameras[camera], options.depth_scale)
        new.add(RAW_DEPTH_MAPS, encoded_depth(depth_m))
    rows = np.arange(len(frames))
    attached = new.attached(vi_map, rows, frames) if len(rows) else vi_map
    return attached, matching.ImportedResources(
        to_hex(vi_map.missions.id[mission]),
        (resource_type(RAW_DEPTH_MAPS).name,),
        len(files),
        len(rows),
        had_some,
        without,
    )


def encoded_depth(depth_m: NDArray[np.floating[Any]]) -> bytes:
    """Return depths (H, W) [m] as a 16-bit PGM file in millimetres; 0 where they are not known.

    Depths beyond 65.535 m, and those that are not positive and finite, are written as unknown.
    """
    import cv2

    millimetres = np.round(MM_PER_M * np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0))
    known = (millimetres > 0) & (millimetres <= np.iinfo(np.uint16).max)
    _, data = cv2.imencode(".pgm", np.where(known, millimetres, 0).astype(np.uint16))
    return bytes(data)


def _read_depth(path: Path, camera: Camera, scale: float) -> F32:
    """Return the depths (H, W) [m] of a file."""
    import cv2

    with os_errors_as(MapError, f"{path}: the depth image cannot be read"):
        data = read_bytes(path, _MAX_FILE_BYTES, remedy="it is no depth image", error=MapError)
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_UNCHANGED
    pixels: Any = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    if pixels is None:
        raise MapError(f"{path}: the depth image is damaged; copy it again")
    if pixels.ndim != 2 or pixels.dtype != np.uint16:
        raise MapError(f"{path}: a depth image has one channel of 16 bits: convert it")
    if pixels.shape != (camera.height_px, camera.width_px):
        raise MapError(
            f"{path}: the depth image is {pixels.shape[1]} x {pixels.shape[0]}, the images of the "
            f"camera are {camera.width_px} x {camera.height_px}: export depth in the camera's pixels"
        )
    return np.asarray(pixels / np.float32(scale), dtype=np.float32)
