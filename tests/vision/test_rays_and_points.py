import numpy as np

from maplab_py.vision.rays_and_points import Rays, points_near_rays


def test_pairs_are_those_of_all_angles():
    rng = np.random.default_rng(0)
    rays, points = np.array([0, 5, 5, 12]), np.array([0, 30, 40, 40 + 25])
    origin, direction = rng.normal(size=(12, 3)), rng.normal(size=(12, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = rng.uniform(0.1, 1.2, 12)
    point = 4.0 * rng.normal(size=(65, 3))
    expected = []
    for problem in range(3):
        for ray in range(rays[problem], rays[problem + 1]):
            for row in range(points[problem], points[problem + 1]):
                toward = point[row] - origin[ray]
                cosine = direction[ray] @ toward / np.linalg.norm(toward)
                if np.arccos(np.clip(cosine, -1.0, 1.0)) <= radius[ray]:
                    expected.append((ray, row))
    near = points_near_rays(Rays(rays, origin, direction, radius), points, point)
    assert list(zip(*(rows.tolist() for rows in near), strict=True)) == expected
    assert len(expected) > 20


def test_nothing_is_near_nothing():
    start, none = np.zeros(2, dtype=np.int64), np.zeros((0, 3))
    ray, row = points_near_rays(Rays(start, none, none, np.zeros(0)), start, none)
    assert len(ray) == len(row) == 0
