"""A recording read with corrected units, axes and calibration."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.recording_check import correction, doctor, findings, inertial_checks
from maplab_py.array_types import F64
from maplab_py.interop.device import RecordedSensors
from maplab_py.interop.recordings import options, protocol


@dataclasses.dataclass(frozen=True, eq=False)
class RecalibratedRecording:
    """A recording with another calibration."""

    plain: protocol.Recording
    device: RecordedSensors
    note: str = ""  # where the calibration is from

    @property
    def name(self) -> str:
        """File or folder."""
        return self.plain.name

    @property
    def kind(self) -> str:
        """Kind of the recording."""
        return self.plain.kind

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        return self.plain.start_ns

    @property
    def end_ns(self) -> int:
        """Approximate time of the last item."""
        return self.plain.end_ns

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the reader, and where the calibration is from."""
        return (*self.plain.notes, self.note)

    def parts(self) -> tuple[protocol.PartSpan, ...]:
        """Return the parts between restarts of the clock."""
        return self.plain.parts()

    def items(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[protocol.Item]:
        """Yield the items of the recording."""
        yield from self.plain.items(start_ns, end_ns)


@dataclasses.dataclass(frozen=True, eq=False)
class MendedRecording(RecalibratedRecording):
    """A recording with another calibration, and samples in the units and axes that it expects."""

    accel: F64 = dataclasses.field(default_factory=lambda: np.eye(3))  # (3, 3) times accelerations
    gyro: F64 = dataclasses.field(default_factory=lambda: np.eye(3))  # (3, 3) times rates
    words: tuple[str, ...] = ()  # what is mended

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the reader, and corrections."""
        note = (
            f"does not fit its calibration; read with what check_recording finds: {', '.join(self.words)} "
            "(--vio_apply_calibration=false does not do so)"
        )
        return (*self.plain.notes, note)

    def mend(self, accel_gyro: F64) -> F64:
        """Return samples (S, 6) in the units and axes of the calibration."""
        accel, gyro = accel_gyro[:, :3] @ self.accel.T, accel_gyro[:, 3:] @ self.gyro.T
        return np.concatenate([accel, gyro], axis=1)

    def items(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[protocol.Item]:
        """Yield the corrected items of the recording; see `Recording`."""
        old = [camera.time_offset_ns for camera in self.plain.device.cameras]
        shift_ns = [
            camera.time_offset_ns - before_ns
            for camera, before_ns in zip(self.device.cameras, old, strict=True)
        ]
        imu = self.device.imu
        for item in self.plain.items(start_ns, end_ns):
            if isinstance(item, protocol.ImuBatch) and imu is not None:
                yield protocol.ImuBatch.of(imu, item.times_ns, self.mend(item.accel_gyro))
            elif isinstance(item, protocol.CameraImage):
                yield dataclasses.replace(item, time_ns=item.time_ns + shift_ns[item.camera])
            elif isinstance(item, protocol.TrackedFrameSet):
                yield dataclasses.replace(item, time_ns=item.time_ns + shift_ns[0])
            else:
                yield item


def mended(
    recording: protocol.Recording, diagnosis: doctor.Diagnosis, stream: options.StreamOptions
) -> MendedRecording | None:
    """Return a recording with the faults of its diagnosis corrected; None if there are none to correct."""
    if (
        any(f.verdict is findings.Verdict.HOPELESS for f in diagnosis.findings)
        or not diagnosis.cameras
    ):
        return None
    read = _with_samples(recording, diagnosis)
    if read.words:
        imu = diagnosis.signals.imu
        imu = dataclasses.replace(imu, accel_gyro=read.mend(imu.accel_gyro))
        diagnosis = doctor.diagnose_signals(dataclasses.replace(diagnosis.signals, imu=imu), stream)
    device, notes = correction.correct(diagnosis)
    words = read.words
    if device is not diagnosis.signals.device:
        told = ("not of the calibration", "nothing to correct")
        words += tuple(note for note in notes if not note.startswith(told))
    return dataclasses.replace(read, device=device, words=words) if words else None


def _with_samples(recording: protocol.Recording, diagnosis: doctor.Diagnosis) -> MendedRecording:
    """Return a recording whose samples are in the units and axes of the calibration."""
    signals, first = diagnosis.signals, diagnosis.cameras[0]
    accel, gyro, words = np.eye(3), np.eye(3), []
    quiet = inertial_checks.measured_quiet(signals)
    unit = inertial_checks.accel_unit(quiet)
    wrong = {f.check: f for f in diagnosis.findings if f.verdict is findings.Verdict.WRONG}
    if "unit of the accelerometer" in wrong and unit != 1.0:
        accel = unit * accel
        words.append(f"accelerations times {unit:.6g}")
    if "unit of the gyroscope" in wrong and first.unit != 1.0:
        gyro = first.unit * gyro
        words.append(f"rates times {first.unit:.6g}")
    if axes := wrong.get("axes of the gyroscope"):
        gyro = first.axes @ gyro
        if inertial_checks.raw_axes_agree(signals, unit * signals.imu.accel_gyro[:, :3], first):
            accel = first.axes @ accel
        words.append(f"axes {axes.observed}")
    if "sign of the accelerometer" in wrong:
        accel = -accel
        words.append("accelerations times -1")
    return MendedRecording(recording, recording.device, accel=accel, gyro=gyro, words=tuple(words))
