"""Reading scenarios from YAML: every mistake is one line that names file and key."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from maplab_py.errors import MapError, UserError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text
from maplab_py.options import violation
from maplab_py.sensors import Distortion, Projection, yaml_text
from maplab_py.sensors.camera import CAMERA_MODELS, DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.reports import ScenarioLine, ScenarioList

_FOLDER = Path(__file__).parent / "scenarios"
_KINDS: dict[type, str] = {bool: "true or false", int: "a whole number", float: "a number"}


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with the program."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def list_scenarios() -> ScenarioList:
    """Describe the scenarios that come with the program."""
    lines = []
    for name in scenario_names():
        scenario = load_scenario(name)
        seconds = sum(session.total_s for session in scenario.sessions)
        lines.append(ScenarioLine(name, len(scenario.sessions), seconds, scenario.description))
    return ScenarioList(tuple(lines))


def load_scenario(name_or_path: str | Path, seed: int | None = None) -> sim.Scenario:
    """Read a scenario by name, or from a YAML file; a seed takes the place of its own seeds.

    Raises:
        UserError: There is no such scenario, or it has a mistake (names file and key), or the seed is
            negative.
    """
    if seed is not None and seed < 0:
        raise UserError(f"--seed={seed}: must be 0 or greater")
    path = Path(name_or_path)
    if str(name_or_path) in scenario_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    elif not path.is_file():
        known = ", ".join(scenario_names())
        raise UserError(
            f"there is no scenario '{name_or_path}': give a YAML file or one of {known}"
        )
    try:
        text = read_text(path, SCRIPT_MAX_BYTES, remedy="scenarios are shorter")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise UserError(f"cannot read {path}: {reason}") from None
    scenario = _with_absolute_paths(parse_scenario(text, path.name), path.parent)
    return scenario if seed is None else scenario.with_seed(seed)


def parse_scenario(text: str, source: str) -> sim.Scenario:
    """Read a scenario from YAML text.

    Raises:
        UserError: The text has a mistake; names source and key.
    """
    try:
        content = yaml_text.parse_yaml(text, source)
    except MapError as error:
        raise UserError(_syntax_error(source, error)) from None
    try:
        scenario: sim.Scenario = _read(sim.Scenario, content, "")
        check_scenario(scenario)
    except UserError as error:
        raise UserError(f"{source}: {error}") from None
    return scenario


def _syntax_error(source: str, error: MapError) -> str:
    """Say in a few words where the text ceases to be YAML."""
    cause = error.__cause__
    problem = getattr(cause, "problem", None) or "it cannot be read"
    mark = getattr(cause, "problem_mark", None)
    where = f", line {mark.line + 1}" if mark else ""
    return f"{source}{where}: this is not YAML: {problem}"


def _with_absolute_paths(scenario: sim.Scenario, folder: Path) -> sim.Scenario:
    """Return the scenario with the files of its sessions looked up beside the scenario file."""

    def beside(file: str) -> str:
        return str(folder / file) if file else ""

    sessions = tuple(
        dataclasses.replace(
            session,
            trajectory=beside(session.trajectory),
            recorded_imu=beside(session.recorded_imu),
        )
        for session in scenario.sessions
    )
    return dataclasses.replace(scenario, sessions=sessions)


def _read(kind: Any, value: Any, key: str) -> Any:
    """Turn a YAML value into a dataclass, a tuple or a scalar."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _read_group(kind, value, key)
    if typing.get_origin(kind) is tuple:
        return _read_list(typing.get_args(kind), value, key)
    if isinstance(kind, types.UnionType):
        raise TypeError(f"{key}: unions are not supported")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind is float and is_number:
        return float(value)
    if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
        return value
    raise UserError(f"{key}: {_KINDS.get(kind, 'a text')} is expected, not {value!r}")


def _read_group(kind: type, value: Any, key: str) -> Any:
    if not isinstance(value, Mapping):
        raise UserError(f"{key or 'the file'}: a mapping of keys is expected, not {value!r}")
    hints = typing.get_type_hints(kind)
    fields: dict[str, Any] = {}
    for name, item in value.items():
        inner = f"{key}.{name}" if key else str(name)
        if name not in hints:
            near = difflib.get_close_matches(str(name), hints, 1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(hints)}"
            raise UserError(f"{inner}: unknown key{hint}")
        fields[name] = _read(hints[name], item, inner)
    return kind(**fields)


