"""Verified pairs of stereo keyframes by the type of their features: `python -m benchmarks.learned_features`.

Pairs of the recorded keyframes of EuRoC V1_01, 20 s and more apart. Points of one keyframe come from
its two cameras; keypoints of the left image of the other one are matched with them, mutually best or by
LighterGlue, and the pose that most agree on is judged by ground truth. A pair counts as verified where at
least as many keypoints agree as no wrong pose has in any pair of the run, and never fewer than `lc` wants.
"""

import argparse
import dataclasses
import json
import resource
import time
from pathlib import Path

import numpy as np

from maplab_py.algorithms.landmarks.keypoint_rays import bearings
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import F32, F64, I8, I64, U8, U64, Mask
from maplab_py.geometry import interpolation, se3, so3, triangulation
from maplab_py.interop.recordings import protocol, reader_choice
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.sensors import Camera
from maplab_py.vision import absolute_pose, descriptors
from maplab_py.vision.epipolar_matching import EpipolarRule, ImageRays, match_images
from maplab_py.vision.features.extension import ExtractedFeatures
from maplab_py.vision.features.extractors import KINDS, extract
from maplab_py.vision.features.learned.lighterglue import ImageKeypoints, installed_lighterglue
from tests.support.data import shared_data_folder

_APART_S, _NEAR_M, _NEAR_DEG = 20.0, 2.0, 45.0
_RIGHT_M, _RIGHT_DEG = 0.5, 5.0
"""Largest error of a right pose: a wrong place is off by more."""
_STEREO_GATES = 0.26, 0.6
"""Share of different bits, or distance, of the same point in both images of a pair."""
_MATCHER = "lighterglue"
_EVERY = 4
"""Of pairs that see different places, every 4th is tried, by the network every 40th."""


@dataclasses.dataclass(frozen=True, eq=False)
class Keyframe:
    """Features of a stereo pair."""

    words: U64 | I8  # (N, W) of the left image
    ray_I: F64  # (N, 3)
    origin_I: F64  # (3,) centre of the left camera
    rad_per_px: F64  # (N,)
    point_I: F64  # (N, 3) zero where there is none
    has_point: Mask  # (N,)
    row: I64  # (N,) of the features of the left image


@dataclasses.dataclass(frozen=True)
class Result:
    """Verified pairs by one type of features."""

    features: str
    gate: float
    near_pairs: int
    verified: int  # near pairs with a right pose and more inliers than any wrong pose
    at_options: int  # near pairs that the inlier count of lc alone accepts
    wrong_at_options: int
    threshold: int  # inliers
    median_inliers: float  # of near pairs
    extraction_cpu_ms: float
    extraction_ms: float
    peak_mb: float


def measure(
    features: str, gates: tuple[float, ...], max_features: int, light: float
) -> list[Result]:
    """Measure one type of features with several gates of its descriptors; lighterglue matches those of xfeat.

    With less light than 1 every other keyframe is darker, and its pairs with the others count.
    """
    title, features = features, "xfeat" if features == _MATCHER else features
    options = LoopClosureOptions(feature_type=str(KINDS[features].feature_type))
    recording = reader_choice.open_recording(shared_data_folder() / "euroc_v101_keyframes")
    cameras, T_I_C = recording.device.cameras, recording.device.T_I_C
    sets = [event for event in EventStream(recording) if isinstance(event, protocol.FrameSet)]
    truth = read_trajectory(shared_data_folder() / "euroc_imu" / "V101.gt.csv")
    times_ns = np.array([each.time_ns for each in sets])
    T_G_I, known = interpolation.interpolate_poses(truth.times_ns, truth.T_R_B, times_ns)
    sets = [each for each, is_known in zip(sets, known.tolist(), strict=True) if is_known]
    T_G_I, times_ns = T_G_I[known], times_ns[known]
    images = [[image.grey() for image in each.images] for each in sets]
    if light < 1.0:
        rng = np.random.default_rng(0)
        images[1::2] = [[_darken(image, light, rng) for image in pair] for pair in images[1::2]]
    extract(features, images[0][0], max_features)
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    found = [[extract(features, image, max_features) for image in pair] for pair in images]
    count = 2 * len(images)
    cpu_ms = 1e3 * (time.process_time() - cpu_s) / count
    wall_ms = 1e3 * (time.perf_counter() - wall_s) / count
    results = []
    kind = KINDS[features]
    frames = [_keyframe(pair, features, cameras, T_I_C) for pair in found]
    pairs = _pairs(times_ns)
    if light < 1.0:
        pairs = pairs[(pairs[:, 0] % 2 == 1) & (pairs[:, 1] % 2 == 0)]
    is_near = _are_near(T_G_I, pairs)
    every = 10 * _EVERY if title == _MATCHER else _EVERY
    pairs = np.concatenate([pairs[is_near], pairs[~is_near][::every]])
    is_near = _are_near(T_G_I, pairs)
    if title == _MATCHER:
        matches = _match_by_network(found, frames, pairs, images[0][0])
    else:
        matches = [_match(frames[a], frames[b]) for a, b in pairs.tolist()]
    needed = round(options.inlier_factor * options.min_inlier_count)
    for gate in gates:
        most = kind.largest(gate, gate)
        chosen = [(i[gap <= most], j[gap <= most]) for i, j, gap in matches]
        inliers, is_right = _verify(frames, T_G_I, pairs, chosen, options)
        wrong = inliers[~is_right]
        threshold = max(int(wrong.max(initial=0)) + 1, needed)
        accepted = inliers >= needed
        results.append(
            Result(
                features=title,
                gate=gate,
                near_pairs=int(is_near.sum()),
                verified=int(np.count_nonzero(is_near & is_right & (inliers >= threshold))),
                at_options=int(np.count_nonzero(is_near & is_right & accepted)),
                wrong_at_options=int(np.count_nonzero(accepted & ~is_right)),
                threshold=threshold,
                median_inliers=float(np.median(inliers[is_near & is_right])),
                extraction_cpu_ms=cpu_ms,
                extraction_ms=wall_ms,
                peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            )
        )
    return results


