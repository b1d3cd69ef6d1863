"""Compiled kernels of voxel grids: look-up of blocks, integration of depth, and surface nets.

Blocks have 8 x 8 x 8 voxels. They are found by a hash table with open addressing: a row is the packed
coordinates of a block and the row of the block in the arrays of the grid; a free row has the key -1.
"""

import numpy as np

from maplab_py.array_types import F32, F64, I32, I64
from maplab_py.compilation import compiled, prange

BLOCK_SIDE = 8
"""Voxels along a side of a block."""
FULL = -1
"""Returned when the table has no room for the blocks of a depth map."""
NEIGHBOURS = 27
_BIAS, _MIX = 1 << 20, np.int64(-7046029254386353131)
"""Coordinates of blocks are in [-2^20, 2^20); a factor that mixes their bits (2^64 / golden ratio)."""


@compiled()
def block_key(a: int, b: int, c: int) -> int:
    """Return the packed coordinates of a block."""
    return ((a + _BIAS) << 42) | ((b + _BIAS) << 21) | (c + _BIAS)


@compiled()
def find_slot(table: I64, key: int) -> int:
    """Return the row of a key in the table, or the free row where it belongs."""
    slot: int = ((key * _MIX) >> 20) & (table.shape[0] - 1)
    while table[slot, 0] != key and table[slot, 0] != -1:
        slot = (slot + 1) & (table.shape[0] - 1)
    return slot


@compiled()
def fill_table(coordinates: I32, table: I64) -> None:
    """Enter blocks (B, 3) into an empty table."""
    for row in range(len(coordinates)):
        key = block_key(
            np.int64(coordinates[row, 0]),
            np.int64(coordinates[row, 1]),
            np.int64(coordinates[row, 2]),
        )
        slot = find_slot(table, key)
        table[slot, 0], table[slot, 1] = key, row


@compiled()
def allocate_blocks(
    depth: F32, camera: F64, T_G_C: F64, settings: F64, table: I64, coordinates: I32, count: int
) -> int:
    """Add the blocks in the truncation band about the pixels of a depth map, or from the camera on.

    Args:
        depth: Depths (H, W) [m], 0 = unknown.
        camera: Focal length, centre u, centre v [px].
        T_G_C: Pose (4, 4) of the camera.
        settings: Side of a block, truncation distance, smallest and largest depth [m], the step
            between the pixels that are looked at, and 1 to add the blocks of the free space in front of
            the surface, too, else 0.
        table: Hash table (N, 2), N a power of two.
        coordinates: Blocks (capacity, 3); new ones are added.
        count: Number of blocks.

    Returns:
        The new number of blocks, or FULL.
    """
    block_m, band_m, near, far = settings[0], settings[1], settings[2], settings[3]
    step, is_free_wanted = int(settings[4]), settings[5] > 0.0
    last = np.int64(-1)
    for v in range(0, depth.shape[0], step):
        y = (v - camera[2]) / camera[0]
        for u in range(0, depth.shape[1], step):
            z = np.float64(depth[v, u])
            if z < near or z > far:
                continue
            x = (u - camera[1]) / camera[0]
            d0 = T_G_C[0, 0] * x + T_G_C[0, 1] * y + T_G_C[0, 2]
            d1 = T_G_C[1, 0] * x + T_G_C[1, 1] * y + T_G_C[1, 2]
            d2 = T_G_C[2, 0] * x + T_G_C[2, 1] * y + T_G_C[2, 2]
            length = np.sqrt(x * x + y * y + 1.0)
            middle, stretch = z, band_m / length
            if is_free_wanted:
                middle, stretch = 0.5 * (z + stretch), 0.5 * (z + stretch)
            samples = int(np.ceil(2.0 * stretch * length / (0.75 * block_m) - 1e-9))
            for k in range(samples + 1):
                along = middle + stretch * (2.0 * k / samples - 1.0)
                a = np.int64(np.floor((d0 * along + T_G_C[0, 3]) / block_m))
                b = np.int64(np.floor((d1 * along + T_G_C[1, 3]) / block_m))
                c = np.int64(np.floor((d2 * along + T_G_C[2, 3]) / block_m))
                key = block_key(a, b, c)
                if key == last:
                    continue
                last = key
                slot = find_slot(table, key)
                if table[slot, 0] == -1:
                    if count == len(coordinates):
                        return FULL
                    table[slot, 0], table[slot, 1] = key, count
                    coordinates[count, 0], coordinates[count, 1], coordinates[count, 2] = a, b, c
                    count += 1
    return count


