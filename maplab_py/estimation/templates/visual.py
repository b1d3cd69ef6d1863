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
the new cost and the decrease that the quadratic model promised.

The elimination takes two turns per slab of landmarks (see `visual_structure`):

1. by landmark: evaluate, sum P'P, P'r and H, leave Y of every observation of the slab;
2. by pose: for every observation b from there and every a of the same landmark up to b, subtract
   Y_b' Y_a in the pose's own row of blocks. A row is short enough to stay in the fastest cache,
   and belongs to one thread.

The result does not depend on how many threads there are, bit for bit: sums of the first turn are
those of a fixed number of chunks, added in a fixed order; a row is summed in the order of its views.

A landmark may have a prior, a place and the inverse of its standard deviation, which adds to H, to
Q'r and to the cost.

This file is a template: `reproject` is generated for the camera models in use, and both are
compiled as one module (see `codegen.modules`).
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_pose(out, n, k, Y, square, grad, diag):
    """Write W = Q'P of one observation to Y[n]; add P'P to square[k], its diagonal and P'r."""
    for c in range(6):
        a, b = out[3 + 2 * c], out[4 + 2 * c]
        Y[n, 0, c] = a * out[15] + b * out[16]
        Y[n, 1, c] = a * out[17] + b * out[18]
        Y[n, 2, c] = a * out[19] + b * out[20]
        grad[k, c] += a * out[0] + b * out[1]
        diag[k, c] += a * a + b * b
        for e in range(6):
            square[k, c, e] += a * out[3 + 2 * e] + b * out[4 + 2 * e]


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_observations(
    first, last, base, landmark, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses,
    extrinsics, parameters, points, prior, square, grad, diag, Y, out, h, g,
):  # fmt: skip
    """Evaluate a landmark's observations; return the sum of rho.

    Adds P'P and P'r of the poses to square, grad and diag, leaves H in h, Q'r in g and W in Y,
    whose first row is that of observation `base`.
    """
    total = begin_landmark(points, prior, landmark, h, g)
    for o in range(first, last):
        n = o - base
        if inverse_sigma[o] == 0.0:
            Y[n] = 0.0
            continue
        k = pose_of[o]
        reproject(poses, k, extrinsics, camera_of[o], parameters, points, landmark, uv, o, out)
        total += weighted(out, inverse_sigma[o], loss_kind, scale2[o])
        add_landmark_sums(out, h, g)
        add_pose(out, n, k, Y, square, grad, diag)
    return total


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def subtract_product(S, k, Y, b, a):
    """Compute S[k] -= Y[b]' Y[a].

    Half the time of an elimination goes here, hence the plain form. Entries are named by all their
    indices, since a view like Y[b] counts references, which costs as much as the arithmetic. The
    compiler has to assume that S and Y overlap: what is read before the first number is written it
    need not read again. And each product is subtracted on its own, which is one instruction.
    """
    p0, p1, p2, p3, p4, p5 = Y[a, 0, 0], Y[a, 0, 1], Y[a, 0, 2], Y[a, 0, 3], Y[a, 0, 4], Y[a, 0, 5]
    q0, q1, q2, q3, q4, q5 = Y[a, 1, 0], Y[a, 1, 1], Y[a, 1, 2], Y[a, 1, 3], Y[a, 1, 4], Y[a, 1, 5]
    r0, r1, r2, r3, r4, r5 = Y[a, 2, 0], Y[a, 2, 1], Y[a, 2, 2], Y[a, 2, 3], Y[a, 2, 4], Y[a, 2, 5]
    for c in range(6):
        p, q, r = Y[b, 0, c], Y[b, 1, c], Y[b, 2, c]
        s0 = S[k, c, 0] - p * p0 - q * q0 - r * r0
        s1 = S[k, c, 1] - p * p1 - q * q1 - r * r1
        s2 = S[k, c, 2] - p * p2 - q * q2 - r * r2
        s3 = S[k, c, 3] - p * p3 - q * q3 - r * r3
        s4 = S[k, c, 4] - p * p4 - q * q4 - r * r4
        s5 = S[k, c, 5] - p * p5 - q * q5 - r * r5
        S[k, c, 0], S[k, c, 1], S[k, c, 2] = s0, s1, s2
        S[k, c, 3], S[k, c, 4], S[k, c, 5] = s3, s4, s5


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def eliminate_landmark(first, last, base, pose_of, grad, Y, f, g):
    """Turn W of a landmark's observations into Y = L^-1 W and subtract Y_o' z from grad."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for o in range(first, last):
        n, k = o - base, pose_of[o]
        for c in range(6):
            y0 = Y[n, 0, c] * f[0]
            y1 = (Y[n, 1, c] - f[1] * y0) * f[2]
            y2 = (Y[n, 2, c] - f[3] * y0 - f[4] * y1) * f[5]
            Y[n, 0, c], Y[n, 1, c], Y[n, 2, c] = y0, y1, y2
            grad[k, c] -= y0 * z0 + y1 * z1 + y2 * z2


@njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def subtract_views(plan, slab, base, pose_of, inverse_sigma, Y, blocks):
    """Subtract Y_b' Y_a of all pairs of a slab, block row by block row."""
    num_poses, num_observations = len(plan.row_start) - 1, len(pose_of)
    for piece in prange(plan.piece_start.shape[1] - 1):
        block_of = np.empty(num_poses, np.int64)  # by column, in the row at hand
        for row in range(plan.piece_start[slab, piece], plan.piece_start[slab, piece + 1]):
            low, high = plan.view_start[slab, row], plan.view_start[slab, row + 1]
            if low == high:
                continue
            for block in range(plan.row_start[row], plan.row_start[row + 1]):
                block_of[plan.cols[block]] = block
            for view in range(low, high):
                b = plan.views[view]
                if inverse_sigma[b] == 0.0:
                    continue
                first = plan.first[b]
                for a in range(first, b + 1):
                    subtract_product(blocks, block_of[pose_of[a]], Y, b - base, a - base)
                a = b + 1  # other cameras of the rig: pairs of the pose with itself
                while a < num_observations and plan.first[a] == first and pose_of[a] == row:
                    subtract_product(blocks, block_of[row], Y, b - base, a - base)
                    a += 1


