"""Visual terms: landmarks are eliminated in the pass that evaluates them.

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

Landmarks are worked on in a fixed number of chunks, each with sums of its own that are added in a
fixed order: the result does not depend on how many threads there are, bit for bit.

A landmark may have a prior, a place and the inverse of its standard deviation, which adds to H, to
Q'r and to the cost.

This file is a template: `reproject` is generated for the camera models in use, and both are
compiled as one module (see `codegen.modules`).
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def add_pose(out, n, block, k, Y, S, grad, diag):
    """Write W = Q'P of one observation to Y[n]; add P'P to S[block], its diagonal and P'r."""
    for c in range(6):
        a, b = out[3 + 2 * c], out[4 + 2 * c]
        Y[n, 0, c] = a * out[15] + b * out[16]
        Y[n, 1, c] = a * out[17] + b * out[18]
        Y[n, 2, c] = a * out[19] + b * out[20]
        grad[k, c] += a * out[0] + b * out[1]
        diag[k, c] += a * a + b * b
        for e in range(6):
            S[block, c, e] += a * out[3 + 2 * e] + b * out[4 + 2 * e]


@njit(cache=True, error_model="numpy", inline="always")
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
    first, last, landmark, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses,
    extrinsics, parameters, points, prior, diagonal_block, S, grad, diag, Y, out, h, g,
):  # fmt: skip
    """Evaluate a landmark's observations; return the sum of rho.

    Adds P'P and P'r of the poses to S, grad and diag, leaves H in h, Q'r in g and W in Y.
    """
    total = begin_landmark(points, prior, landmark, h, g)
    for o in range(first, last):
        n = o - first
        if inverse_sigma[o] == 0.0:
            Y[n] = 0.0
            continue
        k = pose_of[o]
        reproject(poses, k, extrinsics, camera_of[o], parameters, points, landmark, uv, o, out)
        total += weighted(out, inverse_sigma[o], loss_kind, scale2[o])
        add_landmark_sums(out, h, g)
        add_pose(out, n, diagonal_block[k], k, Y, S, grad, diag)
    return total


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def subtract_product(S, k, Y, b, a):
    """Compute S[k] -= Y[b]' Y[a].

    Half the time of an elimination goes here, hence the plain form. Entries are named by all their
    indices, since a view like Y[b] counts references, which costs as much as the arithmetic. And
    the compiler has to assume that S and Y overlap: what is read before the first number is written
    it need not read again.
    """
    p0, p1, p2, p3, p4, p5 = Y[a, 0, 0], Y[a, 0, 1], Y[a, 0, 2], Y[a, 0, 3], Y[a, 0, 4], Y[a, 0, 5]
    q0, q1, q2, q3, q4, q5 = Y[a, 1, 0], Y[a, 1, 1], Y[a, 1, 2], Y[a, 1, 3], Y[a, 1, 4], Y[a, 1, 5]
    r0, r1, r2, r3, r4, r5 = Y[a, 2, 0], Y[a, 2, 1], Y[a, 2, 2], Y[a, 2, 3], Y[a, 2, 4], Y[a, 2, 5]
    for c in range(6):
        p, q, r = Y[b, 0, c], Y[b, 1, c], Y[b, 2, c]
        s0 = S[k, c, 0] - (p * p0 + q * q0 + r * r0)
        s1 = S[k, c, 1] - (p * p1 + q * q1 + r * r1)
        s2 = S[k, c, 2] - (p * p2 + q * q2 + r * r2)
        s3 = S[k, c, 3] - (p * p3 + q * q3 + r * r3)
        s4 = S[k, c, 4] - (p * p4 + q * q4 + r * r4)
        s5 = S[k, c, 5] - (p * p5 + q * q5 + r * r5)
        S[k, c, 0], S[k, c, 1], S[k, c, 2] = s0, s1, s2
        S[k, c, 3], S[k, c, 4], S[k, c, 5] = s3, s4, s5


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)
def subtract_landmark(first, last, pose_of, pair_block, pair, S, grad, Y, f, g):
    """Turn W into Y = L^-1 W and subtract Y_b' Y_a and Y_o' z from S and grad."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for o in range(first, last):
        n, k = o - first, pose_of[o]
        for c in range(6):
            y0 = Y[n, 0, c] * f[0]
            y1 = (Y[n, 1, c] - f[1] * y0) * f[2]
            y2 = (Y[n, 2, c] - f[3] * y0 - f[4] * y1) * f[5]
            Y[n, 0, c], Y[n, 1, c], Y[n, 2, c] = y0, y1, y2
            grad[k, c] -= y0 * z0 + y1 * z1 + y2 * z2
    for b in range(last - first):
        for a in range(b + 1):
            k = pair_block[pair]
            pair += 1
            subtract_product(S, k, Y, b, a)
            if a != b and pose_of[first + a] == pose_of[first + b]:  # two cameras of a rig
                subtract_product(S, k, Y, a, b)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def reduce_chunks(blocks, gradient, diagonal, cost):
    """Add the sums of all chunks into chunk 0, always in the same order."""
    chunks = blocks.shape[0]
    for block in prange(blocks.shape[1]):
        for chunk in range(1, chunks):
            blocks[0, block] += blocks[chunk, block]
    for pose in prange(gradient.shape[1]):
        for chunk in range(1, chunks):
            gradient[0, pose] += gradient[chunk, pose]
            diagonal[0, pose] += diagonal[chunk, pose]
    for chunk in range(1, chunks):
        cost[0] += cost[chunk]


@njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def eliminate(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, prior, pair_start, pair_block, diagonal_block, damping, move_points, chunk_start,
    blocks, gradient, diagonal, cost,
):  # fmt: skip
    """Form the reduced normal equations of the poses.

    Out: blocks (chunks, B, 6, 6), block [row pose, column pose] of each co-observing pair; gradient
    and diagonal (chunks, P, 6), the latter that of the unreduced equations; cost (chunks,), the
    sum of rho. Chunk 0 holds the sum over all chunks at the end.
    """
    longest = 0
    for landmark in range(len(start) - 1):
        longest = max(longest, start[landmark + 1] - start[landmark])
    for chunk in prange(blocks.shape[0]):
        S, grad, diag = blocks[chunk], gradient[chunk], diagonal[chunk]
        S[:] = 0.0
        grad[:] = 0.0
        diag[:] = 0.0
        total = 0.0
        Y = np.empty((longest, 3, 6))
        out, h, f, g = np.empty(NUM_OUT), np.empty(6), np.empty(6), np.empty(3)
        for landmark in range(chunk_start[chunk], chunk_start[chunk + 1]):
            first, last = start[landmark], start[landmark + 1]
            total += add_observations(
                first, last, landmark, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind,
                poses, extrinsics, parameters, points, prior, diagonal_block, S, grad, diag, Y, out,
                h, g,
            )  # fmt: skip
            if move_points:
                factor_3x3(h, damping, f)
                subtract_landmark(
                    first, last, pose_of, pair_block, pair_start[landmark], S, grad, Y, f, g
                )
        cost[chunk] = total
    reduce_chunks(blocks, gradient, diagonal, cost)


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
