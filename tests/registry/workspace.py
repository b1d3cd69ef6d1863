"""A folder in which the example of every command can be typed.

A new command whose example needs something that is not here gets it here: a file in
`make_workspace`, or lines that are typed first in `PREPARED`.
"""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pymap3d import enu2geodetic

from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.simulation import scenario as sim
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from tests.frontend.simulated import REST_FIRST, replayed
from tests.interop.recordings.written import make_content, write_bag, write_folder
from tests.registry.resources import save_with_resources, write_stamped_files
from tests.simulation.small import simulated
from tests.support.small_xfeat import checkpoint, random_arrays
from tests.support.stereo_room import StereoRoom, quarter_size

ROUND = sim.Scenario(
    name="round",
    world=sim.WorldOptions(landmarks_per_room=1200),
    measurement=sim.MeasurementOptions(frame_rate_hz=3.0, max_keypoints=150),
    sessions=(
        sim.SessionOptions(duration_s=20.0, turns=1.3),
        sim.SessionOptions(duration_s=20.0, turns=1.3, start_turn=0.1),
    ),
)
"""Two walks round a room, each with a loop and much in common."""

SCANNED = sim.Scenario(
    name="scanned",
    world=sim.WorldOptions(landmarks_per_room=800),
    measurement=sim.MeasurementOptions(max_keypoints=60),
    lidar=sim.LidarOptions(rate_hz=0.5, columns=600),
    sessions=(sim.SessionOptions(duration_s=22.0, turns=1.7),),
)
"""A walk round a room with a lidar."""

MERGED = "load_merge_all_maps --maps_folder=maps --target_map_key=office; elq"
PREPARED = {
    "rovioli": "",
    "cancel": "",
    "load": "",
    "recover": "",
    "check": "!echo map_stats > nightly.maplab",
    "load_all": "",
    "load_merge_all_maps": "",
    "load_merge_all_submaps": "",
    "load_merge_map": "load maps/v1_01",
    "load_merge_submap": "",
    "merge_map": "load_all maps; select_map v1_01",
    "select_map": "load_all maps",
    "rename_map": MERGED,
    "reproduce": f"{MERGED}; save --map_folder=merged",
    "join_all_maps": "load_all maps",
    "anchor_mission": f"{MERGED}; sbk --map_mission=a1; ",
    "anchor_all_missions": f"{MERGED}; sbk --map_mission=59f0",
    "redo": f"{MERGED}; rlq; undo",
    "restore": f"{MERGED}; snapshot before_relax; rlq",
    "timing": MERGED,
    "unalias": "alias tidy=elq",
    "unset": "set --ba_num_iterations=3",
}
"""Lines typed before a command's example; MERGED where nothing is said."""

CLOSED = f"{MERGED}; lc --lc_insert_lc_edge_instead_of_merging"
for _name in (
    "assign_edge_uncertainties",
    "assign_switch_variable_uncertainties_for_loop-closure_edges",
    "assign_switch_variable_values_for_loop-closure_edges",
    "visualize_loop_closures",
):
    PREPARED[_name] = CLOSED
for _name in ("save_view", "export_view", "viewer_go_to", "viewer_keep", "viewer_stop"):
    PREPARED[_name] = f"{MERGED}; visualize --viewer_port=0"
for _name in ("print_summary_map", "localize"):
    PREPARED[_name] = f"{MERGED}; summary_map --summary_map_save_path=office_summary"
for _name in ("segment_database_stats", "prune_segments", "export_segments", "suggest_motion"):
    PREPARED[_name] = f"{MERGED}; collect_segments --database=device.segments"
# two short walks show no accelerometer scale, and are refused if that is asked of them
PREPARED["self_calibrate"] = f"{MERGED}; set --sc_states=intrinsics,extrinsics_rotation"
PREPARED["remove_loopclosure"] = PREPARED["judge_closures"] = f"{MERGED}; lc"
PREPARED["simulate"] = f"{MERGED}; !rm -r simulated"
PREPARED["tour"] = "!mkdir -p maplab_tour/sessions && touch maplab_tour/sessions/truth.npz"
PREPARED["relax_external"] = f"{MERGED}; sbk --map_mission=59f0; sbk --map_mission=a1"
PREPARED["import_g2o"] = f"{MERGED}; export_g2o graph.g2o"
PREPARED["import_calibration"] = f"{MERGED}; export_calibration --format=kalibr --folder=kalibr"
PREPARED["import_trajectory"] = (
    f"{MERGED}; ettc --pose_export_file=poses.csv --csv_export_format=rpg --map_mission=59f0"
)
PREPARED["compare_maps"] = "load maps/v1_01 --map_key=before_optvi; load maps/v1_02"
PREPARED["update_map"] = (
    "load maps/v1_02 --map_key=tuesday; load maps/v1_01; set_mission_baseframe_to_known"
)
PREPARED["visualize_changes"] = PREPARED["update_map"]
PREPARED["map_log"] = PREPARED["map_at"] = f"{PREPARED['update_map']}; update_map --session=tuesday"
PREPARED["import_colmap"] = (
    "load maps/v1_01; export_colmap --colmap_folder=office_colmap; "
    "ettc --pose_export_file=office_truth.csv --csv_export_format=rpg"
)
PREPARED["visualize_difference"] = f"{MERGED}; snapshot before; rlq"

