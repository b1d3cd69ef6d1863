"""Merges of tracks that show different points are counted, and those that a track joins are not."""

import numpy as np

from benchmarks.places.aliased import strangers
from maplab_py.simulation.evaluation import Sightings

POINT_G = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [9.0, 0.0, 0.0], [20.0, 0.0, 0.0]])


def _seen(*rows: tuple[int, int, int]) -> Sightings:
    landmark, track, point = np.array(rows, dtype=np.int64).T
    return Sightings(landmark, point, track)


def test_tracks_of_one_point_or_of_near_points_are_no_strangers():
    assert strangers(_seen((0, 1, 0), (0, 2, 0), (0, 3, 1), (5, 9, 2)), POINT_G) == 0


def test_a_track_that_went_over_to_another_point_joins_both():
    seen = _seen(*[(0, 1, 0)] * 300, (0, 2, 0), (0, 2, 2), (0, 3, 2))
    assert strangers(seen, POINT_G) == 0


def test_two_tracks_of_one_point_with_two_of_another_are_two_strangers():
    assert strangers(_seen((4, 1, 0), (4, 2, 0), (4, 3, 2), (4, 4, 2)), POINT_G) == 2


def test_every_landmark_is_counted_and_clutter_is_not():
    seen = _seen((0, 1, 0), (0, 2, 2), (0, 3, 3), (1, 4, 0), (1, 5, 3), (2, 6, -1), (2, -1, 0))
    assert strangers(seen, POINT_G) == 3


def test_nothing_seen():
    none = np.zeros(0, dtype=np.int64)
    assert strangers(Sightings(none, none, none), POINT_G) == 0
