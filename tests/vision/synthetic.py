"""Synthetic binary descriptors with correlated noise, and poses with matches."""

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3, yaw
from maplab_py.vision.absolute_pose import PoseProblems
from maplab_py.vision.descriptors import pack_words
from maplab_py.vision.index import DescriptorSet
from maplab_py.vision.projection import learn_projection

SIZE = 48


def tracks(count: int, length: int, *, flips: float, seed: int, size: int = SIZE):
    """Return descriptors (count * length, size) of noisy tracks, and their labels.

    The second half of the bits is pure noise: a good metric learns to ignore it.
    """
    rng = np.random.default_rng(seed)
    bits = 8 * size
    # few hidden causes make bits of different points correlated, as in real descriptors
    hidden = rng.normal(size=(count, 24)) @ rng.normal(size=(24, bits))
    base = hidden + 0.5 * rng.normal(size=(count, bits)) > 0.0
    label = np.repeat(np.arange(count), length)
    flipped = rng.random((len(label), bits)) < flips
    values = base[label] ^ flipped
    values[:, bits // 2 :] = rng.random((len(label), bits // 2)) < 0.5
    return np.packbits(values, axis=1), label


def descriptor_set(descriptors: NDArray[np.uint8], label, *, session=0, time_ns=None):
    """Return a DescriptorSet with a projection learned from the descriptors themselves."""
    projection = learn_projection(descriptors, label)
    count = len(label)
    return DescriptorSet(
        projected=projection.project(descriptors),
        words=pack_words(descriptors),
        label=label,
        session=np.full(count, session, dtype=np.int32),
        time_ns=np.zeros(count, dtype=np.int64) if time_ns is None else time_ns,
    )


def nearest_by_bits(database: DescriptorSet, queries: DescriptorSet) -> NDArray[np.int64]:
    """Return the fewest different bits (Q,) from descriptors of other labels, of an exhaustive search."""
    fewest = np.empty(len(queries), dtype=np.int64)
    for query, (words, label) in enumerate(zip(queries.words, queries.label, strict=True)):
        other = (database.label != label) | (label < 0)
        bits = np.bitwise_count(database.words ^ words).sum(axis=1, dtype=np.int64)
        fewest[query] = bits[other].min()
    return fewest


def pose_problems(
    count: int,
    matches: int,
    *,
    outliers: float,
    noise_rad: float,
    tilt_rad: float,
    seed: int,
    cameras: int = 2,
    flatness: float = 1.0,
) -> tuple[PoseProblems, NDArray[np.float64], NDArray[np.bool_]]:
    """Return problems of a rig with one or two cameras, the true poses, and which matches are wrong.

    Points lie in a box; with a flatness of 0 they lie in its middle plane, x = 0.
    """
    rng = np.random.default_rng(seed)
    turn = yaw.quaternion(rng.uniform(-np.pi, np.pi, count))
    q = so3.multiply(turn, so3.exp(rng.normal(scale=0.4, size=(count, 3))))
    T = se3.make(q, rng.normal(scale=3.0, size=(count, 3)))
    problem = np.repeat(np.arange(count), matches)
    total = count * matches
    point = rng.uniform(-6.0, 6.0, size=(total, 3)) * [flatness, 1.0, 1.0]
    is_first = rng.random((total, 1)) < 0.5
    origin = np.where(is_first | (cameras == 1), [0.1, 0.0, 0.05], [-0.1, 0.02, 0.0])
    ray = se3.transform(se3.inverse(T)[problem], point) - origin
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray += rng.normal(scale=noise_rad, size=ray.shape)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    wrong = rng.random(total) < outliers
    point[wrong] = rng.uniform(-6.0, 6.0, size=(int(wrong.sum()), 3))
    tilt = rng.normal(scale=tilt_rad, size=(count, 3)) * [1.0, 1.0, 0.0]
    guess = so3.multiply(yaw.quaternion(rng.uniform(-np.pi, np.pi, count)), so3.exp(tilt))
    problems = PoseProblems(
        start=np.arange(count + 1) * matches,
        key=np.arange(count),
        q_M_I=so3.multiply(guess, q),
        origin_I=origin,
        ray_I=ray,
        point_M=point,
        keypoint=np.tile(np.arange(matches), count),
        tolerance=np.full(total, max(4.0 * noise_rad, 1e-6)),
    )
    return problems, T, wrong