def _read_list(kinds: tuple[Any, ...], value: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise UserError(f"{key}: a list is expected, not {value!r}")
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise UserError(f"{key}: {len(kinds)} values are expected, not {len(value)}")
    return tuple(
        _read(kind, item, f"{key}[{row}]")
        for row, (kind, item) in enumerate(zip(kinds, value, strict=True))
    )


_LAYOUT_OF_KIND = {
    **dict.fromkeys(("room_scan", "figure_8", "loop", "vehicle"), "rooms"),
    "corridor": "corridor",
    "streets": "city",
}
_LARGEST = 1e6
"""Maximum magnitude of any number of a scenario."""
_MOST_SAMPLES = 10_000_000


def check_scenario(scenario: sim.Scenario) -> None:
    """Check the values of a scenario.

    Raises:
        UserError: A value is out of its range; names the key.
    """
    _check_numbers(scenario, "", {})
    _check_world(scenario)
    if scenario.measurement.frame_rate_hz > scenario.imu.rate_hz:
        raise UserError("measurement.frame_rate_hz: must not exceed imu.rate_hz")
    _check_times(scenario)
    _check_lidar(scenario.lidar)
    if not scenario.sessions:
        raise UserError("sessions: at least one is needed")
    if not scenario.cameras:
        raise UserError("cameras: at least one is needed")
    for row, session in enumerate(scenario.sessions):
        _check_session(scenario, session, f"sessions[{row}]")
    for row, camera in enumerate(scenario.cameras):
        _check_camera(camera, f"cameras[{row}]")


def _check_times(scenario: sim.Scenario) -> None:
    imu = scenario.imu
    if imu.time_jitter_s > 0.1 / imu.rate_hz:
        raise UserError("imu.time_jitter_s: must not exceed a tenth of the time between samples")
    for row, camera in enumerate(scenario.cameras):
        if abs(camera.line_delay_s) * camera.height_px > 0.05:
            raise UserError(f"cameras[{row}].line_delay_s: reads longer than 0.05 s for an image")


def _check_lidar(lidar: sim.LidarOptions) -> None:
    if not lidar.lowest_deg < lidar.highest_deg:
        raise UserError("lidar.lowest_deg, highest_deg: must be in order")
    if not lidar.min_range_m < lidar.max_range_m:
        raise UserError("lidar.min_range_m, max_range_m: must be in order")


def _check_numbers(group: Any, key: str, bounds: Mapping[str, float]) -> None:
    """Check that every number is in its range, finite and not too large, and every text a choice."""
    if dataclasses.is_dataclass(group):
        for field in dataclasses.fields(group):
            inner = f"{key}.{field.name}" if key else field.name
            value, choices = getattr(group, field.name), field.metadata.get("choices", ())
            if choices and value not in choices:
                raise UserError(f"{inner}: must be one of {', '.join(choices)}, not '{value}'")
            _check_numbers(value, inner, field.metadata.get("bounds", {}))
    elif isinstance(group, tuple):
        for row, item in enumerate(group):
            _check_numbers(item, f"{key}[{row}]", bounds)
    elif isinstance(group, (int, float)):
        is_seed = isinstance(group, int) and key.startswith("seeds.")
        if not is_seed and not abs(group) <= _LARGEST:
            raise UserError(f"{key}: must be a number up to {_LARGEST:g}, not {group:g}")
        if said := violation(group, bounds):
            raise UserError(f"{key}: {said}, not {group:g}")


def _check_world(scenario: sim.Scenario) -> None:
    world = scenario.world
    if min(world.room_size_m) <= 0.0:
        raise UserError("world.room_size_m: must be greater than 0")
    if world.layout == "corridor" and min(world.room_size_m[:2]) < 4.0 * world.corridor_width_m:
        raise UserError("world.corridor_width_m: must not exceed a quarter of room_size_m")
    if min(world.blocks) < 1:
        raise UserError("world.blocks: must be 1 or greater")
    if world.corridor_rooms and world.corridor_width_m > world.room_size_m[1]:
        raise UserError("world.corridor_width_m: must not exceed the width of a room")
    for room in world.corridor_rooms:
        if not 0 <= room < world.rooms:
            raise UserError(
                f"world.corridor_rooms: must be from 0 to {world.rooms - 1}, not {room}"
            )
    if world.identical_rooms and len(set(world.corridor_rooms)) == world.rooms:
        raise UserError("world.corridor_rooms: leaves no room that could look like another")


def _check_session(scenario: sim.Scenario, session: sim.SessionOptions, key: str) -> None:
    frames = session.total_s * scenario.measurement.frame_rate_hz
    if not frames >= 2.0:
        raise UserError(f"{key}.duration_s: too short for two frames")
    if session.total_s * scenario.imu.rate_hz > _MOST_SAMPLES:
        raise UserError(f"{key}.duration_s: gives more than {_MOST_SAMPLES} IMU samples")
    images = session.images
    if images.walkers_until_s and images.walkers_until_s <= images.walkers_from_s:
        raise UserError(f"{key}.images.walkers_until_s: must be after walkers_from_s, or 0")
    if images.walkers and not scenario.images.render:
        raise UserError(f"{key}.images.walkers: needs images.render: true")
    if session.trajectory:
        return
    if session.recorded_imu or session.keep_frame:
        name = "recorded_imu" if session.recorded_imu else "keep_frame"
        raise UserError(f"{key}.{name}: is of a trajectory; give {key}.trajectory, too")
    if not session.phases:
        _check_motion(scenario, session, key)
    for row, phase in enumerate(session.phases):
        _check_motion(scenario, phase, f"{key}.phases[{row}]")


def _check_motion(scenario: sim.Scenario, motion: sim.MotionOptions, key: str) -> None:
    world = scenario.world
    if not motion.duration_s >= 0.5:
        raise UserError(f"{key}.duration_s: too short, must be at least 0.5")
    if motion.turns == 0.0 and motion.kind not in ("straight", "stationary", "hover", "shake"):
        raise UserError(f"{key}.turns: must not be 0")
    if not 0 <= motion.room < world.rooms:
        raise UserError(f"{key}.room: must be from 0 to {world.rooms - 1}")
    layout = _LAYOUT_OF_KIND.get(motion.kind, world.layout)
    if layout != world.layout:
        raise UserError(f"{key}.kind: {motion.kind} needs world.layout: {layout}")
    if world.layout == "city":
        _check_street_motion(scenario, motion, key)
        return
    size = world.room_size_m
    if not 0.0 < motion.wall_distance_m < 0.5 * min(size[:2]):
        raise UserError(f"{key}.wall_distance_m: leaves no room to move in")
    swing = abs(motion.height_swing_m) + motion.shake_m
    if not swing < motion.height_m < size[2] - swing:
        raise UserError(f"{key}.height_m: leads through floor or ceiling")


def _check_street_motion(scenario: sim.Scenario, motion: sim.MotionOptions, key: str) -> None:
    if motion.kind != "streets":
        raise UserError(f"{key}.kind: in a city only streets is possible")
    for first, last, count in zip(
        motion.first_block, motion.last_block, scenario.world.blocks, strict=True
    ):
        if not 0 <= first <= last < count:
            raise UserError(
                f"{key}.first_block, last_block: must be blocks of world.blocks, in order"
            )
    if motion.height_m <= abs(motion.height_swing_m) + motion.shake_m:
        raise UserError(f"{key}.height_m: leads through the ground")


def _check_camera(camera: sim.CameraOptions, key: str) -> None:
    model = Projection(camera.projection), Distortion(camera.distortion)
    if model not in CAMERA_MODELS:
        raise UserError(f"{key}.distortion: must be none with {camera.projection}")
    sizes = (
        ("intrinsics", INTRINSICS_SIZE[model[0]]),
        ("distortion_parameters", DISTORTION_SIZE[model[1]]),
    )
    for name, size in sizes:
        if len(getattr(camera, name)) != size:
            raise UserError(
                f"{key}.{name}: {size} values are expected, not {len(getattr(camera, name))}"
            )
