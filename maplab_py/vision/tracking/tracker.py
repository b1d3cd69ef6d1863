"""The tracker: keypoints from image to image, and between the cameras of a rig (thesis, Paper I, 3.1)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from maplab_py.array_types import F64, U8, Mask
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.vision.features.detection import GridDetector, refined
from maplab_py.vision.tracking.drift import align, patches
from maplab_py.vision.tracking.flow import (
    FlowOptions,
    follow,
    in_plane_turn,
    turn_matrix,
    turned_in_plane,
)
from maplab_py.vision.tracking.live_tracks import LiveTracks
from maplab_py.vision.tracking.motion import (
    ImageMotion,
    camera_turn,
    image_motion,
    limits_of,
    summarise,
)
from maplab_py.vision.tracking.options import TrackingOptions
from maplab_py.vision.tracking.stereo import StereoOptions, match
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages
from maplab_py.vision.tracking.views import CameraView, leaders, usable_alone

_MIN_IN_PLANE_TURN_RAD = 0.01
"""From this turn about the optical axis on, the earlier image is turned with the camera."""
_SAME_POINT_PX = 3.0
"""A track of a camera alone ends where a track of its leader arrives; none begins where another one is."""


@dataclasses.dataclass(frozen=True, eq=False)
class _CameraState:
    """The latest image of a camera, and the tracks that it follows by itself."""

    image: U8
    tracks: LiveTracks


class FrameTracker:
    """Follows keypoints through the images of a rig.

    A camera that sees little of what earlier cameras see detects and follows keypoints by itself.
    The others look for the keypoints of the first such camera that they overlap with (stereo), and
    follow keypoints of their own only where that camera does not look.
    """

    def __init__(
        self, cameras: tuple[Camera, ...], T_I_C: F64, options: TrackingOptions | None = None
    ) -> None:
        """Track in the images of a rig.

        Args:
            cameras: The cameras.
            T_I_C: Their poses (C, 7) on the IMU.
            options: Parameters.

        Raises:
            FlagError: An option is wrong.
            UserError: A mask cannot be used.
        """
        self._options = options or TrackingOptions()
        self._options.check()
        poses = np.asarray(T_I_C, dtype=np.float64).reshape(-1, 7)
        self._views = tuple(
            CameraView.of(camera, row, poses[row], self._options)
            for row, camera in enumerate(cameras)
        )
        self._leaders = leaders(self._views)
        self._detectors = [self._detector(row) for row in range(len(cameras))]
        factor = self._options.image_resize_factor
        self._flow = FlowOptions(
            self._options.patch_size_px,
            self._options.pyramid_levels,
            self._options.forward_backward_px * factor,
        )
        self._stereo = StereoOptions(
            self._flow, self._options.epipolar_gate_px, self._options.stereo_distance_m
        )
        self._next_id = 0
        self._states: tuple[_CameraState, ...] | None = None

    def reset(self) -> None:
        """Forget all tracks; ids continue."""
        self._states = None

    def track(
        self, time_ns: int, images: tuple[U8, ...], R_I0_I1: F64 | None = None
    ) -> TrackedImages:
        """Follow the tracks into the images of the next frame set.

        Args:
            time_ns: Time of the frame set.
            images: 8-bit grey image (H, W) of every camera, as recorded.
            R_I0_I1: Turn (3, 3) of the IMU since the previous call, as the gyroscope predicts it,
                bias removed; None = unknown.

        Raises:
            MapError: An image is missing, or has another type or size than its camera's images.
        """
        if len(images) != len(self._views):
            raise MapError(
                f"{len(images)} images of {len(self._views)} cameras: give one of each camera"
            )
        watch = _Stopwatch()
        with watch("prepare"):
            views = zip(self._views, images, strict=True)
            prepared = [view.preparation.prepare(image) for view, image in views]
        motions: list[ImageMotion] = []
        live: list[LiveTracks] = []
        for row, image in enumerate(prepared):
            tracks, motion = self._follow(row, image, R_I0_I1, time_ns, watch)
            live.append(tracks)
            motions += [motion] if motion is not None else []
        output: list[CameraTracks] = []
        for row, image in enumerate(prepared):
            shared = LiveTracks.none()
            leader = self._leaders[row]
            if leader != row:
                with watch("stereo"):
                    pair = prepared[leader], image
                    live[leader], shared = self._shared(leader, row, pair, live[leader])
                    live[row] = live[row][_is_apart(live[row].uv, shared.uv)]
            with watch("detect"):
                live[row] = self._with_new(row, image, live[row], shared)
            output.append(self._output(row, shared.joined(live[row])))
        self._states = tuple(
            _CameraState(image, tracks) for image, tracks in zip(prepared, live, strict=True)
        )
        disparity_px, is_turn_only = summarise(motions)
        return TrackedImages(time_ns, tuple(output), disparity_px, is_turn_only, watch.stage_ms)

    def _detector(self, row: int) -> GridDetector:
        view, leader = self._views[row], self._leaders[row]
        usable = view.preparation.usable
        if leader != row:
            usable = usable_alone(view, self._views[leader])
        return GridDetector(self._options, usable)

    def _follow(
        self, row: int, image: U8, R_I0_I1: F64 | None, seed: int, watch: _Stopwatch
    ) -> tuple[LiveTracks, ImageMotion | None]:
        """Follow the tracks of a camera into its new image."""
        if self._states is None or not len(self._states[row].tracks):
            return LiveTracks.none(), None
        view, state = self._views[row], self._states[row]
        tracks = state.tracks
        with watch("flow"):
            R_C1_C0 = camera_turn(view.R_I_C, R_I0_I1)
            before, start, guess, turn = state.image, tracks.uv, tracks.uv, np.eye(2)
            if R_C1_C0 is not None:
                turned, visible = view.pixels(tracks.ray @ R_C1_C0.T)
                guess = np.where(visible[:, None], turned, tracks.uv)
                angle_rad = in_plane_turn(R_C1_C0)
                turn = turn_matrix(angle_rad)
                if abs(angle_rad) > _MIN_IN_PLANE_TURN_RAD:
                    before, start = turned_in_plane(before, start, view.centre, angle_rad)
            uv, is_tracked = follow(before, image, start, guess, self._flow)
            tracks, uv, guess = tracks[is_tracked], uv[is_tracked], guess[is_tracked]
            aligned = align(image, uv, tracks.patch, turn @ tracks.warp)
            uv, tracks = aligned.uv, tracks.compared_with(aligned.patch, aligned.warp)
            ray, exists = view.rays(uv)
            left = exists & view.is_usable(uv)
            tracks, uv, ray, guess = tracks[left], uv[left], ray[left], guess[left]
        with watch("outliers"):
            motion = image_motion(
                view.camera,
                (tracks.ray, ray),
                view.preparation.to_recorded(uv),
                R_C1_C0,
                limits_of(self._options, view.focal_px),
                seed,
                view.preparation.to_recorded(guess),
            )
            rows = motion.is_inlier
        return tracks[rows].at(uv[rows], ray[rows]), motion

    def _shared(
        self, leader: int, row: int, images: tuple[U8, U8], tracks: LiveTracks
    ) -> tuple[LiveTracks, LiveTracks]:
        """Find the tracks of the leader in a camera; return both, the leader's with distances."""
        matches = match(self._views[leader], self._views[row], images, tracks, self._stereo)
        is_known = np.isfinite(matches.distance_m)
        distance = np.where(is_known, matches.distance_m, tracks.distance_m)
        rows = matches.is_matched
        shared = dataclasses.replace(tracks[rows], uv=matches.uv[rows], ray=matches.ray[rows])
        return dataclasses.replace(tracks, distance_m=distance), shared

    def _with_new(self, row: int, image: U8, tracks: LiveTracks, shared: LiveTracks) -> LiveTracks:
        """Add new tracks where the image has room beside those of the camera and of its leader."""
        uv = self._detectors[row].detect(image, np.concatenate([shared.uv, tracks.uv]))
        uv = refined(image, uv)
        uv = uv[self._views[row].is_usable(uv) & _is_apart(uv, tracks.uv) & _is_apart_before(uv)]
        ray, exists = self._views[row].rays(uv)
        new = LiveTracks.new(uv[exists], ray[exists], self._next_id)
        new = new.compared_with(patches(image, new.uv), new.warp)
        self._next_id += len(new)
        return tracks.joined(new)

    def _output(self, row: int, tracks: LiveTracks) -> CameraTracks:
        count, options = len(tracks), self._options
        return CameraTracks(
            uv_px=self._views[row].preparation.to_recorded(tracks.uv),
            track_id=tracks.track_id,
            sigma_px=np.full(count, options.keypoint_sigma_px),
            scale=np.full(count, options.descriptor_size_px),
            num_frames=tracks.num_frames,
        )


