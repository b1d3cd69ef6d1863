"""Sensors that are left out: found by their signs, until they are whole again."""

import collections
import dataclasses
from collections.abc import Iterable

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.estimation.window.frame import ImuPart, WindowFrame
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.failures.images import ImageWatch
from maplab_py.frontend.failures.motion import Disagreement, MotionComparison, Sighting
from maplab_py.frontend.failures.samples import PARTS, SampleWatch
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.frontend.recorded_mission import RecordedMission
from maplab_py.geometry import so3
from maplab_py.interop.device import RecordedSensors
from maplab_py.sensors import Imu
from maplab_py.vimap.nav_state import NavState
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages

_NAMES = {ImuPart.GYROSCOPE: "gyroscope", ImuPart.ACCELEROMETER: "accelerometer"}
_FLOOR = {ImuPart.GYROSCOPE: 0.03, ImuPart.ACCELEROMETER: 0.3}
"""Disagreements [rad/s], [m/s^2] that are no failure: of MH_01 none exceeds 0.016 and 0.14."""
_FACTOR, _REMEMBERED, _FEWEST = 8.0, 40, 4
"""A disagreement is above so many medians of those of the last ten seconds, of which there must be four. On
Tango's map, whose shutter rolls, single ones reach nine and thirteen medians, never two in a row."""
_SIGMAS = 3.0
"""A disagreement is above so many deviations by noise: few points in a corner tell little."""
_IN_ROW = 2
_WHOLE_IN_ROW = 5
"""Comparisons that must agree with a constant bias until a part of the IMU is used again."""
_MOST_RETURNS = 3
_SETTLING_NS = 250_000_000
"""Time in which the window finds the bias of a part that is used again."""
_MOST_NOTES = 8
_LOST_SHARE, _LOST_NS = 0.2, 600_000_000
"""A camera that sees so small a share of the points of its leader, for so long, compared with before."""
_MISFIT, _FIT_RAD = 2.0, 1e-4
"""Points so many times as far as usual from where they should be tell as much less of the motion."""
_MISFIT_RAD = 0.01
"""Points of a camera are so far from where those of all cameras are seen."""
_GYROSCOPE = (ImuPart.GYROSCOPE,)
_SHIFTED = "its points do not fit: shifted on its mounting?"


@dataclasses.dataclass
class SensorFailure:
    """A sensor that is left out."""

    sensor: str
    reason: str
    since_ns: int
    detected_ns: int
    until_ns: int = 0  # 0 = to the end
    is_used: bool = False  # for want of another
    is_by_motion: bool = False  # found by the motion of the images
    has_new_bias: bool = False  # when it is used again

    @property
    def fate(self) -> str:
        """Treatment of the sensor, in words."""
        return "used for want of another" if self.is_used else "left out"

    def words(self, zero_ns: int) -> str:
        """Return what has happened, in seconds after a time."""
        since_s, until_s = (1e-9 * (t - zero_ns) for t in (self.since_ns, self.until_ns))
        end = f"to {until_s:.1f} s" if self.until_ns else "on"
        later = "; used with another bias since" if self.has_new_bias else ""
        return f"{self.sensor} {self.fate} from {since_s:.1f} s {end}: {self.reason}{later}"


