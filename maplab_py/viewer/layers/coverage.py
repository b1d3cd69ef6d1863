"""Tubes of uncertainty along the path, fog over poorly seen volume, and places to walk to next."""

import dataclasses

import numpy as np

from maplab_py.algorithms.vi_optimization import map_problem, options
from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.errors import MaplabError
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.estimation.states import pose_nodes
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_points
from maplab_py.viewer.layers.cameras import camera_centres
from maplab_py.viewer.scene import WHOLE_MAP, Layer, LegendEntry, Mesh, Part
from maplab_py.vimap import LandmarkQuality

_MAX_COVARIANCES = 120
"""Vertices whose covariance is computed; those between are interpolated."""
_MAX_RINGS = 3000
_CORNERS = 10
_TUBE_OPACITY = 0.45

_CELLS, _LEAST_M = 64, 0.1
"""Voxels along the longest side of the map or the path's height, and least length of that side."""
_MAX_RAYS = 60_000
_DIRECTIONS, _WELL_SEEN = 8, 3
"""Sectors of the compass, and from how many of them a voxel is to be seen through."""
_DOTS = 4
"""Points that stand for the fog of a voxel."""
_FOG = colours.from_hex("#9a86b8")[0]
_NEXT = colours.from_hex("#e2813a")[0]
_WALKS = 3
_REACH, _APART = 3, 10
"""Radius around a place whose fog counts, and least distance of two places, in voxels."""


def coverage_layers(drawing: Drawing) -> tuple[list[Layer], list[str]]:
    """Return tubes, fog and places to walk to, and what could not be computed."""
    problems = []
    layers = []
    try:
        layers.append(uncertainty_tubes(drawing))
    except MaplabError as error:
        problems.append(f"Uncertainty of the path: {error}")
    volume = seen_volume(drawing)
    if volume is not None:
        layers += [_fog(drawing, volume), _next_walks(drawing, volume)]
    return layers, problems


