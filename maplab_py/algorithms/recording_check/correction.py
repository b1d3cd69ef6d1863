"""Correction of a calibration by findings on a recording: mounting, time offset, line delay, scale, noise."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from maplab_py.algorithms.recording_check import doctor, inertial_checks, rates, turn_checks
from maplab_py.algorithms.recording_check.findings import Finding, Verdict
from maplab_py.geometry import se3, so3
from maplab_py.interop.device import RecordedSensors
from maplab_py.sensors import CameraRig, Imu
from maplab_py.sensors.imu import ImuIntrinsics

_MENDED = (Verdict.WRONG, Verdict.NOTE)
_AXES = np.eye(3)
_SAME_CLOCK_S, _SIGMAS = 2e-3, 4.0
"""Cameras whose delays differ by no more, or by no more deviations, have one clock."""


def correct(diagnosis: doctor.Diagnosis) -> tuple[RecordedSensors, tuple[str, ...]]:
    """Return the sensors corrected by a diagnosis, and descriptions of the changes made and still needed.

    Units and axes are of the samples, not of the calibration: they are only told.
    """
    device = diagnosis.signals.device
    notes = [
        f"not of the calibration: {finding.line}"
        for finding in diagnosis.findings
        if finding.verdict is Verdict.WRONG and finding.check.startswith(("unit", "axes", "sign"))
    ]
    if diagnosis.cameras and device.imu is not None:
        rig, told = _corrected_rig(diagnosis)
        imu, also = _corrected_imu(diagnosis, device.imu)
        known = {**device.sensors.sensors, rig.id: rig, imu.id: imu}
        device = dataclasses.replace(
            device, sensors=dataclasses.replace(device.sensors, sensors=known)
        )
        notes += [*told, *also]
    return device, tuple(notes) or ("nothing to correct",)


def _verdicts(diagnosis: doctor.Diagnosis, beginning: str) -> list[Finding]:
    return [f for f in diagnosis.findings if f.check.startswith(beginning) and f.verdict in _MENDED]


def _corrected_rig(diagnosis: doctor.Diagnosis) -> tuple[CameraRig, list[str]]:
    device, notes = diagnosis.signals.device, []
    rig, T_B_C = device.rig, device.rig.T_B_C.copy()
    models = list(rig.cameras)
    is_late = turn_checks.check_clock(diagnosis.cameras, rig.cameras).verdict in _MENDED
    delays_s = _delays(diagnosis.cameras)
    for row, camera in enumerate(diagnosis.cameras):
        fit = camera.hand_eye
        if is_late:
            offset_ns = models[row].time_offset_ns + round(delays_s[row] * 1e9)
            models[row] = dataclasses.replace(models[row], time_offset_ns=offset_ns)
            notes.append(f"camera {row}: time offset {offset_ns * 1e-6:.1f} ms")
        if fit is None or not camera.agrees:
            continue
        if _verdicts(diagnosis, "rotation of the extrinsics, camera " + str(row)) or (
            _verdicts(diagnosis, "rotation of the extrinsics")
            and not np.array_equal(camera.axes, _AXES)
        ):
            R = camera.axes.T @ fit.R_I_C  # of the IMU's axes as recorded
            turn = so3.from_matrix(camera.R_I_C.T @ R)
            T_B_C[row] = se3.compose(T_B_C[row], np.concatenate([turn, np.zeros(3)]))
            angle = float(np.degrees(np.linalg.norm(so3.log(turn))))
            notes.append(f"camera {row}: turned by {angle:.1f} deg (T_B_C)")
        if _verdicts(diagnosis, f"shutter of camera {row}"):
            line_ns = round(fit.readout_s * 1e9 / models[row].height_px)
            models[row] = dataclasses.replace(
                models[row],
                line_delay_ns=line_ns,
                image_delay_s=-0.5 * fit.readout_s,  # the stamp is that of the middle row
            )
            notes.append(f"camera {row}: line delay {line_ns} ns")
    return dataclasses.replace(rig, cameras=tuple(models), T_B_C=T_B_C), notes


def _delays(cameras: Sequence[rates.CameraTurns]) -> list[float]:
    """Return the delays of the images [s], the same for all cameras that have the first one's clock.

    With delays that differ by their errors, images taken together would not be partners any more.
    """
    fits = [camera.hand_eye if camera.agrees else None for camera in cameras]
    first = fits[0]
    if first is None:
        return [0.0] * len(fits)
    common = []
    for fit in fits:
        if fit is not None:
            sigma_s = np.hypot(fit.delay_sigma_s, first.delay_sigma_s)
            if abs(fit.delay_s - first.delay_s) <= max(_SAME_CLOCK_S, _SIGMAS * sigma_s):
                common.append(fit)
    weights = [1.0 / max(fit.delay_sigma_s, 1e-6) ** 2 for fit in common]
    mean_s = float(np.average([fit.delay_s for fit in common], weights=weights))
    return [mean_s if fit is None or fit in common else fit.delay_s for fit in fits]


def _corrected_imu(diagnosis: doctor.Diagnosis, imu: Imu) -> tuple[Imu, list[str]]:
    notes: list[str] = []
    quiet = inertial_checks.measured_quiet(diagnosis.signals)
    if quiet is not None:
        units = {"acc": 1.0, "gyro": diagnosis.cameras[0].unit}
        for name, key, measured in (
            ("accelerometer", "acc", quiet.accel_density),
            ("gyroscope", "gyro", quiet.gyro_density),
        ):
            if _verdicts(diagnosis, f"noise of the {name}"):
                density = measured * units[key]
                changed: dict[str, Any] = {f"{key}_noise_density": density}
                imu = dataclasses.replace(imu, **changed)
                notes.append(f"{key}_noise_density {density:.3g}")
    fit = diagnosis.cameras[0].hand_eye
    if fit is not None and turn_checks.check_scale(diagnosis.cameras).verdict in _MENDED:
        known = imu.intrinsics or ImuIntrinsics()
        scaled = dataclasses.replace(known, T_g=fit.scale * known.T_g)
        imu = dataclasses.replace(imu, intrinsics=scaled)
        notes.append(f"T_g times {fit.scale:.3f}")
    return imu, notes
