"""Compiled kernels of the absolute pose search: hypotheses, scoring, refinement.

W is the query's body frame turned so that its z axis points up; M is the gravity-aligned frame of
the points. Hypotheses are T_M_W: yaw and position from two matches. The refinement frees roll and
pitch, held by a prior.
"""

from typing import NamedTuple

import numpy as np

from maplab_py.compilation import compiled, prange
from maplab_py.vision.random_numbers import random_below

_MIN_DEPTH_M = 0.05
_CONFIDENCE = 0.999
_LOOSE = 3.0
"""Hypotheses are scored with as many times the tolerance: their tilt is only as good as given."""


class SearchSettings(NamedTuple):
    """Length of the search, and uncertainty of gravity."""

    max_iterations: int
    inverse_tilt: float  # 1 / standard deviation [1/rad] of the given roll and pitch


@compiled()
def _score(R, t, origin, ray, point, keypoint, inverse_sigma, best_match):  # type: ignore[no-untyped-def]
    """Return the MSAC cost of a pose and the number of inlying keypoints.

    Of a keypoint's candidate points only the best counts; `best_match` (one per match row) marks
    it where it is an inlier. Errors are in units of the threshold.
    """
    cost, inliers = 0.0, 0
    i, end = 0, len(keypoint)
    while i < end:
        best, best_row = 1.0, -1
        j = i
        while j < end and keypoint[j] == keypoint[i]:
            best_match[j] = False
            x, y, z = point[j, 0] - t[0], point[j, 1] - t[1], point[j, 2] - t[2]
            cx = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z - origin[j, 0]
            cy = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z - origin[j, 1]
            cz = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z - origin[j, 2]
            along = cx * ray[j, 0] + cy * ray[j, 1] + cz * ray[j, 2]
            if along > _MIN_DEPTH_M:
                # tan^2 of the angle to the ray
                square = (cx * cx + cy * cy + cz * cz - along * along) / (along * along)
                error = square * inverse_sigma[j] * inverse_sigma[j]
                if error < best:
                    best, best_row = error, j
            j += 1
        cost += best
        if best_row >= 0:
            inliers += 1
            best_match[best_row] = True
        i = j
    return cost, inliers


@compiled(forceinline=True)
def _across(ray, first, second):  # type: ignore[no-untyped-def]
    """Fill in two unit vectors across a unit ray (Duff et al., Building an Orthonormal Basis)."""
    sign = 1.0 if ray[2] >= 0.0 else -1.0
    a = -1.0 / (sign + ray[2])
    b = ray[0] * ray[1] * a
    first[0], first[1], first[2] = 1.0 + sign * ray[0] * ray[0] * a, sign * b, -sign * ray[0]
    second[0], second[1], second[2] = b, sign + ray[1] * ray[1] * a, -ray[1]


@compiled(forceinline=True)
def _add_row(row, e, H, g):  # type: ignore[no-untyped-def]
    """Add a row of the Jacobian to the upper triangle of H and to g."""
    for i in range(6):
        g[i] += row[i] * e
        for k in range(i, 6):
            H[i, k] += row[i] * row[k]