@compiled()
def find_neighbours(coordinates: I32, table: I64, around: I32) -> None:
    """Enter the rows of the 27 blocks around each block (B, 3), itself in the middle, -1 = none.

    Args:
        coordinates: Blocks (B, 3).
        table: Hash table.
        around: Rows (B, 27) to fill, the last coordinate fastest.
    """
    for row in range(len(coordinates)):
        a, b, c = coordinates[row, 0], coordinates[row, 1], coordinates[row, 2]
        for place in range(NEIGHBOURS):
            key = block_key(
                np.int64(a + place // 9 - 1),
                np.int64(b + place // 3 % 3 - 1),
                np.int64(c + place % 3 - 1),
            )
            slot = find_slot(table, key)
            around[row, place] = table[slot, 1] if table[slot, 0] == key else -1


# Compiled integration of depth maps into truncated signed distances.
#
# Source: Curless and Levoy, A volumetric method for building complex models from range images, 1996;
# the projective distance along the camera's axis is that of KinectFusion (Newcombe et al., 2011).


REFERENCE_DEPTH_M = 2.0
"""A measurement at this depth has the weight one."""


@compiled()
def is_block_visible(p: F64, image: F64, radius: float) -> bool:
    """Tell whether a ball may be seen by a camera.

    Args:
        p: Centre (3,) of the ball in the camera's frame [m].
        image: Focal length, centre u, centre v, width, height [px], smallest and largest depth [m].
        radius: Of the ball [m].
    """
    focal, left, top = image[0], image[1] + 0.5, image[2] + 0.5
    right, bottom = image[3] - left, image[4] - top
    if p[2] < image[5] - radius or p[2] > image[6] + radius:
        return False
    if focal * p[0] + left * p[2] < -radius * np.sqrt(focal * focal + left * left):
        return False
    if -focal * p[0] + right * p[2] < -radius * np.sqrt(focal * focal + right * right):
        return False
    if focal * p[1] + top * p[2] < -radius * np.sqrt(focal * focal + top * top):
        return False
    return bool(-focal * p[1] + bottom * p[2] >= -radius * np.sqrt(focal * focal + bottom * bottom))


@compiled()
def block_centre(coordinate: I32, voxel: float, T_C_G: F64) -> F64:
    """Return the centre (3,) of a block (3,) in the camera's frame."""
    centre = np.empty(3)
    for axis in range(3):
        centre[axis] = T_C_G[axis, 3]
        for k in range(3):
            centre[axis] += T_C_G[axis, k] * (coordinate[k] + 0.5) * BLOCK_SIDE * voxel
    return centre


@compiled(parallel=True, fastmath=True)
def integrate_depth(
    depth: F32,
    image: F64,
    T_C_G: F64,
    settings: F64,
    coordinates: I32,
    distance: F32,
    weight: F32,
) -> None:
    """Add a depth map to all voxels of the blocks that its camera sees, or take it out again.

    Args:
        depth: Depths (H, W) [m] along the optical axis, 0 = unknown.
        image: Focal length, centre u, centre v, width, height [px], smallest and largest depth [m].
        T_C_G: Transformation (4, 4) of points to the camera.
        settings: Voxel size [m], truncation distance [m], power of the depth by which the weight
            falls, largest weight, and +1 to add or -1 to take out.
        coordinates: Blocks (B, 3).
        distance: Mean distances (B, 8, 8, 8) in units of the truncation distance, in [-1, 1].
        weight: Their weights (B, 8, 8, 8).
    """
    voxel = settings[0]
    radius = 0.5 * np.sqrt(3.0) * BLOCK_SIDE * voxel
    power, sign = int(settings[2]), np.float32(settings[4])
    band, largest = np.float32(settings[1]), np.float32(settings[3])
    inverse_band = np.float32(1.0) / band
    focal, near, far = np.float32(image[0]), np.float32(image[5]), np.float32(image[6])
    # half a pixel more, so that cutting off the fraction rounds to the nearest pixel
    centre_u, centre_v = np.float32(image[1] + 0.5), np.float32(image[2] + 0.5)
    width, height = depth.shape[1], depth.shape[0]
    reference = np.float32(REFERENCE_DEPTH_M)
    step0 = np.float32(voxel * T_C_G[0, 2])
    step1 = np.float32(voxel * T_C_G[1, 2])
    step2 = np.float32(voxel * T_C_G[2, 2])
    for block in prange(len(coordinates)):
        centre = block_centre(coordinates[block], voxel, T_C_G)
        if not is_block_visible(centre, image, radius + settings[1]):
            continue
        first = 0.5 * voxel - 0.5 * BLOCK_SIDE * voxel
        for i in range(BLOCK_SIDE):
            for j in range(BLOCK_SIDE):
                o0, o1 = first + i * voxel, first + j * voxel
                x = np.float32(
                    centre[0] + T_C_G[0, 0] * o0 + T_C_G[0, 1] * o1 + T_C_G[0, 2] * first
                )
                y = np.float32(
                    centre[1] + T_C_G[1, 0] * o0 + T_C_G[1, 1] * o1 + T_C_G[1, 2] * first
                )
                z = np.float32(
                    centre[2] + T_C_G[2, 0] * o0 + T_C_G[2, 1] * o1 + T_C_G[2, 2] * first
                )
                for k in range(BLOCK_SIDE):
                    z_k = z + np.float32(k) * step2
                    if z_k < near:
                        continue
                    scale = focal / z_k
                    u = (x + np.float32(k) * step0) * scale + centre_u
                    v = (y + np.float32(k) * step1) * scale + centre_v
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    d = depth[np.int32(v), np.int32(u)]
                    s = d - z_k
                    if d < near or d > far or s < -band:
                        continue
                    s = min(s * inverse_band, np.float32(1.0))
                    ratio, w = reference / d, np.float32(1.0)
                    for _ in range(power):
                        w *= ratio
                    old = weight[block, i, j, k]
                    new = old + sign * w
                    if new <= np.float32(1e-6) * w:
                        distance[block, i, j, k] = np.float32(0.0)
                        weight[block, i, j, k] = np.float32(0.0)
                        continue
                    distance[block, i, j, k] += sign * w / new * (s - distance[block, i, j, k])
                    weight[block, i, j, k] = min(new, largest)


# Compiled surface nets over voxel blocks: the surface between positive and negative distances.
#
# A cell lies between eight voxel centres. It counts only if all eight have been observed; otherwise the
# rim of the truncation band would become a false surface. Its vertex is the mean of the crossings on its
# twelve edges. An edge between two voxels of different sign joins the vertices of the four cells around
# it to a quadrilateral.
# Source: Gibson, Constrained elastic surface nets, MICCAI 1998.


_EDGES = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
"""Edges of a cell between its corners; the bits of a corner are its offsets along x, y and z."""


@compiled()
def neighbour_of(i: int, j: int, k: int) -> int:
    """Return the column of `around` of the block with a voxel, whose indices may be -1 or 8."""
    return 9 * (1 + i // BLOCK_SIDE) + 3 * (1 + j // BLOCK_SIDE) + 1 + k // BLOCK_SIDE


@compiled()
def read_block(
    block: int, around: I32, distance: F32, weight: F32, enough: float, values: F32
) -> None:
    """Copy the voxels (9, 9, 9) of a block and of the next ones along x, y and z; NaN = unobserved."""
    side = BLOCK_SIDE
    for i in range(side + 1):
        for j in range(side + 1):
            for k in range(side + 1):
                home = around[block, neighbour_of(i, j, k)]
                a, b, c = i % side, j % side, k % side
                is_observed = home >= 0 and weight[home, a, b, c] >= enough
                values[i, j, k] = distance[home, a, b, c] if is_observed else np.nan


@compiled()
def place_vertex(corners: F32, most: float, p: F64) -> bool:
    """Put the vertex (3,) of a cell of side 1; False if no surface with distances up to `most` passes it."""
    negative = 0
    for m in range(8):
        if np.isnan(corners[m]) or corners[m] > most:
            return False
        negative += corners[m] < 0
    if negative in (0, 8):
        return False
    p[:] = 0.0
    crossings = 0
    for a, b in _EDGES:
        if (corners[a] < 0) != (corners[b] < 0):
            s = corners[a] / (corners[a] - corners[b])
            p[0] += (a & 1) + s * ((b & 1) - (a & 1))
            p[1] += (a >> 1 & 1) + s * ((b >> 1 & 1) - (a >> 1 & 1))
            p[2] += (a >> 2) + s * ((b >> 2) - (a >> 2))
            crossings += 1
    p /= crossings
    return True


@compiled()
def place_vertices(
    coordinates: I32,
    around: I32,
    distance: F32,
    weight: F32,
    settings: F64,
    cells: I32,
    points: F64,
) -> int:
    """Number the cells that have a vertex, and put the vertices; return their number.

    Args:
        coordinates: Blocks (B, 3).
        around: Rows (B, 27) of the blocks around each.
        distance: Distances (B, 8, 8, 8).
        weight: Weights (B, 8, 8, 8).
        settings: Voxel size [m], the weight from which a voxel counts as observed, and the largest distance
            of a voxel beside a surface.
        cells: Numbers (B, 8, 8, 8) of the vertices to fill, -1 = none.
        points: Vertices (N, 3) to fill [m]; with N = 0 they are only counted.
    """
    side = BLOCK_SIDE
    values = np.empty((side + 1, side + 1, side + 1), dtype=np.float32)
    corners = np.empty(8, dtype=np.float32)
    p = np.empty(3)
    count = 0
    for block in range(len(coordinates)):
        read_block(block, around, distance, weight, settings[1], values)
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    cells[block, i, j, k] = -1
                    for m in range(8):
                        corners[m] = values[i + (m & 1), j + (m >> 1 & 1), k + (m >> 2)]
                    if not place_vertex(corners, settings[2], p):
                        continue
                    if len(points):
                        for axis, index in enumerate((i, j, k)):
                            voxels = coordinates[block, axis] * side + index + 0.5 + p[axis]
                            points[count, axis] = voxels * settings[0]
                    cells[block, i, j, k] = count
                    count += 1
    return count


@compiled()
def join_vertices(around: I32, distance: F32, cells: I32, quads: I32) -> int:
    """Join the vertices around every edge that the surface crosses; return the number of quads.

    Corners run anticlockwise as seen from the side of positive distances.

    Args:
        around: Rows (B, 27) of the blocks around each.
        distance: Distances (B, 8, 8, 8).
        cells: Numbers (B, 8, 8, 8) of the cells' vertices, -1 = none.
        quads: Vertices (M, 4) to fill; with M = 0 they are only counted.
    """
    side = BLOCK_SIDE
    corner = np.empty(4, dtype=np.int32)
    at = np.empty(3, dtype=np.int64)
    count = 0
    for block in range(len(around)):
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    if cells[block, i, j, k] < 0:
                        continue
                    is_negative = distance[block, i, j, k] < 0
                    for axis in range(3):
                        p, q, r = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                        home = around[block, neighbour_of(p, q, r)]
                        if (distance[home, p % side, q % side, r % side] < 0) == is_negative:
                            continue
                        is_complete = True
                        for m in range(4):
                            at[0], at[1], at[2] = i, j, k
                            at[(axis + 1) % 3] -= m in (1, 2)
                            at[(axis + 2) % 3] -= m >= 2
                            home = around[block, neighbour_of(at[0], at[1], at[2])]
                            corner[m] = (
                                cells[home, at[0] % side, at[1] % side, at[2] % side]
                                if home >= 0
                                else -1
                            )
                            is_complete = is_complete and corner[m] >= 0
                        if is_complete:
                            if len(quads):
                                for m in range(4):
                                    quads[count, m] = corner[m] if is_negative else corner[3 - m]
                            count += 1
    return count


def compile_kernels() -> None:
    """Compile the kernels of this module for the types that the grid uses."""
    table = np.full((64, 2), -1, dtype=np.int64)
    coordinates = np.zeros((8, 3), dtype=np.int32)
    depth = np.ones((2, 2), dtype=np.float32)
    settings = np.array([1.0, 0.1, 0.1, 9.0, 1.0, 0.0])
    count = allocate_blocks(depth, np.ones(3), np.eye(4), settings, table, coordinates, 0)
    fill_table(coordinates[:count], table)
    find_neighbours(coordinates[:count], table, np.zeros((count, NEIGHBOURS), dtype=np.int32))
    voxels = np.zeros((1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE), dtype=np.float32)
    image = np.array([1.0, 0.5, 0.5, 2.0, 2.0, 0.1, 9.0])
    settings = np.array([0.1, 0.3, 2.0, 1e4, 1.0])
    blocks = np.zeros((1, 3), dtype=np.int32)
    integrate_depth(depth, image, np.eye(4), settings, blocks, voxels, voxels.copy())
    around = np.full((1, NEIGHBOURS), -1, dtype=np.int32)
    cells = np.full(voxels.shape, -1, dtype=np.int32)
    settings = np.array([0.1, 1.0, 1.0])
    place_vertices(blocks, around, voxels, voxels, settings, cells, np.zeros((0, 3)))
    join_vertices(around, voxels, cells, np.zeros((0, 4), dtype=np.int32))
