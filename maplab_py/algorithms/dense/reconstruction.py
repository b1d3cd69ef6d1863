"""Depth of the stereo images along the vertices of missions, as new resources of the map."""

from __future__ import annotations

import dataclasses
import math
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense.clouds import CloudMaker
from maplab_py.algorithms.dense.depth_matcher import DepthMatcher, without_edges
from maplab_py.algorithms.dense.options import BmOptions, SgbmOptions, StereoOptions
from maplab_py.algorithms.dense.rectification import StereoPair, pinhole_pose, stereo_pairs
from maplab_py.algorithms.dense.resources import (
    COLOUR_CLOUDS,
    RAW_DEPTH_MAPS,
    FrameImages,
    FrameResources,
    chosen_missions,
    mission_rig,
)
from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.array_types import F32, F64, I64, U8, Mask
from maplab_py.compilation import compiled, prange
from maplab_py.errors import UserError
from maplab_py.interop.ply import encode_ply
from maplab_py.interop.resources.depth_maps import encoded_depth
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import (
    LandmarkQuality,
    ResourceOwner,
    VIMap,
    resources_of,
    to_hex,
    without_resources,
)

OUTPUT_TYPES = (RAW_DEPTH_MAPS, COLOUR_CLOUDS)
_NEIGHBOURS_EACH_WAY = 3
_LEAST_LANDMARKS, _INLIER_PX, _NEAR_QUANTILE = 200, 3.0, 0.02
"""Observations that tell the depth of a scene, and the share of them that may be wrong and too near."""


@dataclasses.dataclass(frozen=True)
class PairReport:
    """Depth of one stereo pair of a mission."""

    mission: str
    left_camera: int
    right_camera: int
    vertices: int
    without_images: int
    disparities_px: int
    nearest_m: float  # surfaces nearer than this have no depth
    matched_share: float  # of the rectified pixels, before neighbouring vertices are asked
    kept_share: float  # after that, without edges


class StereoReport(Report):
    """Depth of stereo images; the files are written when the map is saved."""

    resource_type: str
    resources: int
    pairs: tuple[PairReport, ...]
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class StereoSettings:
    """All options of the reconstruction."""

    stereo: StereoOptions = dataclasses.field(default_factory=StereoOptions)
    sgbm: SgbmOptions = dataclasses.field(default_factory=SgbmOptions)
    bm: BmOptions = dataclasses.field(default_factory=BmOptions)