@compiled()
def _accumulate(R, t, origin, ray, point, inverse_sigma, used, inverse_tilt, H, g):  # type: ignore[no-untyped-def]
    """Fill in the normal equations of the bearing errors in [dp (M), dtheta (W)].

    The error is the unit vector d to the point along two directions b across the ray; with
    c = b - d (d . b) over the distance, it changes by -R c with the position and c x q with theta.
    """
    H[:] = 0.0
    g[:] = 0.0
    row, q, d, c = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    directions = np.empty((2, 3))
    for j in range(len(used)):
        if not used[j]:
            continue
        x, y, z = point[j, 0] - t[0], point[j, 1] - t[1], point[j, 2] - t[2]
        square = 0.0
        for i in range(3):
            q[i] = R[0, i] * x + R[1, i] * y + R[2, i] * z
            d[i] = q[i] - origin[j, i]
            square += d[i] * d[i]
        length = np.sqrt(square)
        w = inverse_sigma[j]
        _across(ray[j], directions[0], directions[1])
        for b in directions:
            along = (d[0] * b[0] + d[1] * b[1] + d[2] * b[2]) / length
            for i in range(3):
                c[i] = (b[i] - d[i] / length * along) * (w / length)
            for i in range(3):
                row[i] = -(R[i, 0] * c[0] + R[i, 1] * c[1] + R[i, 2] * c[2])
            row[3] = c[1] * q[2] - c[2] * q[1]
            row[4] = c[2] * q[0] - c[0] * q[2]
            row[5] = c[0] * q[1] - c[1] * q[0]
            _add_row(row, w * along, H, g)
    # prior: the z axis of W stays up in M, d(R e_z)/dtheta = -R [e_z]x
    for i in range(2):
        row[:] = 0.0
        row[3] = -R[i, 1] * inverse_tilt
        row[4] = R[i, 0] * inverse_tilt
        _add_row(row, R[i, 2] * inverse_tilt, H, g)
    for i in range(6):
        for k in range(i):
            H[i, k] = H[k, i]


@compiled()
def _retract(R, t, step):  # type: ignore[no-untyped-def]
    """Apply [dp, dtheta] in place: t <- t + dp, R <- R exp(dtheta)."""
    x, y, z = step[3], step[4], step[5]
    angle = np.sqrt(x * x + y * y + z * z)
    a = np.sin(angle) / angle if angle > 1e-8 else 1.0
    b = 2.0 * (np.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    c = 1.0 - b * angle * angle
    for i in range(3):
        t[i] += step[i]
        u, v, w = R[i, 0], R[i, 1], R[i, 2]
        along = b * (u * x + v * y + w * z)
        R[i, 0] = c * u + along * x + a * (v * z - w * y)
        R[i, 1] = c * v + along * y + a * (w * x - u * z)
        R[i, 2] = c * w + along * z + a * (u * y - v * x)


@compiled()
def _solve(H, g, L, step):  # type: ignore[no-untyped-def]
    """Fill in step = -H^-1 g (6,) by Cholesky's factor of H scaled to a diagonal of one plus 1e-9.

    L (6, 6) is room to work in. Returns False where H has a zero on its diagonal.
    """
    for i in range(6):
        if H[i, i] <= 0.0:
            return False
        for j in range(i + 1):
            total = H[i, j] / np.sqrt(H[i, i] * H[j, j])
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j] if i != j else np.sqrt(max(total, 0.0) + 1e-9)
    for i in range(6):
        total = -g[i] / np.sqrt(H[i, i])
        for k in range(i):
            total -= L[i, k] * step[k]
        step[i] = total / L[i, i]
    for i in range(5, -1, -1):
        total = step[i]
        for k in range(i + 1, 6):
            total -= L[k, i] * step[k]
        step[i] = total / L[i, i]
    for i in range(6):
        step[i] /= np.sqrt(H[i, i])
    return True


@compiled()
def _refine(R, t, origin, ray, point, inverse_sigma, used, inverse_tilt, iterations, H):  # type: ignore[no-untyped-def]
    """Gauss-Newton on the used matches, in place; return False when it is not determined."""
    g, L, step = np.empty(6), np.empty((6, 6)), np.empty(6)
    for _ in range(iterations):
        _accumulate(R, t, origin, ray, point, inverse_sigma, used, inverse_tilt, H, g)
        if not _solve(H, g, L, step):
            return False
        largest = 0.0
        for i in range(6):
            if not abs(step[i]) < (0.5 if i >= 3 else np.inf):
                return False
            largest = max(largest, abs(step[i]))
        _retract(R, t, step)
        if largest < 1e-9:
            break
    return True


