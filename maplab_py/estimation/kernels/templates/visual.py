"""Visual terms: landmarks are eliminated slab by slab as they are evaluated.

For one landmark with observations o of poses k(o), whitened and robustly weighted Jacobians P_o
(2 x 6, pose) and Q_o (2 x 3, landmark), and residuals r_o, the normal equations are

    [ sum P'P   W' ] [ pose steps    ]     [ sum P'r ]
    [   W       H  ] [ landmark step ] = - [ sum Q'r ],   W_o = Q_o' P_o,  H = sum Q_o' Q_o.

With H = L L' (3 x 3), Y_o = L^-1 W_o and z = L^-1 sum Q'r, eliminating the landmark leaves
-Y_b' Y_a at the pose pair (k(b), k(a)) and -Y_o' z in the gradient of k(o): the Schur complement,
formed without storing any Jacobian (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000,
section 6.1; Agarwal et al., Bundle Adjustment in the Large, 2010). After the poses are solved for,
a second pass evaluates the same Jacobians again, gives the landmark steps, and in the same sweep
the new cost and the decrease that the quadratic model promised. Landmarks whose step does not keep
its promise take further ones.

The elimination takes two turns per slab of landmarks (see `visual_structure`):

1. by landmark: evaluate, sum P'P, P'r and H, leave Y of every observation of the slab;
2. by pose: for every observation b from there and every a of the same landmark up to b, subtract
   Y_b' Y_a in the pose's own row of blocks. A row is short enough to stay in the fastest cache,
   and belongs to one thread. What a slab leaves in a row is added to the storage of the system,
   where the factorisation wants it: the blocks are never listed.

The result does not depend on how many threads there are, bit for bit: sums of the first turn are
those of a fixed number of chunks, added in a fixed order; a row is summed in the order of its views.

A landmark may have a prior, a place and the inverse of its standard deviation, which adds to H, to
Q'r and to the cost.

Where cameras are estimated, an observation touches the W numbers of its camera, too: extrinsics,
delays, intrinsics. With their Jacobian C_o (2 x W), V_c = sum Q_o' C_o
over the landmark's observations by camera c, and Z_c = L^-1 V_c, eliminating the landmark leaves

    C_o' P_o - Z_c' Y_o   between camera c and pose k(o): the border,
    C_o' C_o - Z_c' Z_d   between cameras c and d,
    C_o' r_o - Z_c' z     in the gradient of camera c.

A camera whose clock is late by t sees a landmark where its pixel was t earlier: the residual gets
uv_motion t, where uv_motion is the pixel's velocity from the states' velocities (Qin and Shen,
Online Temporal Calibration for Monocular Visual-Inertial Systems, IROS 2018, with the velocity
from the states instead of from the neighbouring image). Row v of a rolling shutter is read v line
delays l after the first one: t becomes t + v l, and a row of uv_motion is [px/s, px/s, v] (Li, Kim and
Mourikis, Real-time motion tracking on a cellphone using inertial sensing and a rolling-shutter camera,
ICRA 2013, section IV, to first order in the time within an image). Without cameras to estimate W is zero.

This file is a template: it is compiled as one module with `camera`, the camera models and the second pass
(`visual_step`), see `codegen.kernels`.
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def reproject(poses, k, cameras, c, points, landmark, uv, o, out, columns):
    """Write residual, depth and Jacobian of one observation to `out`; the camera's if it has columns."""
    axes, parameters = cameras
    R = rotation(poses, k)
    x, y, z = (
        points[landmark, 0] - poses[k, 4],
        points[landmark, 1] - poses[k, 5],
        points[landmark, 2] - poses[k, 6],
    )
    b0 = R[0] * x + R[3] * y + R[6] * z
    b1 = R[1] * x + R[4] * y + R[7] * z
    b2 = R[2] * x + R[5] * y + R[8] * z
    c0, c1, c2 = from_axes(axes, c, b0 - axes[c, 9], b1 - axes[c, 10], b2 - axes[c, 11])
    u, v, u0, u1, u2, v0, v1, v2 = project(parameters, c, c0, c1, c2)
    out[0], out[1], out[2] = u - uv[o, 0], v - uv[o, 1], c2
    for i in range(2):
        if i == 1:
            u0, u1, u2 = v0, v1, v2
        p0, p1, p2 = to_axes(axes, c, u0, u1, u2)
        g0 = R[0] * p0 + R[1] * p1 + R[2] * p2
        g1 = R[3] * p0 + R[4] * p1 + R[5] * p2
        g2 = R[6] * p0 + R[7] * p1 + R[8] * p2
        t0, t1, t2 = cross(p0, p1, p2, b0, b1, b2)
        write_row(out, POSE + i, -g0, -g1, -g2)
        write_row(out, POSE + 6 + i, t0, t1, t2)
        write_row(out, LANDMARK + i, g0, g1, g2)
        if columns > 0:
            t0, t1, t2 = cross(u0, u1, u2, c0, c1, c2)
            write_row(out, CAMERA + i, -p0, -p1, -p2)
            write_row(out, CAMERA + 6 + i, t0, t1, t2)
    if columns > 0:
        project_by_parameters(parameters, c, c0, c1, c2, out, INTRINSICS)


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def reproject_only(poses, k, cameras, c, points, landmark, uv, o, out):
    """Write residual and depth of one observation to `out`."""
    axes, parameters = cameras
    R = rotation(poses, k)
    x, y, z = (
        points[landmark, 0] - poses[k, 4],
        points[landmark, 1] - poses[k, 5],
        points[landmark, 2] - poses[k, 6],
    )
    b0 = R[0] * x + R[3] * y + R[6] * z - axes[c, 9]
    b1 = R[1] * x + R[4] * y + R[7] * z - axes[c, 10]
    b2 = R[2] * x + R[5] * y + R[8] * z - axes[c, 11]
    c0, c1, c2 = from_axes(axes, c, b0, b1, b2)
    pixel = project(parameters, c, c0, c1, c2)
    out[0], out[1], out[2] = pixel[0] - uv[o, 0], pixel[1] - uv[o, 1], c2


