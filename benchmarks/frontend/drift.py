"""How far keypoints move away from their points: `python -m benchmarks.frontend.drift SCENARIO FOLDER`.

FOLDER is a session that `simulate --raw_data` has rendered of the scenario file. The ray of each keypoint of
the first camera, at the true pose, meets the rendered surface in a point; its distance to the point of the
first keypoint of the track is given in pixels, by the age of the track in images.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from benchmarks.frontend.sequences import TRUTH
from maplab_py.algorithms.landmarks.keypoint_rays import bearings
from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SessionSimulator
from maplab_py.simulation.world import World
from maplab_py.vision.tracking.tracker import FrameTracker

AGES = (1, 2, 5, 10, 20, 40, 60, 100, 160)
_MAX_GAP_NS = 100_000_000


def surface_points(world: World, origin: F64, ray: F64) -> F64:
    """Return where rays (N, 3) from origins (N, 3) meet the walls and boxes of a world."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.max((world.bounds - origin[:, None]) / ray[:, None], axis=1).min(axis=1)
        for low, high in world.boxes:
            a, b = (low - origin) / ray, (high - origin) / ray
            enters, leaves = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            is_hit = (enters < leaves) & (enters > 0.0) & (enters < distance)
            distance = np.where(is_hit, enters, distance)
    return np.asarray(origin + distance[:, None] * ray)


def drift(scenario: Path, folder: Path, images: int) -> tuple[F64, F64]:
    """Return the ages (N,) of keypoints [images] and their drift (N,) [px]."""
    world = SessionSimulator(load_scenario(scenario)).world
    device = open_recording(folder, SourceOptions(rovio_active_camera_indices="0")).device
    files = sorted((folder / "mav0" / "cam0" / "data").glob("*.png"))[:images]
    times_ns = np.array([int(file.stem) for file in files])
    truth = read_trajectory(folder / TRUTH)
    T_R_I, _ = interpolate_poses(truth.times_ns, truth.T_R_B, times_ns, max_gap_ns=_MAX_GAP_NS)
    R_R_I, T_R_C = so3.to_matrix(T_R_I[:, :4]), se3.compose(T_R_I, device.T_I_C[0])
    tracker = FrameTracker(device.cameras, device.T_I_C)
    first: dict[int, F64] = {}
    ages, drifts = [], []
    for number, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        turn = R_R_I[number - 1].T @ R_R_I[number] if number else None
        tracks = tracker.track(int(times_ns[number]), (image.astype(np.uint8),), turn).cameras[0]
        ray_C, rad_per_px, _ = bearings(device.cameras[0], tracks.uv_px)
        pose = np.tile(T_R_C[number], (len(ray_C), 1))
        ray, origin = so3.rotate(pose[:, :4], ray_C), pose[:, 4:]
        points = surface_points(world, origin, ray)
        for track, point in zip(tracks.track_id.tolist(), points, strict=True):
            first.setdefault(track, point)
        offset = points - np.stack([first[track] for track in tracks.track_id.tolist()])
        across = np.linalg.norm(np.cross(offset, ray), axis=1)
        ages.append(tracks.num_frames - 1.0)
        drifts.append(across / np.linalg.norm(points - origin, axis=1) / rad_per_px)
    return np.concatenate(ages), np.concatenate(drifts)


def main() -> None:
    """Print the drift at some ages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--images", type=int, default=400)
    arguments = parser.parse_args()
    age, drift_px = drift(arguments.scenario, arguments.folder, arguments.images)
    for images in AGES:
        mine = drift_px[age == images]
        if len(mine):
            median, most = np.percentile(mine, [50.0, 90.0])
            sys.stdout.write(
                f"{images:4d} images: {len(mine):5d} keypoints, {median:.2f} px, 90 % below {most:.2f}\n"
            )


if __name__ == "__main__":
    main()
