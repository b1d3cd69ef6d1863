"""Write a map's images, poses and landmarks as a dense workspace of COLMAP or a folder of PMVS."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.dense import pinhole as pinholes
from maplab_py.algorithms.dense.resources import IMAGES, FrameImages, FrameResources, check_size
from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop import mvs
from maplab_py.output_files import check_writable, write_bytes, write_text
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors import Camera, projection
from maplab_py.vimap import LandmarkQuality, ResourceOwner, VIMap, resources_of, to_hex

_GREY = 128
_SOURCES = 20
"""Source images per reference image in COLMAP's patch match."""
_IMAGE_SUFFIXES = (".ppm", ".jpg")


class MvsExport(Report):
    """Files written for multi-view stereo."""

    folder: Path
    images: int
    cameras: int
    points: int
    observations: int
    median_error_px: float  # of the points in the undistorted images


def write_colmap_workspace(
    views: UndistortedViews,
    folder: Path,
    *,
    only_good: bool = True,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> MvsExport:
    """Write a dense workspace: images, sparse model and the settings of patch match and fusion.

    `colmap patch_match_stereo --workspace_path=...` and `stereo_fusion` work on it.

    Raises:
        UserError: A file exists and `overwrite` is not set, or cannot be written.
        MapError: An image is missing or damaged.
        Cancelled: The user wants to stop.
    """
    names = [_colmap_name(views, view) for view in range(len(views))]
    check_writable(folder / "sparse" / "cameras.bin", overwrite=overwrite)
    scene = views.scene(names, only_good=only_good)
    for view, image in _images(views, progress):
        write_bytes(folder / "images" / names[view], [_encode(image, ".png")], overwrite=overwrite)
        _paint(scene, image, view)
    for name, content in mvs.encode_model(scene).items():
        write_bytes(folder / "sparse" / name, [content], overwrite=overwrite)
    settings = (f"{name}\n__auto__, {_SOURCES}\n" for name in names)
    write_text(folder / "stereo" / "patch-match.cfg", settings, overwrite=overwrite)
    fused = (f"{name}\n" for name in names)
    write_text(folder / "stereo" / "fusion.cfg", fused, overwrite=overwrite)
    for name in ("depth_maps", "normal_maps", "consistency_graphs"):
        _keep(folder / "stereo" / name, overwrite=overwrite)
    return _report(folder, views, scene)


def write_pmvs_folder(
    views: UndistortedViews,
    folder: Path,
    *,
    image_format: str = "ppm",
    only_good: bool = True,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> MvsExport:
    """Write images, projection matrices and a Bundler file for CMVS and PMVS-2.

    Raises:
        UserError: The format is not known, a file exists, or cannot be written.
        MapError: An image is missing or damaged.
        Cancelled: The user wants to stop.
    """
    suffix = f".{image_format}"
    if suffix not in _IMAGE_SUFFIXES:
        known = ", ".join(name[1:] for name in _IMAGE_SUFFIXES)
        raise UserError(f"--pmvs_image_format={image_format}: choose one of {known}")
    check_writable(folder / "bundle.rd.out", overwrite=overwrite)
    names = [mvs.file_number(view) + suffix for view in range(len(views))]
    scene = views.scene(names, only_good=only_good)
    for view, image in _images(views, progress):
        content = _encode(_three_channels(image), suffix)
        write_bytes(folder / "visualize" / names[view], [content], overwrite=overwrite)
        matrix = folder / "txt" / f"{mvs.file_number(view)}.txt"
        write_text(matrix, [mvs.projection_text(scene, view)], overwrite=overwrite)
        _paint(scene, image, view)
    for name, text in (
        ("list.rd.txt", mvs.list_text(names)),
        ("option-all", mvs.option_text(len(names))),
        ("bundle.rd.out", mvs.bundler_text(scene)),
    ):
        write_text(folder / name, [text], overwrite=overwrite)
    _keep(folder / "models", overwrite=overwrite)
    return _report(folder, views, scene)


def _errors_px(scene: mvs.MvsScene) -> F64:
    """Return the mean reprojection error (L,) [px] of the points."""
    p_C = se3.transform(scene.T_C_G[scene.view], scene.p_G[scene.landmark])
    K = scene.K[scene.camera[scene.view]]
    z = np.maximum(p_C[:, 2:], 1e-6)
    error = np.linalg.norm(K[:, :2] * p_C[:, :2] / z + K[:, 2:] - scene.uv_px, axis=1)
    count = np.maximum(np.bincount(scene.landmark, minlength=len(scene.p_G)), 1)
    return np.asarray(np.bincount(scene.landmark, error, minlength=len(scene.p_G)) / count)


def _images(views: UndistortedViews, progress: Progress) -> Iterator[tuple[int, Any]]:
    for view in range(len(views)):
        progress.step(view, len(views), "undistorting images")
        yield view, views.image(view)


def _paint(scene: mvs.MvsScene, image: Any, view: int) -> None:
    """Give the points that an image shows the colours of their pixels."""
    rows = np.flatnonzero(scene.view == view)
    u, v = np.round(scene.uv_px[rows]).astype(np.int64).T
    scene.colours[scene.landmark[rows]] = _three_channels(image)[v, u, ::-1]


def _three_channels(image: Any) -> Any:
    return np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image


def _encode(image: Any, suffix: str) -> bytes:
    import cv2

    return bytes(cv2.imencode(suffix, image)[1])


def _colmap_name(views: UndistortedViews, view: int) -> str:
    """Return the file of an image: mission, camera and time stamp."""
    vi_map, frame = views.vi_map, int(views.frames[view])
    mission = int(vi_map.vertices.mission[vi_map.frames.vertex[frame]])
    name = to_hex(vi_map.missions.id[mission])[:8]
    camera = int(vi_map.frames.camera_index[frame])
    return f"{name}_cam{camera}_{int(vi_map.frames.timestamp_ns[frame])}.png"


def _keep(folder: Path, *, overwrite: bool) -> None:
    """Make a folder that the other program writes into: it gets an empty file."""
    write_bytes(folder / ".keep", [b""], overwrite=overwrite)


def _report(folder: Path, views: UndistortedViews, scene: mvs.MvsScene) -> MvsExport:
    error = float(np.median(scene.error_px)) if len(scene.p_G) else 0.0
    return MvsExport(
        folder,
        len(scene.names),
        len(views.cameras),
        len(scene.p_G),
        len(scene.landmark),
        error,
    )


@dataclasses.dataclass(frozen=True)
class UndistortionOptions:
    """Size of undistorted images."""

    alpha: float = 0.0  # 0 = valid pixels only, 1 = all pixels of the recorded image
    scale: float = 1.0
    max_size_px: int = 0  # of the longer side; 0 = no limit


class UndistortedViews:
    """The frames of missions that have an image, as perspective cameras."""

    def __init__(
        self,
        vi_map: VIMap,
        map_folder: Path,
        missions: I64 | None,
        options: UndistortionOptions,
        *,
        every_nth: int = 1,
    ) -> None:
        """Choose the frames with images at every n-th vertex of each mission.

        Raises:
            UserError: There is none.
            MapError: A camera is not in sensors.yaml.
        """
        self.vi_map = vi_map
        self._images = FrameImages(vi_map, map_folder)
        self._resources = FrameResources(vi_map, map_folder)
        self.frames = _frames_with_images(vi_map, missions, every_nth)
        if not len(self.frames):
            raise UserError("the chosen missions have no images: import_images attaches some")
        self.cameras: list[Camera] = []
        rows: dict[str, int] = {}
        of_frame = []
        for frame in self.frames.tolist():
            camera = self._resources.camera(frame)
            if camera.id not in rows:
                rows[camera.id] = len(self.cameras)
                self.cameras.append(camera)
            of_frame.append(rows[camera.id])
        self.camera_of_view = np.array(of_frame, dtype=np.int64)
        made = [perspective(camera, options) for camera in self.cameras]
        self.pinholes: list[pinholes.Pinhole] = [pinhole for pinhole, _ in made]
        self._maps = [image_map for _, image_map in made]
        self.T_C_G = se3.inverse(np.stack([self._resources.T_G_C(f) for f in self.frames.tolist()]))

    def __len__(self) -> int:
        return len(self.frames)

    def image(self, view: int) -> Any:
        """Return the undistorted image (H, W) or (H, W, 3) BGR of a view, 8 bits.

        Raises:
            MapError: The file is missing, no image, or of another size than the camera's images.
        """
        frame, camera = int(self.frames[view]), int(self.camera_of_view[view])
        image: Any = self._images.image(frame)
        name = f"the image of frame {to_hex(self.vi_map.frames.id[frame])}"
        check_size(name, image, self.cameras[camera])
        return self._maps[camera].image(image)

    def scene(self, names: list[str], *, only_good: bool = True) -> mvs.MvsScene:
        """Return the views, and the landmarks that they observe, at least two each, still grey.

        Observations outside an undistorted image are left out. The quality of landmarks is evaluated where
        it is unknown.

        Args:
            names: Files (V,) of the images.
        """
        vi_map = evaluate_unknown_quality(self.vi_map, SILENT)[0] if only_good else self.vi_map
        view_of_frame = np.full(len(vi_map.frames), -1, dtype=np.int64)
        view_of_frame[self.frames] = np.arange(len(self.frames))
        view = view_of_frame[vi_map.keypoint_frame]
        landmark = vi_map.keypoints.landmark.astype(np.int64)
        chosen = (view >= 0) & (landmark >= 0)
        if only_good:
            is_good = vi_map.landmarks.quality == LandmarkQuality.GOOD
            chosen[chosen] &= is_good[landmark[chosen]]
        rows = np.flatnonzero(chosen)
        uv, inside = self._undistort(view[rows], vi_map.keypoints.uv_px[rows])
        rows, uv = rows[inside], uv[inside]
        count = np.bincount(landmark[rows], minlength=len(vi_map.landmarks))
        often = count[landmark[rows]] >= 2
        rows, uv = rows[often], uv[often]
        kept, number = np.unique(landmark[rows], return_inverse=True)
        scene = mvs.MvsScene(
            np.array([[p.width_px, p.height_px] for p in self.pinholes], dtype=np.int64),
            np.array([[p.focal_px, p.focal_px, *p.centre_px] for p in self.pinholes]),
            self.camera_of_view,
            names,
            self.T_C_G,
            vi_map.p_G[kept],
            np.full((len(kept), 3), _GREY, dtype=np.uint8),
            number.reshape(-1),
            view[rows],
            uv,
            np.zeros(len(kept)),
        )
        return dataclasses.replace(scene, error_px=_errors_px(scene))

    def _undistort(self, view: I64, uv_px: F64) -> tuple[F64, Any]:
        """Return keypoints (N, 2) in the undistorted images, and which are inside."""
        result = np.zeros((len(view), 2))
        inside = np.zeros(len(view), dtype=np.bool_)
        camera_of_row = self.camera_of_view[view]
        for number, camera in enumerate(self.cameras):
            rows = np.flatnonzero(camera_of_row == number)
            rays, valid = projection.back_project(camera, uv_px[rows])
            pinhole = self.pinholes[number]
            u, v, in_front = pinhole.pixels(rays)
            result[rows] = np.stack([u, v], axis=1)
            inside[rows] = valid & in_front & (u >= 0) & (v >= 0)
            inside[rows] &= (u <= pinhole.width_px - 1) & (v <= pinhole.height_px - 1)
        return result, inside


def perspective(
    camera: Camera, options: UndistortionOptions
) -> tuple[pinholes.Pinhole, pinholes.ImageMap]:
    """Return a perspective camera on the axis of a camera, and where its pixels lie in the recorded image.

    Between alpha = 0 (no pixel without image) and 1 (all of the image) the borders move linearly.
    """
    inner = pinholes.inscribed([(camera, np.eye(3))], camera.width_px, camera.height_px)
    outer, _ = pinholes.undistorted(camera)
    low, high = (
        (1.0 - options.alpha) * a + options.alpha * b
        for a, b in zip(_borders(inner), _borders(outer), strict=True)
    )
    scale = options.scale
    longest = scale * inner.focal_px * float(np.max(high - low)) + 1.0
    if options.max_size_px and longest > options.max_size_px:
        scale *= (options.max_size_px - 1.0) / (longest - 1.0)
    focal = scale * inner.focal_px
    width, height = (np.floor(focal * (high - low) + 1e-6) + 1.0).astype(int).tolist()
    centre = -focal * low
    pinhole = pinholes.Pinhole(focal, (float(centre[0]), float(centre[1])), width, height)
    return pinhole, pinholes.map_to_camera(pinhole, camera, np.eye(3))


def _borders(pinhole: pinholes.Pinhole) -> tuple[F64, F64]:
    """Return the points on the plane z = 1 of the first and of the last pixel."""
    centre = np.array(pinhole.centre_px)
    size = np.array([pinhole.width_px - 1.0, pinhole.height_px - 1.0])
    return -centre / pinhole.focal_px, (size - centre) / pinhole.focal_px


def _frames_with_images(vi_map: VIMap, missions: I64 | None, every_nth: int) -> I64:
    """Return the frames (rows) with an image, by mission, time and camera."""
    table = vi_map.resources
    owned = resources_of(vi_map, IMAGES, missions) & (table.owner_kind == ResourceOwner.FRAME)
    frames = np.unique(table.owner[owned]).astype(np.int64)
    frames = frames[vi_map.frames.is_valid[frames]]
    vertex = vi_map.frames.vertex[frames].astype(np.int64)
    place = vertex - vi_map.vertex_start[:-1][vi_map.vertices.mission[vertex]]
    chosen = place % every_nth == 0
    order = np.lexsort((vi_map.frames.camera_index[frames[chosen]], vertex[chosen]))
    return np.asarray(frames[chosen][order])
