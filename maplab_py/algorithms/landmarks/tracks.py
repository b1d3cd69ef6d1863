"""Create landmarks from feature tracks without landmark."""

import numpy as np

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions, TrackReport
from maplab_py.algorithms.landmarks.triangulation import retriangulate, triangulate_keypoints
from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, edits, mission_mask, ragged_rows, starts_of_counts
from maplab_py.vimap.descriptors import NO_DESCRIPTOR, FeatureType


def init_tracks(
    vi_map: VIMap,
    options: LandmarkQualityOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    across_cameras: bool = False,
    progress: Progress = SILENT,
) -> tuple[VIMap, TrackReport]:
    """Create landmarks from keypoints without landmark that share mission, camera and track id.

    A track needs two keypoints of different frames (of two in one frame the first counts), rays
    that meet, and a point in front of its cameras; the landmark is stored in its first observer.
    All landmarks of the missions are triangulated afterwards, as in maplab.

    Args:
        across_cameras: Track ids are unique in a mission: keypoints of different cameras with the
            same id show the same point.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    progress.check()
    chosen = mission_mask(vi_map, missions)
    unused = (vi_map.keypoints.landmark < 0) & (vi_map.keypoints.track_id >= 0)
    rows = np.flatnonzero(unused)
    rows = rows[chosen[vi_map.vertices.mission[vi_map.keypoint_vertex[rows]]]]
    label = np.zeros(len(rows), dtype=np.int64)
    keypoints, start = group_tracks(vi_map, rows, label, across_cameras=across_cameras)
    p_G, _, usable = triangulate_keypoints(vi_map, keypoints, start)
    progress.check()
    added, observations = add_tracks(vi_map, keypoints, start, p_G, usable)
    result, retriangulation = retriangulate(added, options, missions=missions, progress=progress)
    report = TrackReport(
        tracks=len(usable),
        landmarks_added=int(usable.sum()),
        observations_added=observations,
        undetermined=int((~usable).sum()),
        retriangulation=retriangulation,
    )
    return result, report


def group_tracks(
    vi_map: VIMap, rows: I64, label: I64, *, across_cameras: bool = False
) -> tuple[I64, I64]:
    """Group keypoints (N,) by mission, camera (unless across them), feature type, track, label (N,).

    Returns:
        Keypoint rows in groups of two or more, one per frame, and the groups' offsets.
    """
    frame = vi_map.keypoint_frame[rows]
    mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]]
    camera, track = vi_map.frames.camera_index[frame], vi_map.keypoints.track_id[rows]
    if across_cameras:
        camera = np.zeros_like(camera)
    kind = vi_map.feature_type[rows]
    order = np.lexsort((rows, track, kind, label, camera, mission))
    rows, frame = rows[order], frame[order]
    keys = np.stack([mission[order], camera[order], label[order], kind[order], track[order]])
    begins = np.ones(len(rows), dtype=np.bool_)
    begins[1:] = np.any(keys[:, 1:] != keys[:, :-1], axis=0)
    again = np.zeros(len(rows), dtype=np.bool_)
    again[1:] = ~begins[1:] & (frame[1:] == frame[:-1])
    group = np.cumsum(begins) - 1
    counts = np.bincount(group[~again], minlength=int(begins.sum()))
    taken = ~again & (counts[group] >= 2) if len(rows) else again
    return rows[taken], starts_of_counts(counts[counts >= 2])


def add_tracks(
    vi_map: VIMap, keypoints: I64, start: I64, p_G: F64, usable: Mask
) -> tuple[VIMap, int]:
    """Create a landmark at p_G (L, 3) for each valid group; also return the observation count."""
    groups = np.flatnonzero(usable)
    if len(groups) == 0:
        return vi_map, 0
    taken = keypoints[ragged_rows(start, groups)]
    store = vi_map.keypoint_vertex[keypoints[start[:-1][groups]]]
    p_I = se3.transform(se3.inverse(vi_map.T_G_I[store]), p_G[groups])
    number = np.repeat(np.arange(len(groups)), np.diff(start)[groups])
    kind = vi_map.feature_type[keypoints[start[:-1][groups]]]
    added = edits.add_landmarks(
        vi_map,
        vertex=store,
        p_I=p_I,
        keypoint_rows=taken,
        keypoint_landmark=number,
        feature_type=np.where(kind == NO_DESCRIPTOR, FeatureType.BINARY, kind),
    )
    return added, len(taken)
