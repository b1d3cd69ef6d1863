"""Work of the process beside an odometry: it evaluates segments, keeps the database, and calibrates."""

import dataclasses
import functools
import itertools
import time

import numpy as np

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.algorithms.self_calibration import changes, checks, reports
from maplab_py.algorithms.self_calibration.device import transfer_calibration, with_device_of
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.pruning import (
    PROBABILITY,
    estimate_segment,
    test_segments,
)
from maplab_py.algorithms.self_calibration.segments import selection
from maplab_py.algorithms.self_calibration.segments.database import (
    Key,
    SegmentDatabase,
    SegmentRecord,
    load_database,
    locked_database,
    save_database,
)
from maplab_py.array_types import F64
from maplab_py.errors import EstimationError, MaplabError
from maplab_py.frontend.recorded_mission import RecordedMission, mission_map
from maplab_py.interop.device import RecordedSensors
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.online_calibration.suggestions import (
    known_share,
    simulated_covariances,
    suggestions,
    wanted_sigma,
)
from maplab_py.output_files import write_text
from maplab_py.progress import SILENT
from maplab_py.sensors import SensorSet, calibration_transfer, sensors_yaml
from maplab_py.vimap import VIMap, excerpts, merge, to_hex

OPTIONS = SelfCalibrationOptions(keep_unobservable_at_prior=True)
_SEGMENTS_AT_ONCE = 5
"""Segments after which the database is written; fewer at the end. A crash loses those since."""
_MAX_CAMERA_SHIFT_M = 0.025
_MAX_SUGGESTED = 12
_CLEAR_SIGMAS = 15.0
"""A running odometry goes on with a calibration that is so much better than the one it has."""
_REDO_SHARE = 0.5
"""Without a contradiction, calibrate when this share of the database is newer than the last calibration."""


@dataclasses.dataclass(frozen=True, eq=False)
class Opening:
    """First request: the device and its options."""

    options: OnlineCalibrationOptions
    device: RecordedSensors


@dataclasses.dataclass(frozen=True, eq=False)
class Piece:
    """Request: a segment whose vertices have left the window."""

    session: str  # name of the mission, from which ids follow
    recorded: RecordedMission


@dataclasses.dataclass(frozen=True)
class Finish:
    """Last request: write what is left, and calibrate if it is due."""


@dataclasses.dataclass(frozen=True)
class Missing:
    """Segments and motion that lead to the wanted deviations."""

    known_share: float
    segments: str = ""  # their number in words; empty = nothing is missing
    motion: str = ""  # words of the best one

    def __str__(self) -> str:
        return f"{self.segments} needed; {self.motion}" if self.segments else ""


@dataclasses.dataclass(frozen=True)
class Status:
    """Answer to every request."""

    evaluated: int = 0
    kept: int = 0  # segments in the database
    processor_s: float = 0.0  # of all requests
    contradiction: changes.Contradiction | None = None  # the strongest so far, if significant
    missing: Missing | None = None  # None before the first segment
    proposal: reports.SelfCalibrationReport | None = None
    problem: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class _Segment:
    """A segment of this session."""

    piece: Piece
    evaluation: selection.Evaluation  # of it alone, at the calibration of the database

    @property
    def covariance(self) -> F64:
        return self.evaluation.segments[0].covariance


