"""Draw docs/images/first_map.png: an image of the tutorial's recording, and the map that is made of it.

python docs/scripts/draw_first_map.py
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from maplab_py.array_types import F64, I64, U8
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.vimap import LandmarkQuality, VIMap

TARGET = Path(__file__).resolve().parents[1] / "images" / "first_map.png"
SCENARIO = "flight_short"
VERTEX = 120
TAIL = 5
"""Earlier vertices whose keypoints are joined with those of the image."""


def flown(folder: Path) -> tuple[VIMap, Trajectory, U8]:
    """Return the optimised map of the recording, the truth, and the image of `VERTEX`."""
    raw = folder / "flight" / "raw" / "session_1"
    with Session() as session:
        session.run("simulate", scenario=SCENARIO, raw_data=True, map_folder=folder / "flight")
        session.run("rovioli", datasource_folder=raw)
        for command in ("optvi", "lc", "optvi"):
            session.run(command)
        vi_map = session.vi_map
    truth = read_trajectory(folder / "flight" / "truth" / "session_1" / "ground_truth.csv")
    time_ns = vi_map.vertices.timestamp_ns[VERTEX]
    image = cv2.imread(str(raw / "mav0" / "cam0" / "data" / f"{time_ns}.png"), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"the recording has no image at {time_ns}")
    return vi_map, truth, np.asarray(image, dtype=np.uint8)


def tails(vi_map: VIMap) -> list[F64]:
    """Return the paths (K, 2) [px] of the keypoints of the first camera that are seen at `VERTEX`."""
    by_track: dict[int, list[F64]] = {}
    for vertex in range(VERTEX, VERTEX - TAIL, -1):
        rows = keypoints_of(vi_map, vertex)
        tracks = vi_map.keypoints.track_id[rows]
        for track, uv in zip(tracks.tolist(), vi_map.keypoints.uv_px[rows], strict=True):
            path = by_track.get(track)
            if vertex == VERTEX:
                by_track[track] = [uv]
            elif path is not None and len(path) == VERTEX - vertex:
                path.append(uv)
    return [np.stack(path) for path in by_track.values()]


def keypoints_of(vi_map: VIMap, vertex: int) -> I64:
    """Return the rows of the keypoints that the first camera has at a vertex."""
    frames = np.flatnonzero(vi_map.frames.vertex == vertex)
    first = frames[np.argmin(vi_map.frames.camera_index[frames])]
    return np.arange(vi_map.keypoint_start[first], vi_map.keypoint_start[first + 1])


def draw_image(axes: Axes, image: U8, paths: list[F64]) -> None:
    """Draw the image with the paths of its keypoints."""
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.add_collection(LineCollection(paths, colors="#ffb000", linewidths=1.0))
    ends = np.stack([path[0] for path in paths])
    axes.plot(ends[:, 0], ends[:, 1], ".", color="#ff5a00", markersize=3.5)
    axes.set_title("stereo images and IMU in")


def draw_map(axes: Axes, vi_map: VIMap, truth: Trajectory) -> float:
    """Draw landmarks, path and truth from above; return the ATE [m] after alignment (SE(3))."""
    times_ns = vi_map.vertices.timestamp_ns
    T_R_I, is_known = interpolate_poses(truth.times_ns, truth.T_R_B, times_ns, max_gap_ns=10**9)
    T_G_R, _ = umeyama(vi_map.T_G_I[is_known, 4:], T_R_I[is_known, 4:])
    p_true, p_G = se3.transform(T_G_R, T_R_I[is_known, 4:]), vi_map.T_G_I[:, 4:]
    good = vi_map.p_G[vi_map.landmarks.quality == LandmarkQuality.GOOD]
    low, high = np.percentile(good, [1, 99], axis=0)
    good = good[np.all((good > low - 0.3) & (good < high + 0.3), axis=1)]
    axes.scatter(good[:, 0], good[:, 1], c=good[:, 2], s=3.0, cmap="viridis", linewidths=0)
    axes.plot(p_true[:, 0], p_true[:, 1], color="#999999", linewidth=4.5)
    axes.plot(p_G[:, 0], p_G[:, 1], color="#c02000", linewidth=1.5)
    left, bottom = good[:, :2].min(axis=0)
    axes.plot([left, left + 1.0], [bottom - 0.4] * 2, color="#222222", linewidth=2)
    axes.text(left + 1.15, bottom - 0.4, "1 m", va="center", fontsize=9)
    axes.set_aspect("equal")
    axes.set_title("map out")
    error_m = np.linalg.norm(p_true - p_G[is_known], axis=1)
    return float(np.sqrt(np.mean(error_m**2)))


def main() -> None:
    """Simulate, estimate and draw."""
    with tempfile.TemporaryDirectory() as folder:
        vi_map, truth, image = flown(Path(folder))
    figure = Figure(figsize=(10.4, 3.9), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.28, 1.0])
    draw_image(left, image, tails(vi_map))
    ate_m = draw_map(right, vi_map, truth)
    for axes in (left, right):
        axes.axis("off")
    figure.savefig(TARGET)
    sys.stdout.write(f"{TARGET.name}: {len(vi_map.vertices)} vertices, ATE {ate_m:.4f} m\n")


if __name__ == "__main__":
    main()