@compiled()
def _copy_pose(R, t, R_to, t_to):  # type: ignore[no-untyped-def]
    for i in range(3):
        t_to[i] = t[i]
        for j in range(3):
            R_to[i, j] = R[i, j]


@compiled()
def _polish(  # type: ignore[no-untyped-def]
    R, t, origin, ray, point, keypoint, inverse_sigma, used, inverse_tilt, rounds
):
    """Alternate refinement and choice of inliers while the cost falls; return cost and inliers."""
    cost, inliers = _score(R, t, origin, ray, point, keypoint, inverse_sigma, used)
    H, R_new, t_new = np.empty((6, 6)), np.empty((3, 3)), np.empty(3)
    trial = np.zeros(len(used), dtype=np.bool_)
    for _ in range(rounds):
        if inliers < 3:
            break
        _copy_pose(R, t, R_new, t_new)
        if not _refine(R_new, t_new, origin, ray, point, inverse_sigma, used, inverse_tilt, 3, H):
            break
        rest = _score(R_new, t_new, origin, ray, point, keypoint, inverse_sigma, trial)
        if rest[0] >= cost:
            break
        cost, inliers = rest
        _copy_pose(R_new, t_new, R, t)
        for j in range(len(used)):
            used[j] = trial[j]
    return cost, inliers


@compiled()
def _two_point(o1, f1, X1, o2, f2, X2, yaw, position):  # type: ignore[no-untyped-def]
    """Fill in up to two solutions of Rz(yaw) (o_i + depth_i f_i) + position = X_i; return how many.

    The z components make the depths a line, depth(s) = base + s u; the horizontal distance of
    the two points then is a quadratic in s.
    """
    n = np.sqrt(f1[2] * f1[2] + f2[2] * f2[2])
    if n < 1e-3:
        return 0
    c = (X1[2] - X2[2] - o1[2] + o2[2]) / (n * n)
    base1, base2 = c * f1[2], -c * f2[2]
    u1, u2 = f2[2] / n, f1[2] / n
    ax = o1[0] - o2[0] + base1 * f1[0] - base2 * f2[0]
    ay = o1[1] - o2[1] + base1 * f1[1] - base2 * f2[1]
    bx, by = u1 * f1[0] - u2 * f2[0], u1 * f1[1] - u2 * f2[1]
    dx, dy = X1[0] - X2[0], X1[1] - X2[1]
    qa = bx * bx + by * by
    qb = ax * bx + ay * by
    qc = ax * ax + ay * ay - dx * dx - dy * dy
    discriminant = qb * qb - qa * qc
    if qa < 1e-12 or discriminant < 0.0:
        return 0
    root = np.sqrt(discriminant)
    count = 0
    for sign in (-1.0, 1.0):
        s = (-qb + sign * root) / qa
        depth1, depth2 = base1 + s * u1, base2 + s * u2
        if depth1 < _MIN_DEPTH_M or depth2 < _MIN_DEPTH_M:
            continue
        vx, vy = ax + s * bx, ay + s * by
        phi = np.arctan2(dy, dx) - np.arctan2(vy, vx)
        cos, sin = np.cos(phi), np.sin(phi)
        px, py = o1[0] + depth1 * f1[0], o1[1] + depth1 * f1[1]
        yaw[count] = phi
        position[count, 0] = X1[0] - (cos * px - sin * py)
        position[count, 1] = X1[1] - (sin * px + cos * py)
        position[count, 2] = X1[2] - (o1[2] + depth1 * f1[2])
        count += 1
    return count