class DeviceCalibration:
    """Knowledge of a device: segments of the running session, and those of the database."""

    def __init__(self, opening: Opening) -> None:
        """Read the database, if there is one.

        Raises:
            UserError: It cannot be read.
        """
        self._options, self._device = opening.options, opening.device
        assert opening.options.database is not None
        self._path = opening.options.database
        database = load_database(self._path) if self._path.exists() else None
        self._database = database if database is not None and len(database) else None
        self._earlier: dict[Key, F64] = {}  # covariances of the database's segments
        self._session: list[_Segment] = []  # all of them that may still be kept
        self._evidence: list[changes.Evidence] = []
        self._unwritten, self._evaluated = 0, 0
        self._parameters, self._tolerance = Parameters(()), np.zeros(0)
        self._library: dict[str, F64] | None = None
        self._contradiction: changes.Contradiction | None = None
        self._proposal: reports.SelfCalibrationReport | None = None
        self._calibrated: frozenset[Key] = frozenset()
        self._problem = ""

    def answer(self, request: Piece | Finish) -> Status:
        """Do what a request asks; an error becomes the problem of the status."""
        try:
            if isinstance(request, Piece):
                self._add(request)
            else:
                self._finish()
        except (MaplabError, np.linalg.LinAlgError) as error:
            self._problem = str(error)
        return self.status()

    def status(self) -> Status:
        """Return what is known now."""
        return Status(
            evaluated=self._evaluated,
            kept=0 if self._database is None else len(self._database),
            processor_s=time.process_time(),
            contradiction=self._contradiction,
            missing=self._missing(),
            proposal=self._proposal,
            problem=self._problem,
        )

    # -- segments ---------------------------------------------------------------------------------

    def _add(self, piece: Piece) -> None:
        segment = _map_of([piece], self._device)
        try:
            estimate = estimate_segment(segment, OPTIONS)
        except EstimationError:
            estimate = None  # without tracks there is no statement
        time_ns = segment.vertices.timestamp_ns
        source = segment
        if self._database is not None:
            source = with_device_of(segment, self._database.vi_map)
        evaluation = selection.evaluate(source, OPTIONS)
        self._evaluated += 1
        if len(evaluation.parameters) > len(self._parameters):
            self._parameters = evaluation.parameters
            self._tolerance = wanted_sigma(segment, OPTIONS, self._options.wanted)
        if estimate is not None and len(estimate.parameters) == len(self._parameters):
            evidence = changes.evidence_of(estimate, int(time_ns[0]), int(time_ns[-1]))
            self._evidence.append(evidence)
        if len(evaluation.parameters) == len(self._parameters):
            self._session.append(_Segment(piece, evaluation))
            self._unwritten += 1
        self._look_for_contradiction()
        if self._unwritten >= _SEGMENTS_AT_ONCE:
            self._write()
        if self._is_contradiction_understood() and self._proposal is None:
            self._calibrate()

    def _look_for_contradiction(self) -> None:
        """Compare the newest segments with the calibration; the first time is kept."""
        new = changes.strongest_contradiction(self._evidence, self._parameters, self._tolerance)
        if new is None or not new.is_significant:
            return
        old = self._contradiction
        if old is not None:
            new = dataclasses.replace(
                new if new.sigmas > old.sigmas else old, since_ns=min(old.since_ns, new.since_ns)
            )
        self._contradiction = new

    def _write(self) -> None:
        """Merge the session's segments into the database on disk, which others may have changed."""
        if not self._unwritten:
            return
        with locked_database(self._path):
            database = load_database(self._path) if self._path.exists() else None
            if database is None or not len(database):
                reference = np.median(
                    [np.sqrt(np.diag(each.covariance)) for each in self._session], axis=0
                )
                vi_map = self._session[0].evaluation.vi_map
                database = selection.empty_database(vi_map, self._parameters, reference, OPTIONS)
            records = [self._record(each, database) for each in self._session]
            whole = _map_of([each.piece for each in self._session], self._device)
            database, _ = selection.keep_best(database, whole, self._parameters, records, OPTIONS)
            save_database(database, self._path)
        kept = {record.key for record in database.records}
        pairs = zip(self._session, records, strict=True)
        self._session = [segment for segment, record in pairs if record.key in kept]
        self._database, self._unwritten = database, 0

    def _record(self, segment: _Segment, database: SegmentDatabase) -> SegmentRecord:
        return segment.evaluation.records(OPTIONS, database.sigma_ref)[0]

    # -- calibration ------------------------------------------------------------------------------

    def _covariance(self) -> F64:
        """Return what the segments that belong to the present state of the device leave (k, k)."""
        since_ns = None if self._contradiction is None else self._contradiction.since_ns
        known = [
            segment.covariance
            for segment in self._session
            if since_ns is None or _begin_ns(segment) >= since_ns
        ]
        if since_ns is None:
            known += self._covariances_of_database()
        return changes.joint_covariance(known, self._parameters.prior_sigma)

    def _covariances_of_database(self) -> list[F64]:
        """Return the covariances (k, k) that the segments of earlier sessions leave alone."""
        database = self._database
        if database is None:
            return []
        here = {_mission_of(segment) for segment in self._session}
        earlier = [record for record in database.records if record.mission not in here]
        for record in earlier:
            if record.key not in self._earlier:
                evaluation = selection.evaluate(database.map_of(record), OPTIONS)
                self._earlier[record.key] = evaluation.segments[0].covariance
        covariances = (self._earlier[record.key] for record in earlier)
        return [each for each in covariances if len(each) == len(self._parameters)]

    def _is_contradiction_understood(self) -> bool:
        """Return whether what is contradicted is known as well as wanted, or much better than before."""
        if self._contradiction is None:
            return False
        if self._options.apply == "now" and self._contradiction.sigmas >= _CLEAR_SIGMAS:
            return True
        rows = changes.families(self._parameters)[self._contradiction.family]
        sigma = np.sqrt(np.diag(self._covariance()))
        return bool(np.all(sigma[rows] <= self._tolerance[rows]))

    def _missing(self) -> Missing | None:
        """Return how many segments of which motion lead to what is wanted."""
        if not len(self._parameters) or (self._contradiction is None and not self._evidence):
            return None
        covariance, rows = self._covariance(), np.arange(len(self._parameters))
        if self._contradiction is not None:
            rows = changes.families(self._parameters)[self._contradiction.family]
        sigma, tolerance = np.sqrt(np.diag(covariance))[rows], self._tolerance[rows]
        share = known_share(sigma, self._parameters.prior_sigma[rows], tolerance)
        if np.all(sigma <= tolerance):
            return Missing(share)
        if self._library is None:
            self._library = simulated_covariances(self._device.sensors, OPTIONS)
        coming = suggestions(covariance, self._library, self._parameters, self._tolerance, rows)
        needed, motion = 0, ""
        for suggestion in itertools.islice(coming, _MAX_SUGGESTED):
            needed, motion = needed + 1, motion or suggestion.motion
            if suggestion.is_sufficient:
                return Missing(share, f"{needed} more segments", motion)
        return Missing(share, f"{needed} more segments or more", motion)

    def _finish(self) -> None:
        self._write()
        database = self._database
        if database is None:
            return
        keys = {record.key for record in database.records}
        is_new = len(keys - self._calibrated) >= _REDO_SHARE * max(len(keys), 1)
        if self._contradiction is not None:
            if self._proposal is None or is_new:
                self._calibrate()
        elif is_new and len(self._parameters) and not self._options.proposal.exists():
            sigma = np.sqrt(np.diag(self._covariance()))
            if np.all(sigma <= self._tolerance):
                self._calibrate()

    def _calibrate(self) -> None:
        """Calibrate on the segments that belong to the present state of the device; write the proposal.

        Raises:
            MaplabError: It cannot be calibrated.
        """
        self._write()
        database = self._database
        assert database is not None
        valid = self._valid_segments(database)
        vi_map = transfer_calibration(valid.vi_map, self._device.sensors)
        sensors, _, report = checks.calibrate_with_checks(
            vi_map, OPTIONS, max_camera_shift_m=_MAX_CAMERA_SHIFT_M, batch=True
        )
        report = dataclasses.replace(report, segments=len(valid))
        calibrated = calibration_transfer.with_calibration_of(
            self._device.sensors,
            calibration_transfer.Device(self._device.imu_id, self._device.rig_id),
            sensors,
            calibration_transfer.only_device(sensors),
        )
        write_proposal(self._options, calibrated, report)
        self._proposal = report
        self._calibrated = frozenset(record.key for record in database.records)
        if self._options.applies_later and len(valid) < len(database):
            self._drop(database, valid)

    def _valid_segments(self, database: SegmentDatabase) -> SegmentDatabase:
        """Return the segments since a contradiction, with those of before that agree with them."""
        if self._contradiction is None:
            return database
        since_ns = self._contradiction.since_ns
        here = {_mission_of(segment) for segment in self._session}
        recent = {
            record.key
            for record in database.records
            if record.mission in here and record.begin_ns >= since_ns
        }
        if not recent or len(recent) == len(database):
            return database
        new = database.with_only(recent)
        vi_map = transfer_calibration(new.vi_map, self._device.sensors)
        sensors, _, _ = checks.calibrate_with_checks(
            vi_map, OPTIONS, max_camera_shift_m=_MAX_CAMERA_SHIFT_M, batch=True
        )
        before = database.with_only({record.key for record in database.records} - recent)
        tests = test_segments(before, sensors, OPTIONS, PROBABILITY, SILENT)
        pairs = zip(before.records, tests, strict=True)
        agreeing = {record.key for record, test in pairs if not test.outdated}
        return database.with_only(recent | agreeing)

    def _drop(self, database: SegmentDatabase, valid: SegmentDatabase) -> None:
        """Remove outdated segments from the database on disk."""
        outdated = {r.key for r in database.records} - {r.key for r in valid.records}
        with locked_database(self._path):
            now = load_database(self._path)
            self._database = now.with_only({r.key for r in now.records} - outdated)
            save_database(self._database, self._path)