for _name in ("export_images", "remove_resources", "clean_up_resource_folders"):
    PREPARED[_name] = "load with_resources/office"
_ROOM = "load stereo_room/session_1; import_images stereo_room/raw/session_1"
PREPARED["extract_features"] = _ROOM
PREPARED["track_features"] = f"{_ROOM}; extract_features --max_features=100"
PREPARED["stereo_dense_reconstruction"] = _ROOM
PREPARED["convert_all_depth_maps_to_point_clouds"] = f"{_ROOM}; sdr"
PREPARED["create_tsdf_from_depth_resource"] = f"{_ROOM}; sdr"
PREPARED["create_esdf_from_depth_resource"] = f"{_ROOM}; sdr"
PREPARED["visualize_esdf"] = f"{_ROOM}; sdr; esdf"
PREPARED["create_mesh_from_tsdf_grid"] = f"{_ROOM}; sdr; tsdf"
PREPARED["export_colmap_mvs"] = PREPARED["export_for_pmvs_reconstruction"] = _ROOM
PREPARED["visualize_mesh"] = PREPARED["create_mesh_from_tsdf_grid"]
PREPARED["register_point_clouds"] = "load lidar"
PREPARED["join_submaps"] = (
    "load_merge_all_maps --maps_folder=maps --target_map_key=city; split_map --cell_count=2; "
    "delete_map city --yes"
)

PREPARED["push"] = ""
_PUSHED = "push submap_1 --spool=spool --robot_name=ant"
PREPARED["serve"] = _PUSHED
_SERVING = "serve --spool=spool --maplab_server_merged_map_folder=city --serve_stop_when_idle_s=5"
WITH_ROBOT = ("live_topics", "play_recording", "record_bag")
"""Commands that talk to the programs of a running robot: tests/interop/live has some."""

SERVED = (
    "delete_all_robot_missions",
    "delete_mission",
    "map_lookup",
    "serve_status",
    "serve_stop",
)
for _name in SERVED:
    PREPARED[_name] = f"{_PUSHED}; {_SERVING} &; serve_status --spool=spool --wait_s=100"
PREPARED["get_dense_map_in_range"] = (
    "push lidar --spool=spool --robot_name=ant; "
    f"{_SERVING} &; serve_status --spool=spool --wait_s=100"
)

OTHER_EXAMPLES = {
    "install_features": "install_features xfeat --weights=weights.pt",
    "save_view": "save_view --file=map.png --width_px=320 --height_px=200",
    "simulate_robots": "simulate_robots --spool=spool --scenario=walk.yaml --robots_rate=0",
}
"""Lines that take the place of examples which take long, or need a connection."""
_WALK = """
name: walk
world: {landmarks_per_room: 600}
measurement: {frame_rate_hz: 3.0, max_keypoints: 100}
sessions: [{duration_s: 9.0, turns: 0.6}]
"""

_SHOWING = ("images", "depth_maps", "disparity_maps", "pointclouds")


def lines_before(name: str) -> str:
    """Return what is typed before a command's example."""
    if name.startswith("visualize_") and any(kind in name for kind in _SHOWING):
        return "load with_resources/office"
    return PREPARED.get(name, MERGED)


SLOW = (
    *SERVED,
    "anchor_all_missions",
    "anchor_mission",
    "assign_edge_uncertainties",
    "demo",
    "get_dense_map_in_range",
    "loopclosure_all_missions",
    "loopclosure_one_mission",
    "optimize_visual",
    "relax",
    "relax_missions_independently",
    "serve",
    "simulate",
    "warmup",
)
"""Commands whose examples take more than a second or two."""


def make_workspace(folder: Path) -> None:
    """Write the maps and files that examples name."""
    data = simulated(ROUND)
    (folder / "simulated").mkdir()
    data.truth.save(folder / "simulated" / "truth.npz")
    write_workspace(folder, *data.maps)