@rows_of_six
def add_pose(out, n, k, Y, square, grad):
    """Write W = Q'P of one observation to Y[n]; add P'P to square[k] and P'r to grad[k]."""
    p = row(out[POSE], out[POSE + 2], out[POSE + 4], out[POSE + 6], out[POSE + 8], out[POSE + 10])
    q = row(
        out[POSE + 1], out[POSE + 3], out[POSE + 5], out[POSE + 7], out[POSE + 9], out[POSE + 11]
    )
    for i in range(3):
        Y[n, i] = p * out[LANDMARK + 2 * i] + q * out[LANDMARK + 2 * i + 1]
    grad[k] = grad[k] + (p * out[0] + q * out[1])
    for c in range(6):
        square[k, c] = square[k, c] + (out[POSE + 2 * c] * p + out[POSE + 2 * c + 1] * q)


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def step_landmark(h, f, g, d):
    """Solve H d = -g with the factor f of the damped H; return the decrease that d promises."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    d[2] = -z2 * f[5]
    d[1] = (-z1 - f[4] * d[2]) * f[2]
    d[0] = (-z0 - f[1] * d[1] - f[3] * d[2]) * f[0]
    decrease = -2.0 * (d[0] * g[0] + d[1] * g[1] + d[2] * g[2])
    decrease -= h[0] * d[0] * d[0] + h[2] * d[1] * d[1] + h[5] * d[2] * d[2]
    return decrease - 2.0 * (h[1] * d[0] * d[1] + h[3] * d[0] * d[2] + h[4] * d[1] * d[2])


@rows_of_six
def subtract_product(S, k, Y, b, a):
    """Compute S[k] -= Y[b]' Y[a]: a third of an elimination."""
    p = Y[a, 0]
    q = Y[a, 1]
    r = Y[a, 2]
    for c in range(6):
        S[k, c] = S[k, c] - Y[b, 0, c] * p - Y[b, 1, c] * q - Y[b, 2, c] * r


