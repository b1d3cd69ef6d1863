"""Second matching of candidates whose nearest neighbours left too few inliers, by a network.

Nearest neighbours compare single descriptors. LighterGlue matches all keypoints of two images jointly, also
those whose descriptors a change of light has altered too much, in about 0.1 s per pair.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure.candidates import Candidates, Matches
from maplab_py.algorithms.loop_closure.features import MapFeatures
from maplab_py.array_types import F32, I64
from maplab_py.errors import UserError
from maplab_py.progress import Progress
from maplab_py.vimap import MissionSensor, VIMap, starts_of_counts, to_hex
from maplab_py.vimap.descriptors import DescriptorDepth
from maplab_py.vision.descriptors import DescriptorKind, differences
from maplab_py.vision.features.learned.lighterglue import ImageKeypoints, installed_lighterglue
from maplab_py.vision.features.learned.lighterglue_graph import DIMENSIONS

_PAIRS_AT_ONCE = 64


def check_matcher(kind: DescriptorKind) -> None:
    """Check, before a search, that the network can match descriptors of a kind.

    Raises:
        UserError: It is not installed, or is for others.
    """
    if (kind.dimensions, kind.depth) != (DIMENSIONS, DescriptorDepth.FLOAT32):
        raise UserError(
            f"--lc_matcher=lighterglue: matches descriptors of {4 * DIMENSIONS} bytes, the map has "
            f"{kind.words}: give --lc_matcher=nearest, or run extract_features"
        )
    installed_lighterglue()


def match_again(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    candidates: Candidates,
    which: I64,
    progress: Progress,
) -> tuple[Matches, Candidates]:
    """Return some candidates with additional matches by the network, and all matches.

    Images of the same camera at the query and at the place's vertex are compared.

    Args:
        matches: Matches of all candidates.
        which: Rows of those that are matched again.

    Raises:
        UserError: The network is not installed.
    """
    images = _Images(vi_map, features)
    again = candidates.take(which)
    owner, first, second = images.pairs(again.query_vertex, again.place_vertex)
    query, database = images.match(first, second, progress)
    count = np.array([len(rows) for rows in query], dtype=np.int64)
    owner = np.repeat(owner, count)
    i = np.concatenate([np.zeros(0, dtype=np.int64), *query])
    j = np.concatenate([np.zeros(0, dtype=np.int64), *database])
    label = features.descriptors.label
    kept = features.in_database[j] & (label[i] != label[j])
    owner, i, j = owner[kept], i[kept], j[kept]
    words = features.descriptors.words
    extra = Matches(i, j, differences(words, i, words, j))
    owner = np.concatenate([np.repeat(np.arange(len(again)), np.diff(again.start)), owner])
    match = np.concatenate([again.match, len(matches) + np.arange(len(extra))])
    return Matches.concatenate([matches, extra]), dataclasses.replace(
        again,
        start=starts_of_counts(np.bincount(owner, minlength=len(again))),
        match=match[np.argsort(owner, kind="stable")],
    )


class _Images:
    """Features by image: frames that have some are numbered in ascending order."""

    def __init__(self, vi_map: VIMap, features: MapFeatures) -> None:
        self._map, self._features = vi_map, features
        self._frame, self._first = np.unique(
            vi_map.keypoint_frame[features.keypoint], return_index=True
        )
        self._end = np.append(self._first[1:], len(features))

    def pairs(self, query: I64, place: I64) -> tuple[I64, I64, I64]:
        """Return candidate and both images of each pair of images, of vertices (N,)."""
        frames = self._map.frames
        cameras = int(frames.camera_index.max(initial=0)) + 1
        key = (
            frames.vertex[self._frame].astype(np.int64) * cameras + frames.camera_index[self._frame]
        )
        row_of = np.full(len(self._map.vertices) * cameras, -1, dtype=np.int64)
        row_of[key] = np.arange(len(key))
        camera = np.arange(cameras)
        first, second = (row_of[vertex[:, None] * cameras + camera] for vertex in (query, place))
        owner, column = np.nonzero((first >= 0) & (second >= 0))
        return owner, first[owner, column], second[owner, column]

    def match(self, first: I64, second: I64, progress: Progress) -> tuple[list[I64], list[I64]]:
        """Return the features of each pair of images (P,) that the network matches."""
        network = installed_lighterglue()
        query: list[I64] = []
        database: list[I64] = []
        for begin in range(0, len(first), _PAIRS_AT_ONCE):
            progress.step(begin, len(first), "matching candidates again")
            a, b = (each[begin : begin + _PAIRS_AT_ONCE].tolist() for each in (first, second))
            keypoints = {row: self._keypoints(row) for row in {*a, *b}}
            pairs = [(keypoints[i], keypoints[j]) for i, j in zip(a, b, strict=True)]
            for i, j, (rows, others) in zip(a, b, network.match(pairs), strict=True):
                query.append(self._first[i] + rows)
                database.append(self._first[j] + others)
        return query, database

    def _keypoints(self, image: int) -> ImageKeypoints:
        vi_map, frame = self._map, int(self._frame[image])
        rows = self._features.keypoint[self._first[image] : self._end[image]]
        numbers = np.ascontiguousarray(
            vi_map.keypoints.descriptor[rows, : self._features.kind.size]
        )
        descriptors: F32 = numbers.view("<f4")
        descriptors = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
        mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]]
        rig = to_hex(vi_map.missions.sensor_id[mission, MissionSensor.NCAMERA])
        camera = vi_map.sensors.camera_rig(rig).cameras[int(vi_map.frames.camera_index[frame])]
        size_px = int(camera.width_px), int(camera.height_px)
        return ImageKeypoints(vi_map.keypoints.uv_px[rows], descriptors, size_px)
