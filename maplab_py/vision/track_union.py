"""Merge pairs of tracks unless an image would contain two keypoints of one track."""

import numpy as np

from maplab_py.array_types import I64, NDArray
from maplab_py.compilation import compiled


def unite_tracks(
    first: I64, second: I64, start: I64, image: I64, image_count: int
) -> NDArray[np.bool_]:
    """Return which pairs of tracks can be merged, processed in order.

    A pair is rejected if both merged tracks have a keypoint in the same image, because two points
    observed in one image are distinct.

    Args:
        first: Track of each pair (N,), best pairs first.
        second: The other track (N,).
        start: Offsets (T + 1): images of track t are image[start[t]] .. image[start[t + 1] - 1].
        image: Images of the tracks' keypoints.
        image_count: Number of images.

    Returns:
        Accepted pairs (N,); pairs whose tracks are merged already are accepted.
    """
    accepted = np.zeros(len(first), dtype=np.bool_)
    _unite(first, second, start, image, np.full(image_count, -1, dtype=np.int64), accepted)
    return accepted


@compiled()
def _root(parent, track):  # type: ignore[no-untyped-def]
    while parent[track] != track:
        parent[track] = parent[parent[track]]
        track = parent[track]
    return track


@compiled()
def _unite(first, second, start, image, stamp, accepted):  # type: ignore[no-untyped-def]
    tracks = len(start) - 1
    parent = np.arange(tracks)
    following = np.full(tracks, -1, dtype=np.int64)  # members of a set as a linked list
    last = np.arange(tracks)
    for pair in range(len(first)):
        a, b = _root(parent, first[pair]), _root(parent, second[pair])
        if a == b:
            accepted[pair] = True
            continue
        member = a
        while member >= 0:
            for i in range(start[member], start[member + 1]):
                stamp[image[i]] = pair
            member = following[member]
        clash = False
        member = b
        while member >= 0 and not clash:
            for i in range(start[member], start[member + 1]):
                if stamp[image[i]] == pair:
                    clash = True
                    break
            member = following[member]
        if clash:
            continue
        accepted[pair] = True
        parent[b] = a
        following[last[a]] = b
        last[a] = last[b]


def compile_kernels() -> None:
    """Compile the union on two tracks."""
    track = np.arange(2)
    unite_tracks(track[:1], track[1:], np.arange(3), track, 2)