@rows_of_six
def eliminate_observation(n, k, f, z0, z1, z2, Y, grad):
    """Turn W of an observation into Y = L^-1 W and subtract Y' z from grad[k]."""
    p = Y[n, 0] * f[0]
    q = (Y[n, 1] - f[1] * p) * f[2]
    r = (Y[n, 2] - f[3] * p - f[4] * q) * f[5]
    Y[n, 0] = p
    Y[n, 1] = q
    Y[n, 2] = r
    grad[k] = grad[k] - (p * z0 + q * z1 + r * z2)


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def eliminate_landmark(first, last, base, pose_of, grad, Y, f, g):
    """Turn W of a landmark's observations into Y = L^-1 W and subtract Y_o' z from grad."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for o in range(first, last):
        eliminate_observation(o - base, pose_of[o], f, z0, z1, z2, Y, grad)


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_part(S, k, i, j, target, numbers, row, col, place):
    """Add the part S[k, 3 i.., 3 j..] (3 x 3) at node row and column of the system."""
    if target.position[row] >= target.position[col]:
        at, leading = target.column_start[col] + place, target.leading[col]
        for c in range(3):
            for r in range(3):
                numbers[at + c * leading + r] += S[k, 3 * i + r, 3 * j + c]
    else:
        at, leading = target.column_start[row] + place, target.leading[row]
        for r in range(3):
            for c in range(3):
                numbers[at + r * leading + c] += S[k, 3 * i + r, 3 * j + c]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_pose_block(S, k, plan, block, row, target, numbers):
    """Add S[k] (6 x 6), a block of the pose `row`, to the system; a diagonal block's lower triangle."""
    col, each = plan.cols[block], target.nodes_per_vertex
    for i in range(2):
        for j in range(2):
            if col < row or i >= j:
                place = target.places[4 * block + 2 * i + j]
                add_part(S, k, i, j, target, numbers, each * row + i, each * col + j, place)


@compiled(parallel=True, fastmath={"contract", "nsz"})
def subtract_views(plan, slab, base, pose_of, inverse_sigma, Y, target, numbers):
    """Subtract Y_b' Y_a of all pairs of a slab, block row by block row.

    A row is summed up in a small matrix first, which stays in the fastest cache.
    """
    num_poses, num_observations = len(plan.row_start) - 1, len(pose_of)
    for piece in prange(plan.piece_start.shape[1] - 1):
        place_of = np.empty(num_poses, np.int64)  # by column, in the row at hand
        S = np.empty((plan.widest_row, 6, 6))
        for row in range(plan.piece_start[slab, piece], plan.piece_start[slab, piece + 1]):
            low, high = plan.view_start[slab, row], plan.view_start[slab, row + 1]
            if low == high:
                continue
            begin, end = plan.row_start[row], plan.row_start[row + 1]
            for block in range(begin, end):
                place_of[plan.cols[block]] = block - begin
            S[: end - begin] = 0.0
            for view in range(low, high):
                b = plan.views[view]
                if inverse_sigma[b] == 0.0:
                    continue
                first = plan.first[b]
                for a in range(first, b + 1):
                    subtract_product(S, place_of[pose_of[a]], Y, b - base, a - base)
                a = b + 1  # other cameras of the rig: pairs of the pose with itself
                while a < num_observations and plan.first[a] == first and pose_of[a] == row:
                    subtract_product(S, place_of[row], Y, b - base, a - base)
                    a += 1
            for block in range(begin, end):
                add_pose_block(S, block - begin, plan, block, row, target, numbers)


