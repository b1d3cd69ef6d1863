"""Dense maps of the simulated stereo room against the truth, and the fusion against Open3D.

python -m benchmarks.dense [--folder FOLDER] [--optimised]

FOLDER keeps the simulation for the next run. Open3D is compared where it is installed (open3d-cpu).
"""

import argparse
import dataclasses
import importlib.util
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from maplab_py.algorithms.dense import clouds, depth_inputs, fusion, meshing
from maplab_py.algorithms.dense.grid import GridSettings, TsdfGrid, blocks_of_views
from maplab_py.algorithms.dense.options import MESH_MIN_WEIGHT, FusionOptions, StereoOptions
from maplab_py.algorithms.dense.reconstruction import StereoSettings, reconstruct_stereo
from maplab_py.algorithms.dense.resources import FrameResources
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64
from maplab_py.geometry import alignment, se3
from maplab_py.interop.resources.depth_maps import import_depth_maps
from maplab_py.interop.resources.images import ImageImportOptions, import_images
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap, resources_of
from tests.support.stereo_room import StereoRoom

VOXEL_M, FAR_M = 0.05, 6.0
OPTIONS = FusionOptions(voxel_size_m=VOXEL_M)
TRUE_OPTIONS = FusionOptions(voxel_size_m=VOXEL_M, weight_depth_power=2)
SEEN_OF_TRUTH = 0.1
"""Weight of a voxel that true depth needs: one measurement suffices."""


@dataclasses.dataclass(frozen=True)
class DepthErrors:
    """Errors of depth maps, means over the frames."""

    median_relative: float
    off_by_3_px: float  # share of the known pixels
    fill: float  # of the rectified pixels, before neighbouring vertices are asked
    cpu_ms: float  # a frame


@dataclasses.dataclass(frozen=True)
class MeshErrors:
    """Distances of a mesh to the true surfaces."""

    mean_mm: float
    p90_mm: float
    off_by_10_cm: float  # share of the vertices
    within_5_cm: float  # share of the true surface in view with a vertex nearby
    vertices: int


@dataclasses.dataclass(frozen=True)
class Integration:
    """Processor time and memory of fusing true depth."""

    cpu_ms: float  # a depth map
    wall_ms: float
    megabytes: float  # of the voxels in use


