"""Compiled kernels of Lucas-Kanade on a level of an image pyramid.

Source: J.-Y. Bouguet, Pyramidal Implementation of the Affine Lucas Kanade Feature Tracker, 2001; derivatives
of H. Scharr. Every keypoint is followed by itself.
"""

import numpy as np

from maplab_py.compilation import compiled, prange

_FAST = {"fastmath": {"contract", "nsz", "arcp", "reassoc"}}
"""Sums are formed in several parts at a time."""
_LANES = 16
"""Rows of a patch are filled up with zeros to a multiple of it, so that whole vectors are computed."""
_UPRIGHT_RAD = 0.01
"""Up to this turn patches are compared as they are (measured: keypoints drift by 0.3 px at 5 degrees)."""
_BLOCK = 16
"""Keypoints that a thread follows at a time."""
_ITERATIONS, _CONVERGED_PX, _COARSELY_CONVERGED_PX = 20, 0.01, 0.05
"""Steps in pixels of the image itself, and of the levels above, which only find where the next one begins."""
_MIN_EIGENVALUE = np.float32(0.1)
"""Smallest mean square of the gradient in any direction [grey^2 / px^2]."""
_ZERO, _UNITY, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_MIDDLE, _SIDE = np.float32(10.0 / 32.0), np.float32(3.0 / 32.0)


