"""How long an image takes to render, compared with a ray caster in numpy.

python -m benchmarks.rendering [--scenario stereo_room] [--images 20]
"""

import argparse
import dataclasses
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3
from maplab_py.simulation import imaging, scenario_file
from maplab_py.simulation.raw_data import SessionFolders, write_images
from maplab_py.simulation.ray_caster import RayCaster, painted_boxes
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scene import Scene, make_scene
from maplab_py.simulation.simulate import RecordedSession, simulate
from tests.simulation.slow_renderer import render_slowly

COMPARED = 3
"""Images that the slow ray caster renders, too."""
CROWDED = 100
"""Boxes in the room beside those of the scenario."""


@dataclasses.dataclass(frozen=True)
class Figures:
    """Processor times of one thread, per image of one camera."""

    boxes: int
    cast_ms: float  # one sample, no blur: the median
    fastest_cast_ms: float
    numpy_ms: float  # the fastest
    largest_grey_difference: float
    written_ms: (
        float  # all blur samples, noise, encoding and writing; includes preparing the camera
    )
    blur_samples: int

    @property
    def ratio(self) -> float:
        """Time of numpy by that of the compiled ray caster, both the fastest."""
        return self.numpy_ms / self.fastest_cast_ms


def measure(
    name: str = "stereo_room", images: int = 20, boxes: int = 0, compared: int = COMPARED
) -> Figures:
    """Render images of a scenario, with some more boxes in its room, and `compared` of them slowly."""
    scenario = scenario_file.load_scenario(name)
    short = dataclasses.replace(scenario.sessions[0], phases=(), duration_s=images / 10.0)
    scenario = dataclasses.replace(
        scenario,
        measurement=dataclasses.replace(scenario.measurement, frame_rate_hz=10.0),
        images=dataclasses.replace(scenario.images, depth=False),
        sessions=(short,),
    )
    data = simulate(scenario)
    rng = np.random.default_rng(0)
    low, high = data.world.bounds
    middle, half = rng.uniform(low, high, (boxes, 3)), rng.uniform(0.05, 0.2, (boxes, 3))
    added = np.stack([middle - half, middle + half], axis=1)
    every = np.concatenate([data.world.boxes, added])
    scene = make_scene(data.world.bounds, every, scenario.images, rng)
    return _measured(scenario, data.recordings[0], scene, compared)


def _measured(scenario: Scenario, session: RecordedSession, scene: Scene, compared: int) -> Figures:
    camera = session.device.true_rig.cameras[0]
    rays, focal_px = imaging.pixel_rays(camera), float(np.mean(camera.intrinsics[-4:-2]))
    caster = RayCaster.of(painted_boxes(scene), rays, focal_px)
    T_I_C, recording = session.device.true_rig.T_B_C[0], session.recording
    poses: F64 = se3.compose(recording.spline.evaluate(recording.frame_s).T_G_I, T_I_C)[:, None]
    caster.render(poses[0])
    fast_s = [_cpu_s(lambda pose=pose: caster.render(pose)) for pose in poses]  # type: ignore[misc]
    slow_s, difference = [], 0.0
    for pose in poses[:: max(1, len(poses) // compared)][:compared]:
        begin = time.process_time()
        expected, _ = render_slowly(scene, rays, focal_px, pose)
        slow_s.append(time.process_time() - begin)
        difference = max(difference, float(np.abs(caster.render(pose)[0] - expected).max()))
    return Figures(
        len(scene.boxes) - 1,
        1e3 * float(np.median(fast_s)),
        1e3 * min(fast_s),
        1e3 * min(slow_s),
        difference,
        1e3 * _written_s(scenario, session, scene),
        scenario.images.blur_samples,
    )


def _written_s(scenario: Scenario, session: RecordedSession, scene: Scene) -> float:
    """Return the time per image to render and write on one thread, without preparing the cameras."""
    painted, recording = painted_boxes(scene), session.recording
    cameras, count = len(session.device.true_rig.cameras), len(recording.time_ns)
    first = dataclasses.replace(
        recording, time_ns=recording.time_ns[:1], frame_s=recording.frame_s[:1]
    )
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for row in range(cameras):
            (Path(folder) / f"cam{row}").mkdir()
        folders = SessionFolders(Path(folder), Path(folder))
        for part in (first, recording):
            rows = dataclasses.replace(session, recording=part)
            seconds.append(
                _cpu_s(
                    lambda rows=rows: write_images(scenario, 0, rows, painted, folders, threads=1)
                )  # type: ignore[misc]
            )
    return (seconds[1] - seconds[0]) / (cameras * (count - 1))


def _cpu_s(action: Callable[[], object]) -> float:
    begin = time.process_time()
    action()
    return time.process_time() - begin


def main() -> None:
    """Print milliseconds per image and the ratio to numpy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="stereo_room", help="name; must render images")
    parser.add_argument("--images", type=int, default=20)
    arguments = parser.parse_args()
    print(f"processor milliseconds per image on one thread; load {os.getloadavg()[0]:.1f}")
    for boxes in (0, CROWDED):
        figures = measure(arguments.scenario, arguments.images, boxes)
        print(
            f"{figures.boxes} boxes: cast {figures.cast_ms:.1f} (fastest "
            f"{figures.fastest_cast_ms:.1f}), numpy {figures.numpy_ms:.0f} = {figures.ratio:.0f} x, "
            f"largest difference {figures.largest_grey_difference:.3f} of 255; with "
            f"{figures.blur_samples} blur samples and writing {figures.written_ms:.1f}"
        )


if __name__ == "__main__":
    main()
