"""The map server that robots feed, and the commands that talk to it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.cancellation import ending_early, lasting_effect
from maplab_py.plugin import CommandContext, Message, command
from maplab_py.report import counted
from maplab_py.server import options as server_options

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from maplab_py.server.spool import Spool
    from maplab_py.server.submap_sources import RecordedSession
    from maplab_py.vimap import VIMap

_SECONDS_BETWEEN_LOOKS = 0.2


def _spool(folder: Path) -> Spool:
    from maplab_py.server.spool import Spool

    return Spool(folder)


@command(
    "serve",
    example="serve --spool=spool --maplab_server_merged_map_folder=city --serve_stop_when_idle_s=1",
    needs_map=False,
    guards_effects=True,
    see_also=("push", "serve_status", "serve_stop", "simulate_robots", "load_merge_submap"),
)
def serve(
    context: CommandContext,
    *,
    spool: Path,
    server: server_options.MapServerOptions = server_options.MapServerOptions(),
    stationary: StationaryOptions = StationaryOptions(),
    incremental: server_options.IncrementalOptions = server_options.IncrementalOptions(),
    service: server_options.ServiceOptions = server_options.ServiceOptions(),
    serve_visualize_map: bool = False,
) -> server_options.ServeReport:
    """Merge the submaps that robots put into a spool into one map, and publish it.

    Robots put map folders under incoming/ROBOT of the spool by one rename; `push` does it. Every
    submap is checked and optimised in a process of its own, appended to its mission, anchored and tied
    to the map by loop closures; what it touches is optimised, now and then everything is. The map's folder
    always holds a complete map. What is refused goes to rejected, with a reason. After a crash the
    server goes on where it was. Ctrl-C or serve_stop end it: it optimises jointly, and publishes.

    Args:
        spool: Folder of the spool; made when it does not exist.
        serve_visualize_map: Show the published map in the viewer, one colour a robot.
    """
    from maplab_py.server.server import MapServer

    watch, shown_at = _shown(context) if serve_visualize_map else (None, "")
    map_server = MapServer(
        _spool(spool),
        server,
        stationary=stationary,
        incremental=incremental,
        service=service,
        progress=context.progress,
        watch=watch,
        shown_at=shown_at,
    )
    with ending_early() as is_to_end:
        return map_server.run(is_to_end)


@command(
    "push",
    example="push submap_1 --spool=spool --robot_name=ant",
    needs_map=False,
    guards_effects=True,
    see_also=("serve",),
)
def push(
    _: CommandContext, map_folder: Path, *, spool: Path, robot_name: str = "robot", name: str = ""
) -> server_options.PushReport:
    """Put a submap into the spool of a map server: copied, compared with its checksum, then renamed.

    Args:
        map_folder: Folder of the submap.
        robot_name: Robot that the submap comes from.
        name: Name in the spool; empty = that of the folder.
    """
    from maplab_py.server import spool as spools

    with lasting_effect():
        return server_options.PushReport(
            spools.push(spools.Spool(spool), robot_name, map_folder, name)
        )


@command(
    "serve_status",
    example="serve_status --spool=spool",
    needs_map=False,
    see_also=("serve", "serve_stop"),
)
def serve_status(
    context: CommandContext, *, spool: Path, wait_s: float = 0.0
) -> server_options.ServerStatus:
    """Tell what a map server has done, and what lies in its spool; also where no server runs.

    Args:
        wait_s: Wait up to so long [s] until a server has merged all that can be merged.
    """
    from maplab_py.server.client import NotRunning, ask
    from maplab_py.server.status import status_without_server

    folder, deadline = _spool(spool), time.monotonic() + wait_s
    while True:
        try:
            content = ask(folder, "serve_status")
        except NotRunning:
            status = status_without_server(folder)
        else:
            robots = tuple(server_options.RobotLine(**line) for line in content.pop("robots"))
            content["spool"] = Path(content["spool"])
            events = (server_options.EventLine(**line) for line in content["last_events"])
            content["last_events"] = tuple(events)
            status = server_options.ServerStatus(**content, robots=robots)
        is_idle = status.is_running and not status.incoming + status.preparing + status.waiting
        if is_idle or time.monotonic() >= deadline:
            return status
        context.progress.check()
        time.sleep(_SECONDS_BETWEEN_LOOKS)


@command(
    "serve_stop",
    example="serve_stop --spool=spool",
    needs_map=False,
    acts_outside=True,
    see_also=("serve", "serve_status"),
)
def serve_stop(context: CommandContext, *, spool: Path, wait_s: float = 0.0) -> Message:
    """Let a map server optimise its map jointly, publish it and end.

    Args:
        wait_s: Wait up to so long [s] for its end.
    """
    from maplab_py.server.client import order

    folder, deadline = _spool(spool), time.monotonic() + wait_s
    order(folder, "serve_stop")
    while folder.address.exists() and time.monotonic() < deadline:
        context.progress.check()
        time.sleep(_SECONDS_BETWEEN_LOOKS)
    return Message("the server stops" if folder.address.exists() else "the server has stopped")


@command(
    "delete_mission",
    example="delete_mission --spool=spool --map_mission=59f0",
    needs_map=False,
    acts_outside=True,
    see_also=("delete_all_robot_missions", "remove_mission"),
)
def delete_mission(
    _: CommandContext, *, spool: Path, map_mission: str
) -> server_options.DeletedMissions:
    """Remove a mission from the map of a server for good; its later submaps are refused.

    Args:
        map_mission: Mission id or unambiguous beginning.
    """
    return _delete(spool, "delete_mission", mission=map_mission)


@command(
    "delete_all_robot_missions",
    example="delete_all_robot_missions --spool=spool --robot_name=ant",
    needs_map=False,
    acts_outside=True,
    see_also=("delete_mission",),
)
def delete_all_robot_missions(
    _: CommandContext, *, spool: Path, robot_name: str
) -> server_options.DeletedMissions:
    """Remove all missions of a robot from the map of a server; submaps of new ones are accepted.

    Args:
        robot_name: The robot.
    """
    return _delete(spool, "delete_all_robot_missions", robot_name=robot_name)


@command(
    "map_lookup",
    example="map_lookup --spool=spool --robot_name=ant --timestamp_ns=1600000001000000000",
    needs_map=False,
    see_also=("serve",),
)
def map_lookup(
    _: CommandContext,
    *,
    spool: Path,
    robot_name: str,
    timestamp_ns: int,
    sensor: str = "",
    p_S: str = "0 0 0",
) -> server_options.LookupReport:
    """Ask a map server where a point that a robot's sensor saw is in the global frame.

    Args:
        robot_name: The robot.
        timestamp_ns: Time at which the point was seen.
        sensor: Id of the sensor; empty = the IMU.
        p_S: Point in the frame of the sensor, "x y z" in metres.
    """
    from maplab_py.server.client import ask

    content = ask(
        _spool(spool),
        "map_lookup",
        robot_name=robot_name,
        timestamp_ns=str(timestamp_ns),
        sensor=sensor,
        p_S=p_S,
    )
    for name in ("p_G", "p_G_sensor"):
        content[name] = tuple(content[name])
    return server_options.LookupReport(**content)


@command(
    "get_dense_map_in_range",
    example='get_dense_map_in_range --spool=spool --center_G="0 0 1" --radius_m=5',
    needs_map=False,
    writes_files=True,
    see_also=("serve",),
)
def get_dense_map_in_range(
    _: CommandContext,
    *,
    spool: Path,
    center_G: str,
    radius_m: float,
    output_file: Path | None = None,
    overwrite: bool = False,
) -> server_options.DenseMapReport:
    """Ask a map server for the dense points around a position.

    The server looks into resources of the type --maplab_server_dense_map_resource_type.

    Args:
        center_G: Position in the global frame, "x y z" in metres.
        radius_m: Distance up to which points are wanted [m].
        output_file: PLY file that gets the points; empty = none.
    """
    import numpy as np

    from maplab_py.interop.ply import PlyCloud, write_ply
    from maplab_py.server.client import ask

    given = {"center_G": center_G, "radius_m": repr(radius_m)}
    content = ask(_spool(spool), "get_dense_map_in_range", **given)
    points = np.array(content["p_G"], dtype=np.float64).reshape(-1, 3)
    if output_file is not None:
        write_ply(PlyCloud(points), output_file, overwrite=overwrite)
    return server_options.DenseMapReport(len(points), int(content["resources"]), output_file)


@command(
    "simulate_robots",
    example="simulate_robots --spool=spool --scenario=single_session --robots_rate=0",
    needs_map=False,
    guards_effects=True,
    see_also=("serve", "simulate", "evaluate_map"),
)
def simulate_robots(
    context: CommandContext,
    *,
    spool: Path,
    scenario: str = "four_sessions",
    seed: int | None = None,
    maps_folder: Path | None = None,
    play: server_options.PlayOptions = server_options.PlayOptions(),
) -> server_options.PlayedRobots:
    """Play robots: cut their sessions into submaps and put each into a spool when its time has come.

    The truth of simulated sessions goes to truth.npz of the spool, for `evaluate_map`.

    Args:
        scenario: Name of a scenario (see list_scenarios), or a YAML file; each session is a robot.
        seed: Seed of all random numbers; empty = the seed of the scenario.
        maps_folder: Play the maps below this folder instead, as rovioli makes them of recordings; each
            mission is a robot, named after it or after the folder of its map.
    """
    from maplab_py.server.submap_sources import play as play_submaps
    from maplab_py.server.submap_sources import recorded_sessions, timed_submaps

    folder = _spool(spool)
    truth = folder.root / "truth.npz" if maps_folder is None else None
    sessions: Mapping[str, VIMap | RecordedSession]
    if maps_folder is not None:
        sessions = recorded_sessions(maps_folder)
    else:
        sessions = _simulated_sessions(context, scenario, seed, folder.root / "truth.npz")
    submaps = timed_submaps(sessions, play.submap_s)
    seconds = play_submaps(submaps, folder, play.rate, context.progress)
    return server_options.PlayedRobots(len(sessions), len(submaps), truth, seconds)


@command("tie_stationary_missions", see_also=("optimize_visual_inertial", "serve"))
def tie_stationary_missions(
    context: CommandContext, *, options: StationaryOptions = StationaryOptions()
) -> Message:
    """Tie the first and last vertex of every mission that stands still by a loop closure edge.

    `optvi --ba_include_loop_closure_edges` uses the edges, so that such a mission does not drift.
    """
    from maplab_py.algorithms.pose_graph_manipulation.edges import tie_stationary

    result, missions = tie_stationary(context.vi_map, options)
    context.commit(result)
    names = f": {', '.join(name[:8] for name in missions)}" if missions else ""
    return Message(f"{counted(len(missions), 'mission stands', 'missions stand')} still{names}")


def _shown(context: CommandContext) -> tuple[Callable[[VIMap], None], str]:
    """Return a function that shows a map in the session's viewer, and the address of its page."""
    from maplab_plugins.visualization.following import ViewerOptions, ensure_viewer
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.options import VisualizationOptions

    viewer = ensure_viewer(context, ViewerOptions())
    options = VisualizationOptions(color_missions_by_name=True)

    def watch(vi_map: VIMap) -> None:
        if len(vi_map.vertices) and not viewer.is_stopped:
            viewer.follow(Subject(vi_map, "server", options))

    return watch, viewer.url


def _delete(spool: Path, name: str, **parameters: str) -> server_options.DeletedMissions:
    from maplab_py.server.client import order

    content = order(_spool(spool), name, **parameters)
    return server_options.DeletedMissions(tuple(content["missions"]), content["vertices"])


def _simulated_sessions(
    context: CommandContext, scenario: str, seed: int | None, truth: Path
) -> dict[str, VIMap]:
    from maplab_py.simulation.scenario_file import load_scenario
    from maplab_py.simulation.simulate import simulate

    data = simulate(load_scenario(scenario, seed), progress=context.progress)
    truth.parent.mkdir(parents=True, exist_ok=True)
    data.truth.save(truth)
    return {f"robot_{number + 1}": vi_map for number, vi_map in enumerate(data.maps)}