def write_workspace(folder: Path, first: VIMap, second: VIMap) -> None:
    """Write two maps, and the files that examples name, under the names of the examples."""
    first, second = _with_mission_id(first, 0x59F0), _with_mission_id(second, 0xA1B2)
    for place, vi_map in (
        ("maps/v1_01", first),
        ("maps/v1_02", second),
        ("euroc_v1_01/part_1", first),
        ("submap_1", first),
    ):
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        save_map(vi_map, folder / place)
    save_with_resources(first, folder / "with_resources" / "office")
    (folder / "walk.yaml").write_text(_WALK)
    (folder / "weights.pt").write_bytes(checkpoint(random_arrays()))
    _write_closures(first, second, folder / "closures.yaml")
    _write_fixes(first, folder / "track.csv")
    _write_wheels(first, folder / "wheels.csv")
    sensors = next((folder / "maps" / "v1_01").rglob("sensors.yaml"))
    (folder / "sensors.yaml").write_bytes(sensors.read_bytes())
    (folder / "images").mkdir()
    write_stamped_files(first, folder)
    StereoRoom.simulated(folder / "stereo_room", quarter_size(frame_rate_hz=2.0))
    _write_scanned_map(folder / "lidar")
    write_folder(make_content(), folder / "MH_01_easy")
    write_bag(make_content(), folder / "walk.bag")
    save_map(replayed(REST_FIRST, 1)[0], folder / "walk")  # a recording to replay
    with Session() as session:
        session.run("load", map_folder=folder / "maps" / "v1_01")
        for name in ("V1_01_easy.csv", "vil.csv"):
            session.run("ettc", pose_export_file=folder / name, csv_export_format="rpg")


def _write_scanned_map(folder: Path) -> None:
    """Write a map with the clouds of a lidar."""
    save_map(simulated(SCANNED).maps[0], folder)


def _write_fixes(vi_map: VIMap, path: Path) -> None:
    """Write the positions of the vertices of a map as a satellite receiver would give them."""
    positions = enu2geodetic(*vi_map.T_G_I[:, 4:].T, 47.3769, 8.5417, 450.0)
    rows = zip(vi_map.vertices.timestamp_ns.tolist(), *positions, strict=True)
    lines = [f"{time_ns},{lat:.10f},{lon:.10f},{alt:.4f}" for time_ns, lat, lon, alt in rows]
    path.write_text("\n".join(["timestamp,latitude,longitude,altitude", *lines]))


def _write_wheels(vi_map: VIMap, path: Path) -> None:
    """Write the poses of wheels that are on the IMU where the example says."""
    T_I_S = se3.make(se3.identity()[:4], np.array([-0.2, 0.0, -0.3]))
    T = se3.compose(vi_map.vertices.T_M_I, T_I_S)
    lines = [
        ",".join([str(time_ns), *map(repr, [*row[4:], *row[:4]])])
        for time_ns, row in zip(vi_map.vertices.timestamp_ns.tolist(), T.tolist(), strict=True)
    ]
    path.write_text("\n".join(["timestamp,x,y,z,qx,qy,qz,qw", *lines]))


def _write_closures(first: VIMap, second: VIMap, path: Path) -> None:
    """Write one closure between the first vertices of two maps, in maplab's YAML."""

    def pose(T: Any) -> dict[str, list[float]]:
        return {"rotation_xyzw": T[:4].tolist(), "translation_m": T[4:].tolist()}

    ends = {
        name: {
            "timestamp_ns": int(vi_map.vertices.timestamp_ns[0]),
            "pose": pose(vi_map.T_G_I[0]),
        }
        for name, vi_map in (("camera_from", first), ("camera_to", second))
    }
    closure = {
        **ends,
        "T_from_to": pose(se3.relative(first.T_G_I[0], second.T_G_I[0])),
        "covariance": (np.eye(6) * 1e-4).ravel().tolist(),
        "switch_variable": 1.0,
        "switch_variable_variance": 1e-8,
    }
    path.write_text(yaml.safe_dump([closure]))


def _with_mission_id(vi_map: VIMap, first_digits: int) -> VIMap:
    ids = vi_map.missions.id.copy()
    ids[:, 0] = (ids[:, 0] & np.uint64(0xFFFFFFFFFFFF)) | np.uint64(first_digits << 48)
    return vi_map.replace(missions=vi_map.missions.replace(id=ids))


def digest(value: Any) -> str:
    """Return a checksum of every byte of a map (or any nest of dataclasses and arrays)."""
    checksum = hashlib.sha256()
    _feed(value, checksum)
    return checksum.hexdigest()


def _feed(value: Any, checksum: Any) -> None:
    if isinstance(value, np.ndarray):
        checksum.update(f"{value.dtype} {value.shape}".encode())
        checksum.update(np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            checksum.update(field.name.encode())
            _feed(getattr(value, field.name), checksum)
    elif isinstance(value, dict):
        for key, item in value.items():
            checksum.update(repr(key).encode())
            _feed(item, checksum)
    elif isinstance(value, (list, tuple)):
        for item in value:
            _feed(item, checksum)
    else:
        checksum.update(repr(value).encode())
