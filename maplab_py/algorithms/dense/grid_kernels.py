"""Compiled kernels of voxel grids: blocks near the surface, and integration of depth.

Blocks have 8 x 8 x 8 voxels.
"""

import numpy as np

from maplab_py.array_types import F32, F64, I32, I64
from maplab_py.compilation import compiled, prange

BLOCK_SIDE = 8
"""Voxels along a side of a block."""
KEY_BITS = 21
"""Bits of each coordinate in the packed coordinates of a block."""
LIMIT = 1 << (KEY_BITS - 1)
"""Coordinates of blocks are in [-LIMIT, LIMIT)."""


@compiled()
def keys_of_depth(depth: F32, camera: F64, T_G_C: F64, settings: F64) -> I64:
    """Return the blocks in the truncation band about the pixels of a depth map, or from the camera on.

    Args:
        depth: Depths (H, W) [m], 0 = unknown.
        camera: Focal length, centre u, centre v [px].
        T_G_C: Pose (4, 4) of the camera.
        settings: Side of a block, truncation distance, smallest and largest depth [m], the step
            between the pixels that are looked at, 1 to add the blocks of the free space in front of
            the surface, too, else 0, and the number of blocks after which no more rows are looked at.

    Returns:
        Packed coordinates (B,), each once.
    """
    block_m, band_m, near, far = settings[0], settings[1], settings[2], settings[3]
    step, is_free_wanted = int(settings[4]), settings[5] > 0.0
    last = np.int64(-1)
    keys = {last}
    for v in range(0, depth.shape[0], step):
        if len(keys) > settings[6]:
            break
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
                key = ((a + LIMIT) << 2 * KEY_BITS) | ((b + LIMIT) << KEY_BITS) | (c + LIMIT)
                if key != last:
                    keys.add(key)
                last = key
    keys.remove(np.int64(-1))
    result = np.empty(len(keys), dtype=np.int64)
    for row, key in enumerate(keys):
        result[row] = key
    return result


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


def compile_kernels() -> None:
    """Compile the kernels of this module for the types that the grid uses."""
    depth = np.ones((2, 2), dtype=np.float32)
    keys_of_depth(depth, np.ones(3), np.eye(4), np.array([1.0, 0.1, 0.1, 9.0, 1.0, 0.0, 9.0]))
    voxels = np.zeros((1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE), dtype=np.float32)
    image = np.array([1.0, 0.5, 0.5, 2.0, 2.0, 0.1, 9.0])
    settings = np.array([0.1, 0.3, 2.0, 1e4, 1.0])
    blocks = np.zeros((1, 3), dtype=np.int32)
    integrate_depth(depth, image, np.eye(4), settings, blocks, voxels, voxels.copy())