def _darken(image: U8, light: float, rng: np.random.Generator) -> U8:
    """Return an image in less light, of more contrast, with the noise of a higher gain."""
    values = 255.0 * light * (image / 255.0) ** 1.3 + rng.normal(8.0, 1.5, image.shape)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _keyframe(
    found: list[ExtractedFeatures],
    features: str,
    cameras: tuple[Camera, ...],
    T_I_C: F64,
) -> Keyframe:
    """Return the left features with points where the right image sees them, too."""
    sides, kept = [], []
    for part, camera, T in zip(found, cameras, T_I_C, strict=True):
        ray_C, rad_per_px, is_ray = bearings(camera, part.keypoints_px)
        raw = np.ascontiguousarray(part.descriptors).view(np.uint8)[is_ray]
        words = KINDS[features].comparable(np.ascontiguousarray(raw))
        ray_I = np.ascontiguousarray(so3.rotate(T[:4], ray_C[is_ray]))
        sides.append(ImageRays(words, ray_I, rad_per_px[is_ray], T[4:]))
        kept.append(np.flatnonzero(is_ray))
    left, right = sides
    largest = KINDS[features].largest(*_STEREO_GATES)
    i, j, _ = match_images(left, right, EpipolarRule(2.0, 0.5, largest, 0.95))
    origins = np.tile([left.origin_G, right.origin_G], (len(i), 1))
    rays = np.stack([left.ray_G[i], right.ray_G[j]], axis=1).reshape(-1, 3)
    point, ok, _ = triangulation.triangulate(origins, rays, 2 * np.arange(len(i) + 1))
    ahead = np.einsum("nd,nd->n", point - left.origin_G, left.ray_G[i]) > 0.0
    points, has_point = np.zeros((len(left.ray_G), 3)), np.zeros(len(left.ray_G), dtype=np.bool_)
    points[i], has_point[i] = point, ok & ahead
    return Keyframe(
        left.words, left.ray_G, left.origin_G, left.rad_per_px, points, has_point, kept[0]
    )


def _pairs(times_ns: I64) -> I64:
    """Return ordered pairs (P, 2) of keyframes that are far apart in time."""
    apart = np.abs(times_ns[:, None] - times_ns) >= _APART_S * 1e9
    return np.argwhere(apart)


def _are_near(T_G_I: F64, pairs: I64) -> Mask:
    T_A_B = se3.relative(T_G_I[pairs[:, 0]], T_G_I[pairs[:, 1]])
    turn = np.degrees(np.linalg.norm(so3.log(T_A_B[:, :4]), axis=1))
    return (np.linalg.norm(T_A_B[:, 4:], axis=1) < _NEAR_M) & (turn < _NEAR_DEG)


