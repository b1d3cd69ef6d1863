"""All that the smoother compiles is compiled ahead."""

import numpy as np

from maplab_py.estimation.codegen.kernels import residual_kernel, window_kernels
from maplab_py.estimation.kernels import imu
from maplab_py.estimation.kernels import window as kernels
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.warmup import optimizer_jobs
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.estimation.window.warmup import window_jobs
from tests.estimation.window.recordings import scenario, simulated


def signatures() -> dict[str, set[object]]:
    """Return the signatures for which each kernel of the smoother has been compiled."""
    module = window_kernels()
    compiled = {
        name: getattr(module, name) for name in ("eliminate", "substitute", "evaluate", "unproject")
    }
    names = (
        "add_factors",
        "add_walks",
        "offsets",
        "retract",
        "camera_poses",
        "triangulate",
        "group",
    )
    compiled |= {name: getattr(kernels, name) for name in names}
    compiled["integrate_for_residuals"] = imu.integrate_for_residuals
    for name in ("inertial", "relative_pose"):
        compiled[name] = residual_kernel(name, getattr(sources, name)).evaluate
    return {name: set(kernel.signatures) for name, kernel in compiled.items()}


def test_a_run_compiles_nothing_after_warmup() -> None:
    jobs = {**optimizer_jobs(), **window_jobs()}
    for name in ("window", "window landmarks", "inertial", "relative_pose"):
        jobs[name]()
    ahead = signatures()
    tracks = simulated(scenario(duration_s=1.5, keypoints=40))
    options = WindowOptions(num_keyframes=3, num_recent_frames=2)
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    smoother.start(tracks.frames[0], tracks.start_state(np.full(15, 1e-2)))
    for frame in tracks.frames[1:]:
        smoother.add(frame)
    assert signatures() == ahead
    assert all(ahead.values())
