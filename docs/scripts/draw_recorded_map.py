"""Draw docs/images/recorded_map.svg: path and landmarks that `rovioli` estimates, from the side.

python docs/scripts/draw_recorded_map.py EUROC_FOLDER

The folder has ground truth in state_groundtruth_estimate0, which is drawn in grey.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.frontend.mapping import Mapping
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.vimap import LandmarkQuality, VIMap

F64 = NDArray[np.float64]

TARGET = Path(__file__).resolve().parents[1] / "images" / "recorded_map.svg"
WIDTH_PX, HEIGHT_PX, MARGIN_PX = 640, 400, 24
NEAR_M = 3.0
"""Landmarks further than this from the path are not drawn."""


def aligned(vi_map: VIMap, truth: Trajectory) -> tuple[VIMap, F64, float]:
    """Return the map's pose in the frame of the truth, the true path (N, 3), and the ATE [m]."""
    times_ns = vi_map.vertices.timestamp_ns
    T_R_I, is_known = interpolate_poses(truth.times_ns, truth.T_R_B, times_ns, max_gap_ns=10**9)
    T_R_G, _ = umeyama(T_R_I[is_known, 4:], vi_map.T_G_I[is_known, 4:])
    frames = vi_map.baseframes.replace(T_G_M=se3.compose(T_R_G, vi_map.baseframes.T_G_M))
    moved = vi_map.replace(baseframes=frames)
    error = np.linalg.norm(moved.T_G_I[is_known, 4:] - T_R_I[is_known, 4:], axis=1)
    return moved, T_R_I[is_known, 4:], float(np.sqrt(np.mean(error**2)))


def drawing(vi_map: VIMap, p_true: F64) -> str:
    """Return the picture: landmarks by depth, the true path, the estimated path."""
    good = vi_map.p_G[vi_map.landmarks.quality == LandmarkQuality.GOOD]
    distance = np.linalg.norm(good[:, None] - vi_map.T_G_I[None, ::5, 4:], axis=2).min(axis=1)
    near = good[distance < NEAR_M]
    # the horizontal direction in which landmarks spread most is drawn to the right
    _, _, axes = np.linalg.svd(near[:, :2] - near[:, :2].mean(axis=0), full_matrices=False)

    def seen(p: F64) -> F64:
        return np.stack([p[:, :2] @ axes[0], p[:, 2], p[:, :2] @ axes[1]], axis=1)

    landmarks, path, p_true = seen(near), seen(vi_map.T_G_I[:, 4:]), seen(p_true)
    low, high = np.percentile(np.concatenate([landmarks, path])[:, :2], [0.5, 99.5], axis=0)
    scale = float(np.min((np.array([WIDTH_PX, HEIGHT_PX]) - 2 * MARGIN_PX) / (high - low)))
    middle = 0.5 * (low + high)

    def pixels(p: F64) -> F64:
        centre = np.array([WIDTH_PX, HEIGHT_PX]) / 2
        return np.asarray(centre + (p[:, :2] - middle) * np.array([1.0, -1.0]) * scale)

    nearest, furthest = np.percentile(landmarks[:, 2], [5, 95])
    depth = np.clip((landmarks[:, 2] - nearest) / (furthest - nearest), 0.0, 1.0)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {HEIGHT_PX}" '
        f'width="{WIDTH_PX}" height="{HEIGHT_PX}">',
        f'<rect width="{WIDTH_PX}" height="{HEIGHT_PX}" fill="#ffffff"/>',
    ]
    for (x, y), share in zip(pixels(landmarks), depth, strict=True):
        if 0 < x < WIDTH_PX and 0 < y < HEIGHT_PX:
            hue = 215 - 190 * share
            lines.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.3" fill="hsl({hue:.0f},65%,50%)"/>'
            )
    for p, colour, width in ((p_true, "#777777", 5.0), (path, "#111111", 1.8)):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels(p))
        lines.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}"/>'
        )
    bar = scale  # one metre
    y = HEIGHT_PX - 14
    lines += [
        f'<line x1="14" y1="{y}" x2="{14 + bar:.1f}" y2="{y}" stroke="#111111" stroke-width="2"/>',
        f'<text x="14" y="{y - 6}" font-family="sans-serif" font-size="12">1 m</text>',
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Estimate and draw."""
    folder = Path(sys.argv[1])
    mapping = Mapping(open_recording(folder))
    mapping.run()
    if mapping.builder is None:
        raise SystemExit("there is no map")
    vi_map, _ = mapping.builder.finish()
    truth = read_trajectory(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    moved, p_true, ate_m = aligned(vi_map, truth)
    TARGET.write_text(drawing(moved, p_true))
    sys.stdout.write(f"{TARGET}: {len(vi_map.vertices)} vertices, ATE {ate_m:.4f} m\n")


if __name__ == "__main__":
    main()
