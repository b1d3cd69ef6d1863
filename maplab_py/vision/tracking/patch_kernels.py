"""Compiled kernels: patches about keypoints, and their alignment with an image under an affine warp.

Source: S. Baker, I. Matthews, Lucas-Kanade 20 Years On, IJCV 2004 (inverse compositional); J. Shi, C. Tomasi,
Good Features to Track, CVPR 1994 (affine motion since the first image tells whether a track drifts).
"""

import numpy as np

from maplab_py.compilation import compiled, prange

HALF_PX = 7
"""Half the side of a patch; one more pixel on each side serves for gradients."""
SIDE_PX = 2 * HALF_PX + 3
_COUNT = (2 * HALF_PX + 1) ** 2
_LANES = 2 * HALF_PX + 2
_PARAMETERS = 6
_GREY_SIGMA = 4.0
_WARP_SIGMA = 0.02
"""Standard deviation of a change of the warp from image to image, at the edge of the patch [half sides]."""
_ITERATIONS = 8
_FAST = {"fastmath": {"contract", "nsz", "arcp", "reassoc"}}
"""Sums are formed in several parts at a time."""
_ZERO, _HALF, _UNITY = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_CONVERGED_PX = 0.01
_MIN_SIMILARITY = 0.8
"""Correlation of a patch and the image below which the image does not show it."""
_LARGEST_STEP_PX = 1.5
"""Farthest that a keypoint is moved from where Lucas-Kanade has put it."""
_LARGEST_STRETCH = 1.8
"""Change of scale, in any direction, from which on the latest image takes the place of the first one."""
_BLOCK = 16
"""Patches that a thread takes at a time."""


@compiled(**_FAST)
def sample_patches(image, uv, patch):  # type: ignore[no-untyped-def]
    """Fill in the patches (K, S, S) about keypoints uv (K, 2) of an image (H, W), continued at its border."""
    for k in range(len(uv)):
        _sample_patch(image, uv[k, 0], uv[k, 1], patch[k])


@compiled(**_FAST)
def _sample_patch(image, centre_u, centre_v, patch):  # type: ignore[no-untyped-def]
    """Fill in the patch (S, S) about a place."""
    height, width = image.shape
    reach = HALF_PX + 1
    for row in range(SIDE_PX):
        for column in range(SIDE_PX):
            u, v = centre_u + column - reach, centre_v + row - reach
            # of places that are no numbers, too, as nothing may be read outside the image
            u = min(u, width - 1.001) if u > 0.0 else 0.0
            v = min(v, height - 1.001) if v > 0.0 else 0.0
            patch[row, column] = _bilinear(image, u, v)


@compiled(**_FAST)
def _bilinear(image, u, v):  # type: ignore[no-untyped-def]
    """Return the grey value at a place inside the image."""
    # numbers without sign: those with one might count from the end of an array, which takes time to check
    # (converted by way of numbers with one, for which processors have an instruction)
    left, top, following = np.int64(u), np.int64(v), np.uint64(1)
    column, row = np.uint64(left), np.uint64(top)
    a, b = np.float32(u - left), np.float32(v - top)
    above = (_UNITY - a) * np.float32(image[row, column])
    above += a * np.float32(image[row, column + following])
    row += following
    below = (_UNITY - a) * np.float32(image[row, column])
    below += a * np.float32(image[row, column + following])
    return (_UNITY - b) * above + b * below


