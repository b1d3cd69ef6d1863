"""Removal of segments from a database: of missions, beyond a capacity, or of a device that changed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.device import transfer_calibration
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.reports import PrunedSegment, PruneReport
from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase
from maplab_py.algorithms.self_calibration.uncertainty.segment_test import (
    SegmentTest,
    test_segment,
)
from maplab_py.errors import EstimationError, UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet

PROBABILITY = 0.999
"""Of accepting a segment if the calibration is right."""


def prune(
    database: SegmentDatabase,
    options: SelfCalibrationOptions,
    *,
    missions: Sequence[str] = (),
    outdated: bool = False,
    calibration: SensorSet | None = None,
    probability: float = PROBABILITY,
    capacity: int = 0,
    progress: Progress = SILENT,
) -> tuple[SegmentDatabase, PruneReport]:
    """Remove segments of some missions, then outdated ones, then those beyond a capacity.

    Args:
        database: Segments.
        options: What was estimated.
        missions: Beginnings of ids of missions.
        outdated: Test the segments and remove those that contradict the calibration.
        calibration: To test against; None = the joint calibration of all segments.
        probability: Of accepting a segment if the calibration is right.
        capacity: Segments per table; 0 = as many as it has.
        progress: Shown while segments are tested.

    Raises:
        EstimationError: Half of the segments contradict their joint calibration.
        UserError: A mission is unknown, or the calibration is of other cameras.
    """
    result, tests = database, list[SegmentTest]()
    if missions:
        prefixes = tuple(missions)
        removed = {r.mission for r in database.records if r.mission.startswith(prefixes)}
        if not removed:
            raise UserError(f"--missions: the database has no segment of {','.join(missions)}")
        result = result.without_missions(removed)
    tested = result
    if outdated:
        if calibration is None:
            tests = test_mutual_consistency(tested, options, probability, progress)
        else:
            tests = test_segments(tested, calibration, options, probability, progress)
        pairs = zip(tested.records, tests, strict=True)
        result = result.with_only([record.key for record, test in pairs if not test.is_outdated])
    if capacity:
        result = result.pruned(capacity)
    rows = (
        PrunedSegment(
            mission=record.mission[:8],
            first_vertex=record.first_vertex[:8],
            distance=test.distance,
            limit=test.limit,
            chi_square_per_freedom=test.chi_square_per_freedom,
            outdated=test.is_outdated,
        )
        for record, test in zip(tested.records if tests else (), tests, strict=True)
    )
    return result, PruneReport(len(database), len(result), tuple(rows))


def test_mutual_consistency(
    database: SegmentDatabase,
    options: SelfCalibrationOptions,
    probability: float,
    progress: Progress,
) -> list[SegmentTest]:
    """Test every segment against the joint calibration of all segments.

    Raises:
        EstimationError: Half of the segments contradict it, so that it is unknown which of them are
            outdated.
    """
    if not len(database):
        return []
    lenient = dataclasses.replace(options, keep_unobservable_at_prior=True)
    result, _ = calibrate(database.vi_map, lenient, segments=len(database), progress=progress)
    tests = test_segments(database, result.sensors, options, probability, progress)
    against = sum(test.is_outdated for test in tests)
    if 2 * against >= len(tests):
        raise EstimationError(
            f"{against} of {len(tests)} segments contradict what all say together, so the device may "
            "have changed between sessions: name the calibration that holds now by --calibration"
        )
    return tests


def test_segments(
    database: SegmentDatabase,
    sensors: SensorSet,
    options: SelfCalibrationOptions,
    probability: float,
    progress: Progress,
) -> list[SegmentTest]:
    """Test every segment against a calibration.

    Args:
        database: Segments.
        sensors: The calibration; of other ids, when it has one IMU and one rig.
        options: What was estimated.
        probability: Of accepting a segment if the calibration is right.
        progress: Shown while segments are tested.

    Raises:
        UserError: The calibration is of other cameras, or it is not clear of which.
    """
    tests = []
    for number, record in enumerate(database.records):
        progress.step(number, len(database), "test segments")
        segment = transfer_calibration(database.map_of(record), sensors)
        tests.append(test_segment(segment, options, probability))
    return tests