def depth_errors(
    room: StereoRoom, vi_map: VIMap, focal_baseline: float, fill: float, cpu_ms: float
) -> DepthErrors:
    """Compare the depth maps of a map with the true ones."""
    resources = FrameResources(vi_map, Path())
    relative, off = [], []
    for row in np.flatnonzero(resources_of(vi_map, (8,))).tolist():
        depth = resources.depth(row)
        stamp = vi_map.frames.timestamp_ns[vi_map.resources.owner[row]]
        image: Any = cv2.imread(str(room.depth() / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        truth = image * 1e-3
        known = (depth > 0.0) & (truth > 0.0)
        relative.append(float(np.median(np.abs(depth / np.maximum(truth, 1e-3) - 1.0)[known])))
        difference = focal_baseline / depth[known] - focal_baseline / truth[known]
        off.append(float(np.mean(np.abs(difference) > 3.0)))
    return DepthErrors(float(np.mean(relative)), float(np.mean(off)), fill, cpu_ms)


def seen_surface(true_depth: VIMap) -> F64:
    """Return points (N, 3) in G of the true surfaces that the left camera sees nearer than 6 m."""
    resources = FrameResources(true_depth, Path())
    points = []
    for row in np.flatnonzero(resources_of(true_depth, (8,)))[::8].tolist():
        frame = int(true_depth.resources.owner[row])
        depth = resources.depth(row)
        maker = clouds.CloudMaker(resources.camera(frame))
        p_C = maker.cloud(np.where(depth < FAR_M, depth, np.float32(0.0))).p[::97]
        points.append(se3.transform(resources.T_G_C(frame), p_C))
    return np.concatenate(points)


def mesh_errors(room: StereoRoom, p_G: F64, surface: F64) -> MeshErrors:
    """Compare the vertices (N, 3) of a mesh with the true surfaces."""
    distance = room.distances_to_surfaces(p_G)
    gap = cKDTree(p_G).query(surface)[0]
    return MeshErrors(
        1e3 * float(distance.mean()),
        1e3 * float(np.percentile(distance, 90)),
        float(np.mean(distance > 0.1)),
        float(np.mean(gap < 0.05)),
        len(p_G),
    )


def measure_integration(true_depth: VIMap, repeats: int = 3) -> dict[str, Integration]:
    """Fuse true depth here and, where it is installed, by Open3D; the best of some runs counts."""
    views = depth_inputs.DepthViews(true_depth, Path(), 8)
    rows = views.of_missions([0])
    depths = [views.view(row) for row in rows.tolist()]
    poses = [se3.to_matrix(T) for T in views.poses(rows, se3.identity())]
    runs = {"maplab-py": _integrate}
    if importlib.util.find_spec("open3d") is not None:
        runs["Open3D"] = _integrate_open3d
    results: dict[str, Integration] = {}
    for _ in range(repeats):
        for name, run in runs.items():
            result = run(depths, poses)
            if name not in results or result.cpu_ms < results[name].cpu_ms:
                results[name] = result
    return results


def _integrate(depths: Any, poses: list[F64]) -> Integration:
    o = TRUE_OPTIONS
    settings = GridSettings(
        VOXEL_M, 3.0 * VOXEL_M, o.min_ray_length_m, FAR_M, o.weight_depth_power, o.max_weight
    )
    cpu, wall = time.process_time(), time.perf_counter()
    views = [(*view, pose) for view, pose in zip(depths, poses, strict=True)]
    grid = TsdfGrid.unobserved(settings, blocks_of_views(views, settings))
    for view in views:
        grid.integrate(*view)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return Integration(1e3 * cpu / len(depths), 1e3 * wall / len(depths), grid.nbytes / 1e6)


def _integrate_open3d(depths: Any, poses: list[F64]) -> Integration:
    import open3d as o3d

    core = o3d.core
    kinds = (core.Dtype.Float32, core.Dtype.Float32)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), kinds, ((1), (1)), VOXEL_M, 8, 1024, core.Device("CPU:0")
    )
    images = [o3d.t.geometry.Image(core.Tensor(depth)) for depth, _ in depths]
    pinhole = depths[0][1]
    K = np.array(
        [
            [pinhole.focal_px, 0.0, pinhole.centre_px[0]],
            [0.0, pinhole.focal_px, pinhole.centre_px[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    intrinsic = core.Tensor(K)
    extrinsics = [core.Tensor(np.linalg.inv(pose)) for pose in poses]
    cpu, wall = time.process_time(), time.perf_counter()
    for image, extrinsic in zip(images, extrinsics, strict=True):
        blocks = grid.compute_unique_block_coordinates(image, intrinsic, extrinsic, 1.0, FAR_M, 3.0)
        grid.integrate(blocks, image, intrinsic, extrinsic, 1.0, FAR_M, 3.0)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    capacity = grid.hashmap().capacity()
    return Integration(1e3 * cpu / len(depths), 1e3 * wall / len(depths), capacity * 512 * 8 / 1e6)


def optimised(room: StereoRoom) -> VIMap:
    """Return the map of the odometry after optvi, aligned with the truth in yaw and position."""
    vi_map = optimize(load_map(room.map_folder)[0], VIOptimizationOptions())[0]
    truth = room.true_map
    T_truth = alignment.align_yaw_position(truth.T_G_I[:, 4:], vi_map.T_G_I[:, 4:])
    T_G_M = se3.compose(T_truth, vi_map.baseframes.T_G_M)
    return vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M))


def measure(
    room: StereoRoom, *, with_optimised: bool = False, unchecked: bool = False
) -> dict[str, Any]:
    """Return the figures, if asked also those of depth that neighbours have not checked."""
    truth = room.true_map
    true_depth, _ = import_depth_maps(truth, 0, 0, room.depth())
    surface = seen_surface(true_depth)
    fused, _ = fusion.fuse_depth(true_depth, Path(), None, TRUE_OPTIONS)
    mesh, _ = meshing.map_mesh(fused, Path(), None, SEEN_OF_TRUTH)
    results: dict[str, Any] = {"mesh of true depth": mesh_errors(room, mesh.p, surface)}
    links = ImageImportOptions(link=True)
    images, _ = import_images(truth, 0, room.recording, links)
    kinds = {"without neighbours": False} if unchecked else {}
    for name, checked in (kinds | {"stereo": True}).items():
        cpu = time.process_time()
        settings = StereoSettings(StereoOptions(multi_view=checked))
        stereo, report = reconstruct_stereo(images, Path(), None, settings)
        cpu_ms = 1e3 * (time.process_time() - cpu) / report.resources
        fill = report.pairs[0].matched_share
        results[f"depth {name}"] = depth_errors(room, stereo, 336.0 * 0.11, fill, cpu_ms)
        fused, _ = fusion.fuse_depth(stereo, Path(), None, OPTIONS)
        mesh, _ = meshing.map_mesh(fused, Path(), None, MESH_MIN_WEIGHT)
        results[f"mesh {name}"] = mesh_errors(room, mesh.p, surface)
    if with_optimised:
        images, _ = import_images(optimised(room), 0, room.recording, links)
        stereo, _ = reconstruct_stereo(images, Path(), None, StereoSettings())
        fused, _ = fusion.fuse_depth(stereo, Path(), None, OPTIONS)
        mesh, _ = meshing.map_mesh(fused, Path(), None, MESH_MIN_WEIGHT)
        results["mesh with the poses of optvi"] = mesh_errors(room, mesh.p, surface)
    results["integration"] = measure_integration(true_depth)
    return results


def main() -> None:
    """Measure and print as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="keeps the simulation")
    parser.add_argument("--optimised", action="store_true", help="also with the poses of optvi")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary) / "room"
        if (folder / "truth.npz").exists():
            room = StereoRoom(folder)
        else:
            room = StereoRoom.simulated(folder, load_scenario("stereo_room"))
        results = measure(room, with_optimised=arguments.optimised, unchecked=True)
    print(json.dumps(results, indent=2, default=dataclasses.asdict))


if __name__ == "__main__":
    main()
