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

This file is a template: `reproject` is generated for the camera models in use, and both are
compiled as one module (see `codegen.modules`).
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
NUM_OUT = 21  # residual 2, depth 1, Jacobian 2 x 9 column-major: pose 6, landmark 3
SMALLEST_DAMPED = 1e-6
LARGEST_DAMPED = 1e32
NONE, HUBER, CAUCHY, TUKEY, GEMAN_MCCLURE, DCS = 0, 1, 2, 3, 4, 5


@njit(cache=True, error_model="numpy", inline="always")
def robust(kind, s, c2):
    """Return rho(s) and its derivative for the squared residual s and squared scale c2."""
    if kind == HUBER:
        if s <= c2:
            return s, 1.0
        root = math.sqrt(c2 / s)
        return 2.0 * s * root - c2, root
    if kind == CAUCHY:
        return c2 * math.log(1.0 + s / c2), 1.0 / (1.0 + s / c2)
    if kind == TUKEY:
        if s >= c2:
            return c2 / 3.0, 0.0
        t = 1.0 - s / c2
        return c2 / 3.0 * (1.0 - t * t * t), t * t
    if kind == GEMAN_MCCLURE:
        t = c2 / (c2 + s)
        return s * t, t * t
    if kind == DCS:
        if s <= c2:
            return s, 1.0
        t = 2.0 * c2 / (c2 + s)
        return c2 * (3.0 * s - c2) / (s + c2), t * t
    return s, 1.0


@njit(cache=True, error_model="numpy", inline="always")
def weighted(out, inverse_sigma, loss_kind, scale2):
    """Whiten residual and Jacobian in `out` and apply the robust weight; return rho."""
    s = (out[0] * out[0] + out[1] * out[1]) * inverse_sigma * inverse_sigma
    rho, weight = robust(loss_kind, s, scale2)
    factor = inverse_sigma * math.sqrt(weight)
    out[0] *= factor
    out[1] *= factor
    for k in range(3, NUM_OUT):
        out[k] *= factor
    return rho


@njit(cache=True, error_model="numpy", inline="always")
def damped(h, damping):
    """Return a diagonal entry of H after Levenberg-Marquardt damping, clamped as Ceres does."""
    return h + damping * min(max(h, SMALLEST_DAMPED), LARGEST_DAMPED)


@njit(cache=True, error_model="numpy", inline="always")
def factor_3x3(h, damping, f):
    """Cholesky of the damped 3 x 3 matrix h = [00 10 11 20 21 22] into f (inverse diagonal)."""
    a0, a1, a2 = damped(h[0], damping), damped(h[2], damping), damped(h[5], damping)
    f[0] = 1.0 / math.sqrt(a0)
    f[1] = h[1] * f[0]
    f[2] = 1.0 / math.sqrt(max(a1 - f[1] * f[1], 1e-14 * a1))
    f[3] = h[3] * f[0]
    f[4] = (h[4] - f[3] * f[1]) * f[2]
    f[5] = 1.0 / math.sqrt(max(a2 - f[3] * f[3] - f[4] * f[4], 1e-14 * a2))