@njit(cache=True, nogil=True, error_model="numpy")
def add_chunks(plan, square, gradient, diagonal, cost, blocks):
    """Add the sums of all chunks into chunk 0, always in the same order, and P'P to the blocks."""
    chunks = square.shape[0]
    for pose in range(square.shape[1]):
        block = plan.row_start[pose + 1] - 1
        for chunk in range(chunks):
            for c in range(6):
                for e in range(6):
                    blocks[block, c, e] += square[chunk, pose, c, e]
                if chunk > 0:
                    gradient[0, pose, c] += gradient[chunk, pose, c]
                    diagonal[0, pose, c] += diagonal[chunk, pose, c]
    for chunk in range(1, chunks):
        cost[0] += cost[chunk]


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def cut_blocks(plan, blocks, parts):
    """Cut each block (6, 6) into its 3 x 3 parts, in place: `parts` (4 B, 3, 3) is the same memory.

    The parts follow each other by row, then column. A diagonal block's upper one is set to zero.
    """
    for row in prange(len(plan.row_start) - 1):
        whole = np.empty((6, 6))
        for block in range(plan.row_start[row], plan.row_start[row + 1]):
            for c in range(6):
                for e in range(6):
                    whole[c, e] = blocks[block, c, e]
            for c in range(6):
                for e in range(6):
                    is_upper = plan.cols[block] == row and c < 3 and e >= 3
                    part = 4 * block + 2 * (c // 3) + e // 3
                    parts[part, c % 3, e % 3] = 0.0 if is_upper else whole[c, e]


@njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def eliminate(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, prior, plan, damping, move_points, Y, square, gradient, diagonal, cost, blocks,
):  # fmt: skip
    """Form the reduced normal equations of the poses.

    Room: Y (observations of the largest slab, 3, 6), square (chunks, P, 6, 6).
    Out: gradient and diagonal (chunks, P, 6), the latter that of the unreduced equations, and cost
    (chunks,), the sum of rho: chunk 0 holds the sum over all chunks at the end. blocks (B, 6, 6):
    block [row pose, column pose] of each co-observing pair. Everything but Y is zero at first.
    """
    for slab in range(len(plan.slab_start) - 1):
        base = start[plan.slab_start[slab]]
        for chunk in prange(len(cost)):
            out, h, f, g = np.empty(NUM_OUT), np.empty(6), np.empty(6), np.empty(3)
            total = 0.0
            for landmark in range(plan.chunk_start[slab, chunk], plan.chunk_start[slab, chunk + 1]):
                first, last = start[landmark], start[landmark + 1]
                total += add_observations(
                    first, last, base, landmark, pose_of, camera_of, uv, inverse_sigma, scale2,
                    loss_kind, poses, extrinsics, parameters, points, prior, square[chunk],
                    gradient[chunk], diagonal[chunk], Y, out, h, g,
                )  # fmt: skip
                if move_points:
                    factor_3x3(h, damping, f)
                    eliminate_landmark(first, last, base, pose_of, gradient[chunk], Y, f, g)
            cost[chunk] += total
        if move_points:
            subtract_views(plan, slab, base, pose_of, inverse_sigma, Y, blocks)
    add_chunks(plan, square, gradient, diagonal, cost, blocks)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def substitute(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, prior, pose_step, damping, move_points, chunk_start, new_poses, new_points, sums,
):  # fmt: skip
    """Step the landmarks for given pose steps (P, 6).

    Out: new_points (L, 3); sums (chunks, 2): new sum of rho, and twice the decrease of the
    quadratic model. Row 0 of sums holds the sum over all chunks at the end.
    """
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
                k = pose_of[o]
                reproject(
                    poses, k, extrinsics, camera_of[o], parameters, points, landmark, uv, o, out
                )
                weighted(out, inverse_sigma[o], loss_kind, scale2[o])
                decrease += out[0] * out[0] + out[1] * out[1]
                for c in range(6):
                    out[0] += out[3 + 2 * c] * pose_step[k, c]
                    out[1] += out[4 + 2 * c] * pose_step[k, c]
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
                reproject_only(
                    new_poses, pose_of[o], extrinsics, camera_of[o], parameters, new_points,
                    landmark, uv, o, out,
                )  # fmt: skip
                s = (out[0] * out[0] + out[1] * out[1]) * inverse_sigma[o] * inverse_sigma[o]
                new_cost += robust(loss_kind, s, scale2[o])[0]
        sums[chunk, 0] = new_cost
        sums[chunk, 1] = decrease
    for chunk in range(1, chunks):
        sums[0, 0] += sums[chunk, 0]
        sums[0, 1] += sums[chunk, 1]


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def evaluate(start, pose_of, camera_of, uv, poses, extrinsics, parameters, points, error_depth):
    """Write every observation's reprojection error [px] and depth [m] to error_depth (O, 2)."""
    for landmark in prange(len(start) - 1):
        out = np.empty(NUM_OUT)
        for o in range(start[landmark], start[landmark + 1]):
            reproject_only(
                poses, pose_of[o], extrinsics, camera_of[o], parameters, points, landmark, uv, o,
                out,
            )  # fmt: skip
            error_depth[o, 0] = math.sqrt(out[0] * out[0] + out[1] * out[1])
            error_depth[o, 1] = out[2]
