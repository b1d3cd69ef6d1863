"""Link keypoints of neighbouring frames into tracks, from which landmarks can be made."""

import dataclasses

import numpy as np

from maplab_py.algorithms.image_features.keypoint_edits import keypoints_of
from maplab_py.algorithms.image_features.options import FeatureTrackOptions, FeatureTrackReport
from maplab_py.algorithms.landmarks.keypoint_rays import keypoint_rays
from maplab_py.algorithms.loop_closure.features import most_frequent_kind
from maplab_py.array_types import F64, I64, Mask
from maplab_py.distinct import distinct
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, mission_mask, table, tables, type_name
from maplab_py.vision import descriptors, epipolar_matching, track_union


@dataclasses.dataclass(frozen=True, eq=False)
class _Links:
    """Matches of keypoints (rows of the map), and how many each pair of frames gave."""

    first: I64  # (N,)
    second: I64  # (N,)
    difference: I64  # (N,) of the descriptors
    per_pair: I64  # (P,)


def track_features(
    vi_map: VIMap,
    options: FeatureTrackOptions,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, FeatureTrackReport]:
    """Give keypoints of neighbouring frames of a camera that show the same point the same track.

    The poses of the map say where a point may be in the next image. Only keypoints without a track and
    without a landmark are linked. Matches are taken in the order of their descriptors' differences, and none
    that would put two keypoints of a frame into one track.

    Raises:
        EstimationError: There are no such keypoints, or all have a track.
    """
    feature_type, sizes = options.wanted()
    chosen = mission_mask(vi_map, missions)[vi_map.vertices.mission[vi_map.frames.vertex]]
    kind, of_kind = most_frequent_kind(
        vi_map, chosen & vi_map.frames.is_valid, feature_type, sizes, flag="--feature_type"
    )
    free = of_kind & (vi_map.keypoints.track_id < 0) & (vi_map.keypoints.landmark < 0)
    if not free.any():
        raise EstimationError(
            f"all keypoints with descriptors {kind.words} have a track or a landmark: nothing to link"
        )
    links = _match_neighbours(vi_map, options, kind, free, progress)
    track, accepted = _tracks(vi_map, links)
    tracked = np.flatnonzero(track >= 0)
    frames = vi_map.frames
    present = frames.present.copy()
    present[distinct(vi_map.keypoint_frame[tracked])] |= np.uint16(tables.FrameField.TRACK_ID)
    ids = np.where(track >= 0, track, vi_map.keypoints.track_id)
    result = vi_map.replace(
        frames=frames.replace(present=present), keypoints=vi_map.keypoints.replace(track_id=ids)
    )
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex[tracked]]
    count = len(np.unique(np.stack([mission, track[tracked]]), axis=1).T)
    return result, FeatureTrackReport(
        feature_type=type_name(kind.feature_type),
        frame_pairs=len(links.per_pair),
        matches=len(links.first),
        median_matches_per_pair=float(np.median(links.per_pair)) if len(links.per_pair) else 0.0,
        tracks=count,
        mean_track_length=len(tracked) / max(count, 1),
        contradictions=int(np.count_nonzero(~accepted)),
    )


def _match_neighbours(
    vi_map: VIMap,
    options: FeatureTrackOptions,
    kind: descriptors.DescriptorKind,
    free: Mask,
    progress: Progress,
) -> _Links:
    """Match the free keypoints (K,) of each frame with those of the frames that follow it."""
    rule = epipolar_matching.EpipolarRule(
        options.epipolar_gate_px,
        options.min_depth_m,
        kind.largest(options.max_bit_fraction, options.max_descriptor_distance),
        options.max_ratio,
    )
    pairs = _neighbours(vi_map, free, options.neighbors)
    first, second, difference = [], [], []
    images: dict[int, tuple[epipolar_matching.ImageRays, I64]] = {}
    for number, (a, b) in enumerate(pairs.tolist()):
        progress.step(number, len(pairs), "frames")
        for frame in (a, b):
            if frame not in images:
                images[frame] = _rays(vi_map, frame, kind, free)
        images = {row: value for row, value in images.items() if row >= a}
        (rays_a, rows_a), (rays_b, rows_b) = images[a], images[b]
        i, j, gap = epipolar_matching.match_images(rays_a, rays_b, rule)
        first.append(rows_a[i])
        second.append(rows_b[j])
        difference.append(gap.astype(np.int64))
    none = [np.zeros(0, dtype=np.int64)]
    return _Links(
        np.concatenate(first or none),
        np.concatenate(second or none),
        np.concatenate(difference or none),
        np.array([len(part) for part in first], dtype=np.int64),
    )


