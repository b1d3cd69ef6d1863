"""Checks of what images show: light, sharpness, texture, and whether they change."""

from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.recording_check.findings import Check, Finding
from maplab_py.algorithms.recording_check.signals import CameraSignal, Signals
from maplab_py.algorithms.recording_check.turns import GyroTurns

_LEAST_FIGURES = 5
_FROZEN, _REPEATED = 0.95, 0.15
"""Shares of images that are the same as the one before, while the device turns."""
_LEAST_TURN_RAD = 0.005
_DARK_SHARE, _DARK_GREY, _BRIGHT_SHARE = 0.75, 18.0, 0.35
_LEAST_CORNERS, _FEW_CORNERS = 12, 30
_BLURRED = 0.31
"""Share of an edge's contrast in its steepest pixel: 0.25 of a wide ramp, 0.4 to 0.6 of sharp images."""


def check_images(signals: Signals) -> Iterator[Finding]:
    """Yield findings on the images of every camera."""
    for row, camera in enumerate(signals.cameras):
        if camera.damaged:
            check = Check(f"files of camera {row}", "images that can be decoded")
            observed = f"{camera.damaged} of the images looked at are damaged"
            yield check.wrong(observed, signals.damage)
        if len(camera.figures) >= _LEAST_FIGURES:
            yield _check_change(signals, row)
            yield _check_light(row, camera)
            yield _check_texture(row, camera)
            yield _check_sharpness(row, camera)


def _check_change(signals: Signals, row: int) -> Finding:
    check = Check(f"change of camera {row}", "every image is new")
    figures = signals.cameras[row].figures
    times_ns = np.array([figure.time_ns for figure in figures], dtype=np.int64)
    is_repeated = np.array([figure.is_repeated for figure in figures])[1:]
    moves = np.ones(len(is_repeated), dtype=np.bool_)
    if len(signals.imu) > 10:
        rate = signals.imu.accel_gyro[:, 3:]
        gyro = GyroTurns(signals.imu.times_ns, rate - np.median(rate, axis=0))
        moves = np.linalg.norm(gyro.phi(times_ns[:-1], times_ns[1:]), axis=1) > _LEAST_TURN_RAD
    count = int(np.count_nonzero(moves))
    if count < _LEAST_FIGURES:
        return check.ok("the device rests")
    share = float(np.mean(is_repeated[moves]))
    observed = f"{share:.0%} are the image before again, though the device turns"
    if share > _FROZEN:
        return check.hopeless(observed, "the camera or its driver hung: record again")
    if share > _REPEATED:
        return check.wrong(observed, "let the driver write each image once, with its own stamp")
    return check.ok("images change")


def _check_light(row: int, camera: CameraSignal) -> Finding:
    check = Check(f"light of camera {row}", "grey values within the range")
    grey, dark, bright = (
        float(np.median([getattr(figure, name) for figure in camera.figures]))
        for name in ("mean_grey", "dark_share", "bright_share")
    )
    observed = f"mean {grey:.0f} of 255, {dark:.0%} black, {bright:.0%} white"
    if bright > _BRIGHT_SHARE:
        return check.wrong(observed, "over-exposed: shorten the exposure or lower the gain")
    if grey < _DARK_GREY or dark > _DARK_SHARE:
        remedy = (
            "under-exposed: more light, more gain, or --image_bits if the values have fewer bits"
        )
        return check.wrong(observed, remedy)
    return check.ok(observed)


def _check_texture(row: int, camera: CameraSignal) -> Finding:
    check = Check(f"texture of camera {row}", f"{_FEW_CORNERS} corners or more")
    corners = np.array([figure.corners for figure in camera.figures])
    poor = float(np.mean(corners < _FEW_CORNERS))
    observed = (
        f"{int(np.median(corners))} corners at the median, {poor:.0%} of the images have fewer"
    )
    if np.median(corners) < _LEAST_CORNERS:
        remedy = "look at furniture and edges rather than at bare walls, floor or sky"
        return check.wrong(observed, remedy)
    if poor > 0.25:
        return check.note(observed, "keep bare walls out of the image; a wider lens helps")
    return check.ok(observed)


def _check_sharpness(row: int, camera: CameraSignal) -> Finding:
    check = Check(f"sharpness of camera {row}", f"{_BLURRED:.0%} or more")
    values = [figure.sharpness for figure in camera.figures if figure.corners >= _LEAST_CORNERS]
    if len(values) < _LEAST_FIGURES:
        return check.unknown("too few edges to tell")
    sharp = float(np.median(values))
    observed = f"{sharp:.0%} of an edge's contrast are in its steepest pixel"
    if sharp < _BLURRED:
        remedy = "out of focus or blurred by motion: focus the lens, expose for less than 10 ms"
        return check.note(observed, remedy)
    return check.ok(observed)