def _begin_ns(segment: _Segment) -> int:
    return int(segment.piece.recorded.states[0].time_ns[0])


def _mission_of(segment: _Segment) -> str:
    return to_hex(segment.evaluation.vi_map.missions.id[0])


def _map_of(pieces: list[Piece], device: RecordedSensors) -> VIMap:
    """Return the map of segments of one session, in the order of time, with landmarks.

    Segments that adjoin share a vertex; across gaps there is no edge.
    """
    maps = []
    for session in dict.fromkeys(piece.session for piece in pieces):
        joined = RecordedMission()
        for piece in (piece for piece in pieces if piece.session == session):
            part = piece.recorded
            if joined.states and joined.last_ns == int(part.states[0].time_ns[0]):
                part = part.part(1)
                joined.edges += piece.recorded.edges[:1]
            elif joined.states:
                joined.edges.append((np.zeros(0, dtype=np.int64), np.zeros((0, 6))))
            joined.states += part.states
            joined.frames += part.frames
            joined.image_rows += part.image_rows
            joined.edges += part.edges
        vi_map = mission_map(device, joined, None)
        edges = vi_map.imu_edges
        vi_map = vi_map.replace(imu_edges=edges.take(np.flatnonzero(edges.sample_count > 0)))
        vi_map, _ = init_tracks(vi_map, LandmarkQualityOptions(), across_cameras=True)
        maps.append(excerpts.with_ids_of_times(vi_map, session))
    return functools.reduce(merge.stack, maps)


def write_proposal(
    options: OnlineCalibrationOptions, sensors: SensorSet, report: reports.SelfCalibrationReport
) -> None:
    """Write a calibration as sensors.yaml that begins with values and deviations.

    Raises:
        UserError: It cannot be written.
    """
    lines = [f"# calibration by {report.segments} segments of {options.database}"]
    lines += [f"# {words(estimate)}; {estimate.verdict}" for estimate in report.parameters]
    lines += [f"# not observable: {name}" for name in report.unobservable]
    text = "\n".join(lines) + "\n" + sensors_yaml.write_sensors(sensors)
    write_text(options.proposal, [text], overwrite=True)


def words(estimate: reports.ParameterEstimate) -> str:
    """Return an estimate in words."""
    unit = f" {estimate.unit}" if estimate.unit else ""
    return (
        f"{estimate.parameter} {estimate.before:.6g} -> {estimate.after:.6g} +- {estimate.sigma:.2g}"
        f"{unit} ({estimate.change_in_sigmas:+.1f} sigma)"
    )
