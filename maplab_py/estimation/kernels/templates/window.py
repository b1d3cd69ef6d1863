"""The landmarks of a window: eliminated one after the other into one dense system.

A landmark h = [x / z, y / z, 1 / z] has the coordinates x, y, z in the camera of its anchor frame a and is
seen by frames k. Everything is multiplied by 1 / z, so that landmarks at infinity are regular (Civera et
al., Inverse Depth Parametrization for Monocular SLAM, TRO 2008, eq. (3)-(6), with the place in the image
instead of two angles). An observation from the anchor frame itself, with whichever camera, moves with
the frame and depends on h only. All others have Jacobians A_o by the anchor's pose, P_o by their own
frame's and Q_o by h. With H = sum Q_o' Q_o = L L' and W_f = sum Q_o' (A_o or P_o) by frame f,
eliminating h subtracts Y_f' Y_g, Y_f = L^-1 W_f, from the block of frames f, g, as in the template
`visual`. There are few frames, so the system is a dense matrix and every landmark a dense row of it;
what it takes to step a landmark is kept, since it is small, and no Jacobian is evaluated a second time.

Frames of the prior keep the linearisation point they had when they entered it. There Jacobians are
evaluated, residuals where the frame is (first-estimate Jacobians: Huang, Mourikis and Roumeliotis,
Observability-based Rules for Designing Consistent EKF SLAM Estimators, IJRR 2010). The landmark moves
with its anchor, so position and yaw of all frames together stay unobservable whatever h is.

A landmark of which no parallax has been seen has an expected inverse depth with a deviation. Without it the
noise of its rays would decide, and what is known of a translation is proportional to the inverse depth.

What depends on the cameras' calibration is in the template `window_calibration`, which comes before.

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


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def anchored_ray(poses, a, k, axes, d, h, n):
    """Return the landmark's ray in the body A of its anchor, in M, and from I in M, times 1 / z."""
    w = h[n, 2]
    a0, a1, a2 = to_axes(axes, d, h[n, 0], h[n, 1], 1.0)
    a0, a1, a2 = a0 + w * axes[d, 9], a1 + w * axes[d, 10], a2 + w * axes[d, 11]
    R = rotation(poses, a)
    return (
        a0, a1, a2,
        R[0] * a0 + R[1] * a1 + R[2] * a2 + w * (poses[a, 4] - poses[k, 4]),
        R[3] * a0 + R[4] * a1 + R[5] * a2 + w * (poses[a, 5] - poses[k, 5]),
        R[6] * a0 + R[7] * a1 + R[8] * a2 + w * (poses[a, 6] - poses[k, 6]),
    )  # fmt: skip


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def reproject(poses, rows, cameras, h, n, uv, o, out, J):
    """Write residual, depth times 1 / z, and Jacobians by frame k, anchor a and h to `out`.

    The Jacobian (2, K) by the calibration is written to J.
    """
    (a, d, k, c), (axes, parameters, timing, slope, columns, twist) = (
        rows,
        cameras,
    )  # frame and camera of the anchor, and those that see
    w, t = h[n, 2], lateness(timing, twist, k, c, uv[o, 1])
    a0, a1, a2, x, y, z = anchored_ray(poses, a, k, axes, d, h, n)
    A, R = rotation(poses, a), rotation(poses, k)
    b0 = R[0] * x + R[3] * y + R[6] * z
    b1 = R[1] * x + R[4] * y + R[7] * z
    b2 = R[2] * x + R[5] * y + R[8] * z
    e0, e1, e2 = b0, b1, b2
    if t != 0.0:
        e0, e1, e2 = moved(twist, k, w, t, b0, b1, b2)
    c0, c1, c2 = from_axes(axes, c, e0 - w * axes[c, 9], e1 - w * axes[c, 10], e2 - w * axes[c, 11])
    u, v, u0, u1, u2, v0, v1, v2 = project(parameters, c, c0, c1, c2)
    out[0], out[1], out[2] = u - uv[o, 0], v - uv[o, 1], c2
    is_calibrating = J.shape[1] > 0
    if is_calibrating:
        J[:, :] = 0.0
        add_intrinsics(J, columns, parameters, c, c0, c1, c2)
    for i in range(2):
        if i == 1:
            u0, u1, u2 = v0, v1, v2
        s0, s1, s2 = to_axes(axes, c, u0, u1, u2)  # by the point as the moved body sees it
        p0, p1, p2 = s0, s1, s2
        if t != 0.0:
            p0, p1, p2 = turned(twist, k, -t, s0, s1, s2)
        m0 = R[0] * p0 + R[1] * p1 + R[2] * p2
        m1 = R[3] * p0 + R[4] * p1 + R[5] * p2
        m2 = R[6] * p0 + R[7] * p1 + R[8] * p2
        write_row(out, ANCHOR + i, w * m0, w * m1, w * m2)
        write_row(out, POSE + i, -w * m0, -w * m1, -w * m2)
        t0, t1, t2 = cross(p0, p1, p2, b0, b1, b2)
        write_row(out, POSE + 6 + i, t0, t1, t2)
        by_w = m0 * (poses[a, 4] - poses[k, 4]) + m1 * (poses[a, 5] - poses[k, 5])
        by_w += m2 * (poses[a, 6] - poses[k, 6])
        by_w -= s0 * axes[c, 9] + s1 * axes[c, 10] + s2 * axes[c, 11]
        along = 0.0
        if len(twist) > 0:
            along = p0 * twist[k, 0] + p1 * twist[k, 1] + p2 * twist[k, 2]
            by_w -= t * along
        q0 = A[0] * m0 + A[3] * m1 + A[6] * m2
        q1 = A[1] * m0 + A[4] * m1 + A[7] * m2
        q2 = A[2] * m0 + A[5] * m1 + A[8] * m2
        by_w += q0 * axes[d, 9] + q1 * axes[d, 10] + q2 * axes[d, 11]
        t0, t1, t2 = cross(a0, a1, a2, q0, q1, q2)
        write_row(out, ANCHOR + 6 + i, t0, t1, t2)
        r0, r1, r2 = from_axes(axes, d, q0, q1, q2)
        write_row(out, LANDMARK + i, r0, r1, by_w)
        if not is_calibrating:
            continue
        add_columns(J, i, columns, c, 0, -w * s0, -w * s1, -w * s2)
        add_columns(J, i, columns, d, 0, w * q0, w * q1, w * q2)
        t0, t1, t2 = cross(u0, u1, u2, c0, c1, c2)
        add_rotation(J, i, columns, slope, c, t0, t1, t2)
        t0, t1, t2 = cross(h[n, 0], h[n, 1], 1.0, r0, r1, r2)
        add_rotation(J, i, columns, slope, d, t0, t1, t2)
        if len(twist) > 0:
            rate = -by_turn(twist, k, w, t, (b0, b1, b2), (s0, s1, s2)) - w * along
            if columns[c, DELAY] >= 0:
                J[i, columns[c, DELAY]] += rate
            if columns[c, DELAY + 1] >= 0:
                J[i, columns[c, DELAY + 1]] += rate * uv[o, 1]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def reproject_only(poses, rows, cameras, h, n, uv, o, out):
    """Write residual, and depth times 1 / z, to `out`."""
    (a, d, k, c), (axes, parameters, timing, _, _, twist) = (
        rows,
        cameras,
    )  # frame and camera of the anchor, and those that see
    w, R, t = h[n, 2], rotation(poses, k), lateness(timing, twist, k, c, uv[o, 1])
    _, _, _, x, y, z = anchored_ray(poses, a, k, axes, d, h, n)
    b0 = R[0] * x + R[3] * y + R[6] * z
    b1 = R[1] * x + R[4] * y + R[7] * z
    b2 = R[2] * x + R[5] * y + R[8] * z
    if t != 0.0:
        b0, b1, b2 = moved(twist, k, w, t, b0, b1, b2)
    c0, c1, c2 = from_axes(axes, c, b0 - w * axes[c, 9], b1 - w * axes[c, 10], b2 - w * axes[c, 11])
    pixel = project(parameters, c, c0, c1, c2)
    out[0], out[1], out[2] = pixel[0] - uv[o, 0], pixel[1] - uv[o, 1], c2


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
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


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
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


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
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


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def prepared(cameras, twist):
    """Return cameras as `reproject` takes them: their axes in place of their poses."""
    extrinsics, parameters, timing, slope, columns = cameras
    return camera_axes(extrinsics), parameters, timing, slope, columns, twist