@compiled()
def _draw(state, sample, k, o, f, X, R, t):  # type: ignore[no-untyped-def]
    """Fill in up to two poses of a random sample of two matches; return how many."""
    for i in range(len(sample)):
        sample[i] = random_below(state, len(k))
        for j in range(i):
            if k[sample[j]] == k[sample[i]]:
                return 0
    a, b = sample[0], sample[1]
    yaw = np.empty(2)
    count = _two_point(o[a], f[a], X[a], o[b], f[b], X[b], yaw, t)
    for s in range(count):
        cos, sin = np.cos(yaw[s]), np.sin(yaw[s])
        R[s, 0, 0], R[s, 0, 1], R[s, 0, 2] = cos, -sin, 0.0
        R[s, 1, 0], R[s, 1, 1], R[s, 1, 2] = sin, cos, 0.0
        R[s, 2, 0], R[s, 2, 1], R[s, 2, 2] = 0.0, 0.0, 1.0
    return count


@compiled()
def _search_pose(i, matches, settings, poses):  # type: ignore[no-untyped-def]
    """Search the pose of one problem."""
    a, b = matches.start[i], matches.start[i + 1]
    o, f, X = matches.origin_W[a:b], matches.ray_W[a:b], matches.point_M[a:b]
    k, w = matches.keypoint[a:b], matches.inverse_sigma[a:b]
    max_iterations, inverse_tilt = settings.max_iterations, settings.inverse_tilt
    best_R, best_t, H = poses.R_M_W[i], poses.p_M_W[i], poses.information[i]
    best_used = poses.is_inlier[a:b]
    count = len(k)
    keypoints = min(count, 1)
    w_loose = np.empty(count)
    for j in range(count):
        w_loose[j] = w[j] / _LOOSE
        if j > 0 and k[j] != k[j - 1]:
            keypoints += 1
    state = np.empty(1, dtype=np.uint64)
    state[0] = matches.seed[i]
    used = np.zeros(count, dtype=np.bool_)
    best_cost, best_inliers = float(keypoints), 0
    best_loose = best_cost
    R_guess, t_guess = np.empty((2, 3, 3)), np.empty((2, 3))
    R, t = np.empty((3, 3)), np.empty(3)
    needed, done = max_iterations, 0
    sample = np.empty(2, dtype=np.int64)
    while done < needed and keypoints >= 3:
        done += 1
        for s in range(_draw(state, sample, k, o, f, X, R_guess, t_guess)):
            _copy_pose(R_guess[s], t_guess[s], R, t)
            cost, inliers = _score(R, t, o, f, X, k, w_loose, used)
            if cost >= best_loose or inliers < 3:
                continue
            best_loose = cost
            if not _refine(R, t, o, f, X, w_loose, used, inverse_tilt, 3, H):
                continue
            cost, inliers = _polish(R, t, o, f, X, k, w, used, inverse_tilt, 2)
            if cost >= best_cost:
                continue
            best_cost, best_inliers = cost, inliers
            _copy_pose(R, t, best_R, best_t)
            for j in range(count):
                best_used[j] = used[j]
            miss = 1.0 - (inliers / count) ** len(sample)
            if miss < 1e-9:
                needed = done
            else:
                wanted = np.log(1.0 - _CONFIDENCE) / np.log(miss)
                needed = min(max_iterations, max(int(wanted) + 1, 10))
    H[:] = 0.0
    if best_inliers >= 3:
        best_cost, best_inliers = _polish(
            best_R, best_t, o, f, X, k, w, best_used, inverse_tilt, 10
        )
        g = np.empty(6)
        _accumulate(best_R, best_t, o, f, X, w, best_used, inverse_tilt, H, g)
    poses.cost[i], poses.inlier_count[i] = best_cost, best_inliers


@compiled(parallel=True)
def search_poses(matches, settings, poses):  # type: ignore[no-untyped-def]
    """Search the pose of every problem.

    Args:
        matches: `absolute_pose.LevelProblems`, sorted by problem and keypoint.
        settings: SearchSettings.
        poses: `absolute_pose.LevelSolutions`, filled in.
    """
    for problem in prange(len(matches.start) - 1):
        _search_pose(np.int64(problem), matches, settings, poses)
