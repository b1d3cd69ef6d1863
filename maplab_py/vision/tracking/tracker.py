"""The tracker: keypoints from image to image, and between the cameras of a rig (thesis, Paper I, 3.1)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from maplab_py.array_types import F32, F64, I64, U8, Mask, Rows
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.vision.features import detection
from maplab_py.vision.tracking import patch_kernels, stereo_kernels
from maplab_py.vision.tracking.flow import (
    FlowOptions,
    Pyramid,
    follow,
    in_plane_turn,
    is_tracked_back,
    search,
)
from maplab_py.vision.tracking.motion import (
    ImageMotion,
    camera_turn,
    image_motion,
    limits_of,
    summarise,
)
from maplab_py.vision.tracking.options import TrackingOptions
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages
from maplab_py.vision.tracking.views import CameraView, leaders, usable_alone

_ENOUGH_TRACKS, _CONTRADICTED_SHARE = 20, 0.3
"""The turn is looked for in the tracks when so small a share of so many of them agrees with the given one."""
_DETECTION_FRAMES, _KEPT_SHARE, _FIRST_FRAMES = 2, 0.9, 80
"""Keypoints are detected in every second frame, where at most this share of them is left, and in the first
frames, in which the odometry starts: with half of the new tracks it starts later, and less well."""
_SAME_POINT_PX = 3.0
"""A track of a camera alone ends where a track of its leader arrives; none begins where another one is."""


@dataclasses.dataclass(frozen=True, eq=False)
class _CameraState:
    """The latest image of a camera, and the tracks that it follows by itself."""

    image: Pyramid
    tracks: LiveTracks
    shared: StereoMatches  # points of its leader


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
            T_I_C: Their poses (C, 7) on the IMU.

        Raises:
            UserError: A mask cannot be used.
        """
        self._options, self._absent = options or TrackingOptions(), frozenset[int]()
        self._take_cameras(cameras, T_I_C)
        factor = self._options.image_resize_factor
        self._flow = FlowOptions(
            self._options.patch_size_px,
            self._options.pyramid_levels,
            self._options.forward_backward_px * factor,
        )
        self._next_id = self._num_frames = 0
        self._detected = [np.inf] * len(cameras)  # keypoints after the last detection
        self._states: tuple[_CameraState, ...] | None = None

    def _take_cameras(self, cameras: tuple[Camera, ...], T_I_C: F64) -> None:
        poses = np.asarray(T_I_C, dtype=np.float64).reshape(-1, 7)
        self._views = tuple(
            CameraView.of(camera, row, poses[row], self._options)
            for row, camera in enumerate(cameras)
        )
        self._leaders = leaders(self._views, self._absent)
        self._detectors = [self._detector(row) for row in range(len(cameras))]

    def recalibrate(self, cameras: tuple[Camera, ...], T_I_C: F64) -> None:
        """Go on with another calibration of the same cameras; all tracks stay."""
        self._take_cameras(cameras, T_I_C)
        states = list(self._states or ())
        for row, state in enumerate(states):
            ray, _ = self._views[row].rays(state.tracks.uv)
            states[row] = dataclasses.replace(
                state, tracks=dataclasses.replace(state.tracks, ray=ray)
            )
        self._states = tuple(states) if states else None

    def reset(self) -> None:
        """Forget all tracks; ids continue."""
        self._states, self._num_frames = None, 0
        self._detected = [np.inf] * len(self._views)

    def leave_out(self, cameras: frozenset[int]) -> None:
        """Look for nothing in the images of some cameras from now on, until another set is left out.

        Cameras that have lost their leader follow the points that they shared with it.
        """
        if cameras == self._absent:
            return
        before, self._absent = self._leaders, cameras
        self._leaders = leaders(self._views, cameras)
        self._detectors = [self._detector(row) for row in range(len(self._views))]
        self._detected = [np.inf] * len(self._views)
        states = list(self._states or ())
        for row, state in enumerate(states):
            tracks = state.tracks
            if row in cameras:
                tracks = LiveTracks.none()
            elif before[row] != row and self._leaders[row] == row:
                tracks = LiveTracks.concatenate([tracks, self._alone(row, state)])
            states[row] = dataclasses.replace(state, tracks=tracks)
        self._states = tuple(states) if states else None

    def _alone(self, row: int, state: _CameraState) -> LiveTracks:
        """Return the points that a camera shared with its leader as tracks of its own."""
        shared = state.shared
        ray, exists = self._views[row].rays(shared.uv)
        tracks = LiveTracks.new(shared.uv[exists], ray[exists], 0)
        tracks = dataclasses.replace(
            tracks, track_id=shared.track_id[exists], num_frames=shared.num_frames[exists]
        )
        return tracks.compared_with(patches(state.image.image, tracks.uv), tracks.warp)

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
            prepared = [
                Pyramid.of(view.preparation.prepare(image), self._flow) for view, image in views
            ]
        motions: list[ImageMotion] = []
        live: list[LiveTracks] = []
        for row, image in enumerate(prepared):
            tracks, motion = self._follow(row, image, R_I0_I1, time_ns, watch)
            live.append(tracks)
            motions += [motion] if motion is not None else []
        output: list[CameraTracks] = []
        matches: list[StereoMatches] = []
        for row, image in enumerate(prepared):
            shared = StereoMatches.none()
            leader = self._leaders[row]
            if leader != row:
                with watch("stereo"):
                    pair = prepared[leader], image
                    live[leader], shared = self._shared(leader, row, pair, live[leader])
                    is_apart = detection.are_apart(live[row].uv, shared.uv, _SAME_POINT_PX)
                    live[row] = live[row].take(is_apart)
            if row not in self._absent and self._needs_keypoints(row, live[row], shared):
                with watch("detect"):
                    live[row] = self._with_new(row, image.image, live[row], shared)
            output.append(self._output(row, shared, live[row]))
            matches.append(shared)
        self._num_frames += 1
        self._states = tuple(map(_CameraState, prepared, live, matches))
        disparity_px, is_turn_only = summarise(motions)
        return TrackedImages(
            time_ns,
            tuple(output),
            disparity_px,
            is_turn_only,
            watch.stage_ms,
            self._options.descriptor_type,
        )

    def _detector(self, row: int) -> detection.GridDetector:
        view, leader = self._views[row], self._leaders[row]
        usable = view.preparation.usable
        if leader != row:
            usable = usable_alone(view, self._views[leader])
        return detection.GridDetector(self._options, usable)

    def _follow(
        self, row: int, image: Pyramid, R_I0_I1: F64 | None, seed: int, watch: _Stopwatch
    ) -> tuple[LiveTracks, ImageMotion | None]:
        """Follow the tracks of a camera into its new image."""
        if self._states is None or not len(self._states[row].tracks):
            return LiveTracks.none(), None
        view, state = self._views[row], self._states[row]
        tracks = state.tracks
        with watch("flow"):
            R_C1_C0 = camera_turn(view.R_I_C, R_I0_I1)
            guess, turn = tracks.uv, np.eye(2)
            if R_C1_C0 is not None:
                turned, visible = view.pixels(tracks.ray @ R_C1_C0.T)
                guess = np.where(visible[:, None], turned, tracks.uv)
                turn = in_plane_turn(R_C1_C0)
            uv, is_tracked = search(state.image, image, tracks.uv, guess, self._flow, turn)
            aligned = align(image.image, uv, tracks.patch, turn @ tracks.warp)
            # what the first image of its track confirms need not be tracked back
            doubtful = np.flatnonzero(is_tracked & ~aligned.is_shown)
            is_tracked[doubtful] = is_tracked_back(
                state.image, image, tracks.uv[doubtful], uv[doubtful], self._flow, turn
            )
            ray, exists = view.rays(aligned.uv)
            rows = np.flatnonzero(is_tracked & exists & view.is_usable(aligned.uv))
        with watch("outliers"):
            rays, limits = (tracks.ray[rows], ray[rows]), limits_of(self._options, view.focal_px)
            recorded_px = view.preparation.to_recorded(aligned.uv[rows])
            motion = image_motion(
                view.camera, rays, recorded_px, R_C1_C0, limits, seed,
                view.preparation.to_recorded(guess[rows]),
            )  # fmt: skip
            if len(rows) >= _ENOUGH_TRACKS and np.mean(motion.is_inlier) < _CONTRADICTED_SHARE:
                free = image_motion(view.camera, rays, recorded_px, None, limits, seed)
                if np.mean(free.is_inlier) > 1.0 - _CONTRADICTED_SHARE:
                    motion = free  # the gyroscope is wrong, or the camera has been knocked
            rows = rows[motion.is_inlier]
        tracks = tracks.compared_with(aligned.patch, aligned.warp).take(rows)
        return tracks.at(aligned.uv[rows], ray[rows]), motion

    def _shared(
        self, leader: int, row: int, images: tuple[Pyramid, Pyramid], tracks: LiveTracks
    ) -> tuple[LiveTracks, StereoMatches]:
        """Find the tracks of the leader in a camera; return these with distances, and the matches."""
        matches = match(
            self._views[leader], self._views[row], images, tracks, self._options, self._flow
        )
        is_known = np.isfinite(matches.distance_m)
        distance = np.where(is_known, matches.distance_m, tracks.distance_m)
        return dataclasses.replace(tracks, distance_m=distance), matches

    def _needs_keypoints(self, row: int, tracks: LiveTracks, shared: StereoMatches) -> bool:
        """Tell whether to detect: at first, then in turn with other cameras, and after losses."""
        is_first = self._num_frames < _FIRST_FRAMES
        is_turn = is_first or (self._num_frames + row) % _DETECTION_FRAMES == 0
        return is_turn or len(tracks) + len(shared.uv) <= _KEPT_SHARE * self._detected[row]

    def _with_new(
        self, row: int, image: U8, tracks: LiveTracks, shared: StereoMatches
    ) -> LiveTracks:
        """Add new tracks where the image has room beside those of the camera and of its leader."""
        uv = self._detectors[row].detect(image, np.concatenate([shared.uv, tracks.uv]))
        uv = detection.refined(image, uv)
        is_apart = detection.are_apart(uv, tracks.uv, _SAME_POINT_PX)
        uv = uv[
            self._views[row].is_usable(uv)
            & is_apart
            & detection.are_apart_before(uv, _SAME_POINT_PX)
        ]
        ray, exists = self._views[row].rays(uv)
        new = LiveTracks.new(uv[exists], ray[exists], self._next_id)
        new = new.compared_with(patches(image, new.uv), new.warp)
        self._next_id += len(new)
        self._detected[row] = len(shared.uv) + len(tracks) + len(new)
        return LiveTracks.concatenate([tracks, new])

    def _output(self, row: int, shared: StereoMatches, tracks: LiveTracks) -> CameraTracks:
        options = self._options
        uv = np.concatenate([shared.uv, tracks.uv])
        return CameraTracks(
            uv_px=self._views[row].preparation.to_recorded(uv),
            track_id=np.concatenate([shared.track_id, tracks.track_id]),
            sigma_px=np.full(len(uv), options.keypoint_sigma_px),
            scale=np.full(len(uv), options.descriptor_size_px),
            num_frames=np.concatenate([shared.num_frames, tracks.num_frames]),
        )


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
    """Compile detection, tracking, stereo and the two-point RANSAC, with known and with unknown turn."""
    size_px = 160
    intrinsics = np.array([100.0, 100.0, 80.0, 80.0])
    camera = Camera(
        "0" * 32, Projection.PINHOLE, Distortion.NONE, intrinsics, np.zeros(0), size_px, size_px
    )
    T_I_C = se3.identity(2)
    T_I_C[1, 4] = 0.1
    tracker = FrameTracker((camera, camera), T_I_C)
    grey = np.random.default_rng(0).integers(0, 256, (size_px // 8, size_px // 8), dtype=np.uint8)
    image = np.kron(grey, np.ones((8, 8), dtype=np.uint8))
    for time_ns, turn in enumerate((None, np.eye(3), None)):
        tracker.track(time_ns, (image, image), turn)


# Keypoints without drift: each is aligned with the patch about it in the first image of its track.
#
# Lucas-Kanade from image to image adds up the errors of all images: patches are compared without a change of
# scale and shear, and a keypoint moves away from its point by a pixel in five seconds. Its landmark is
# then triangulated at a wrong depth, whatever the number of observations. Comparison with the first image
# under an affine warp (J. Shi, C. Tomasi, Good Features to Track, CVPR 1994) has an error that does not grow.


@dataclasses.dataclass(frozen=True, eq=False)
class AlignedKeypoints:
    """K keypoints in an image, and what the next images are compared with."""

    uv: F64  # (K, 2)
    patch: F32  # (K, S, S)
    warp: F64  # (K, 2, 2) from offsets in the patch to offsets in the image
    is_shown: Mask  # (K,) the image shows the patch


def align(image: U8, uv: F64, patch: F32, warp: F64) -> AlignedKeypoints:
    """Align keypoints with their patches.

    Where the image does not show a patch, the keypoint stays where it is; it is compared with this image
    from now on.

    Args:
        image: Image (H, W).
        uv: Keypoints (K, 2) in it, from Lucas-Kanade.
        patch: Their patches (K, S, S).
        warp: Expected warps (K, 2, 2).
    """
    uv, patch, warp = uv.copy(), patch.copy(), np.array(warp, order="C")
    is_shown = np.empty(len(uv), dtype=np.bool_)
    patch_kernels.align_patches(image, uv, patch, warp, is_shown)
    return AlignedKeypoints(uv, patch, warp, is_shown)


def patches(image: U8, uv: F64) -> F32:
    """Return the patches (K, S, S) about keypoints (K, 2) of an image (H, W)."""
    result = np.empty((len(uv), patch_kernels.SIDE_PX, patch_kernels.SIDE_PX), dtype=np.float32)
    patch_kernels.sample_patches(image, uv, result)
    return result


_RETRY_FRAMES = 4
"""Interval in which a point of unknown distance is sought again."""


@dataclasses.dataclass(frozen=True, eq=False)
class StereoMatches:
    """M observations of K tracks by another camera."""

    uv: F64  # (M, 2) of its prepared image
    track_id: I64  # (M,)
    num_frames: I64  # (M,)
    distance_m: F64  # (K,) from the first camera, NaN where it is not known

    @classmethod
    def none(cls) -> StereoMatches:
        """Return no observations."""
        ids = np.zeros(0, dtype=np.int64)
        return cls(np.zeros((0, 2)), ids, ids, np.zeros(0))


def match(
    first: CameraView,
    second: CameraView,
    images: tuple[Pyramid, Pyramid],
    tracks: LiveTracks,
    options: TrackingOptions,
    flow: FlowOptions,
) -> StereoMatches:
    """Find the tracks of a camera in the image that another took at the same time.

    Points are sought where they would be at their last known distance, else at the distance of
    their neighbours in the image, else at the default distance. A match must be tracked back to where
    it came from, lie on its epipolar line, and in front of both cameras.
    """
    R_A_B, p_A_B = first.R_I_C.T @ second.R_I_C, first.R_I_C.T @ (second.p_I_C - first.p_I_C)
    expected_m = np.empty(len(tracks))
    stereo_kernels.expect_distances(
        tracks.uv, tracks.distance_m, options.stereo_distance_m, expected_m
    )
    guess, visible = second.pixels((expected_m[:, None] * tracks.ray - p_A_B) @ R_A_B)
    is_due = np.isfinite(tracks.distance_m) | (tracks.num_frames % _RETRY_FRAMES == 1)
    rows = np.flatnonzero(is_due & visible & second.is_usable(guess))
    is_near = np.isfinite(tracks.distance_m[rows])
    uv, is_match = follow(*images, tracks.uv[rows], guess[rows], flow, is_near)
    ray, exists = second.rays(uv)
    is_match &= exists & second.is_usable(uv)
    gate, distance_m = options.epipolar_gate_px / second.focal_px, np.full(len(tracks), np.nan)
    of_rows = np.empty(len(rows))
    stereo_kernels.check_matches(tracks.ray[rows], ray @ R_A_B.T, p_A_B, gate, is_match, of_rows)
    distance_m[rows] = of_rows
    rows, uv = rows[is_match], uv[is_match]
    return StereoMatches(uv, tracks.track_id[rows], tracks.num_frames[rows], distance_m)


class LiveTracks(Rows):
    """Tracks at the latest image of a camera."""

    uv: F64  # (K, 2) of the prepared image
    ray: F64  # (K, 3) unit, in the camera
    track_id: I64  # (K,)
    num_frames: I64  # (K,)
    distance_m: F64  # (K,) along the ray, NaN = unknown
    patch: F32  # (K, S, S) about the keypoint in an earlier image
    warp: F64  # (K, 2, 2) from offsets in the patch to offsets in the latest image

    def at(self, uv: F64, ray: F64) -> LiveTracks:
        """Return the tracks an image later."""
        return dataclasses.replace(self, uv=uv, ray=ray, num_frames=self.num_frames + 1)

    def compared_with(self, patch: F32, warp: F64) -> LiveTracks:
        """Return the tracks with other patches (K, S, S) and warps (K, 2, 2)."""
        return dataclasses.replace(self, patch=patch, warp=warp)

    @classmethod
    def new(cls, uv: F64, ray: F64, first_id: int) -> LiveTracks:
        """Return tracks that begin, numbered from an id on."""
        count = len(uv)
        ids = np.arange(first_id, first_id + count, dtype=np.int64)
        patch = np.zeros((count, patch_kernels.SIDE_PX, patch_kernels.SIDE_PX), dtype=np.float32)
        warp = np.tile(np.eye(2), (count, 1, 1))
        return cls(
            uv, ray, ids, np.ones(count, dtype=np.int64), np.full(count, np.nan), patch, warp
        )

    @classmethod
    def none(cls) -> LiveTracks:
        """Return no tracks."""
        return cls.new(np.zeros((0, 2)), np.zeros((0, 3)), 0)