@compiled(parallel=True, **_FAST)
def follow_on_level(first, second, border, size, level, turn, uv, there, levels, is_tracked):  # type: ignore[no-untyped-def]
    """Move keypoints to where a level of the second image looks as the first one about them.

    Args:
        first: Grey values of the level with a border on all sides.
        second: Those of the other image.
        border: Width of the border [px].
        size: Side of the patches [px], odd.
        level: Halvings of the image.
        turn: (2, 2) from offsets in the first image to those in the second.
        uv: Keypoints (K, 2) in the first image.
        there: Where they are expected in the second one (K, 2); changed.
        levels: Levels above the image (K,) on which a keypoint is sought; it stays on others.
        is_tracked: Filled in (K,): the level shows the patch, and it can be followed.
    """
    width = -(-size // _LANES) * _LANES
    stride = max(width, -(-(size + 2) // 8) * 8)
    for block in prange(-(-len(uv) // _BLOCK)):
        square = np.zeros((size + 3) * stride, dtype=np.float32)
        template = np.zeros(size * stride, dtype=np.float32)
        patch = square, template, np.zeros_like(template), np.zeros_like(template)
        for k in range(block * _BLOCK, min((block + 1) * _BLOCK, len(uv))):
            is_tracked[k] = False
            if level <= levels[k]:
                is_tracked[k] = _follow(
                    first,
                    second,
                    border,
                    (size, width, stride),
                    level,
                    turn,
                    uv[k],
                    there[k],
                    patch,
                )


@compiled(**_FAST)
def _follow(first, second, border, sizes, level, turn, uv, there, patch):  # type: ignore[no-untyped-def]
    """Move one keypoint; return whether it can be followed."""
    size, width, stride = sizes
    square, template, du, dv = patch
    half, scale = size // 2, 0.5**level
    converged_px = _CONVERGED_PX if level == 0 else _COARSELY_CONVERGED_PX
    height_limit, width_limit = second.shape[0] - size - 2.0, second.shape[1] - width - 2.0
    u0, v0 = uv[0] * scale + border, uv[1] * scale + border
    if not _sample(first, u0, v0, turn, size + 2, stride, square):
        return False
    a, b, c = _differentiate(square, size, stride, template, du, dv)
    determinant, mean, part = a * c - b * b, _HALF * (a + c), _HALF * (a - c)
    least = mean - np.sqrt(part * part + b * b)
    if not least > _MIN_EIGENVALUE * np.float32(size * size):
        return False
    u, v = there[0] * scale + border - half, there[1] * scale + border - half
    before_u, before_v = 0.0, 0.0
    for iteration in range(_ITERATIONS):
        if not (0.0 <= u < width_limit and 0.0 <= v < height_limit):
            return False
        of_u, of_v = _compare(second, u, v, size, (width, stride), template, du, dv)
        step_u = float((c * of_u - b * of_v) / determinant)
        step_v = float((a * of_v - b * of_u) / determinant)
        u += step_u
        v += step_v
        if step_u * step_u + step_v * step_v <= converged_px * converged_px:
            break
        swings = abs(step_u + before_u) < converged_px and abs(step_v + before_v) < converged_px
        if iteration > 0 and swings:
            u -= 0.5 * step_u
            v -= 0.5 * step_v
            break
        before_u, before_v = step_u, step_v
    there[0], there[1] = (u + half - border) / scale, (v + half - border) / scale
    return True


@compiled(**_FAST)
def _sample(image, centre_u, centre_v, turn, size, stride, square):  # type: ignore[no-untyped-def]
    """Fill in the patch about a place as it looks after a turn; return whether it is in the image."""
    height, width = image.shape
    reach = size // 2
    extent = reach * (abs(turn[0, 0]) + abs(turn[0, 1])) + 1.0
    inside = extent <= centre_u < width - stride - extent
    if not (inside and extent <= centre_v < height - 1.0 - extent):
        return False
    is_upright = abs(turn[1, 0]) <= _UPRIGHT_RAD
    for row in range(size):
        if is_upright:
            u, v = centre_u - reach, centre_v + row - reach
            _sample_row(image, u, v, stride, square[row * stride :])
            continue
        # the inverse of a turn is its transpose
        u = centre_u - turn[0, 0] * reach + turn[1, 0] * (row - reach)
        v = centre_v - turn[0, 1] * reach + turn[1, 1] * (row - reach)
        for column in range(size):
            _sample_row(image, u, v, 1, square[row * stride + column :])
            u += turn[0, 0]
            v += turn[0, 1]
    return True


@compiled(forceinline=True, **_FAST)
def _sample_row(image, u, v, count, values):  # type: ignore[no-untyped-def]
    """Fill in the grey values of places of a row, a pixel apart."""
    row, first, following = np.uint64(v), np.uint64(u), np.uint64(1)
    a, b = np.float32(u - np.floor(u)), np.float32(v - np.floor(v))
    w00, w01 = (_UNITY - a) * (_UNITY - b), a * (_UNITY - b)
    w10, w11 = (_UNITY - a) * b, a * b
    for column in range(count):
        j = first + np.uint64(column)
        grey = w00 * np.float32(image[row, j]) + w01 * np.float32(image[row, j + following])
        grey += w10 * np.float32(image[row + following, j])
        grey += w11 * np.float32(image[row + following, j + following])
        values[column] = grey


@compiled(**_FAST)
def _differentiate(square, size, stride, template, du, dv):  # type: ignore[no-untyped-def]
    """Fill in the inner part of a patch and its derivatives; return the sums of their products."""
    following, below = np.uint64(1), np.uint64(stride)
    for n in range(size * stride):
        k = np.uint64(n)
        top, right = square[k], square[k + following + following]
        middle = k + below
        left, template[k] = square[middle], square[middle + following]
        low = middle + below
        across, sloping = (
            square[middle + following + following] - left,
            square[low + following + following] - top,
        )
        du[k] = _MIDDLE * across + _SIDE * (sloping + right - square[low])
        across = square[low + following] - square[k + following]
        dv[k] = _MIDDLE * across + _SIDE * (sloping + square[low] - right)
    for row in range(size):
        du[row * stride + size : (row + 1) * stride] = _ZERO
        dv[row * stride + size : (row + 1) * stride] = _ZERO
    a, b, c = _ZERO, _ZERO, _ZERO
    for n in range(size * stride):
        a += du[n] * du[n]
        b += du[n] * dv[n]
        c += dv[n] * dv[n]
    return a, b, c


@compiled(**_FAST)
def _compare(image, u, v, size, widths, template, du, dv):  # type: ignore[no-untyped-def]
    """Return the products of derivatives with the difference of a template and an image from a place on."""
    row, first = np.uint64(v), np.uint64(u)
    a, b = np.float32(u - np.floor(u)), np.float32(v - np.floor(v))
    w00, w01 = (_UNITY - a) * (_UNITY - b), a * (_UNITY - b)
    w10, w11 = (_UNITY - a) * b, a * b
    of_u, of_v = _ZERO, _ZERO
    n, following = np.uint64(0), np.uint64(1)
    width, stride = widths
    for _ in range(size):
        for start in range(0, width, _LANES):
            for lane in range(_LANES):
                j = first + np.uint64(start) + np.uint64(lane)
                grey = w00 * np.float32(image[row, j]) + w01 * np.float32(image[row, j + following])
                grey += w10 * np.float32(image[row + following, j])
                grey += w11 * np.float32(image[row + following, j + following])
                k = n + np.uint64(start) + np.uint64(lane)
                difference = template[k] - grey
                of_u += difference * du[k]
                of_v += difference * dv[k]
        n += np.uint64(stride)
        row += following
    return of_u, of_v
