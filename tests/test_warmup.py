"""What commands need is compiled ahead: after the warmup nothing else is."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py import kernel_cache
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.estimation.terms.pose_graph import RelativePoses
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.geometry import se3
from maplab_py.simulation import raw_data
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.simulate import simulate
from maplab_py.vision.tracking import tracker
from maplab_py.warmup import jobs
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.algorithms.relaxation import loops
from tests.estimation.window.recordings import scenario, simulated
from tests.vision.tracking.rendered import pose, stereo

CAMERA = sim.CameraOptions(intrinsics=(40.0, 40.0, 40.0, 30.0), width_px=80, height_px=60)


@pytest.fixture(scope="module")
def warmup() -> None:
    for job in jobs().values():
        job()


def search(folder: Path) -> None:
    vi_map, _ = make_map([Walk(room=1), Walk(room=1, start_s=60.0)])
    close_loops(vi_map)


def track(folder: Path) -> None:
    rig = stereo()
    frame_tracker = tracker.FrameTracker(rig.cameras, rig.T_I_C)
    for time_ns, turn in enumerate((None, np.eye(3), None)):
        frame_tracker.track(time_ns, rig.images(pose(y=0.02 * time_ns)), turn)


def smooth(folder: Path) -> None:
    tracks = simulated(scenario(duration_s=1.5, keypoints=40))
    options = WindowOptions(num_keyframes=3, num_recent_frames=2)
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    smoother.start(tracks.frames[0], tracks.start_state(np.full(15, 1e-2)))
    for frame in tracks.frames[1:]:
        smoother.add(frame)


def render(folder: Path) -> None:
    image = sim.SessionImages(light=0.5, repainted_share=0.1)
    rooms = sim.Scenario(
        world=sim.WorldOptions(landmarks_per_room=300),
        cameras=(CAMERA, dataclasses.replace(CAMERA, line_delay_s=1e-5)),
        measurement=sim.MeasurementOptions(frame_rate_hz=2.0),
        images=sim.ImageOptions(render=True, texel_m=0.05),
        sessions=(sim.SessionOptions(kind="loop", duration_s=1.0, turns=0.02, images=image),),
    )
    raw_data.write_raw_data(rooms, simulate(rooms), folder)


def relax_loop(folder: Path) -> None:
    loop = loops.simulate(0)
    relax(loop.vi_map, RelaxationOptions(), loop_closures=loop.closures)


def read_only_edges(folder: Path) -> None:
    T_A_B, rows = se3.identity(1), np.zeros(1, dtype=np.int64)
    T_A_B.flags.writeable = False
    RelativePoses(rows, rows, T_A_B, np.eye(6)[None]).errors(se3.identity(1))


@pytest.mark.usefixtures("warmup")
@pytest.mark.parametrize("work", [search, track, smooth, render, relax_loop, read_only_edges])
def test_after_the_warmup_nothing_is_compiled(work: Callable[[Path], None], tmp_path: Path) -> None:
    before = kernel_cache.seconds()
    work(tmp_path)
    assert kernel_cache.seconds() == before


def test_every_residual_has_a_job() -> None:
    named = {
        name
        for name, value in vars(sources).items()
        if not name.startswith("_") and getattr(value, "__module__", "") == sources.__name__
        if value is not PoseError
    }
    assert len(named) >= 7
    assert named <= set(jobs())
