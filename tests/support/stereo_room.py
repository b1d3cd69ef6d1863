"""The scenario `stereo_room` with images of a quarter of the pixels, and fewer of them."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.interop.ply import parse_ply
from maplab_py.simulation import raw_data, scenario_file, truth
from maplab_py.simulation import scenario as sim
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap


def quarter_size(frame_rate_hz: float = 3.0) -> sim.Scenario:
    """Return the scenario with images of 376 x 240 pixels."""
    scenario = scenario_file.load_scenario("stereo_room")
    cameras = tuple(
        dataclasses.replace(
            camera,
            intrinsics=tuple(0.5 * value for value in camera.intrinsics),
            width_px=camera.width_px // 2,
            height_px=camera.height_px // 2,
        )
        for camera in scenario.cameras
    )
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=frame_rate_hz)
    return dataclasses.replace(scenario, cameras=cameras, measurement=measurement)


@dataclasses.dataclass(frozen=True)
class StereoRoom:
    """Folders of a simulated session with images and their truth."""

    folder: Path

    @classmethod
    def simulated(cls, folder: Path, scenario: sim.Scenario | None = None) -> StereoRoom:
        """Simulate and write it."""
        raw_data.write_maps(scenario or quarter_size(), folder, raw_data=True)
        return cls(folder)

    @property
    def map_folder(self) -> Path:
        return self.folder / "session_1"

    @property
    def recording(self) -> Path:
        return self.folder / "raw" / "session_1"

    def depth(self, camera: int = 0) -> Path:
        """Return the folder of the true depth images."""
        return self.folder / "truth" / "session_1" / f"depth{camera}"

    @cached_property
    def true_map(self) -> VIMap:
        """The map with true poses and calibration."""
        vi_map, _ = load_map(self.map_folder)
        return truth.true_map(vi_map, truth.Truth.load(self.folder / "truth.npz"))

    def distances_to_surfaces(self, p_G: F64) -> F64:
        """Return the distances (N,) [m] of points (N, 3) to the true surfaces, all axis-aligned."""
        mesh = parse_ply((self.folder / "truth" / "mesh.ply").read_bytes(), "mesh.ply")
        corners = mesh.p.reshape(-1, 4, 3)
        low, high = corners.min(axis=1), corners.max(axis=1)
        best = np.full(len(p_G), np.inf)
        for near, far in zip(low, high, strict=True):
            beyond = np.maximum(np.maximum(near - p_G, p_G - far), 0.0)
            best = np.minimum(best, np.linalg.norm(beyond, axis=1))
        return best