def uncertainty_tubes(drawing: Drawing) -> Layer:
    """Return a tube around each path: its cross-section is the covariance of the position across the path.

    Raises:
        MaplabError: The measurements do not determine the path.
    """
    vi_map, scale = drawing.vi_map, drawing.options.covariance_scale
    covariance = position_covariances(drawing)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0))
    largest = max(float(sigma.max(initial=0.0)), 1e-9)
    colour = colours.ramp(sigma / largest, colours.HEAT)
    parts: dict[str, Part] = {}
    every = max(1, -(-len(sigma) // _MAX_RINGS))
    for mission_id, vertices in drawing.by_mission(vi_map.vertices.mission):
        rows = vertices[::every]
        p = drawing.p_vertices[rows]
        if len(rows) > 1 and np.isfinite(p).all():
            rings = _rings(p, covariance[rows], scale)
            parts[mission_id] = Mesh(
                rings.reshape(-1, 3).astype(np.float32), _faces(len(rows)),
                np.repeat(colour[rows], _CORNERS, axis=0), opacity=_TUBE_OPACITY,
            )  # fmt: skip
    title = f"uncertainty of the path, {scale:g} sigma"
    legend = LegendEntry.ramp(title, colours.HEAT, "0 m", f"{scale * largest:.3g} m")
    return Layer("uncertainty", "Uncertainty of the path", parts, len(sigma), legend=(legend,))


def position_covariances(drawing: Drawing) -> F64:
    """Return the covariance (V, 3, 3) of each position in G, relative to what the optimisation holds.

    Raises:
        MaplabError: The measurements do not determine the path.
    """
    vi_map = drawing.vi_map
    problem = map_problem.build(vi_map, options.VIOptimizationOptions())
    marginals = Marginals(problem.problem, problem.states)
    start = vi_map.vertex_start
    covariance = np.zeros((len(vi_map.vertices), 3, 3))
    for first, stop in zip(start[:-1].tolist(), start[1:].tolist(), strict=True):
        count = max(2, _MAX_COVARIANCES * (stop - first) // len(vi_map.vertices))
        if stop <= first:
            continue
        rows = np.unique(np.linspace(first, stop - 1, min(count, stop - first)).astype(np.int64))
        nodes = pose_nodes(problem.selection.rows(rows))[:, 0]
        joint = marginals.nodes(nodes).reshape(len(rows), 3, len(rows), 3)
        known = joint[np.arange(len(rows)), :, np.arange(len(rows))]
        all_rows = np.arange(first, stop)
        for i, j in np.ndindex(3, 3):
            covariance[first:stop, i, j] = np.interp(all_rows, rows, known[:, i, j])
    return covariance


def _rings(p: F64, covariance: F64, scale: float) -> F64:
    """Return the corners (N, K, 3) of ellipses across a path (N, 3) with covariances (N, 3, 3)."""
    along = np.gradient(p, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    right = np.cross(along, [0.0, 0.0, 1.0])
    is_upright = np.linalg.norm(right, axis=1) < 1e-3
    right[is_upright] = [1.0, 0.0, 0.0]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    across = np.stack([right, np.cross(right, along)], axis=2)  # (N, 3, 2)
    C = np.swapaxes(across, 1, 2) @ covariance @ across
    # square root of a positive matrix of two rows, by Cayley and Hamilton
    root = np.sqrt(np.maximum(np.linalg.det(C), 0.0))
    trace = np.sqrt(np.maximum(np.trace(C, axis1=1, axis2=2) + 2.0 * root, 1e-18))
    half_axes = (C + root[:, None, None] * np.eye(2)) / trace[:, None, None]
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(p[:, None] + scale * np.swapaxes(across @ half_axes @ circle, 1, 2))


def _faces(rings: int) -> NDArray[np.int32]:
    """Return the triangles between rings that follow each other."""
    corner = np.arange(_CORNERS)
    a = _CORNERS * np.arange(rings - 1)[:, None] + corner
    b = _CORNERS * np.arange(rings - 1)[:, None] + (corner + 1) % _CORNERS
    quads = [[a, b, a + _CORNERS], [b, b + _CORNERS, a + _CORNERS]]
    return np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in quads]).astype(np.int32)


@dataclasses.dataclass(frozen=True, eq=False)
class SeenVolume:
    """Voxels about a path, and from where rays to landmarks cross them."""

    low: F64  # (3,) corner in the scene
    cell_m: float
    directions: NDArray[np.uint8]  # (X, Y, Z) number of sectors of the compass

    @property
    def is_foggy(self) -> Mask:
        """Tell which voxels (X, Y, Z) are seen through from too few sides, or border on the others."""
        from scipy.ndimage import binary_dilation

        is_seen = self.directions >= _WELL_SEEN
        return np.asarray(~is_seen & ((self.directions > 0) | binary_dilation(is_seen)))

    def centres(self, cells: I64) -> F64:
        """Return the centres (N, 3) of voxels (N, 3)."""
        return np.asarray(self.low + self.cell_m * (cells + 0.5))


def seen_volume(drawing: Drawing) -> SeenVolume | None:
    """Return the voxels at the heights of the path that rays to good landmarks cross; None without rays."""
    vi_map = drawing.vi_map
    keypoints = vi_map.observations
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    is_good = vi_map.landmarks.quality[landmark] != LandmarkQuality.BAD
    keypoints, landmark = keypoints[is_good], landmark[is_good]
    every = max(1, -(-len(keypoints) // _MAX_RAYS))
    keypoints, landmark = keypoints[::every], landmark[::every]
    start, _ = camera_centres(drawing, keypoints)
    end = drawing.p_landmarks[landmark]
    is_finite = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
    start, end = start[is_finite], end[is_finite]
    if not len(start):
        return None
    low, high = drawing.extent.outline.min(axis=0), drawing.extent.outline.max(axis=0)
    height = drawing.p_vertices[np.isfinite(drawing.p_vertices).all(axis=1), 2]
    low[2], high[2] = height.min(), height.max()
    cell = max(float((high - low).max()), _LEAST_M) / _CELLS
    low[2], high[2] = low[2] - 2.0 * cell, high[2] + 2.0 * cell
    shape = np.maximum(np.ceil((high - low) / cell).astype(np.int64), 1)
    return SeenVolume(low, cell, _crossings(start, end, low, cell, shape))


def _crossings(start: F64, end: F64, low: F64, cell: float, shape: I64) -> NDArray[np.uint8]:
    """Return from how many sectors of the compass rays (N, 3) to (N, 3) cross each voxel."""
    ray = end - start
    sector = np.floor((np.arctan2(ray[:, 1], ray[:, 0]) / (2.0 * np.pi) + 0.5) * _DIRECTIONS)
    bit = np.left_shift(1, sector.astype(np.int64) % _DIRECTIONS)
    seen = np.zeros(int(shape.prod()), dtype=np.int64)
    length = np.linalg.norm(ray, axis=1)
    for step in np.arange(0.0, min(float(length.max()), 2.0 * _CELLS * cell), 0.7 * cell).tolist():
        reached = length > step
        p = start[reached] + (step / length[reached])[:, None] * ray[reached]
        place = np.floor((p - low) / cell).astype(np.int64)
        inside = ((place >= 0) & (place < shape)).all(axis=1)
        flat = np.ravel_multi_index(tuple(place[inside].T), tuple(shape.tolist()))
        np.bitwise_or.at(seen, flat, bit[reached][inside])
    counts = sum((seen >> k) & 1 for k in range(_DIRECTIONS))
    return np.asarray(counts, dtype=np.uint8).reshape(tuple(shape.tolist()))


def _fog(drawing: Drawing, volume: SeenVolume) -> Layer:
    cells = np.argwhere(volume.is_foggy)
    spread = np.random.default_rng(0).uniform(-0.5, 0.5, (len(cells), _DOTS, 3)) * volume.cell_m
    p = (volume.centres(cells)[:, None] + spread).reshape(-1, 3)
    dots = make_points(p, _FOG, np.arange(len(p)), 0.0022 * drawing.unit_m)
    legend = LegendEntry(
        f"seen from fewer than {_WELL_SEEN} of {_DIRECTIONS} sides", (colours.to_hex(_FOG),)
    )
    return Layer("fog", "Poorly seen volume", {WHOLE_MAP: dots}, len(cells), legend=(legend,))


def next_walks(drawing: Drawing, volume: SeenVolume) -> F64:
    """Return the places (N, 3) off the path, at its height, that most poorly seen volume is around."""
    from scipy.ndimage import uniform_filter
    from scipy.spatial import cKDTree

    fog = volume.is_foggy.sum(axis=2).astype(np.float64)
    side = 2 * _REACH + 1
    # whole numbers, so that equal places stay equal
    gain = np.rint(side**2 * uniform_filter(fog, side, mode="constant"))
    cells = np.argwhere(volume.directions.max(axis=2) > 0)  # rays cross them: nothing is in the way
    p = volume.centres(np.column_stack([cells, np.zeros(len(cells), dtype=np.int64)]))
    path = drawing.p_vertices[np.isfinite(drawing.p_vertices).all(axis=1)]
    distance, nearest = cKDTree(path[:, :2]).query(p[:, :2])
    p[:, 2] = path[nearest, 2]
    off_path = np.where(distance > 2.0 * volume.cell_m, gain[tuple(cells.T)], 0.0)
    order = np.argsort(-off_path, kind="stable")
    chosen: list[int] = []
    for place in order.tolist():
        if len(chosen) == _WALKS or gain[tuple(cells[place])] <= 0.0:
            break
        away = np.linalg.norm(p[chosen, :2] - p[place, :2], axis=1)
        if (away > _APART * volume.cell_m).all() and distance[place] > 2.0 * volume.cell_m:
            chosen.append(place)
    return np.asarray(p[chosen])


def _next_walks(drawing: Drawing, volume: SeenVolume) -> Layer:
    p = next_walks(drawing, volume)
    dots = make_points(p, _NEXT, np.arange(len(p)), 0.02 * drawing.unit_m)
    labels = tuple(f"walk here: {number + 1}" for number in range(len(p)))
    places = p + drawing.origin_G
    notes = tuple(
        f"walk next: {number + 1} at {x:.1f}, {y:.1f}, {z:.1f} m"
        for number, (x, y, z) in enumerate(places.tolist())
    )
    part = {WHOLE_MAP: dataclasses.replace(dots, labels=labels)}
    return Layer("next_walks", "Where to walk next", part, len(p), notes=notes)
