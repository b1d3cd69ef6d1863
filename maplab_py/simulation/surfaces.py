"""Rectangular surfaces and the landmarks on them."""

import numpy as np

from maplab_py.array_types import F64, Rows
from maplab_py.simulation.scenario import WorldOptions

_CLUSTER_SIZE_M = 0.5
_CLUSTERS_PER_LANDMARK = 1.0 / 40.0
_BARE_DENSITY = 0.1
_SURFACE_OFFSET_M = 1e-6
"""Distance of landmarks from their surface, so that it does not occlude them."""


class Surfaces(Rows):
    """Rectangles: corner + a * side_u + b * side_v with a, b in [0, 1]."""

    corner: F64  # (F, 3)
    side_u: F64  # (F, 3)
    side_v: F64  # (F, 3)
    normal: F64  # (F, 3) unit, into the free space

    @property
    def area(self) -> F64:
        """Areas (F,) [m^2]."""
        return np.asarray(np.linalg.norm(np.cross(self.side_u, self.side_v), axis=1))


def box_surfaces(low: F64, high: F64, *, inwards: bool) -> Surfaces:
    """Return the six sides of a box with normals that look in or out.

    Order: lower and upper side along x, along y, along z.
    """
    size = high - low
    corners, sides_u, sides_v, normals = [], [], [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for upper in (False, True):
            corner = low.copy()
            corner[axis] = high[axis] if upper else low[axis]
            corners.append(corner)
            sides_u.append(np.eye(3)[u] * size[u])
            sides_v.append(np.eye(3)[v] * size[v])
            normals.append(np.eye(3)[axis] * (1.0 if upper != inwards else -1.0))
    return Surfaces(np.array(corners), np.array(sides_u), np.array(sides_v), np.array(normals))


def scatter(
    surfaces: Surfaces, options: WorldOptions, count: int, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Draw landmarks: a share of them in clusters, the others evenly over the surfaces.

    Returns:
        Points and normals (count, 3).
    """
    weight = surfaces.area
    if options.bare_share > 0.0:
        is_bare = rng.uniform(size=len(weight)) < options.bare_share
        weight = weight * np.where(is_bare, _BARE_DENSITY, 1.0)
    face = rng.choice(len(weight), count, p=weight / weight.sum())
    place = rng.uniform(0.0, 1.0, (count, 2))
    clusters = max(1, int(count * _CLUSTERS_PER_LANDMARK))
    cluster = rng.integers(0, clusters, count)
    clustered = rng.uniform(size=count) < options.patchiness
    spread = rng.normal(0.0, _CLUSTER_SIZE_M, (count, 2))
    face = np.where(clustered, face[cluster], face)
    side_u, side_v = surfaces.side_u[face], surfaces.side_v[face]
    lengths = np.stack([np.linalg.norm(side_u, axis=1), np.linalg.norm(side_v, axis=1)], axis=1)
    near = place[cluster] + spread / lengths
    is_near = clustered & np.all((near > 0.0) & (near < 1.0), axis=1)
    place = np.where(is_near[:, None], near, place)
    normal = surfaces.normal[face]
    points = surfaces.corner[face] + place[:, :1] * side_u + place[:, 1:] * side_v
    return points + _SURFACE_OFFSET_M * normal, normal