@compiled()
def add_chunks(plan, square, gradient, cost, target, numbers):
    """Add the sums of all chunks into chunk 0, always in the same order, and P'P to the system."""
    chunks = square.shape[0]
    for pose in range(square.shape[1]):
        for chunk in range(1, chunks):
            for c in range(6):
                for e in range(6):
                    square[0, pose, c, e] += square[chunk, pose, c, e]
                gradient[0, pose, c] += gradient[chunk, pose, c]
        add_pose_block(square[0], pose, plan, plan.row_start[pose + 1] - 1, pose, target, numbers)
    for chunk in range(1, chunks):
        cost[0] += cost[chunk]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_delay(out, uv_motion, timing, o, c):
    """Shift the residual by the delay of the pixel's row."""
    delay = timing[c, 0]
    if timing.shape[1] > 1:
        delay += timing[c, 1] * uv_motion[o, 2]
    out[0] += uv_motion[o, 0] * delay
    out[1] += uv_motion[o, 1] * delay


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_delay_columns(out, uv_motion, timing, o):
    """Write the columns of the image delay and of the line delay, zero where it is not estimated."""
    row = uv_motion[o, 2] if timing.shape[1] > 1 else 0.0
    for i in range(2):
        out[DELAY + i] = uv_motion[o, i]
        out[DELAY + 2 + i] = uv_motion[o, i] * row
        out[DELAY + 4 + i] = 0.0


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_camera(out, columns, c, k, s, V, border, square, camera_gradient, camera_diagonal):
    """Add one observation's share to V[s] of its camera c, border, square, gradient, diagonal."""
    for w in range(columns):
        a, b = out[CAMERA + 2 * w], out[CAMERA + 2 * w + 1]
        if a == 0.0 and b == 0.0:
            continue
        for i in range(3):
            V[s, i, w] += a * out[LANDMARK + 2 * i] + b * out[LANDMARK + 2 * i + 1]
        camera_gradient[c, w] += a * out[0] + b * out[1]
        camera_diagonal[c, w] += a * a + b * b
        for e in range(6):
            border[c, k, w, e] += a * out[POSE + 2 * e] + b * out[POSE + 2 * e + 1]
        for x in range(columns):
            square[c, c, w, x] += a * out[CAMERA + 2 * x] + b * out[CAMERA + 2 * x + 1]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def eliminate_cameras(cameras, count, columns, V, f, g, square, camera_gradient):
    """Turn V of the landmark's cameras into Z = L^-1 V and subtract Z'Z and Z'z."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for s in range(count):
        c = cameras[s]
        for w in range(columns):
            y0 = V[s, 0, w] * f[0]
            y1 = (V[s, 1, w] - f[1] * y0) * f[2]
            y2 = (V[s, 2, w] - f[3] * y0 - f[4] * y1) * f[5]
            V[s, 0, w], V[s, 1, w], V[s, 2, w] = y0, y1, y2
            camera_gradient[c, w] -= y0 * z0 + y1 * z1 + y2 * z2
    for s in range(count):
        for t in range(count):
            c, d = cameras[s], cameras[t]
            for w in range(columns):
                y0, y1, y2 = V[s, 0, w], V[s, 1, w], V[s, 2, w]
                for x in range(columns):
                    square[c, d, w, x] -= y0 * V[t, 0, x] + y1 * V[t, 1, x] + y2 * V[t, 2, x]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def subtract_border(first, last, base, pose_of, cameras, count, columns, Y, V, border):
    """Subtract Z'Y of a landmark's observations after `eliminate_cameras` has turned V into Z."""
    for s in range(count):
        c = cameras[s]
        for o in range(first, last):
            n, k = o - base, pose_of[o]
            for w in range(columns):
                y0, y1, y2 = V[s, 0, w], V[s, 1, w], V[s, 2, w]
                for e in range(6):
                    border[c, k, w, e] -= y0 * Y[n, 0, e] + y1 * Y[n, 1, e] + y2 * Y[n, 2, e]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def slot_of(camera, cameras, count):
    """Return the place of a camera among those of the landmark, or `count` for a new one."""
    for s in range(count):
        if cameras[s] == camera:
            return s
    return count


@compiled(parallel=True, fastmath={"contract", "nsz"})
def eliminate(data, at, prior, rule, plan, Y, sums, cost, target, numbers):
    """Form the reduced normal equations of poses and, where cameras have columns, cameras.

    In: `data`, `at` and `rule` as in `kernels.visual_arguments`. Room: Y (observations of the largest
    slab, 3, 6).
    Out: `sums`, of which the camera's parts remain to be added over chunks; cost (chunks,), the sum
    of rho, whose chunk 0 holds the sum over all at the end, as those of the poses do. Sums and cost are
    zero at first. The blocks of poses are added to `numbers`, the storage of the system, where `target`
    says. The numbers are an argument of their own: numba drops what a parallel loop writes into an
    array unpacked from a tuple.
    """
    start, pose_of, camera_of, uv, inverse_sigma, scale2, uv_motion = data
    poses, extrinsics, parameters, points, timing = at
    loss_kind, damping, move_points = rule
    square, gradient, border, camera_square, camera_gradient, camera_diagonal = sums
    axes, columns = camera_axes(extrinsics), camera_gradient.shape[2]
    for slab in range(len(plan.slab_start) - 1):
        base = start[plan.slab_start[slab]]
        for chunk in prange(len(cost)):
            grad, pose_square = gradient[chunk], square[chunk]
            B, C = border[chunk], camera_square[chunk]
            cgrad, cdiag = camera_gradient[chunk], camera_diagonal[chunk]
            V = np.empty((len(extrinsics), 3, columns))
            cameras = np.empty(len(extrinsics), dtype=np.int64)
            out = np.empty(NUM_OUT + 2 * columns)
            h, f, g = np.empty(6), np.empty(6), np.empty(3)
            total = 0.0
            for landmark in range(plan.chunk_start[slab, chunk], plan.chunk_start[slab, chunk + 1]):
                first, last = start[landmark], start[landmark + 1]
                rho, count = begin_landmark(points, prior, landmark, h, g), 0
                for o in range(first, last):
                    n = o - base
                    if inverse_sigma[o] == 0.0:
                        Y[n] = 0.0
                        continue
                    k, c = pose_of[o], camera_of[o]
                    reproject(
                        poses, k, (axes, parameters), c, points, landmark, uv, o, out, columns
                    )
                    if columns > 0:
                        add_delay(out, uv_motion, timing, o, c)
                    loss, factor = weighted(out, inverse_sigma[o], loss_kind, scale2[o])
                    rho += loss
                    add_landmark_sums(out, h, g)
                    add_pose(out, n, k, Y, pose_square, grad)
                    if columns > 0:
                        add_delay_columns(out, uv_motion, timing, o)
                        for w in range(CAMERA, CAMERA + 2 * columns):
                            out[w] *= factor
                        s = slot_of(c, cameras, count)
                        if s == count:
                            cameras[s] = c
                            V[s] = 0.0
                            count += 1
                        add_camera(out, columns, c, k, s, V, B, C, cgrad, cdiag)
                total += rho
                if move_points:
                    factor_3x3(h, damping, f)
                    eliminate_landmark(first, last, base, pose_of, grad, Y, f, g)
                    if columns > 0:
                        eliminate_cameras(cameras, count, columns, V, f, g, C, cgrad)
                        subtract_border(
                            first, last, base, pose_of, cameras, count, columns, Y, V, B
                        )
            cost[chunk] += total
        if move_points:
            subtract_views(plan, slab, base, pose_of, inverse_sigma, Y, target, numbers)
    add_chunks(plan, square, gradient, cost, target, numbers)


@compiled(parallel=True)
def evaluate(data, at, error_depth):
    """Write every observation's reprojection error [px] and depth [m] to error_depth (O, 2)."""
    start, pose_of, camera_of, uv = data.start, data.vertex, data.camera, data.uv_px
    poses, extrinsics, parameters, points, _ = at
    axes = camera_axes(extrinsics)
    for landmark in prange(len(start) - 1):
        out = np.empty(NUM_OUT)
        for o in range(start[landmark], start[landmark + 1]):
            k, c = pose_of[o], camera_of[o]
            reproject_only(poses, k, (axes, parameters), c, points, landmark, uv, o, out)
            error_depth[o, 0] = math.sqrt(out[0] * out[0] + out[1] * out[1])
            error_depth[o, 1] = out[2]


@compiled(parallel=True)
def pixel_motion(data, at, tangent, motion):
    """Write the velocity (O, 2) [px/s] of every projection for velocities (P, 6) of the poses."""
    start, pose_of, camera_of, uv = data.start, data.vertex, data.camera, data.uv_px
    poses, extrinsics, parameters, points, _ = at
    axes = camera_axes(extrinsics)
    for landmark in prange(len(start) - 1):
        out = np.empty(NUM_OUT)
        for o in range(start[landmark], start[landmark + 1]):
            k, c = pose_of[o], camera_of[o]
            reproject(poses, k, (axes, parameters), c, points, landmark, uv, o, out, 0)
            a, b = 0.0, 0.0
            for e in range(6):
                a += out[POSE + 2 * e] * tangent[k, e]
                b += out[POSE + 2 * e + 1] * tangent[k, e]
            motion[o, 0] = a
            motion[o, 1] = b
