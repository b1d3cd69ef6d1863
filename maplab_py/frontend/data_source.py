"""Opening of the recording that a user names."""

from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.frontend.run_options import DataSourceOptions
from maplab_py.interop.recordings import map_replay, protocol, reader_choice
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.storage.native import is_map_folder, load_map
from maplab_py.vimap import VIMap, queries


def open_source(
    folder: Path | None, options: DataSourceOptions, source: SourceOptions
) -> protocol.Recording:
    """Open the recording that the options name.

    Args:
        folder: EuRoC or TUM-VI folder, map folder, or bag; None = the options' bag.
        source: Calibration, cameras and topics.

    Raises:
        UserError: None or two are named, or it is of another kind.
        MapError: A file of it is missing or damaged.
    """
    path = _path(folder, options)
    is_map = is_map_folder(path)
    if options.type == "map" and not is_map:
        raise UserError(f"--datasource_type=map: {path} is not a map folder")
    if options.type in ("euroc", "rosbag") and is_map:
        raise UserError(f"{path} is a map folder: give --datasource_type=map")
    if is_map:
        source.device.check_unused("a mission names its sensors")
        vi_map, _ = load_map(path)
        return map_replay.MapRecording(vi_map, _mission(vi_map, options.map_mission))
    if options.map_mission:
        raise UserError(f"--map_mission={options.map_mission}: {path} is not a map folder")
    recording = reader_choice.open_recording(path, source)
    is_bag = recording.kind.endswith("bag")
    if options.type in ("euroc", "rosbag") and is_bag != (options.type == "rosbag"):
        raise UserError(f"--datasource_type={options.type}: {path} is a {recording.kind}")
    return recording


def _mission(vi_map: VIMap, prefix: str) -> int:
    """Return the row of the mission to replay."""
    is_only = len(vi_map.missions) == 1 and not prefix
    return 0 if is_only else queries.find_mission(vi_map, prefix)


def _path(folder: Path | None, options: DataSourceOptions) -> Path:
    if folder is not None and options.rosbag is not None:
        raise UserError("give --datasource_folder or --datasource_rosbag, not both")
    path = folder or options.rosbag
    if path is None:
        raise UserError(
            "no recording: give --datasource_folder=FOLDER (EuRoC, TUM-VI, map) or "
            "--datasource_rosbag=BAG"
        )
    if options.type in ("euroc", "map") and folder is None:
        raise UserError(f"--datasource_type={options.type} needs --datasource_folder=FOLDER")
    return path
