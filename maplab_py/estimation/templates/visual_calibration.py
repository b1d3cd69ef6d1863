"""Visual terms whose cameras are estimated too: the same elimination with a dense border.

Beside its pose an observation touches the CAMERA_COLUMNS numbers of its camera: extrinsics, time
offset, intrinsics. With their Jacobian C_o (2 x CAMERA_COLUMNS) and V_c = sum Q_o' C_o over the
landmark's observations by camera c, eliminating the landmark leaves (Y, z as in `visual`,
Z_c = L^-1 V_c)

    C_o' P_o - Z_c' Y_o   between camera c and pose k(o),
    C_o' C_o - Z_c' Z_d   between cameras c and d,
    C_o' r_o - Z_c' z     in the gradient of camera c.

A camera whose clock is late by t sees a landmark where its pixel was t earlier: the residual gets
uv_motion t, where uv_motion is the pixel's velocity from the states' velocities (Qin and Shen,
Online Temporal Calibration for Monocular Visual-Inertial Systems, IROS 2018, with the velocity
from the states instead of from the neighbouring image).
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_time_offset(out, uv_motion, time_offset, o, c):
    """Shift the residual by the time offset and write its column."""
    out[0] += uv_motion[o, 0] * time_offset[c, 0]
    out[1] += uv_motion[o, 1] * time_offset[c, 0]
    out[33] = uv_motion[o, 0]
    out[34] = uv_motion[o, 1]


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_camera(out, c, k, s, V, border, square, camera_gradient, camera_diagonal):
    """Add one observation's share to V[s] of its camera c, border, square, gradient, diagonal."""
    for w in range(CAMERA_COLUMNS):
        a, b = out[21 + 2 * w], out[22 + 2 * w]
        if a == 0.0 and b == 0.0:
            continue
        V[s, 0, w] += a * out[15] + b * out[16]
        V[s, 1, w] += a * out[17] + b * out[18]
        V[s, 2, w] += a * out[19] + b * out[20]
        camera_gradient[c, w] += a * out[0] + b * out[1]
        camera_diagonal[c, w] += a * a + b * b
        for e in range(6):
            border[c, k, w, e] += a * out[3 + 2 * e] + b * out[4 + 2 * e]
        for x in range(CAMERA_COLUMNS):
            square[c, c, w, x] += a * out[21 + 2 * x] + b * out[22 + 2 * x]


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def subtract_cameras(
    first, last, base, pose_of, cameras, count, Y, V, f, g, border, square, camera_gradient
):
    """Turn V into Z = L^-1 V and subtract Z'Y, Z'Z and Z'z."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for s in range(count):
        c = cameras[s]
        for w in range(CAMERA_COLUMNS):
            y0 = V[s, 0, w] * f[0]
            y1 = (V[s, 1, w] - f[1] * y0) * f[2]
            y2 = (V[s, 2, w] - f[3] * y0 - f[4] * y1) * f[5]
            V[s, 0, w], V[s, 1, w], V[s, 2, w] = y0, y1, y2
            camera_gradient[c, w] -= y0 * z0 + y1 * z1 + y2 * z2
        for o in range(first, last):
            n, k = o - base, pose_of[o]
            for w in range(CAMERA_COLUMNS):
                y0, y1, y2 = V[s, 0, w], V[s, 1, w], V[s, 2, w]
                for e in range(6):
                    border[c, k, w, e] -= y0 * Y[n, 0, e] + y1 * Y[n, 1, e] + y2 * Y[n, 2, e]
    for s in range(count):
        for t in range(count):
            c, d = cameras[s], cameras[t]
            for w in range(CAMERA_COLUMNS):
                y0, y1, y2 = V[s, 0, w], V[s, 1, w], V[s, 2, w]
                for x in range(CAMERA_COLUMNS):
                    square[c, d, w, x] -= y0 * V[t, 0, x] + y1 * V[t, 1, x] + y2 * V[t, 2, x]


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def slot_of(camera, cameras, count):
    """Return the place of a camera among those of the landmark, or `count` for a new one."""
    for s in range(count):
        if cameras[s] == camera:
            return s
    return count


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_calibrating_observations(
    first, last, base, landmark, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses,
    extrinsics, parameters, points, prior, uv_motion, time_offset, pose_square, grad, diag, border,
    square, camera_gradient, camera_diagonal, Y, V, cameras, out, h, g,
):  # fmt: skip
    """Evaluate a landmark's observations; return the sum of rho and the number of its cameras."""
    total, count = begin_landmark(points, prior, landmark, h, g), 0
    for o in range(first, last):
        n = o - base
        if inverse_sigma[o] == 0.0:
            Y[n] = 0.0
            continue
        k, c = pose_of[o], camera_of[o]
        reproject(poses, k, extrinsics, c, parameters, points, landmark, uv, o, out)
        add_time_offset(out, uv_motion, time_offset, o, c)
        total += weighted(out, inverse_sigma[o], loss_kind, scale2[o])
        add_landmark_sums(out, h, g)
        add_pose(out, n, k, Y, pose_square, grad, diag)
        s = slot_of(c, cameras, count)
        if s == count:
            cameras[s] = c
            V[s] = 0.0
            count += 1
        add_camera(out, c, k, s, V, border, square, camera_gradient, camera_diagonal)
    return total, count


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def eliminate_calibrating(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, prior, uv_motion, time_offset, plan, damping, move_points, Y, pose_square, gradient,
    diagonal, border, square, camera_gradient, camera_diagonal, cost, blocks,
):  # fmt: skip
    """Form the reduced normal equations of poses and cameras.

    Out, beside those of `eliminate`: border (chunks, C, P, W, 6), square (chunks, C, C, W, W),
    camera_gradient and camera_diagonal (chunks, C, W), W = CAMERA_COLUMNS. Chunk 0 holds the sums
    of poses; those of cameras remain to be added. Everything but Y is zero at first.
    """
    for slab in range(len(plan.slab_start) - 1):
        base = start[plan.slab_start[slab]]
        for chunk in prange(len(cost)):
            B, C = border[chunk], square[chunk]
            grad, cgrad, cdiag = gradient[chunk], camera_gradient[chunk], camera_diagonal[chunk]
            V = np.empty((len(extrinsics), 3, CAMERA_COLUMNS))
            cameras = np.empty(len(extrinsics), dtype=np.int64)
            out, h, f, g = np.empty(NUM_OUT), np.empty(6), np.empty(6), np.empty(3)
            total = 0.0
            for landmark in range(plan.chunk_start[slab, chunk], plan.chunk_start[slab, chunk + 1]):
                first, last = start[landmark], start[landmark + 1]
                rho, count = add_calibrating_observations(
                    first, last, base, landmark, pose_of, camera_of, uv, inverse_sigma, scale2,
                    loss_kind, poses, extrinsics, parameters, points, prior, uv_motion, time_offset,
                    pose_square[chunk], grad, diagonal[chunk], B, C, cgrad, cdiag, Y, V, cameras,
                    out, h, g,
                )  # fmt: skip
                total += rho
                if move_points:
                    factor_3x3(h, damping, f)
                    eliminate_landmark(first, last, base, pose_of, grad, Y, f, g)
                    subtract_cameras(
                        first, last, base, pose_of, cameras, count, Y, V, f, g, B, C, cgrad
                    )
            cost[chunk] += total
        if move_points:
            subtract_views(plan, slab, base, pose_of, inverse_sigma, Y, blocks)
    add_chunks(plan, pose_square, gradient, diagonal, cost, blocks)


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def substitute_calibrating(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, prior, uv_motion, time_offset, pose_step, camera_step, damping, move_points, chunk_start,
    new_poses, new_extrinsics, new_parameters, new_time_offset, new_points, sums,
):  # fmt: skip
    """Step the landmarks for given steps of poses (P, 6) and cameras (C, W); see `substitute`."""
    chunks = sums.shape[0]
    for chunk in prange(chunks):
        out, h, f, g = np.empty(NUM_OUT), np.empty(6), np.empty(6), np.empty(3)
        d = np.zeros(3)
        new_cost, decrease = 0.0, 0.0
        for landmark in range(chunk_start[chunk], chunk_start[chunk + 1]):
            first, last = start[landmark], start[landmark + 1]
            begin_landmark(points, prior, landmark, h, g)
            for o in range(first, last):
                if inverse_sigma[o] == 0.0:
                    continue
                k, c = pose_of[o], camera_of[o]
                reproject(poses, k, extrinsics, c, parameters, points, landmark, uv, o, out)
                add_time_offset(out, uv_motion, time_offset, o, c)
                weighted(out, inverse_sigma[o], loss_kind, scale2[o])
                decrease += out[0] * out[0] + out[1] * out[1]
                for e in range(6):
                    out[0] += out[3 + 2 * e] * pose_step[k, e]
                    out[1] += out[4 + 2 * e] * pose_step[k, e]
                for w in range(CAMERA_COLUMNS):
                    out[0] += out[21 + 2 * w] * camera_step[c, w]
                    out[1] += out[22 + 2 * w] * camera_step[c, w]
                decrease -= out[0] * out[0] + out[1] * out[1]
                add_landmark_sums(out, h, g)
            d[:] = 0.0
            if move_points:
                factor_3x3(h, damping, f)
                decrease += step_landmark(h, f, g, d)
            for j in range(3):
                new_points[landmark, j] = points[landmark, j] + d[j]
            new_cost += begin_landmark(new_points, prior, landmark, h, g)
            for o in range(first, last):
                if inverse_sigma[o] == 0.0:
                    continue
                c = camera_of[o]
                reproject_only(
                    new_poses, pose_of[o], new_extrinsics, c, new_parameters, new_points, landmark,
                    uv, o, out,
                )  # fmt: skip
                add_time_offset(out, uv_motion, new_time_offset, o, c)
                s = (out[0] * out[0] + out[1] * out[1]) * inverse_sigma[o] * inverse_sigma[o]
                new_cost += robust(loss_kind, s, scale2[o])[0]
        sums[chunk, 0] = new_cost
        sums[chunk, 1] = decrease
    for chunk in range(1, chunks):
        sums[0, 0] += sums[chunk, 0]
        sums[0, 1] += sums[chunk, 1]


@njit(parallel=True, cache=True, error_model="numpy")
def pixel_motion(
    start, pose_of, camera_of, uv, poses, extrinsics, parameters, points, tangent, motion
):
    """Write the velocity [px/s] of every projection for velocities (P, 6) of the poses."""
    for landmark in prange(len(start) - 1):
        out = np.empty(NUM_OUT)
        for o in range(start[landmark], start[landmark + 1]):
            k = pose_of[o]
            reproject(poses, k, extrinsics, camera_of[o], parameters, points, landmark, uv, o, out)
            a, b = 0.0, 0.0
            for e in range(6):
                a += out[3 + 2 * e] * tangent[k, e]
                b += out[4 + 2 * e] * tangent[k, e]
            motion[o, 0] = a
            motion[o, 1] = b
