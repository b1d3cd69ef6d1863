"""Camera models under the names of other programs, and what their entries have in common."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from maplab_py.array_types import F64, NDArray
from maplab_py.errors import MapError
from maplab_py.sensors import Camera, Distortion, Imu, Projection
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.sensors.yaml_entry import Entry

PROJECTIONS = {
    "pinhole": Projection.PINHOLE,
    "perspective": Projection.PINHOLE,
    "omni": Projection.UNIFIED,
    "mei": Projection.UNIFIED,
    "ds": Projection.DOUBLE_SPHERE,
    "eucm": Projection.EXTENDED_UNIFIED,
}
DISTORTIONS = {
    "none": Distortion.NONE,
    "radtan": Distortion.RADTAN,
    "radial-tangential": Distortion.RADTAN,
    "radialtangential": Distortion.RADTAN,
    "radialtangential8": Distortion.RADTAN,
    "plumb_bob": Distortion.RADTAN,
    "rational_polynomial": Distortion.RADTAN,
    "equidistant": Distortion.EQUIDISTANT,
    "equi": Distortion.EQUIDISTANT,
    "fisheye": Distortion.EQUIDISTANT,
    "kannala_brandt": Distortion.EQUIDISTANT,
    "kannalabrandt": Distortion.EQUIDISTANT,
    "kannalabrandt4": Distortion.EQUIDISTANT,
    "kannalabrandt8": Distortion.EQUIDISTANT,
    "fov": Distortion.FOV,
}
"""Names of models, kalibr's first; the count of coefficients tells the polynomial distortions apart."""
_BY_COUNT = {4: Distortion.RADTAN, 5: Distortion.RADTAN5, 8: Distortion.RATIONAL}
_MAX_TIME_SHIFT_S = 10.0
_NOISE_FIELDS = (
    *("acc_noise_density", "acc_bias_random_walk_noise_density"),
    *("gyro_noise_density", "gyro_bias_random_walk_noise_density"),
)
KALIBR_NOISE = (
    *("accelerometer_noise_density", "accelerometer_random_walk"),
    *("gyroscope_noise_density", "gyroscope_random_walk"),
)


def make_camera(
    entry: Entry,
    projection: tuple[str, str],
    distortion: tuple[str, str],
    intrinsics: Sequence[float] | NDArray[Any],
    coefficients: Sequence[float] | NDArray[Any],
    size: Sequence[float] | NDArray[Any],
    **more: Any,
) -> Camera:
    """Return a camera without id.

    Args:
        entry: For messages.
        projection: Key and name of the projection.
        distortion: Key and name of the distortion.
        intrinsics: Mirror parameters, fu fv cu cv.
        coefficients: Distortion parameters, as many as the file has.
        size: Width and height.

    Raises:
        MapError: A model is not supported, or a number is wrong.
    """
    shape = _named(entry, *projection, PROJECTIONS)
    lens = _named(entry, *distortion, DISTORTIONS)
    values, numbers = np.array(coefficients, dtype=float), np.array(intrinsics, dtype=float)
    if lens is Distortion.RADTAN:
        lens, values = _polynomial(entry, distortion[0], values)
    elif lens is Distortion.NONE or (not np.any(values) and len(values) > DISTORTION_SIZE[lens]):
        values = values[: DISTORTION_SIZE[lens]]
    if len(values) != DISTORTION_SIZE[lens] or len(numbers) != INTRINSICS_SIZE[shape]:
        raise MapError(
            f"{entry.where}: {projection[1]} with {distortion[1]} has {INTRINSICS_SIZE[shape]} + "
            f"{DISTORTION_SIZE[lens]} parameters, not {len(numbers)} + {len(values)}"
        )
    width, height = (float(value) for value in size)
    if numbers[-4] <= 0.0 or numbers[-3] <= 0.0 or not _is_size(width) or not _is_size(height):
        raise MapError(
            f"{entry.where}: focal lengths and the size of images must be positive, the latter whole"
        )
    try:
        return Camera("", shape, lens, numbers, values, int(width), int(height), **more)
    except MapError as error:  # the parameters do not form a camera
        raise MapError(f"{entry.where}: {str(error).removeprefix('camera : ')}") from None


def _is_size(value: float) -> bool:
    return 1 <= value < 1 << 20 and value == round(value)


def kalibr_name(names: Mapping[str, Any], model: Projection | Distortion) -> str:
    """Return the name of a model in kalibr, empty if it has none."""
    return next((name for name, known in names.items() if known is model), "")


