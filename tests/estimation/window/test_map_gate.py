"""The gate of observations of a map."""

import dataclasses

import numpy as np

from maplab_py.estimation.window.map_terms import contradicted, contradicted_unless_most
from maplab_py.estimation.window.options import WindowOptions
from tests.estimation.window.test_map_terms import LANDMARKS, window

OPTIONS = WindowOptions()


def test_one_far_observation_contradicts_its_landmark_alone() -> None:
    terms, states = window()
    seen = terms.observations
    error_px = terms.errors_px(states)
    assert not contradicted(error_px, seen, OPTIONS).any()
    error_px[seen.start[2] + 1] = 9.0
    error_px[seen.start[4]] = np.inf
    np.testing.assert_array_equal(np.flatnonzero(contradicted(error_px, seen, OPTIONS)), [2, 4])
    error_px[seen.start[2] + 1] = 8.0
    np.testing.assert_array_equal(np.flatnonzero(contradicted(error_px, seen, OPTIONS)), [4])


def test_when_most_landmarks_are_far_the_prediction_is_wrong() -> None:
    terms, states = window()
    error_px = np.zeros(len(terms.observations))
    error_px[terms.observations.start[: LANDMARKS // 2]] = 50.0
    assert contradicted(error_px, terms.observations, OPTIONS).sum() == LANDMARKS // 2
    assert not contradicted_unless_most(error_px, terms.observations, OPTIONS).any()
    error_px[0] = 0.0
    assert contradicted_unless_most(error_px, terms.observations, OPTIONS).sum() == 2
    assert len(states) == 3


def test_without_observations_nothing_is_contradicted() -> None:
    terms, _ = window()
    none = dataclasses.replace(
        terms.observations, start=np.zeros(1, dtype=np.int64), sigma_px=np.zeros(0)
    )
    none = dataclasses.replace(none, frame=none.frame[:0])
    assert not len(contradicted(np.zeros(0), none, OPTIONS))
