"""Images of recordings as resources of frames, and resources as an EuRoC folder."""

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.errors import UserError
from maplab_py.interop.images import as_8_bits
from maplab_py.interop.recordings import folders, protocol
from maplab_py.interop.recordings.images import EncodedImage
from maplab_py.interop.resources import matching
from maplab_py.options import Options, option
from maplab_py.output_files import write_bytes, write_text
from maplab_py.progress import SILENT, Progress
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap, resources_of, to_hex

RAW_GREY, RAW_COLOUR = 0, 4
"""Numbers of the resource types of images as recorded."""


class ImageImportOptions(Options):
    """Choice of the images of a recording that become resources."""

    image_tolerance_ms: float = option(1.0, ge=0)
    """Largest difference between the times of image and frame"""
    every_nth: int = option(1, ge=1)
    """Attach images to every n-th vertex only"""
    link: bool = False
    """Refer to the recording's files by symbolic links instead of copying them: the map then needs the
    recording to stay where it is"""


def import_images(
    vi_map: VIMap,
    mission: int,
    folder: Path,
    options: ImageImportOptions | None = None,
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, matching.ImportedResources]:
    """Attach the images of an EuRoC or TUM-VI folder to the frames of a mission (row).

    The k-th camera of the mission gets the images of the folder cam<k>. Frames that have an image
    keep it. Images of 16 bits are reduced to 8, unless they are linked.

    Raises:
        UserError: The folder is no recording, or no image belongs to a frame.
        MapError: An image is missing, damaged, or of another size than the camera.
    """
    options = options or ImageImportOptions()
    root = folders.image_root(folder)
    if root is None:
        raise UserError(f"--dataset_folder={folder}: there is no folder mav0/cam0 or cam0")
    rig = matching.mission_rig(vi_map, mission)
    recording = folders.FolderRecording(root, protocol.RecordedSensors(vi_map.sensors, rig.id))
    images = [item for item in recording.items() if isinstance(item, protocol.CameraImage)]
    new = NewResources(seed=vi_map.missions.id[mission].tobytes())
    rows: list[int] = []
    owners: list[int] = []
    skipped = without = 0
    for camera in range(len(rig.cameras)):
        of_camera = [image for image in images if image.camera == camera]
        frames, files, had_some, unmatched = matching.files_of_frames(
            vi_map,
            mission,
            camera,
            (RAW_GREY, RAW_COLOUR),
            np.array([image.time_ns for image in of_camera], dtype=np.int64),
            options.image_tolerance_ms,
            options.every_nth,
        )
        skipped, without = skipped + had_some, without + unmatched
        for done, row in enumerate(files.tolist()):
            progress.step(done, len(files), f"images of camera {camera}")
            rows.append(add_image(new, of_camera[row], link=options.link))
        owners += frames.tolist()
    if not rows and not skipped:
        raise UserError(
            f"--dataset_folder={folder}: no image is within --image_tolerance_ms="
            f"{options.image_tolerance_ms:g} of a frame of the mission"
        )
    attached = new.attached(vi_map, rows, owners) if rows else vi_map
    mission_id = to_hex(vi_map.missions.id[mission])
    report = matching.ImportedResources(
        mission_id, new.type_names, len(images), len(rows), skipped, without
    )
    return attached, report


def add_image(new: NewResources, image: protocol.CameraImage, *, link: bool) -> int:
    """Add an image of a recording to the new resources, of more bits the upper eight; return its row.

    Raises:
        MapError: The image is missing, damaged, or of another size than the camera's.
    """
    pixels = image.decode()
    kind = RAW_GREY if pixels.ndim == 2 else RAW_COLOUR
    if link and isinstance(image.data, EncodedImage):
        return new.add_link(kind, image.data.read(), Path(image.data.name))
    return new.add_image(as_8_bits(pixels, image.bits), kind)


def export_images(
    vi_map: VIMap,
    map_folder: Path,
    mission: int,
    kind: int,
    folder: Path,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> matching.ExportedImages:
    """Write the images of the frames of a mission (row) as the folders cam0, cam1, ... of an EuRoC folder.

    Args:
        kind: Number of the resource type.
        folder: Gets mav0.

    Raises:
        UserError: The mission has no such images, or a file cannot be written.
        MapError: A file is missing or no image.
    """
    chosen = resources_of(vi_map, (kind,), np.array([mission]))
    chosen &= vi_map.resources.owner_kind == ResourceOwner.FRAME
    resources = np.flatnonzero(chosen)
    if not len(resources):
        name = resource_type(kind).name
        raise UserError(f"the mission has no images of type {name} (see: resource_statistics)")
    frames = vi_map.resources.owner[resources]
    cameras = vi_map.frames.camera_index[frames]
    times_ns = vi_map.frames.timestamp_ns[frames]
    store = ResourceStore(vi_map, map_folder)
    done = 0
    for camera in np.unique(cameras).tolist():
        rows = np.flatnonzero(cameras == camera)
        rows = rows[np.argsort(times_ns[rows], kind="stable")]
        place = folder / "mav0" / f"cam{camera}"
        lines = ["#timestamp [ns],filename\n"]
        for row in rows.tolist():
            progress.step(done, len(resources), "writing images")
            stamp = int(times_ns[row])
            image = encoded_png(store.load(int(resources[row])))
            write_bytes(place / "data" / f"{stamp}.png", [image], overwrite=overwrite)
            lines.append(f"{stamp},{stamp}.png\n")
            done += 1
        write_text(place / "data.csv", lines, overwrite=overwrite)
    return matching.ExportedImages(folder, done, len(np.unique(cameras)))


def encoded_png(image: Any) -> bytes:
    """Return an image (H, W[, 3] BGR) as the bytes of a PNG file."""
    import cv2

    _, data = cv2.imencode(".png", image)
    return bytes(data)