@compiled(parallel=True, **_FAST)
def align_patches(image, uv, patch, warp, is_shown):  # type: ignore[no-untyped-def]
    """Align keypoints with their patches, under affine warps, gain and offset of the brightness.

    Where the image does not show a patch, the keypoint stays where it is, and the patch is taken from this
    image; it is, too, where the change of scale has become large.

    Args:
        image: Grey values (H, W).
        uv: Where the keypoints are expected (K, 2); changed to where they are.
        patch: Patches (K, S, S) of earlier images; changed where they are taken from this one.
        warp: Expected change (K, 2, 2) from offsets in the patch to offsets in the image; changed.
        is_shown: Filled in (K,): the image shows the patch.
    """
    for block in prange(-(-len(uv) // _BLOCK)):
        slope = np.empty((_PARAMETERS, _COUNT), dtype=np.float32)
        template = np.empty(_COUNT, dtype=np.float32)
        sampled = np.empty(_COUNT + 1, dtype=np.float32)
        corners = (
            np.empty(_LANES, dtype=np.int32),
            np.empty((4, _LANES), dtype=np.int32),
            np.empty((2, _LANES), dtype=np.float32),
        )
        square, right = np.empty((_PARAMETERS, _PARAMETERS)), np.empty(_PARAMETERS)
        for k in range(block * _BLOCK, min((block + 1) * _BLOCK, len(uv))):
            u, v = uv[k, 0], uv[k, 1]
            similarity = _align(
                image, patch[k], uv[k], warp[k], slope, template, sampled, corners, square, right
            )
            step_px = np.sqrt((uv[k, 0] - u) ** 2 + (uv[k, 1] - v) ** 2)
            least, largest = _stretch(warp[k])
            # comparisons with what is no number are false
            is_shown[k] = similarity >= _MIN_SIMILARITY and step_px <= _LARGEST_STEP_PX
            is_shown[k] = is_shown[k] and largest < np.inf
            if not is_shown[k]:
                uv[k, 0], uv[k, 1] = u, v
            if is_shown[k] and largest <= _LARGEST_STRETCH and least * _LARGEST_STRETCH >= 1.0:
                continue
            warp[k, 0, 0], warp[k, 0, 1], warp[k, 1, 0], warp[k, 1, 1] = 1.0, 0.0, 0.0, 1.0
            _sample_patch(image, uv[k, 0], uv[k, 1], patch[k])


@compiled()
def _stretch(warp):  # type: ignore[no-untyped-def]
    """Return the singular values of a warp (2, 2), ascending."""
    turned = np.hypot(warp[0, 0] + warp[1, 1], warp[1, 0] - warp[0, 1])
    mirrored = np.hypot(warp[0, 0] - warp[1, 1], warp[1, 0] + warp[0, 1])
    return 0.5 * abs(turned - mirrored), 0.5 * (turned + mirrored)


@compiled(**_FAST)
def _align(image, patch, uv, warp, slope, template, sampled, corners, square, right):  # type: ignore[no-untyped-def]
    """Align one patch; see `align_patches`."""
    contrast = _prepare(patch, slope, template, square)
    if not contrast > 0.0:
        return -1.0
    _factorise(square)
    for _ in range(_ITERATIONS):
        if not _sample(image, uv, warp, contrast, sampled, corners):
            return -1.0
        for i in range(_PARAMETERS):
            # slopes are orthogonal to the template
            total = _ZERO
            for n in range(len(template)):
                total += slope[i, n] * sampled[n]
            right[i] = total
        _solve(square, right)
        _compose(uv, warp, right)
        if right[0] ** 2 + right[1] ** 2 < _CONVERGED_PX**2:
            break
    # as of the last step but one, which is as similar
    total = _ZERO
    for n in range(len(template)):
        total += sampled[n] * template[n]
    return total / (contrast * contrast)


@compiled(**_FAST)
def _prepare(patch, slope, template, square):  # type: ignore[no-untyped-def]
    """Fill in slopes, centred grey values and normal equations of a patch; return its contrast.

    Slopes by [u, v, A_uu, A_uv, A_vu, A_vv] are freed of what offset and gain of the brightness explain.
    """
    side = 2 * HALF_PX + 1
    count = side * side
    total = _ZERO
    n = 0
    for row in range(side):
        for column in range(side):
            here = patch[row + 1, column + 1]
            du = _HALF * (patch[row + 1, column + 2] - patch[row + 1, column])
            dv = _HALF * (patch[row + 2, column + 1] - patch[row, column + 1])
            x = np.float32((column - HALF_PX) / HALF_PX)
            y = np.float32((row - HALF_PX) / HALF_PX)
            slope[0, n], slope[1, n] = du, dv
            slope[2, n], slope[3, n] = du * x, du * y
            slope[4, n], slope[5, n] = dv * x, dv * y
            template[n] = here
            total += here
            n += 1
    mean = np.float32(total / count)
    squares = _ZERO
    for n in range(count):
        template[n] -= mean
        squares += template[n] * template[n]
    for i in range(_PARAMETERS):
        total, along = _ZERO, _ZERO
        for n in range(count):
            total += slope[i, n]
            along += slope[i, n] * template[n]
        mean, share = np.float32(total / count), np.float32(along / max(squares, np.float32(1e-9)))
        for n in range(count):
            slope[i, n] -= mean + share * template[n]
    for i in range(_PARAMETERS):
        for j in range(i + 1):
            total = _ZERO
            for n in range(count):
                total += slope[i, n] * slope[j, n]
            square[i, j] = total
    for i in range(_PARAMETERS):
        square[i, i] += 1e-6 * square[i, i] + 1e-6
        if i >= 2:
            square[i, i] += (_GREY_SIGMA / (_WARP_SIGMA * HALF_PX)) ** 2
    return np.sqrt(squares)


@compiled(**_FAST)
def _sample(image, uv, warp, contrast, sampled, corners):  # type: ignore[no-untyped-def]
    """Fill in grey values under a warp, of mean 0 and a contrast; return whether they are in the image."""
    height, width = image.shape
    reach_u = HALF_PX * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_v = HALF_PX * (abs(warp[1, 0]) + abs(warp[1, 1]))
    inside = reach_u <= uv[0] < width - 1.001 - reach_u
    inside = inside and reach_v <= uv[1] < height - 1.001 - reach_v
    if not inside:
        return False
    total = _ZERO
    for row in range(2 * HALF_PX + 1):
        first = row * (2 * HALF_PX + 1)
        u = uv[0] - HALF_PX * warp[0, 0] + warp[0, 1] * (row - HALF_PX)
        v = uv[1] - HALF_PX * warp[1, 0] + warp[1, 1] * (row - HALF_PX)
        _sample_line(image, u, v, (warp[0, 0], warp[1, 0]), first, sampled, corners)
    for n in range(_COUNT):
        total += sampled[n]
    mean = total / np.float32(_COUNT)
    squares = _ZERO
    for n in range(_COUNT):
        sampled[n] -= mean
        squares += sampled[n] * sampled[n]
    if squares < _UNITY:
        return False
    scale = contrast / np.sqrt(squares)
    for n in range(_COUNT):
        sampled[n] *= scale
    return True


@compiled(forceinline=True, **_FAST)
def _sample_line(image, u, v, step, first, sampled, corners):  # type: ignore[no-untyped-def]
    """Fill in grey values of places in a line, and a last one that is not used.

    Places, loads and sums are loops of their own: whole vectors are computed in the first and the last.
    """
    place, grey, share = corners
    width, flat = np.int32(image.shape[1]), image.ravel()
    for lane in range(_LANES):
        along = min(lane, 2 * HALF_PX)
        x, y = u + along * step[0], v + along * step[1]
        column, row = np.int32(x), np.int32(y)
        place[lane] = row * width + column
        share[0, lane], share[1, lane] = np.float32(x - column), np.float32(y - row)
    following, below = np.uint64(1), np.uint64(width)
    for lane in range(_LANES):
        k = np.uint64(place[lane])
        grey[0, lane], grey[1, lane] = flat[k], flat[k + following]
        k += below
        grey[2, lane], grey[3, lane] = flat[k], flat[k + following]
    for lane in range(_LANES):
        a, b = share[0, lane], share[1, lane]
        above = (_UNITY - a) * np.float32(grey[0, lane]) + a * np.float32(grey[1, lane])
        below = (_UNITY - a) * np.float32(grey[2, lane]) + a * np.float32(grey[3, lane])
        sampled[first + lane] = (_UNITY - b) * above + b * below


@compiled(**_FAST)
def _compose(uv, warp, step):  # type: ignore[no-untyped-def]
    """Replace a warp W by W o D^-1, where D is the step; the matrix part is given in half sides."""
    a, b = 1.0 + step[2] / HALF_PX, step[3] / HALF_PX
    c, d = step[4] / HALF_PX, 1.0 + step[5] / HALF_PX
    determinant = a * d - b * c
    a, b, c, d = d / determinant, -b / determinant, -c / determinant, a / determinant
    w00, w01 = warp[0, 0] * a + warp[0, 1] * c, warp[0, 0] * b + warp[0, 1] * d
    w10, w11 = warp[1, 0] * a + warp[1, 1] * c, warp[1, 0] * b + warp[1, 1] * d
    warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1] = w00, w01, w10, w11
    uv[0] -= w00 * step[0] + w01 * step[1]
    uv[1] -= w10 * step[0] + w11 * step[1]


@compiled(**_FAST)
def _factorise(square):  # type: ignore[no-untyped-def]
    """Replace the lower triangle of a positive definite matrix by its Cholesky factor."""
    for j in range(len(square)):
        for i in range(j, len(square)):
            total = square[i, j]
            for k in range(j):
                total -= square[i, k] * square[j, k]
            square[i, j] = np.sqrt(total) if i == j else total / square[j, j]


@compiled(**_FAST)
def _solve(factor, right):  # type: ignore[no-untyped-def]
    """Replace a right side by the solution, given a Cholesky factor."""
    size = len(right)
    for i in range(size):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]