def _is_apart(uv: F64, others_uv: F64) -> Mask:
    """Tell which keypoints (K, 2) are not where another (L, 2) is."""
    distance = np.linalg.norm(uv[:, None] - others_uv[None], axis=2)
    return np.asarray(np.all(distance > _SAME_POINT_PX, axis=1))


def _is_apart_before(uv: F64) -> Mask:
    """Tell which keypoints (K, 2) are not where one before them is."""
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    is_same = np.tril(distance <= _SAME_POINT_PX, k=-1)
    return np.asarray(~is_same.any(axis=1))


class _Stopwatch:
    """Adds up the time of stages."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Count the time of a block."""
        start = time.perf_counter()
        yield
        spent = 1e3 * (time.perf_counter() - start)
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + spent


def compile_kernels() -> None:
    """Compile detection and the two-point RANSAC, with known and with unknown turn."""
    size_px = 160
    intrinsics = np.array([100.0, 100.0, 80.0, 80.0])
    camera = Camera(
        "0" * 32, Projection.PINHOLE, Distortion.NONE, intrinsics, np.zeros(0), size_px, size_px
    )
    tracker = FrameTracker((camera,), se3.identity(1))
    grey = np.random.default_rng(0).integers(0, 256, (size_px // 8, size_px // 8), dtype=np.uint8)
    image = np.kron(grey, np.ones((8, 8), dtype=np.uint8))
    for time_ns, turn in enumerate((None, np.eye(3), None)):
        tracker.track(time_ns, (image,), turn)