def reconstruct_stereo(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None = None,
    settings: StereoSettings | None = None,
    *,
    output_type: int = RAW_DEPTH_MAPS,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> tuple[VIMap, StereoReport]:
    """Compute depth for every vertex that has images of a stereo pair.

    Args:
        missions: Rows of missions; None = all.
        output_type: Number of the resource type of the results, one of OUTPUT_TYPES.

    Raises:
        UserError: There are no images or no stereo pair, or a frame has depth already.
        MapError: An image is missing, damaged, or of another size than the camera's images.
    """
    settings = settings or StereoSettings()
    if output_type not in OUTPUT_TYPES:
        names = " or ".join(str(kind) for kind in OUTPUT_TYPES)
        raise UserError(f"--dense_depth_resource_output_type={output_type}: wants {names}")
    rows = chosen_missions(vi_map, missions)
    writer = _Writer(FrameResources(vi_map, map_folder), output_type)
    images = FrameImages(vi_map, map_folder)
    reports, notes = [], list[str]()
    for mission in rows:
        for pair in _pairs(vi_map, mission, settings.stereo, notes):
            sequence = _Sequence(vi_map, mission, pair, images, settings.stereo)
            if not len(sequence.vertices):
                continue
            writer.check_free(sequence.left_frames, overwrite=overwrite)
            reports.append(_reconstruct(sequence, writer, settings, progress))
    if not reports:
        reason = notes[0] if notes else "import_images attaches some"
        raise UserError(f"no vertex has images of a stereo pair: {reason}")
    name = resource_type(output_type).name
    report = StereoReport(name, len(writer.owners), tuple(reports), tuple(notes))
    return writer.attached(overwrite=overwrite), report


def _pairs(
    vi_map: VIMap, mission: int, options: StereoOptions, notes: list[str]
) -> list[StereoPair]:
    rig = mission_rig(vi_map, mission)
    prefix = f"mission {to_hex(vi_map.missions.id[mission])[:8]}: "
    if rig is None or len(rig.cameras) < 2:
        notes.append(f"{prefix}it has {0 if rig is None else 1} camera, stereo needs two")
        return []
    pairs, reasons = stereo_pairs(
        rig,
        min_baseline_m=options.min_baseline,
        max_angle_rad=options.max_angle_between_opt_axes,
        scale=options.downscaling_factor,
    )
    notes += [prefix + reason for reason in reasons]
    return pairs


class _Sequence:
    """The vertices of a mission that have images of both cameras of a pair."""

    def __init__(
        self,
        vi_map: VIMap,
        mission: int,
        pair: StereoPair,
        images: FrameImages,
        options: StereoOptions,
    ) -> None:
        self.vi_map, self.mission, self.pair, self.images = vi_map, mission, pair, images
        first, end = vi_map.vertex_start[mission : mission + 2].tolist()
        part = options.debug_reconstruction_start_fraction_of_trajectory
        start = first + math.floor(part * (end - first))
        part = options.debug_reconstruction_end_fraction_of_trajectory
        stop = first + math.ceil(part * (end - first))
        chosen, frames = [], []
        for vertex in range(start, stop):
            rows = range(*vi_map.frame_start[vertex : vertex + 2].tolist())
            of_camera = {int(vi_map.frames.camera_index[row]): row for row in rows}
            both = [of_camera.get(pair.left, -1), of_camera.get(pair.right, -1)]
            if all(frame in images for frame in both):
                chosen.append(vertex)
                frames.append(both)
        self.without_images = stop - start - len(chosen)
        self.vertices = np.array(chosen, dtype=np.int64)
        self.frames = np.array(frames, dtype=np.int64).reshape(-1, 2)

    @property
    def left_frames(self) -> I64:
        return self.frames[:, 0]

    @property
    def near_m(self) -> float:
        """Depth of the nearest landmarks in the left images; infinite where there are too few."""
        vi_map = self.vi_map
        of_frame = np.zeros(len(vi_map.frames), dtype=np.bool_)
        of_frame[self.left_frames] = True
        keypoints = np.flatnonzero(
            of_frame[vi_map.keypoint_frame] & (vi_map.keypoints.landmark >= 0)
        )
        landmark = vi_map.keypoints.landmark[keypoints]
        good = vi_map.landmarks.quality[landmark] != LandmarkQuality.BAD
        if np.count_nonzero(good) < _LEAST_LANDMARKS:
            return float("inf")
        compared = residuals(vi_map, keypoints[good], vi_map.p_G[landmark[good]])
        inliers = (compared.signed_distance_m > 0.0) & (compared.error_px < _INLIER_PX)
        depth_m = compared.signed_distance_m[inliers]
        return float(np.quantile(depth_m, _NEAR_QUANTILE)) if len(depth_m) else float("inf")

    def neighbour_offsets(self, interval_s: float) -> list[int]:
        """Return the steps to the neighbours that are asked, nearest first."""
        times_ns = self.vi_map.vertices.timestamp_ns[self.vertices]
        typical_s = 1e-9 * float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 1.0
        step = max(1, round(interval_s / max(typical_s, 1e-6)))
        return [sign * step * k for k in range(1, 1 + _NEIGHBOURS_EACH_WAY) for sign in (-1, 1)]


def _reconstruct(
    sequence: _Sequence, writer: _Writer, settings: StereoSettings, progress: Progress
) -> PairReport:
    vi_map, pair = sequence.vi_map, sequence.pair
    what = f"depth of cameras {pair.left} and {pair.right}"
    matched, kept = 0.0, 0.0
    count = len(sequence.vertices)
    matcher = DepthMatcher(pair, settings.stereo, settings.sgbm, settings.bm, sequence.near_m)
    depths = _raw_depths(sequence, writer.resources, matcher)
    if settings.stereo.multi_view:
        poses = np.stack(
            [pinhole_pose(pair, writer.resources.T_G_C(f)) for f in sequence.left_frames.tolist()]
        )
        offsets = sequence.neighbour_offsets(settings.stereo.multi_view_interval_s)
        checked = _confirm(depths, poses, offsets, pair, settings.stereo)
    else:
        checked = ((depth, depth) for depth in depths)
    for index, (raw, confirmed) in enumerate(checked):
        progress.step(index, count, what)
        depth = without_edges(confirmed, settings.stereo.edge_margin)
        matched += float(np.mean(raw > 0.0)) / count
        kept += float(np.mean(depth > 0.0)) / count
        frame = int(sequence.left_frames[index])
        writer.add(frame, pair.depth_of_left(depth), sequence.images)
    mission_id = to_hex(vi_map.missions.id[sequence.mission])
    return PairReport(
        mission_id,
        pair.left,
        pair.right,
        count,
        sequence.without_images,
        matcher.disparities_px,
        matcher.nearest_m,
        matched,
        kept,
    )


def _raw_depths(
    sequence: _Sequence, resources: FrameResources, matcher: DepthMatcher
) -> Iterator[F32]:
    """Yield the rectified depths (H, W) of the vertices in order."""
    for frames in sequence.frames.tolist():
        left, right = (sequence.images.grey(f, resources.camera(f)) for f in frames)
        yield matcher.depth(left, right)


def _confirm(
    depths: Iterator[F32],
    T_G_P: F64,
    offsets: list[int],
    pair: StereoPair,
    options: StereoOptions,
) -> Iterator[tuple[F32, F32]]:
    """Yield each depth map as it is, and with the pixels only that enough neighbours confirm.

    Where there are fewer neighbours than must agree, all of them must.

    Args:
        depths: Rectified depths (H, W) [m] of consecutive vertices.
        T_G_P: Poses (N, 4, 4) of the rectified cameras.
        offsets: Steps to the neighbours.
        options: How many must agree, and how well.
    """
    pinhole = pair.pinhole
    camera = np.array([pinhole.focal_px, *pinhole.centre_px, pinhole.focal_px * pair.baseline_m])
    reach, count = max(offsets), len(T_G_P)
    window: OrderedDict[int, F32] = OrderedDict()
    for index in range(count):
        while len(window) == 0 or (next(reversed(window)) < min(index + reach, count - 1)):
            window[next(reversed(window)) + 1 if window else 0] = next(depths)
        depth = window[index]
        votes = np.zeros(depth.shape, dtype=np.uint8)
        neighbours = [index + offset for offset in offsets if 0 <= index + offset < count]
        for other in neighbours:
            T_other_P = np.linalg.inv(T_G_P[other]) @ T_G_P[index]
            difference_px = options.multi_view_max_difference
            count_agreeing(depth, window[other], camera, T_other_P, difference_px, votes)
        needed = min(options.multi_view_min_agreeing, len(neighbours))
        yield depth, np.where(votes >= needed, depth, np.float32(0.0))
        if index >= reach:
            del window[index - reach]


class _Writer:
    """Collects the results as new resources."""

    def __init__(self, resources: FrameResources, output_type: int) -> None:
        self.resources = resources
        self.owners: list[int] = []
        self._type = output_type
        self._new = NewResources(seed=b"stereo")
        self._makers: dict[str, CloudMaker] = {}

    def check_free(self, frames: I64, *, overwrite: bool) -> None:
        """Refuse frames that have a resource of the type.

        Raises:
            UserError: One has, and `overwrite` is not set.
        """
        occupied = int(np.count_nonzero(self._former(frames)))
        if occupied and not overwrite:
            name = resource_type(self._type).name
            raise UserError(
                f"{occupied} frames have {name} already: give --overwrite to replace them"
            )

    def add(self, frame: int, depth: F32, images: FrameImages) -> None:
        """Add the depth map (H, W) [m] of a frame's distorted image."""
        if self._type == RAW_DEPTH_MAPS:
            self._new.add(self._type, encoded_depth(depth))
        else:
            camera = self.resources.camera(frame)
            maker = self._makers.setdefault(camera.id, CloudMaker(camera))
            cloud = maker.cloud(depth, images.image(frame))
            self._new.add(self._type, b"".join(encode_ply(cloud)))
        self.owners.append(frame)

    def attached(self, *, overwrite: bool) -> VIMap:
        """Return the map with the new resources, on request in place of former ones."""
        vi_map = self.resources.vi_map
        if overwrite:
            vi_map = without_resources(vi_map, self._former(np.array(self.owners)))
        return self._new.attached(vi_map, np.arange(len(self._new)), self.owners)

    def _former(self, frames: I64) -> Mask:
        vi_map = self.resources.vi_map
        owned = vi_map.resources.owner_kind == ResourceOwner.FRAME
        of_type = resources_of(vi_map, (self._type,))
        return np.asarray(of_type & owned & np.isin(vi_map.resources.owner, frames))


_NEAREST_M = 0.1
"""Points nearer to the other camera are not compared [m]."""


@compiled(parallel=True)
def count_agreeing(
    depth: F32, other: F32, camera: F64, T_other_P: F64, max_difference_px: float, votes: U8
) -> None:
    """Add a vote to each pixel whose point another view sees at the same disparity.

    Args:
        depth: Depths (H, W) [m], 0 = unknown.
        other: Depths (H, W) of the other view, of the same perspective camera.
        camera: Focal length [px], centre u, centre v [px], focal length times baseline [px m].
        T_other_P: Transformation (4, 4) of points to the other view.
        max_difference_px: Largest difference of disparities that counts as the same.
        votes: Counts (H, W) to add to.
    """
    height, width = depth.shape
    focal, centre_u, centre_v, focal_baseline = camera
    for v in prange(height):
        y = (v - centre_v) / focal
        for u in range(width):
            z = np.float64(depth[v, u])
            if z <= 0.0:
                continue
            x = (u - centre_u) / focal
            p0 = (T_other_P[0, 0] * x + T_other_P[0, 1] * y + T_other_P[0, 2]) * z + T_other_P[0, 3]
            p1 = (T_other_P[1, 0] * x + T_other_P[1, 1] * y + T_other_P[1, 2]) * z + T_other_P[1, 3]
            p2 = (T_other_P[2, 0] * x + T_other_P[2, 1] * y + T_other_P[2, 2]) * z + T_other_P[2, 3]
            if p2 < _NEAREST_M:
                continue
            column = np.floor(focal * p0 / p2 + centre_u + 0.5)
            row = np.floor(focal * p1 / p2 + centre_v + 0.5)
            if column < 0 or row < 0 or column >= width or row >= height:
                continue
            seen = np.float64(other[int(row), int(column)])
            if seen > 0.0 and abs(focal_baseline / seen - focal_baseline / p2) < max_difference_px:
                votes[v, u] += 1


def compile_kernels() -> None:
    """Compile the kernel of this module."""
    depth = np.ones((2, 2), dtype=np.float32)
    votes = np.zeros((2, 2), dtype=np.uint8)
    count_agreeing(depth, depth, np.ones(4), np.eye(4), 1.0, votes)