@njit(cache=True, error_model="numpy", inline="always")
def add_landmark_sums(out, h, g):
    """Add Q'Q of one observation to h (6 entries, lower) and Q'r to g."""
    a0, b0, a1, b1, a2, b2 = out[15], out[16], out[17], out[18], out[19], out[20]
    h[0] += a0 * a0 + b0 * b0
    h[1] += a1 * a0 + b1 * b0
    h[2] += a1 * a1 + b1 * b1
    h[3] += a2 * a0 + b2 * b0
    h[4] += a2 * a1 + b2 * b1
    h[5] += a2 * a2 + b2 * b2
    g[0] += a0 * out[0] + b0 * out[1]
    g[1] += a1 * out[0] + b1 * out[1]
    g[2] += a2 * out[0] + b2 * out[1]


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def add_observations(
    first, last, landmark, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses,
    extrinsics, parameters, points, diagonal_block, S, grad, diag, Y, out, h, g,
):  # fmt: skip
    """Evaluate a landmark's observations; return the sum of rho.

    Adds P'P and P'r of the poses to S, grad and diag, leaves H in h, Q'r in g and W in Y.
    """
    total = 0.0
    h[:] = 0.0
    g[:] = 0.0
    for o in range(first, last):
        W = Y[o - first]
        if inverse_sigma[o] == 0.0:
            W[:] = 0.0
            continue
        k = pose_of[o]
        reproject(poses, k, extrinsics, camera_of[o], parameters, points, landmark, uv, o, out)
        total += weighted(out, inverse_sigma[o], loss_kind, scale2[o])
        add_landmark_sums(out, h, g)
        block = S[diagonal_block[k]]
        for c in range(6):
            a, b = out[3 + 2 * c], out[4 + 2 * c]
            W[0, c] = a * out[15] + b * out[16]
            W[1, c] = a * out[17] + b * out[18]
            W[2, c] = a * out[19] + b * out[20]
            grad[k, c] += a * out[0] + b * out[1]
            diag[k, c] += a * a + b * b
            for e in range(6):
                block[c, e] += a * out[3 + 2 * e] + b * out[4 + 2 * e]
    return total


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def subtract_landmark(first, last, pose_of, pair_block, pair, S, grad, Y, f, g):
    """Turn W into Y = L^-1 W and subtract Y_b' Y_a and Y_o' z from S and grad."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for o in range(first, last):
        W = Y[o - first]
        k = pose_of[o]
        for c in range(6):
            y0 = W[0, c] * f[0]
            y1 = (W[1, c] - f[1] * y0) * f[2]
            y2 = (W[2, c] - f[3] * y0 - f[4] * y1) * f[5]
            W[0, c], W[1, c], W[2, c] = y0, y1, y2
            grad[k, c] -= y0 * z0 + y1 * z1 + y2 * z2
    for b in range(last - first):
        Yb = Y[b]
        for a in range(b + 1):
            block, Ya = S[pair_block[pair]], Y[a]
            pair += 1
            same_pose = a != b and pose_of[first + a] == pose_of[first + b]  # two cameras of a rig
            for c in range(6):
                y0, y1, y2 = Yb[0, c], Yb[1, c], Yb[2, c]
                for e in range(6):
                    block[c, e] -= y0 * Ya[0, e] + y1 * Ya[1, e] + y2 * Ya[2, e]
            if same_pose:
                for c in range(6):
                    y0, y1, y2 = Yb[0, c], Yb[1, c], Yb[2, c]
                    for e in range(6):
                        block[e, c] -= y0 * Ya[0, e] + y1 * Ya[1, e] + y2 * Ya[2, e]


@njit(cache=True, parallel=True, error_model="numpy")
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


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def eliminate(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, pair_start, pair_block, diagonal_block, damping, move_points, chunk_start,
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
                poses, extrinsics, parameters, points, diagonal_block, S, grad, diag, Y, out, h, g,
            )  # fmt: skip
            if move_points:
                factor_3x3(h, damping, f)
                subtract_landmark(
                    first, last, pose_of, pair_block, pair_start[landmark], S, grad, Y, f, g
                )
        cost[chunk] = total
    reduce_chunks(blocks, gradient, diagonal, cost)


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def substitute(
    start, pose_of, camera_of, uv, inverse_sigma, scale2, loss_kind, poses, extrinsics, parameters,
    points, pose_step, damping, move_points, chunk_start, new_poses, new_points, sums,
):  # fmt: skip
    """Step the landmarks for given pose steps (P, 6).

    Out: new_points (L, 3); sums (chunks, 2): new sum of rho, and twice the decrease of the
    quadratic model. Row 0 of sums holds the sum over all chunks at the end.
    """
    chunks = sums.shape[0]
    for chunk in prange(chunks):
        out, h, f, g = np.empty(NUM_OUT), np.empty(6), np.empty(6), np.empty(3)
        new_cost, decrease = 0.0, 0.0
        for landmark in range(chunk_start[chunk], chunk_start[chunk + 1]):
            first, last = start[landmark], start[landmark + 1]
            h[:] = 0.0
            g[:] = 0.0
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
            d0, d1, d2 = 0.0, 0.0, 0.0
            if move_points:
                factor_3x3(h, damping, f)
                z0 = g[0] * f[0]
                z1 = (g[1] - f[1] * z0) * f[2]
                z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
                d2 = -z2 * f[5]
                d1 = (-z1 - f[4] * d2) * f[2]
                d0 = (-z0 - f[1] * d1 - f[3] * d2) * f[0]
                decrease -= 2.0 * (d0 * g[0] + d1 * g[1] + d2 * g[2])
                decrease -= h[0] * d0 * d0 + h[2] * d1 * d1 + h[5] * d2 * d2
                decrease -= 2.0 * (h[1] * d0 * d1 + h[3] * d0 * d2 + h[4] * d1 * d2)
            new_points[landmark, 0] = points[landmark, 0] + d0
            new_points[landmark, 1] = points[landmark, 1] + d1
            new_points[landmark, 2] = points[landmark, 2] + d2
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


@njit(parallel=True, cache=True, error_model="numpy")
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