@compiled(fastmath={"contract", "nsz"})
def eliminate(data, at, rule, system, kept):
    """Add all landmarks to the system, themselves eliminated; return the sum of rho.

    The reduced gradient gets only what the landmarks subtract; the gradient is added by the caller.
    """
    start, frame, camera, uv, inverse_sigma, scale2, anchor_frame, anchor_camera, expected = data
    poses, points, calibration, twist = at
    cameras = prepared(calibration, twist)
    loss, damping, poses_0, is_elsewhere = rule
    matrix, reduced_gradient, full_gradient, diagonal = system
    num_slots, slots, Y, Y_calibration, factor, square, gradient = kept
    J, first = np.empty((2, Y_calibration.shape[2])), 15 * len(poses)
    out, now, h, f, g = np.empty(NUM_OUT), np.empty(3), np.empty(6), np.empty(6), np.empty(3)
    total = 0.0
    for n in range(len(start) - 1):
        a, d, count = anchor_frame[n], anchor_camera[n], 0
        h[:], g[:] = 0.0, 0.0
        Y_calibration[n] = 0.0
        for o in range(start[n], start[n + 1]):
            k, c = frame[o], camera[o]
            if is_elsewhere[a] or is_elsewhere[k]:
                reproject_only(poses, (a, d, k, c), cameras, points, n, uv, o, now)
                reproject(poses_0, (a, d, k, c), cameras, points, n, uv, o, out, J)
                out[0], out[1], out[2] = now[0], now[1], now[2]
            else:
                reproject(poses, (a, d, k, c), cameras, points, n, uv, o, out, J)
            if not out[2] > 0.0:
                total += rho_and_weight(loss, BEHIND, scale2[o])[0]
                continue
            rho, whitening = weighted(out, inverse_sigma[o], loss, scale2[o])
            total += rho
            add_landmark_sums(out, h, g)
            if len(J[0]) > 0:
                add_calibration(
                    out, J, whitening, (a, k, first), n, Y_calibration, matrix, full_gradient,
                    diagonal,
                )  # fmt: skip
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
        if len(J[0]) > 0:
            subtract_calibration(
                n, count, slots, first, Y, Y_calibration, f, g, matrix, reduced_gradient
            )
        num_slots[n] = count
        for i in range(6):
            factor[n, i], square[n, i] = f[i], h[i]
        for i in range(3):
            gradient[n, i] = g[i]
    return total


