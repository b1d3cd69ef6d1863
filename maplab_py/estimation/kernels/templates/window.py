"""The landmarks of a window: eliminated one after the other into one dense system.

A landmark h in the camera of its anchor frame a (`symbolic.residuals.anchored_reprojection`) is seen by
frames k. An observation from the anchor frame itself, with whichever camera, moves with the frame and
depends on h only. All others have Jacobians A_o by the anchor's pose, P_o by their own frame's and Q_o
by h. With H = sum Q_o' Q_o = L L' and W_f = sum Q_o' (A_o or P_o) by frame f, eliminating h subtracts
Y_f' Y_g, Y_f = L^-1 W_f, from the block of frames f, g, as in the template `visual`. There are few
frames, so the system is a dense matrix and every landmark a dense row of it; what it takes to step a
landmark is kept, since it is small, and no Jacobian is evaluated a second time.

Frames of the prior keep the linearisation point they had when they entered it. There Jacobians are
evaluated, residuals where the frame is (first-estimate Jacobians: Huang, Mourikis and Roumeliotis,
Observability-based Rules for Designing Consistent EKF SLAM Estimators, IJRR 2010). The landmark moves
with its anchor, so position and yaw of all frames together stay unobservable whatever h is.

A landmark of which no parallax has been seen has an expected inverse depth with a deviation. Without it the
noise of its rays would decide, and what is known of a translation is proportional to the inverse depth.

A landmark behind a camera counts as an outlier of a fixed size, without a Jacobian: no step gains by
moving a landmark there.

One thread does it all: another one would wait longer than it works.
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
BEHIND = 1e4
"""Squared whitened residual of a landmark behind a camera."""
SMALLEST_INVERSE_DEPTH = 1e-6
MOST_NEWTON_STEPS, CONVERGED = 50, 1e-10


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_frame(out, first, row, landmark, slot, Y, matrix, gradient, diagonal):
    """Add one observation's W, P'P and P'r of the frame whose Jacobian begins at out[first]."""
    r, s = out[0], out[1]
    p0, p1, p2 = out[LANDMARK], out[LANDMARK + 2], out[LANDMARK + 4]
    q0, q1, q2 = out[LANDMARK + 1], out[LANDMARK + 3], out[LANDMARK + 5]
    for c in range(6):
        x, y = out[first + 2 * c], out[first + 2 * c + 1]
        Y[landmark, slot, 0, c] += x * p0 + y * q0
        Y[landmark, slot, 1, c] += x * p1 + y * q1
        Y[landmark, slot, 2, c] += x * p2 + y * q2
        gradient[row + c] += x * r + y * s
        diagonal[row + c] += x * x + y * y
        for e in range(c + 1):
            matrix[row + c, row + e] += x * out[first + 2 * e] + y * out[first + 2 * e + 1]


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_pair(out, row, column, matrix):
    """Add P'A of one observation to the block of its frame, which is later than the anchor."""
    a0, a1, a2, a3 = out[ANCHOR], out[ANCHOR + 2], out[ANCHOR + 4], out[ANCHOR + 6]
    b0, b1, b2, b3 = out[ANCHOR + 1], out[ANCHOR + 3], out[ANCHOR + 5], out[ANCHOR + 7]
    a4, a5, b4, b5 = out[ANCHOR + 8], out[ANCHOR + 10], out[ANCHOR + 9], out[ANCHOR + 11]
    for c in range(6):
        x, y, k = out[POSE + 2 * c], out[POSE + 2 * c + 1], row + c
        matrix[k, column] += x * a0 + y * b0
        matrix[k, column + 1] += x * a1 + y * b1
        matrix[k, column + 2] += x * a2 + y * b2
        matrix[k, column + 3] += x * a3 + y * b3
        matrix[k, column + 4] += x * a4 + y * b4
        matrix[k, column + 5] += x * a5 + y * b5


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def subtract_slots(landmark, count, slots, Y, f, g, matrix, reduced_gradient):
    """Turn W of a landmark's frames into Y = L^-1 W; subtract Y'Y and Y'z.

    The form of the innermost product is that of `subtract_product` in the template `visual`.
    """
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    n = landmark
    for s in range(count):
        row = 15 * slots[n, s]
        for c in range(6):
            y0 = Y[n, s, 0, c] * f[0]
            y1 = (Y[n, s, 1, c] - f[1] * y0) * f[2]
            y2 = (Y[n, s, 2, c] - f[3] * y0 - f[4] * y1) * f[5]
            Y[n, s, 0, c], Y[n, s, 1, c], Y[n, s, 2, c] = y0, y1, y2
            reduced_gradient[row + c] -= y0 * z0 + y1 * z1 + y2 * z2
        for t in range(s + 1):
            k = 15 * slots[n, t]
            p0, p1, p2 = Y[n, t, 0, 0], Y[n, t, 0, 1], Y[n, t, 0, 2]
            p3, p4, p5 = Y[n, t, 0, 3], Y[n, t, 0, 4], Y[n, t, 0, 5]
            q0, q1, q2 = Y[n, t, 1, 0], Y[n, t, 1, 1], Y[n, t, 1, 2]
            q3, q4, q5 = Y[n, t, 1, 3], Y[n, t, 1, 4], Y[n, t, 1, 5]
            r0, r1, r2 = Y[n, t, 2, 0], Y[n, t, 2, 1], Y[n, t, 2, 2]
            r3, r4, r5 = Y[n, t, 2, 3], Y[n, t, 2, 4], Y[n, t, 2, 5]
            for c in range(6):
                p, q, r, j = Y[n, s, 0, c], Y[n, s, 1, c], Y[n, s, 2, c], row + c
                m0 = matrix[j, k] - p * p0 - q * q0 - r * r0
                m1 = matrix[j, k + 1] - p * p1 - q * q1 - r * r1
                m2 = matrix[j, k + 2] - p * p2 - q * q2 - r * r2
                m3 = matrix[j, k + 3] - p * p3 - q * q3 - r * r3
                m4 = matrix[j, k + 4] - p * p4 - q * q4 - r * r4
                m5 = matrix[j, k + 5] - p * p5 - q * q5 - r * r5
                matrix[j, k], matrix[j, k + 1], matrix[j, k + 2] = m0, m1, m2
                matrix[j, k + 3], matrix[j, k + 4], matrix[j, k + 5] = m3, m4, m5


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def eliminate(data, at, rule, system, kept):
    """Add all landmarks to the system, themselves eliminated; return the sum of rho.

    The reduced gradient gets only what the landmarks subtract; the gradient is added by the caller.
    """
    start, frame, camera, uv, inverse_sigma, scale2, anchor_frame, anchor_camera, expected = data
    poses, points, extrinsics, parameters = at
    loss, damping, poses_0, is_elsewhere = rule
    matrix, reduced_gradient, full_gradient, diagonal = system
    num_slots, slots, Y, factor, square, gradient = kept
    out, now, h, f, g = np.empty(NUM_OUT), np.empty(3), np.empty(6), np.empty(6), np.empty(3)
    total = 0.0
    for n in range(len(start) - 1):
        a, d, count = anchor_frame[n], anchor_camera[n], 0
        h[:], g[:] = 0.0, 0.0
        for o in range(start[n], start[n + 1]):
            k, c = frame[o], camera[o]
            if is_elsewhere[a] or is_elsewhere[k]:
                reproject_only(poses, a, k, extrinsics, d, c, parameters, points, n, uv, o, now)
                reproject(poses_0, a, k, extrinsics, d, c, parameters, points, n, uv, o, out)
                out[0], out[1], out[2] = now[0], now[1], now[2]
            else:
                reproject(poses, a, k, extrinsics, d, c, parameters, points, n, uv, o, out)
            if not out[2] > 0.0:
                total += rho_and_weight(loss, BEHIND, scale2[o])[0]
                continue
            total += weighted(out, inverse_sigma[o], loss, scale2[o])
            add_landmark_sums(out, h, g)
            if k == a:
                continue
            if count == 0:
                slots[n, 0], count = a, 1
                Y[n, 0] = 0.0
            if slots[n, count - 1] != k:
                slots[n, count] = k
                Y[n, count] = 0.0
                count += 1
            add_frame(out, ANCHOR, 15 * a, n, 0, Y, matrix, full_gradient, diagonal)
            add_frame(out, POSE, 15 * k, n, count - 1, Y, matrix, full_gradient, diagonal)
            add_pair(out, 15 * k, 15 * a, matrix)
        w = expected[n, 1]
        r = w * (points[n, 2] - expected[n, 0])
        h[5] += w * w
        g[2] += w * r
        total += r * r
        factor_3x3(h, damping, f)
        subtract_slots(n, count, slots, Y, f, g, matrix, reduced_gradient)
        num_slots[n] = count
        for i in range(6):
            factor[n, i], square[n, i] = f[i], h[i]
        for i in range(3):
            gradient[n, i] = g[i]
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def substitute(data, at, rule, kept, step, new):
    """Step the landmarks for the steps (n,) of all frames.

    In: `new` has the frames after the step. Out: its h (L, 3). Returns the new sum of rho, the
    decrease of half the sum of squares that the landmarks' steps promise, and their squared norm.
    """
    start, frame, camera, uv, inverse_sigma, scale2, anchor_frame, anchor_camera, expected = data
    points, damping, loss = at.h, rule.damping, rule.loss
    poses, new_points, extrinsics, parameters = new
    num_slots, slots, Y, factor, square, gradient = kept
    f, g, dh, out = np.empty(6), np.empty(3), np.empty(3), np.empty(NUM_OUT)
    promised, norm2, total = 0.0, 0.0, 0.0
    for n in range(len(start) - 1):
        for i in range(6):
            f[i] = factor[n, i]
        for i in range(3):
            g[i] = gradient[n, i]
        z0 = g[0] * f[0]
        z1 = (g[1] - f[1] * z0) * f[2]
        z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
        for s in range(num_slots[n]):
            row = 15 * slots[n, s]
            for c in range(6):
                z0 += Y[n, s, 0, c] * step[row + c]
                z1 += Y[n, s, 1, c] * step[row + c]
                z2 += Y[n, s, 2, c] * step[row + c]
        dh[2] = -z2 * f[5]
        dh[1] = (-z1 - f[4] * dh[2]) * f[2]
        dh[0] = (-z0 - f[1] * dh[1] - f[3] * dh[2]) * f[0]
        dh[2] = max(dh[2], SMALLEST_INVERSE_DEPTH - points[n, 2])
        for i in range(3):
            on_diagonal = square[n, i * (i + 3) // 2]
            added = damped(on_diagonal, damping) - on_diagonal
            promised += 0.5 * (added * dh[i] - g[i]) * dh[i]
            norm2 += dh[i] * dh[i]
            new_points[n, i] = points[n, i] + dh[i]
        a, d = anchor_frame[n], anchor_camera[n]
        for o in range(start[n], start[n + 1]):
            k, c = frame[o], camera[o]
            reproject_only(poses, a, k, extrinsics, d, c, parameters, new_points, n, uv, o, out)
            e2 = (out[0] * out[0] + out[1] * out[1]) * inverse_sigma[o] * inverse_sigma[o]
            total += rho_and_weight(loss, e2 if out[2] > 0.0 else BEHIND, scale2[o])[0]
        r = expected[n, 1] * (new_points[n, 2] - expected[n, 0])
        total += r * r
    return total, promised, norm2


@njit(nogil=True, cache=True, error_model="numpy")
def evaluate(data, at, error_depth):
    """Write every observation's reprojection error [px] and depth [m] to error_depth (O, 2)."""
    start, frame, camera, uv, _, _, anchor_frame, anchor_camera, _ = data
    poses, points, extrinsics, parameters = at
    out = np.empty(NUM_OUT)
    for n in range(len(start) - 1):
        a, d = anchor_frame[n], anchor_camera[n]
        for o in range(start[n], start[n + 1]):
            k, c = frame[o], camera[o]
            reproject_only(poses, a, k, extrinsics, d, c, parameters, points, n, uv, o, out)
            error_depth[o, 0] = math.sqrt(out[0] * out[0] + out[1] * out[1])
            error_depth[o, 1] = out[2] / points[n, 2]


@njit(nogil=True, cache=True, error_model="numpy")
def unproject(camera, uv, extrinsics, parameters, xy):
    """Find the places xy (N, 2) on the plane z = 1 of pixels (N, 2) by Newton's method.

    A landmark h = [x, y, 0] seen by the camera of its anchor has the pixel as residual. xy is given
    near the solution; what does not converge becomes not-a-number.
    """
    pose, h, out = np.zeros((1, 7)), np.zeros((1, 3)), np.empty(NUM_OUT)
    pose[0, 3] = 1.0
    for o in range(len(uv)):
        c = camera[o]
        h[0, 0], h[0, 1] = xy[o, 0], xy[o, 1]
        xy[o, 0], xy[o, 1] = np.nan, np.nan
        for _ in range(MOST_NEWTON_STEPS):
            reproject(pose, 0, 0, extrinsics, c, c, parameters, h, 0, uv, o, out)
            a, b, d, e = out[LANDMARK], out[LANDMARK + 2], out[LANDMARK + 1], out[LANDMARK + 3]
            determinant = a * e - b * d
            dx = (e * out[0] - b * out[1]) / determinant
            dy = (a * out[1] - d * out[0]) / determinant
            h[0, 0] -= dx
            h[0, 1] -= dy
            if dx * dx + dy * dy < CONVERGED * CONVERGED:
                xy[o, 0], xy[o, 1] = h[0, 0], h[0, 1]
                break
