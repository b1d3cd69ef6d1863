"""Compiled look-up of voxel blocks: a hash table with open addressing.

Blocks have 8 x 8 x 8 voxels. A row of the table is the packed coordinates of a block and the row of
the block in the arrays of the grid; a free row has the key -1.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F32, F64, I32, I64
from maplab_py.compilation import compiled

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


def compile_kernels() -> None:
    """Compile the kernels of this module for the types that the grid uses."""
    table = np.full((64, 2), -1, dtype=np.int64)
    coordinates = np.zeros((8, 3), dtype=np.int32)
    settings = np.array([1.0, 0.1, 0.1, 9.0, 1.0, 0.0])
    depth = np.ones((2, 2), dtype=np.float32)
    count = allocate_blocks(depth, np.ones(3), np.eye(4), settings, table, coordinates, 0)
    fill_table(coordinates[:count], table)
    find_neighbours(coordinates[:count], table, np.zeros((count, NEIGHBOURS), dtype=np.int32))