@compiled(fastmath={"contract", "nsz"})
def substitute(data, at, rule, kept, step, new):
    """Step the landmarks for the steps (n,) of all frames.

    In: `new` has the frames after the step. Out: its h (L, 3). Returns the new sum of rho, the
    decrease of half the sum of squares that the landmarks' steps promise, and their squared norm.
    """
    start, frame, camera, uv, inverse_sigma, scale2, anchor_frame, anchor_camera, expected = data
    points, damping, loss = at.h, rule.damping, rule.loss
    poses, new_points, calibration, twist = new
    cameras, first = prepared(calibration, twist), 15 * len(poses)
    num_slots, slots, Y, Y_calibration, factor, square, gradient = kept
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
        for j in range(Y_calibration.shape[2]):
            z0 += Y_calibration[n, 0, j] * step[first + j]
            z1 += Y_calibration[n, 1, j] * step[first + j]
            z2 += Y_calibration[n, 2, j] * step[first + j]
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
            reproject_only(poses, (a, d, k, c), cameras, new_points, n, uv, o, out)
            e2 = (out[0] * out[0] + out[1] * out[1]) * inverse_sigma[o] * inverse_sigma[o]
            total += rho_and_weight(loss, e2 if out[2] > 0.0 else BEHIND, scale2[o])[0]
        r = expected[n, 1] * (new_points[n, 2] - expected[n, 0])
        total += r * r
    return total, promised, norm2


@compiled()
def evaluate(data, at, error_depth):
    """Write every observation's reprojection error [px] and depth [m] to error_depth (O, 2)."""
    start, frame, camera, uv, _, _, anchor_frame, anchor_camera, _ = data
    poses, points, calibration, twist = at
    cameras, out = prepared(calibration, twist), np.empty(NUM_OUT)
    for n in range(len(start) - 1):
        a, d = anchor_frame[n], anchor_camera[n]
        for o in range(start[n], start[n + 1]):
            k, c = frame[o], camera[o]
            reproject_only(poses, (a, d, k, c), cameras, points, n, uv, o, out)
            error_depth[o, 0] = math.sqrt(out[0] * out[0] + out[1] * out[1])
            error_depth[o, 1] = out[2] / points[n, 2]