def _verify(
    frames: list[Keyframe],
    T_G_I: F64,
    pairs: I64,
    matches: list[tuple[I64, I64]],
    options: LoopClosureOptions,
) -> tuple[I64, Mask]:
    """Return the inliers (P,) of each pair's pose, and whether that is right (P,)."""
    start = np.cumsum([0, *(len(i) for i, _ in matches)])
    query, place = pairs.T
    problems = absolute_pose.PoseProblems(
        start=start,
        key=np.arange(len(pairs)),
        q_M_I=T_G_I[query, :4],
        origin_I=np.concatenate([np.tile(frames[a].origin_I, (len(i), 1))
                                 for a, (i, _) in zip(query, matches, strict=True)]),
        ray_I=np.concatenate([frames[a].ray_I[i] for a, (i, _) in zip(query, matches, strict=True)]),
        point_M=np.concatenate([se3.transform(T_G_I[b], frames[b].point_I[j])
                                for b, (_, j) in zip(place, matches, strict=True)]),
        keypoint=np.concatenate([i for i, _ in matches]),
        tolerance=np.concatenate([options.ransac_pixel_sigma * frames[a].rad_per_px[i]
                                  for a, (i, _) in zip(query, matches, strict=True)]),
    )  # fmt: skip
    solved = absolute_pose.solve_poses(problems, max_iterations=options.num_ransac_iters)
    error = se3.relative(T_G_I[query], solved.T_M_I)
    turn = np.degrees(np.linalg.norm(so3.log(error[:, :4]), axis=1))
    is_right = (np.linalg.norm(error[:, 4:], axis=1) < _RIGHT_M) & (turn < _RIGHT_DEG)
    sigma = np.degrees(np.sqrt(np.trace(solved.covariance[:, 3:, 3:], axis1=1, axis2=2)))
    passes = solved.inlier_count >= options.min_inlier_ratio * solved.keypoint_count
    passes &= sigma <= options.max_rotation_sigma_deg
    passes &= np.degrees(solved.tilt_rad) <= options.max_gravity_deviation_deg
    return np.where(passes, solved.inlier_count, 0), is_right


def _match(query: Keyframe, place: Keyframe) -> tuple[I64, I64, I64]:
    """Return mutually best matches: keypoints of the query, features with points, differences."""
    rows = np.flatnonzero(place.has_point)
    if not len(query.words) or not len(rows):
        return (np.zeros(0, dtype=np.int64),) * 3
    a, b = _vectors(query.words), _vectors(place.words[rows])
    product = a @ b.T
    best = np.argmax(product, axis=1)
    i = np.flatnonzero(np.argmax(product, axis=0)[best] == np.arange(len(best)))
    j = rows[best[i]]
    return i, j, descriptors.differences(query.words, i, place.words, j).astype(np.int64)


def _match_by_network(
    found: list[list[ExtractedFeatures]], frames: list[Keyframe], pairs: I64, image: U8
) -> list[tuple[I64, I64, I64]]:
    """Return the matches of left images by LighterGlue, which may differ by anything."""
    size_px = image.shape[1], image.shape[0]
    sides = [
        ImageKeypoints(
            left.keypoints_px[frame.row], np.asarray(left.descriptors)[frame.row], size_px
        )
        for (left, _), frame in zip(found, frames, strict=True)
    ]
    result = []
    matched = installed_lighterglue().match([(sides[a], sides[b]) for a, b in pairs.tolist()])
    for (i, j), place in zip(matched, pairs[:, 1].tolist(), strict=True):
        kept = frames[place].has_point[j]
        result.append((i[kept], j[kept], np.zeros(np.count_nonzero(kept), dtype=np.int64)))
    return result


def _vectors(words: U64 | I8) -> F32:
    """Return descriptors as vectors whose products order them as their differences do."""
    if words.dtype == np.int8:
        return words.astype(np.float32)
    bits = np.unpackbits(np.ascontiguousarray(words).view(np.uint8), axis=1)
    return np.asarray(2.0 * bits - 1.0, dtype=np.float32)


_GATES = {
    "brisk": (0.26,), "orb": (0.26,), "sift": (0.45, 0.6), "xfeat": (0.34, 0.39, 0.45, 0.53),
    "lighterglue": (1.0,),
}  # fmt: skip


def main() -> None:
    """Measure, print a table, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("features", nargs="*", default=list(_GATES), metavar="|".join(_GATES))
    parser.add_argument("--max_features", type=int, default=1000)
    parser.add_argument("--light", type=float, default=1.0, help="of every other keyframe, 0 to 1")
    parser.add_argument("--json", type=Path, help="write all that was measured to this file")
    arguments = parser.parse_args()
    results = []
    print(
        "features  gate  near pairs  verified  from  lc count: right  wrong  inliers  cpu ms  wall ms  MB"
    )
    for name in arguments.features:
        for r in measure(name, _GATES[name], arguments.max_features, arguments.light):
            results.append(dataclasses.asdict(r))
            print(
                f"{r.features:8} {r.gate:5.2f} {r.near_pairs:11} {r.verified:9} {r.threshold:5} "
                f"{r.at_options:16} {r.wrong_at_options:6} {r.median_inliers:8.0f} "
                f"{r.extraction_cpu_ms:7.0f} {r.extraction_ms:8.0f} {r.peak_mb:5.0f}",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
