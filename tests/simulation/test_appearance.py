"""Descriptors: near views of a point look alike, far ones less, other points not at all."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.simulation.detection import Detections
from maplab_py.simulation.scenario import AppearanceOptions
from maplab_py.simulation.scene import describe, make_appearance, make_session_appearance
from tests.simulation.small import docs_script, simulated
from tests.support.data import REPOSITORY, shared_data

COUNT = 400


def _detections(view: list[float], distance: float) -> Detections:
    rows = np.arange(COUNT)
    direction = np.array(view) / np.linalg.norm(view)
    return Detections(
        frame=np.zeros(COUNT, dtype=np.int64),
        point=rows,
        track=rows,
        uv_true_px=np.zeros((COUNT, 2)),
        uv_px=np.zeros((COUNT, 2)),
        view_G=np.tile(direction, (COUNT, 1)),
        distance_m=np.full(COUNT, distance),
        octave=np.zeros(COUNT, dtype=np.int64),
    )


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.median(np.bitwise_count(a ^ b).sum(axis=1)))


def test_distances_grow_with_view_scale_and_session() -> None:
    world = make_appearance(AppearanceOptions(), np.arange(COUNT), np.random.default_rng(0))
    session = make_session_appearance(world, np.random.default_rng(1))
    other = make_session_appearance(world, np.random.default_rng(2))
    rng = np.random.default_rng(3)
    here = describe(session, _detections([0, 0, 1], 3.0), rng)
    again = describe(session, _detections([0, 0, 1], 3.0), rng)
    tilted = describe(session, _detections([1, 0, 1], 3.0), rng)
    far = describe(session, _detections([0, 0, 1], 9.0), rng)
    later = describe(other, _detections([0, 0, 1], 3.0), rng)
    bits = 8 * here.shape[1]
    assert here.shape == (COUNT, 48)
    same = _distance(here, again)
    assert 0.02 * bits < same < 0.15 * bits
    assert same < _distance(here, tilted) < 0.3 * bits
    assert same < _distance(here, far) < 0.3 * bits
    assert same < _distance(here, later) < 0.3 * bits
    assert 0.45 * bits < _distance(here, here[::-1]) < 0.55 * bits


def test_bits_are_correlated() -> None:
    world = make_appearance(AppearanceOptions(), np.arange(COUNT), np.random.default_rng(0))
    session = make_session_appearance(world, np.random.default_rng(1))
    found = describe(session, _detections([0, 0, 1], 3.0), np.random.default_rng(3))
    bits = np.unpackbits(found, axis=1).astype(np.float64)
    correlation = np.corrcoef(bits.T)
    np.fill_diagonal(correlation, 0.0)
    # independent bits of 400 points would stay below 0.25
    assert np.abs(correlation).max() > 0.3


def test_share_that_vanishes() -> None:
    world = make_appearance(
        AppearanceOptions(vanish_share=0.3), np.arange(5000), np.random.default_rng(0)
    )
    session = make_session_appearance(world, np.random.default_rng(1))
    assert abs(np.mean(session.is_there) - 0.7) < 0.03


def test_length_of_the_descriptor() -> None:
    options = AppearanceOptions(descriptor_bytes=64)
    world = make_appearance(options, np.arange(COUNT), np.random.default_rng(0))
    session = make_session_appearance(world, np.random.default_rng(1))
    found = describe(session, _detections([0, 0, 1], 3.0), np.random.default_rng(3))
    assert found.shape == (COUNT, 64)
    assert found.dtype == np.uint8


def test_distances_are_those_of_recorded_maps() -> None:
    vi_map = simulated().maps[0]
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows]
    point = simulated().truth.landmark_point[landmark]
    descriptor = vi_map.keypoints.descriptor[rows]
    next_same = landmark[1:] == landmark[:-1]
    shuffled = np.random.default_rng(0).permutation(len(rows))
    other = point[shuffled] != point
    same = np.bitwise_count(descriptor[1:] ^ descriptor[:-1]).sum(axis=1)[next_same]
    different = np.bitwise_count(descriptor[shuffled] ^ descriptor).sum(axis=1)[other]
    # measured on Tango and EuRoC maps: equal 8 28 51 82 140, different 107 132 178 220
    assert 40 < np.median(same) < 60
    assert 75 < np.percentile(same, 95) < 145
    assert 165 < np.median(different) < 190
    assert 110 < np.percentile(different, 1) < 140
    assert np.percentile(same, 99) > np.percentile(different, 1)


@pytest.mark.slow
def test_distances_share_their_histograms_with_those_of_recorded_maps() -> None:
    folders = [
        shared_data("maplab_maps/tango_handheld"),
        *sorted(shared_data("maplab_maps/euroc_v1_01").iterdir()),
    ]
    script = docs_script("compare_descriptors")
    recorded, simulated_bits = script.recorded_distances(folders), script.simulated_distances()
    for kind in ("same", "different"):
        common = script.overlap(
            script.histogram(recorded[kind]), script.histogram(simulated_bits[kind])
        )
        # the recorded maps share 0.88 and 0.90 with each other
        assert common > 0.88
    figure = (REPOSITORY / "docs/images/descriptor_distances.svg").read_text()
    assert figure == script.drawing(recorded, simulated_bits)
