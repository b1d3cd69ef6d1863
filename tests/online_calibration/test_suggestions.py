"""Suggested motions teach more than others."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.changes import joint_covariance
from maplab_py.algorithms.self_calibration.segments.selection import collect, evaluate
from maplab_py.errors import UserError
from maplab_py.online_calibration.options import WantedSigmas
from maplab_py.online_calibration.process import OPTIONS
from maplab_py.online_calibration.suggestions import (
    MOTIONS,
    known_share,
    simulated_segment,
    suggest_motion,
    wanted_sigma,
)
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.simulation.simulate import simulate
from tests.online_calibration.recorded import device_scenario


@pytest.mark.parametrize(
    "poor",
    [
        MotionOptions(kind="straight", duration_s=8.0, speed_mps=0.3),
        MotionOptions(kind="rotation", duration_s=8.1, turns=0.4),
    ],
    ids=lambda poor: poor.kind,
)
def test_three_suggestions_teach_more_than_three_everyday_segments(poor: MotionOptions) -> None:
    """The bar of both factors is on the least known parameter."""
    database, _ = collect(simulate(device_scenario(poor)).maps[0], OPTIONS)
    report = suggest_motion(database, OPTIONS, WantedSigmas())
    assert len(report.suggestions) == 3
    assert not report.sufficient
    assert 0.0 < report.known_share < 0.9
    evaluation = evaluate(database.vi_map, OPTIONS)
    prior = evaluation.parameters.prior_sigma
    tolerance = wanted_sigma(database.vi_map, OPTIONS, WantedSigmas())
    known = [segment.covariance for segment in evaluation.segments]
    worst = int(np.argmax(np.diag(joint_covariance(known, prior)) / tolerance**2))
    assert report.suggestions[0].parameter == evaluation.parameters.names[worst]
    # the motions are simulated in another room with other noise than the predictions
    motions = {motion.words: motion for motion in MOTIONS}
    suggested = [
        evaluate(simulated_segment(database.vi_map.sensors, motions[each.motion], seed=7), OPTIONS)
        for each in report.suggestions
    ]
    walk = MotionOptions(kind="room_scan", duration_s=12.1, turns=0.2, height_m=1.4)
    everyday = evaluate(simulate(device_scenario(walk, seed=3)).maps[0], OPTIONS)
    sigma = [
        float(np.sqrt(joint_covariance([*known, *more], prior)[worst, worst]))
        for more in (
            [],
            [each.segments[0].covariance for each in suggested],
            [each.covariance for each in everyday.segments[:3]],
        )
    ]
    assert sigma[1] < sigma[0] / 3.0
    assert sigma[1] < sigma[2] / 2.0
    assert report.suggestions[0].sigma_before == pytest.approx(sigma[0])


def test_the_known_share_grows_from_the_prior_to_what_is_wanted() -> None:
    prior, wanted = np.array([1.0, 10.0]), np.array([0.01, 0.1])
    shares = [known_share(sigma * prior, prior, wanted) for sigma in (2.0, 1.0, 0.1, 0.01, 0.001)]
    assert shares == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    assert known_share(np.array([1.0, 0.1]), prior, wanted) == pytest.approx(0.5)


def test_an_empty_database_is_refused() -> None:
    straight = MotionOptions(kind="straight", duration_s=4.0, speed_mps=0.3)
    database, _ = collect(simulate(device_scenario(straight)).maps[0], OPTIONS)
    empty = dataclasses.replace(database, records=())
    with pytest.raises(UserError, match="the database has no segment"):
        suggest_motion(empty, OPTIONS, WantedSigmas())