class SensorWatch:
    """Watches cameras and IMU of a running odometry."""

    def __init__(self, device: RecordedSensors, imu: Imu) -> None:
        """Watch the sensors of a device; nothing has failed."""
        self._device, self._imu = device, imu
        self._count = len(device.cameras)
        self._images = [ImageWatch() for _ in device.cameras]
        self._samples = SampleWatch()
        self.failures: list[SensorFailure] = []  # all of them, the earliest first
        self._open: dict[str, SensorFailure] = {}
        self._returns = 0
        self.restart(0)

    def recalibrate(self, device: RecordedSensors, imu: Imu) -> None:
        """Compare with another calibration from now on; what has failed stays so."""
        self._device, self._imu = device, imu
        self._comparison = MotionComparison(device, imu)

    def restart(self, now_ns: int) -> None:
        """Forget the motion, and use the whole IMU; the estimator starts again."""
        self._comparison = MotionComparison(self._device, self._imu)
        self._usual = {part: _Usual() for part in PARTS}
        self._fits_rad: collections.deque[float] = collections.deque(maxlen=_REMEMBERED)
        self._shares: collections.deque[float] = collections.deque(maxlen=_REMEMBERED)
        self._lost_since_ns = 0
        for name in [name for name in self._open if not name.startswith("camera")]:
            self._return(name, now_ns)

    @property
    def left_out(self) -> frozenset[int]:
        """Rows of the cameras that are left out."""
        failures = (self._open.get(f"camera {row}") for row in range(self._count))
        return frozenset(
            row for row, each in enumerate(failures) if each is not None and not each.is_used
        )

    @property
    def failed(self) -> ImuPart:
        """Parts of the IMU that are left out."""
        result = ImuPart(0)
        for part, name in _NAMES.items():
            result |= part if name in self._open else ImuPart(0)
        return result

    def status(self) -> str:
        """Return what is left out now."""
        return "; ".join(f"{f.sensor} {f.fate}: {f.reason}" for f in self._open.values())

    def notes(self, zero_ns: int) -> list[str]:
        """Return what has happened, in seconds after a time, a line a failure; the first ones of many."""
        lines = [failure.words(zero_ns) for failure in self.failures[:_MOST_NOTES]]
        more = len(self.failures) - len(lines)
        return lines + ([f"sensors were left out {more} more times"] if more else [])

    def has_failed_between(self, from_ns: int, to_ns: int) -> bool:
        """Tell whether any sensor was left out at some time of an interval."""
        return any(_was_out(each, from_ns, to_ns) for each in self.failures)

    def failed_between(self, from_ns: int, to_ns: int) -> ImuPart:
        """Return the parts of the IMU that were left out at some time of an interval."""
        result = ImuPart(0)
        for part, name in _NAMES.items():
            of_part = (each for each in self.failures if each.sensor == name)
            if any(_was_out(each, from_ns, to_ns) for each in of_part):
                result |= part
        return result

    def has_new_bias(self, part: ImuPart, now_ns: int) -> bool:
        """Tell whether a part of the IMU has come back with another bias from its latest failure."""
        failures = (f for f in self.failures if f.sensor == _NAMES[part] and f.since_ns < now_ns)
        latest = max(failures, key=lambda failure: failure.detected_ns, default=None)
        return latest is not None and latest.has_new_bias

    # -- samples ----------------------------------------------------------------------------------

    def usable(
        self, interval: ImuInterval, smoother: FixedLagSmoother | None
    ) -> tuple[ImuInterval, ImuPart]:
        """Return an interval whose failed parts measure a constant velocity, and these parts."""
        self._samples.push(interval.times_ns[1:-1], interval.accel_gyro[1:-1])
        if smoother is None:
            return interval, ImuPart(0)
        now_ns = int(interval.times_ns[-1])
        for part, name in _NAMES.items():
            if part in self._samples.signs and name not in self._open:
                axes, since_ns = self._samples.signs[part]
                self._fail(name, axes, since_ns, now_ns)
                smoother.doubt_imu(since_ns, part)
            elif name in self._open and part not in self._samples.signs:
                failure = self._open[name]
                if not failure.is_by_motion:
                    self._return(name, now_ns)
        if not self.failed:
            return interval, ImuPart(0)
        samples = interval.accel_gyro.copy()
        rate_I, force_I = _constant_velocity(smoother, self._imu)
        if ImuPart.GYROSCOPE in self.failed:
            samples[:, 3:] = rate_I + smoother.states.motion[-1, 3:6]
        if ImuPart.ACCELEROMETER in self.failed:
            samples[:, :3] = force_I + smoother.states.motion[-1, 6:]
        return dataclasses.replace(interval, accel_gyro=samples), self.failed

    # -- images -----------------------------------------------------------------------------------

    def look(self, time_ns: int, images: tuple[U8, ...], *, is_moving: bool) -> None:
        """Look at the images of a frame."""
        for row, image in enumerate(images):
            watch, name = self._images[row], f"camera {row}"
            watch.push(time_ns, image, is_moving=is_moving)
            is_only = len(self.left_out | {row}) == self._count
            if watch.sign and name not in self._open:
                self._fail(name, watch.sign, watch.since_ns, time_ns)
                # a blurred image is better than none
                self._open[name].is_used = is_only and watch.sign == "out of focus"
            elif not watch.sign and name in self._open and self._open[name].reason != _SHIFTED:
                self._return(name, time_ns)

    def without_failed(self, tracked: TrackedImages) -> TrackedImages:
        """Return tracks without those of cameras that are left out."""
        if not self.left_out:
            return tracked
        cameras = tuple(
            CameraTracks.empty() if row in self.left_out else tracks
            for row, tracks in enumerate(tracked.cameras)
        )
        return dataclasses.replace(tracked, cameras=cameras)

    def _count_shared(self, time_ns: int, frame: WindowFrame) -> None:
        """Find a second camera that has lost the points of the first."""
        if self._count != 2 or self.left_out:
            self._lost_since_ns = 0
            return
        ids = [frame.track_id[frame.camera == row] for row in range(2)]
        if not len(ids[0]):
            return
        share = float(np.mean(np.isin(ids[0], ids[1])))
        is_lost = len(self._shares) >= 10 and share < _LOST_SHARE * float(np.median(self._shares))
        if not is_lost:
            self._shares.append(share)
            self._lost_since_ns = 0
        elif not self._lost_since_ns:
            self._lost_since_ns = time_ns
        elif time_ns - self._lost_since_ns > _LOST_NS:
            self._fail("camera 1", _SHIFTED, self._lost_since_ns, time_ns)

    # -- motion -----------------------------------------------------------------------------------

    def compare(
        self, frame: WindowFrame, interval: ImuInterval, smoother: FixedLagSmoother
    ) -> None:
        """Compare the samples and the cameras with the motion that the images show."""
        states, cameras_now = smoother.states, smoother.cameras
        v_I = so3.rotate(so3.inverse(states.T_M_I[-1, :4]), states.motion[-1, :3])
        rate_I = interval.accel_gyro[-1, 3:] - states.motion[-1, 3:6]
        if ImuPart.GYROSCOPE in self.failed:
            rate_I, _ = _constant_velocity(smoother, self._imu)
        late_s = smoother.calibration.lateness_s(
            frame.camera, frame.uv_px, frame.delay_s, cameras_now
        )
        self._comparison.push(
            Sighting(
                frame.time_ns, frame.camera, frame.track_id, frame.uv_px,
                late_s, np.concatenate([v_I, rate_I]),
                interval.times_ns, interval.accel_gyro,
            )
        )  # fmt: skip
        self._count_shared(frame.time_ns, frame)
        if not self._comparison.is_due(frame.time_ns):
            return
        cameras = frozenset(range(self._count)) - self.left_out
        disagreement = self._comparison.compared(cameras) if cameras else None
        if disagreement is not None:
            shifted = self._shifted_camera(disagreement, cameras, frame.time_ns)
            if shifted is None:
                self._judge(disagreement, frame.time_ns, smoother)
        biases = states.motion[-1, 3:6], states.motion[-1, 6:]
        T_I_C = cameras_now.T_I_C
        self._comparison.remember(smoother.landmarks(), states.T_M_I[-1], biases, T_I_C)

    def _shifted_camera(
        self, joint: Disagreement, cameras: frozenset[int], now_ns: int
    ) -> int | None:
        """Find the camera of several that alone contradicts the IMU; leave it out."""
        if len(cameras) < 2 or not (
            np.nanmax(joint.fit_rad) > _MISFIT_RAD or self._excess(joint, sigmas=_SIGMAS) > 1.0
        ):
            return None
        alone = {row: self._comparison.compared(frozenset([row])) for row in cameras}
        known = {row: each for row, each in alone.items() if each is not None}
        # few points tell a rate better than an acceleration
        wrong = [row for row, each in known.items() if self._excess(each, _GYROSCOPE) > 1.0]
        wrong = wrong or [row for row, each in known.items() if self._is_unusual(each)]
        right = [row for row in known if row not in wrong]
        if len(wrong) != 1 or not (right or np.nanmax(joint.fit_rad) > _MISFIT_RAD):
            return None
        if right:
            bad, good = known[wrong[0]], known[right[0]]
            apart = dataclasses.replace(
                bad, rate=bad.rate - good.rate, acceleration=bad.acceleration - good.acceleration
            )
            if not self._is_unusual(apart):  # the cameras agree: it is the IMU, near the limit
                return None
        self._fail(f"camera {wrong[0]}", _SHIFTED, joint.since_ns, now_ns)
        return wrong[0]

    def _is_unusual(self, disagreement: Disagreement) -> bool:
        return self._excess(disagreement) > 1.0

    def _excess(
        self,
        disagreement: Disagreement,
        parts: Iterable[ImuPart] = tuple(PARTS),
        sigmas: float = 0.0,
    ) -> float:
        """Return the larger excess of the parts of the IMU that are whole; 0 without a gyroscope."""
        if ImuPart.GYROSCOPE in self.failed:
            return 0.0
        counted = (
            self._usual[part].excess(
                part, _of(disagreement, part), sigmas * disagreement.sigma[part]
            )
            for part in parts
            if part not in self.failed and disagreement.since_ns >= self._usual[part].from_ns
        )
        return max(counted, default=0.0)

    def _judge(self, new: Disagreement, now_ns: int, smoother: FixedLagSmoother) -> None:
        """Leave parts of the IMU out, or take them back."""
        misfit = self._misfit(new)
        for part in (ImuPart.GYROSCOPE, ImuPart.ACCELEROMETER):
            failure, agrees = self._open.get(_NAMES[part]), False
            if failure is None and new.since_ns >= self._usual[part].from_ns:
                agrees = self._agrees(part, new, misfit, now_ns, smoother)
            elif failure is not None and failure.is_by_motion:
                self._reconsider(failure, part, new, now_ns)
            if part is ImuPart.GYROSCOPE and not agrees:
                # gravity would be turned by the wrong rates
                self._usual[ImuPart.ACCELEROMETER].in_row = 0
                return

    def _agrees(
        self,
        part: ImuPart,
        new: Disagreement,
        misfit: float,
        now_ns: int,
        smoother: FixedLagSmoother,
    ) -> bool:
        """Return whether a part of the IMU agrees with the images; leave it out if not for long."""
        usual, error = self._usual[part], _of(new, part)
        if usual.add(part, error, _SIGMAS * new.sigma[part] * misfit) <= 1.0:
            usual.since_ns, usual.bias = new.since_ns, new.biases[part]
            return True
        if usual.in_row >= _IN_ROW:
            unit = "rad/s" if part is ImuPart.GYROSCOPE else "m/s^2"
            size = float(np.linalg.norm(error))
            reason = f"it differs by {size:.2g} {unit} from the motion of the images"
            self._fail(_NAMES[part], reason, usual.since_ns, now_ns)
            self._open[_NAMES[part]].is_by_motion = True
            smoother.doubt_imu(usual.since_ns, part)
            usual.in_row = 0
            usual.recent.clear()
        return False

    def _misfit(self, new: Disagreement) -> float:
        """Return how many times as far as usual the points are from where they should be; 1 if it is usual.

        The poses follow from them alone, so a failed IMU does not move them away; the last points that are
        left of a view may be wrong together.
        """
        fit_rad = float(np.nanmedian(new.fit_rad))
        is_known = len(self._fits_rad) >= _FEWEST
        usual_rad = max(float(np.median(self._fits_rad)) if is_known else fit_rad, _FIT_RAD)
        if fit_rad > _MISFIT * usual_rad:
            return fit_rad / usual_rad
        self._fits_rad.append(fit_rad)
        return 1.0

    def _reconsider(
        self, failure: SensorFailure, part: ImuPart, new: Disagreement, now_ns: int
    ) -> None:
        """Use a part of the IMU again that has agreed with a constant bias for a while.

        The window finds this bias by itself: the bias is free while the part is left out.
        """
        usual = self._usual[part]
        usual.recent.append(_of(new, part) + new.biases[part])
        if self._returns < _MOST_RETURNS and usual.agrees_with_a_bias(part):
            failure.has_new_bias = usual.has_new_bias(part)
            usual.from_ns = now_ns + _SETTLING_NS
            self._returns += 1
            self._return(failure.sensor, now_ns)

    def _fail(self, name: str, reason: str, since_ns: int, detected_ns: int) -> None:
        failure = SensorFailure(name, reason, since_ns, detected_ns)
        self._open[name] = failure
        self.failures.append(failure)

    def _return(self, name: str, now_ns: int) -> None:
        self._open.pop(name).until_ns = now_ns