@compiled()
def unproject(camera, uv, parameters, xy):
    """Find the places xy (N, 2) on the plane z = 1 of pixels (N, 2) by Newton's method.

    xy is given near the solution; what does not converge becomes not-a-number.
    """
    for o in range(len(uv)):
        c, x, y = camera[o], xy[o, 0], xy[o, 1]
        xy[o, 0], xy[o, 1] = np.nan, np.nan
        for _ in range(MOST_NEWTON_STEPS):
            u, v, a, b, _, d, e, _ = project(parameters, c, x, y, 1.0)
            u, v = u - uv[o, 0], v - uv[o, 1]
            determinant = a * e - b * d
            dx = (e * u - b * v) / determinant
            dy = (a * v - d * u) / determinant
            x -= dx
            y -= dy
            if dx * dx + dy * dy < CONVERGED * CONVERGED:
                xy[o, 0], xy[o, 1] = x, y
                break


@compiled(fastmath={"contract", "nsz"})
def reproject_map(seen, cameras, T_M_I, T_G_M, p_G, residual, jacobian, visible):
    """Project landmarks of a map; the frames' mission M has the pose T_G_M (1, 7) in the map's frame G.

    Out: whitened residuals (O, 2), their Jacobian (O, 2, 15) by the tangents of T_M_I and T_G_M and by
    p_G, and whether the landmark is visible (O,); both are zero where it is not.
    Source: Schneider 2019, Paper I, eq. (4.4).
    """
    frame, camera, landmark, uv, inverse_sigma = seen
    extrinsics, parameters, limits = cameras
    axes, G = camera_axes(extrinsics), rotation(T_G_M, 0)
    for o in range(len(frame)):
        k, c, n = frame[o], camera[o], landmark[o]
        x, y, z = p_G[n, 0] - T_G_M[0, 4], p_G[n, 1] - T_G_M[0, 5], p_G[n, 2] - T_G_M[0, 6]
        m0 = G[0] * x + G[3] * y + G[6] * z
        m1 = G[1] * x + G[4] * y + G[7] * z
        m2 = G[2] * x + G[5] * y + G[8] * z
        R = rotation(T_M_I, k)
        x, y, z = m0 - T_M_I[k, 4], m1 - T_M_I[k, 5], m2 - T_M_I[k, 6]
        b0 = R[0] * x + R[3] * y + R[6] * z
        b1 = R[1] * x + R[4] * y + R[7] * z
        b2 = R[2] * x + R[5] * y + R[8] * z
        c0, c1, c2 = from_axes(axes, c, b0 - axes[c, 9], b1 - axes[c, 10], b2 - axes[c, 11])
        length = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
        depth = c2 + limits[c, 0] * length
        visible[o] = (
            depth > limits[c, 1]
            and c2 > -limits[c, 2] * length
            and math.sqrt(c0 * c0 + c1 * c1) < limits[c, 3] * depth
        )
        if not visible[o]:
            residual[o] = 0.0
            jacobian[o] = 0.0
            continue
        u, v, u0, u1, u2, v0, v1, v2 = project(parameters, c, c0, c1, c2)
        s = inverse_sigma[o]
        residual[o, 0], residual[o, 1] = s * (u - uv[o, 0]), s * (v - uv[o, 1])
        for i in range(2):
            if i == 1:
                u0, u1, u2 = v0, v1, v2
            p0, p1, p2 = to_axes(axes, c, s * u0, s * u1, s * u2)
            q0 = R[0] * p0 + R[1] * p1 + R[2] * p2
            q1 = R[3] * p0 + R[4] * p1 + R[5] * p2
            q2 = R[6] * p0 + R[7] * p1 + R[8] * p2
            g0 = G[0] * q0 + G[1] * q1 + G[2] * q2
            g1 = G[3] * q0 + G[4] * q1 + G[5] * q2
            g2 = G[6] * q0 + G[7] * q1 + G[8] * q2
            J = jacobian[o, i]
            J[0], J[1], J[2] = -q0, -q1, -q2
            J[3], J[4], J[5] = cross(p0, p1, p2, b0, b1, b2)
            J[6], J[7], J[8] = -g0, -g1, -g2
            J[9], J[10], J[11] = cross(q0, q1, q2, m0, m1, m2)
            J[12], J[13], J[14] = g0, g1, g2
