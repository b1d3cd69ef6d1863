"""What the commands do: collect, choose, calibrate, and put the result into the map."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.calibration import Calibration, calibrate
from maplab_py.algorithms.self_calibration.collection import collect, records_of
from maplab_py.algorithms.self_calibration.collection import evaluate as evaluate_segments
from maplab_py.algorithms.self_calibration.database import (
    SegmentDatabase,
    device_of,
    with_calibration,
)
from maplab_py.algorithms.self_calibration.information_gain import select_by_gain
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.reports import (
    InformationReport,
    ParameterReference,
    SegmentScore,
    SelfCalibrationReport,
)
from maplab_py.algorithms.self_calibration.segments import restricted
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import CameraRig, Imu, SensorSet
from maplab_py.sensors.sensor_set import Sensor
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def self_calibrate(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    database: SegmentDatabase | None = None,
    missions: NDArray[np.integer] | None = None,
    batch: bool = False,
    progress: Progress = SILENT,
) -> tuple[SensorSet, SegmentDatabase | None, Calibration, SelfCalibrationReport]:
    """Calibrate the device of some missions (rows, None = all).

    Args:
        vi_map: The map.
        options: What to estimate, from which segments.
        database: Segments of earlier sessions, to which the map's are added.
        missions: Missions of one device.
        batch: Use all data instead of segments.
        progress: Shown one line an iteration.

    Returns:
        The map's sensors with the new calibration, the database with the map's segments (None
        when no database was made), the result and the report.

    Raises:
        EstimationError: The data do not determine the calibration.
        UserError: The missions were recorded with different devices.
        MapError: Calibrations are missing.
    """
    device_of(vi_map, missions)
    if batch:
        result, report = calibrate(vi_map, options, missions=missions, progress=progress)
        return with_calibration(vi_map.sensors, result.sensors), None, result, report
    if options.selection == "information_gain":
        chosen = select_by_gain(vi_map, options, missions=missions, progress=progress)
        if not chosen.kept:
            raise UserError("no segment has enough information: lower --sc_min_information_gain")
        small = restricted(vi_map, np.unique(np.concatenate(chosen.kept)))
        result, report = calibrate(small, options, segments=len(chosen.kept), progress=progress)
        return with_calibration(vi_map.sensors, result.sensors), None, result, report
    collected, _ = collect(vi_map, options, database, missions=missions, progress=progress)
    result, report = calibrate(
        collected.vi_map, options, segments=len(collected), progress=progress
    )
    sensors = into_map(vi_map, collected.vi_map, result.sensors, missions)
    return sensors, collected, result, report


def into_map(
    vi_map: VIMap,
    collected: VIMap,
    calibrated: SensorSet,
    missions: NDArray[np.integer] | None,
) -> SensorSet:
    """Return the map's sensors with a result that may be under the database's sensor ids."""
    ids = device_of(vi_map, missions)
    if ids == device_of(collected):
        return with_calibration(vi_map.sensors, calibrated)
    return with_device_calibration(vi_map.sensors, ids, calibrated, device_of(collected))


def with_device_calibration(
    sensors: SensorSet,
    ids: tuple[str, str],
    calibrated: SensorSet,
    calibrated_ids: tuple[str, str],
) -> SensorSet:
    """Return sensors whose IMU and rig (ids) take the calibration of another IMU and rig.

    Noise densities, topics and descriptions stay. The rig's mount becomes that on the IMU.

    Raises:
        UserError: The rigs have different cameras.
    """
    imu, rig = sensors.imu(ids[0]), sensors.camera_rig(ids[1])
    new_imu, new_rig = (
        calibrated.imu(calibrated_ids[0]),
        calibrated.camera_rig(calibrated_ids[1]),
    )
    kinds = [[(c.projection, c.distortion) for c in one.cameras] for one in (rig, new_rig)]
    if kinds[0] != kinds[1]:
        raise UserError("the calibration is of other cameras: their number or models differ")
    cameras = tuple(
        dataclasses.replace(
            old,
            intrinsics=new.intrinsics,
            distortion_parameters=new.distortion_parameters,
            image_delay_s=new.image_delay_s,
        )
        for old, new in zip(rig.cameras, new_rig.cameras, strict=True)
    )
    T_I_B = sensors.T_I_S(*ids)
    T_B_C = se3.compose(se3.inverse(T_I_B), calibrated.T_I_C(*calibrated_ids))
    changed: dict[str, Sensor] = {
        ids[0]: dataclasses.replace(imu, intrinsics=new_imu.intrinsics),
        ids[1]: dataclasses.replace(rig, cameras=cameras, T_B_C=T_B_C),
    }
    return dataclasses.replace(sensors, sensors={**sensors.sensors, **changed})


def segment_information(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> tuple[InformationReport, list[I64]]:
    """Score all segments by themselves; return the report and their vertex rows."""
    by_group = dataclasses.replace(options, groups="imu,camera,extrinsics")
    evaluation = evaluate_segments(vi_map, by_group, missions=missions, progress=progress)
    sigma_ref = evaluation.sigma_ref()
    records = records_of(evaluation, by_group, sigma_ref)
    time = vi_map.vertices.timestamp_ns
    scores = tuple(
        SegmentScore(
            mission=one.mission,
            start_ns=one.begin_ns,
            end_ns=int(time[segment.rows[-1]]),
            imu=one.scores.get("imu", 0.0),
            camera=one.scores.get("camera", 0.0),
            extrinsics=one.scores.get("extrinsics", 0.0),
            unobservable=one.unobservable,
            gyro_rms_degps=float(np.rad2deg(one.gyro_rms_radps)),
            accel_change_mps2=one.accel_change_mps2,
        )
        for one, segment in zip(records, evaluation.segments, strict=True)
    )
    reference = tuple(
        ParameterReference(one.name, one.unit, float(sigma))
        for one, sigma in zip(evaluation.parameters.each, sigma_ref, strict=True)
    )
    report = InformationReport(options.metric, scores, reference, evaluation.seconds_each)
    return report, [one.rows for one in evaluation.segments]


def applied(
    vi_map: VIMap,
    calibrated: SensorSet,
    *,
    missions: NDArray[np.integer] | None = None,
) -> VIMap:
    """Return the map with the IMU and rig calibration of another set of sensors.

    Sensors are found by id; where the ids differ, a set with one IMU and one rig fits any device.

    Raises:
        UserError: It is not clear which sensors are meant.
    """
    ids = device_of(vi_map, missions)
    source = ids if _has(calibrated, ids) else only_device(calibrated)
    return vi_map.replace(sensors=with_device_calibration(vi_map.sensors, ids, calibrated, source))


def _has(sensors: SensorSet, ids: tuple[str, str]) -> bool:
    return all(sensor_id in sensors.sensors for sensor_id in ids)


def only_device(sensors: SensorSet) -> tuple[str, str]:
    """Return the ids of the one IMU and the one rig of a set.

    Raises:
        UserError: There are none or several.
    """
    imus = [key for key, one in sensors.sensors.items() if isinstance(one, Imu)]
    rigs = [key for key, one in sensors.sensors.items() if isinstance(one, CameraRig)]
    if len(imus) != 1 or len(rigs) != 1:
        raise UserError(
            f"the calibration has {len(imus)} IMUs and {len(rigs)} camera rigs, none of them the "
            "map's: give one with one of each"
        )
    return imus[0], rigs[0]