def _was_out(failure: SensorFailure, from_ns: int, to_ns: int) -> bool:
    return failure.since_ns < to_ns and not 0 < failure.until_ns <= from_ns


class _Usual:
    """Disagreements of a part of the IMU while it is whole."""

    def __init__(self) -> None:
        self._sizes: collections.deque[float] = collections.deque(maxlen=_REMEMBERED)
        self.recent: collections.deque[F64] = collections.deque(maxlen=_WHOLE_IN_ROW)  # biases
        self.bias: F64 = np.zeros(3)  # when it was whole
        self.in_row, self.since_ns = 0, 0
        self.from_ns = 0  # from which on errors count

    def excess(self, part: ImuPart, error: F64, noise: float) -> float:
        """Return the size of an error as a multiple of what is possible; 0 while nothing is known."""
        if len(self._sizes) < _FEWEST:
            return 0.0
        return float(np.linalg.norm(error)) / max(self._limit(part), noise)

    def add(self, part: ImuPart, error: F64, noise: float) -> float:
        """Take an error; return it as a multiple of what is possible."""
        excess = self.excess(part, error, noise)
        self.in_row = self.in_row + 1 if excess > 1.0 else 0
        if not self.in_row:
            self._sizes.append(float(np.linalg.norm(error)))
        return excess

    def agrees_with_a_bias(self, part: ImuPart) -> bool:
        """Tell whether the newest errors are those of the same bias."""
        if len(self.recent) < _WHOLE_IN_ROW:
            return False
        spread = np.linalg.norm(self.recent - np.mean(self.recent, axis=0), axis=1)
        return bool(spread.max() < 0.5 * self._limit(part))

    def has_new_bias(self, part: ImuPart) -> bool:
        """Tell whether this bias is another one than before the failure."""
        change = np.mean(self.recent, axis=0) - self.bias
        return float(np.linalg.norm(change)) > self._limit(part)

    def _limit(self, part: ImuPart) -> float:
        return max(_FLOOR[part], _FACTOR * float(np.median(self._sizes)))