def _named(entry: Entry, key: str, name: str, kinds: dict[str, Any]) -> Any:
    kind = kinds.get(name.strip().lower().replace("-", "_"), kinds.get(name.strip().lower()))
    if kind is None:
        raise MapError(
            f"{entry.where}: key '{key}': '{name}' is not supported: calibrate with one of "
            f"{', '.join(kinds)}"
        )
    return kind


def _polynomial(entry: Entry, key: str, values: F64) -> tuple[Distortion, F64]:
    """Return the model k1 k2 p1 p2 k3 ... with as many coefficients as are given and not 0."""
    if not len(values):
        return Distortion.NONE, values
    last = max(4, int(np.flatnonzero(values)[-1]) + 1) if np.any(values) else 4
    size = next((count for count in sorted(_BY_COUNT) if count >= last), 0)
    if size and len(values) >= 4:
        padded = np.zeros(max(size, len(values)))
        padded[: len(values)] = values
        return _BY_COUNT[size], padded[:size]
    raise MapError(
        f"{entry.where}: key '{key}' needs {' or '.join(map(str, sorted(_BY_COUNT)))} distortion "
        f"parameters (k1 k2 p1 p2 k3 ...), not {len(values)}"
    )


def read_camera(entry: Entry, distortion_key: str, **more: Any) -> Camera:
    """Return the camera of an entry with kalibr's keys; its id is empty.

    Raises:
        MapError: A key is missing or wrong, or a model is not supported.
    """
    model = entry.text("camera_model", default="pinhole")
    lens = entry.text("distortion_model", default="none")
    _named(entry, "camera_model", model, PROJECTIONS)
    lens_model = _named(entry, "distortion_model", lens, DISTORTIONS)
    coefficients: F64 = np.zeros(0)
    if lens_model is not Distortion.NONE or distortion_key in entry:
        coefficients = entry.numbers(distortion_key)
    return make_camera(
        entry,
        ("camera_model", model),
        ("distortion_model", lens),
        entry.numbers("intrinsics"),
        coefficients,
        entry.vector("resolution", 2),
        topic=entry.text("rostopic"),
        time_offset_ns=read_time_shift_ns(entry, "timeshift_cam_imu"),
        line_delay_ns=read_time_shift_ns(entry, "line_delay"),
        **more,
    )


def read_time_shift_ns(entry: Entry, key: str, *, sign: int = 1) -> int:
    """Return the seconds under a key in nanoseconds, 0 if there are none.

    Raises:
        MapError: It is no number, or longer than a clock is off.
    """
    shift_s = sign * entry.number(key, 0.0)
    if abs(shift_s) > _MAX_TIME_SHIFT_S:
        raise MapError(
            f"{entry.where}: key '{key}': {shift_s:g} s: it must be below {_MAX_TIME_SHIFT_S:g} s: give "
            "seconds"
        )
    return round(1e9 * shift_s)


def note_line_delays(entry: Entry, cameras: Sequence[Camera]) -> list[str]:
    """Return a note on rolling shutters that run upwards.

    Raises:
        MapError: An image would take longer than a second.
    """
    notes = []
    for row, camera in enumerate(cameras):
        readout_s = 1e-9 * abs(camera.line_delay_ns) * camera.height_px
        if readout_s > 1.0:
            raise MapError(
                f"{entry.where}: camera {row}: a line delay of {1e-9 * camera.line_delay_ns:g} s is "
                f"{readout_s:g} s for {camera.height_px} rows: give the seconds between two rows"
            )
        if camera.line_delay_ns < 0:
            notes.append(
                f"{entry.where}: camera {row}: the line delay is negative: from below upwards"
            )
    return notes


def read_imu(
    entry: Entry, noise: Sequence[str], limits: Mapping[str, str] | None = None, **more: Any
) -> Imu:
    """Return the IMU of an entry without id.

    Args:
        noise: Keys of the noise density and the random walk of the accelerometer, then of the gyroscope.
        limits: Keys that may be missing, by the field of the IMU.

    Raises:
        MapError: A key is missing or not positive.
    """
    default = Imu(id="")
    for field, key in (limits or {}).items():
        more[field] = entry.number(key, getattr(default, field), positive=True)
    for field, key in zip(_NOISE_FIELDS, noise, strict=True):
        more[field] = entry.number(key, positive=True)
    return Imu("", **more)
