"""The pass that evaluates reprojection errors and keeps their Jacobians, for iterative solvers.

Of an observation 12 numbers are kept: the whitened, robustly weighted Jacobian by the landmark, Q
(2 x 3), and by the orientation, R (2 x 3). Landmark and position are both given in G, so the Jacobian
by the position is -Q. Numbers are rounded to single precision first; everything that is squared is
computed from the rounded ones, so that the reduced system stays positive semidefinite. The gradient is
that of the exact numbers, so that the optimum is the same (see `kernels.schur_products`).
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_gradients(out, chunk, k, gradient, g):
    """Add P'r of one observation to the gradient of pose k, and Q'r to g."""
    for c in range(6):
        a, b = out[POSE + 2 * c], out[POSE + 2 * c + 1]
        gradient[chunk, k, c] += a * out[0] + b * out[1]
    for c in range(3):
        g[c] += out[LANDMARK + 2 * c] * out[0] + out[LANDMARK + 2 * c + 1] * out[1]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def keep_rounded(out, o, jacobian):
    """Keep [Q R] of one observation as rows u and v of six, and leave the rounded numbers in out."""
    for c in range(3):
        jacobian[o, c] = out[LANDMARK + 2 * c]
        jacobian[o, 6 + c] = out[LANDMARK + 2 * c + 1]
        jacobian[o, 3 + c] = out[POSE + 6 + 2 * c]
        jacobian[o, 9 + c] = out[POSE + 6 + 2 * c + 1]
    for c in range(3):
        a, b = np.float64(jacobian[o, c]), np.float64(jacobian[o, 6 + c])
        out[LANDMARK + 2 * c], out[LANDMARK + 2 * c + 1] = a, b
        out[POSE + 2 * c], out[POSE + 2 * c + 1] = -a, -b
        out[POSE + 6 + 2 * c] = np.float64(jacobian[o, 3 + c])
        out[POSE + 6 + 2 * c + 1] = np.float64(jacobian[o, 9 + c])


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_squares(out, chunk, k, square, h):
    """Add P'P of one observation to the square of pose k, and Q'Q to h (6 entries, lower)."""
    for c in range(6):
        a, b = out[POSE + 2 * c], out[POSE + 2 * c + 1]
        for e in range(6):
            square[chunk, k, c, e] += a * out[POSE + 2 * e] + b * out[POSE + 2 * e + 1]
    entry = 0
    for c in range(3):
        a, b = out[LANDMARK + 2 * c], out[LANDMARK + 2 * c + 1]
        for e in range(c + 1):
            h[entry] += a * out[LANDMARK + 2 * e] + b * out[LANDMARK + 2 * e + 1]
            entry += 1


@compiled(parallel=True, fastmath={"contract", "nsz"})
def keep_jacobians(data, at, prior, loss_kind, chunk_start, kept, sums, cost):
    """Evaluate all observations; the results are `kept` and, by chunk of landmarks, `sums` and cost.

    Landmarks' priors are part of their h, g and cost, as in `eliminate`. The cost is an argument of
    its own: numba drops what a parallel loop writes by chunk into an array unpacked from a tuple.
    """
    start, pose_of, camera_of, uv, inverse_sigma, scale2, _ = data
    poses, extrinsics, parameters, points, _ = at
    axes = camera_axes(extrinsics)
    jacobian, landmark_square, landmark_gradient, _ = kept
    square, gradient = sums
    for chunk in prange(len(chunk_start) - 1):
        out, h, g = np.empty(NUM_OUT), np.empty(6), np.empty(3)
        total = 0.0
        for landmark in range(chunk_start[chunk], chunk_start[chunk + 1]):
            rho = begin_landmark(points, prior, landmark, h, g)
            for o in range(start[landmark], start[landmark + 1]):
                if inverse_sigma[o] == 0.0:
                    for c in range(12):
                        jacobian[o, c] = 0.0
                    continue
                k, c = pose_of[o], camera_of[o]
                reproject(poses, k, (axes, parameters), c, points, landmark, uv, o, out, 0)
                rho += weighted(out, inverse_sigma[o], loss_kind, scale2[o])[0]
                add_gradients(out, chunk, k, gradient, g)
                keep_rounded(out, o, jacobian)
                add_squares(out, chunk, k, square, h)
            total += rho
            for c in range(6):
                landmark_square[landmark, c] = h[c]
            for c in range(3):
                landmark_gradient[landmark, c] = g[c]
        cost[chunk] += total