def _of(disagreement: Disagreement, part: ImuPart) -> F64:
    return disagreement.rate if part is ImuPart.GYROSCOPE else disagreement.acceleration


def _constant_velocity(smoother: FixedLagSmoother, imu: Imu) -> tuple[F64, F64]:
    """Return rate and specific force (3,), (3,) in I that go on as between the two newest frames."""
    T_M_I, times_ns = smoother.states.T_M_I[-2:], smoother.times_ns[-2:]
    force_I = so3.rotate(
        so3.inverse(T_M_I[-1, :4]), np.array([0.0, 0.0, imu.gravity_magnitude_mps2])
    )
    if len(times_ns) < 2:
        return np.zeros(3), force_I
    turned = so3.log(so3.multiply(so3.inverse(T_M_I[0, :4]), T_M_I[1, :4]))
    return turned / (1e-9 * float(times_ns[1] - times_ns[0])), force_I


def replace_failed(mission: RecordedMission, watch: SensorWatch, gravity_mps2: float) -> None:
    """Put the motion of the states in place of the samples of parts of the IMU that had failed.

    Biases stay as they were before: nothing was known of them meanwhile. When a part has come back with
    another bias, the difference is taken from its samples, for biases of a map change slowly.
    """
    # in the order of samples, of the accelerometer first
    states = np.array([np.hstack([s.accel_bias[0], s.gyro_bias[0]]) for s in mission.states])
    biases, change, before = states.copy(), np.zeros(6), ImuPart(0)
    for row, (times_ns, samples) in enumerate(mission.edges):
        from_ns = int(times_ns[0])
        failed = watch.failed_between(from_ns, int(times_ns[-1]))
        for part, columns in PARTS.items():
            if part in failed:
                biases[row + 1, columns] = biases[row, columns]
                continue
            if part in before and watch.has_new_bias(part, from_ns):
                change[columns] = states[row, columns] - biases[row, columns]
            biases[row + 1, columns] = states[row + 1, columns] - change[columns]
        before = failed
        if not failed and not change.any():
            continue
        mission.states[row + 1] = dataclasses.replace(
            mission.states[row + 1],
            accel_bias=biases[row + 1 : row + 2, :3], gyro_bias=biases[row + 1 : row + 2, 3:],
        )  # fmt: skip
        ends = NavState.stack(mission.states[row : row + 2])
        mission.edges[row] = (
            times_ns, replaced(times_ns, samples - change, failed, ends, gravity_mps2)
        )  # fmt: skip


def replaced(
    times_ns: I64, accel_gyro: F64, parts: ImuPart, ends: NavState, gravity_mps2: float
) -> F64:
    """Return samples (S, 6) of an interval whose failed parts are those that lead from state to state."""
    dt = 1e-9 * float(times_ns[-1] - times_ns[0])
    result, q = accel_gyro.copy(), ends.T_M_I[:, :4]
    if ImuPart.GYROSCOPE in parts:
        turned = so3.log(so3.multiply(so3.inverse(q[0]), q[1]))
        result[:, 3:] = turned / dt + ends.gyro_bias[0]
    if ImuPart.ACCELEROMETER in parts:
        acceleration = (ends.v_M[1] - ends.v_M[0]) / dt + np.array([0.0, 0.0, gravity_mps2])
        middle = so3.multiply(q[0], so3.exp(0.5 * so3.log(so3.multiply(so3.inverse(q[0]), q[1]))))
        result[:, :3] = so3.rotate(so3.inverse(middle), acceleration) + ends.accel_bias[0]
    return result