def _neighbours(vi_map: VIMap, free: Mask, most: int) -> I64:
    """Return pairs of frames (P, 2) of one camera that follow each other, by the first frame."""
    frames = vi_map.frames
    rows = distinct(vi_map.keypoint_frame[free]).astype(np.int64)
    mission = vi_map.vertices.mission[frames.vertex[rows]].astype(np.int64)
    camera = frames.camera_index[rows].astype(np.int64)
    order = np.lexsort((rows, camera, mission))
    rows, mission, camera = rows[order], mission[order], camera[order]
    pairs = []
    for step in range(1, most + 1):
        a, b = slice(None, -step), slice(step, None)
        same = (mission[a] == mission[b]) & (camera[a] == camera[b])
        pairs.append(np.stack([rows[a], rows[b]], axis=1)[same])
    every = np.concatenate(pairs)
    return every[np.lexsort((every[:, 1], every[:, 0]))]


def _rays(
    vi_map: VIMap, frame: int, kind: descriptors.DescriptorKind, free: Mask
) -> tuple[epipolar_matching.ImageRays, I64]:
    """Return the free keypoints of a frame, and their rows."""
    rows, _ = keypoints_of(vi_map, np.array([frame]))
    rows = rows[free[rows]]
    origin_I, ray_I, rad_per_px, seen = keypoint_rays(vi_map, rows)
    rows, ray_I, rad_per_px = rows[seen], ray_I[seen], rad_per_px[seen]
    T_G_I = vi_map.T_G_I[vi_map.frames.vertex[frame]]
    origin_G: F64 = se3.transform(T_G_I, origin_I[0] if len(origin_I) else np.zeros(3))
    raw = np.ascontiguousarray(vi_map.keypoints.descriptor[rows, : kind.size])
    ray_G = np.ascontiguousarray(so3.rotate(T_G_I[:4], ray_I))
    return epipolar_matching.ImageRays(kind.comparable(raw), ray_G, rad_per_px, origin_G), rows


def _tracks(vi_map: VIMap, links: _Links) -> tuple[I64, Mask]:
    """Return the track (K,) of every keypoint that gets one, else -1, and which links were used."""
    track = np.full(len(vi_map.keypoints), -1, dtype=np.int64)
    if not len(links.first):
        return track, np.zeros(0, dtype=np.bool_)
    order = np.lexsort((links.second, links.first, links.difference))
    first, second = links.first[order], links.second[order]
    rows, index = np.unique(np.concatenate([first, second]), return_inverse=True)
    a, b = index[: len(first)], index[len(first) :]
    accepted = track_union.unite_tracks(
        a,
        b,
        np.arange(len(rows) + 1),
        vi_map.keypoint_frame[rows].astype(np.int64),
        len(vi_map.frames),
    )
    part = table.connected_groups(a[accepted], b[accepted], len(rows))
    size = np.bincount(part, minlength=1)
    linked = size[part] >= 2
    track[rows[linked]] = _numbers(vi_map, rows[linked], part[linked])
    return track, accepted


def _numbers(vi_map: VIMap, rows: I64, part: I64) -> I64:
    """Return a track id for keypoints (N,) of each part (N,): new in their missions, by first keypoint."""
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex]
    largest = np.full(len(vi_map.missions), -1, dtype=np.int64)
    np.maximum.at(largest, mission, vi_map.keypoints.track_id)
    _, first, part = np.unique(part, return_index=True, return_inverse=True)
    owner = mission[rows[first]].astype(np.int64)
    order = np.lexsort((rows[first], owner))
    starts = np.searchsorted(owner[order], np.arange(len(vi_map.missions)))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) - starts[owner[order]]
    return np.asarray((largest[owner] + 1 + number)[part.reshape(-1)])
