"""Common parts of the visual kernels: weights, and the 3 x 3 system of one landmark.

`out` holds one observation: residual (2), depth, and the Jacobian's columns of two entries each:
pose (6) from POSE on, landmark (3) from LANDMARK on; NUM_OUT entries in all, after which those of an
estimated camera may follow.
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
SMALLEST_DAMPED = 1e-6
LARGEST_DAMPED = 1e32


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def weighted(out, inverse_sigma, loss_kind, scale2):
    """Whiten residual and Jacobian in `out`, apply the robust weight; return rho and the factor."""
    s = (out[0] * out[0] + out[1] * out[1]) * inverse_sigma * inverse_sigma
    rho, weight = rho_and_weight(loss_kind, s, scale2)
    factor = inverse_sigma * math.sqrt(weight)
    out[0] *= factor
    out[1] *= factor
    for k in range(POSE, NUM_OUT):
        out[k] *= factor
    return rho, factor


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def damped(h, damping):
    """Return a diagonal entry of H after Levenberg-Marquardt damping, clamped as Ceres does."""
    return h + damping * min(max(h, SMALLEST_DAMPED), LARGEST_DAMPED)


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def factor_3x3(h, damping, f):
    """Cholesky of the damped 3 x 3 matrix h = [00 10 11 20 21 22] into f (inverse diagonal)."""
    a0, a1, a2 = damped(h[0], damping), damped(h[2], damping), damped(h[5], damping)
    f[0] = 1.0 / math.sqrt(a0)
    f[1] = h[1] * f[0]
    f[2] = 1.0 / math.sqrt(max(a1 - f[1] * f[1], 1e-14 * a1))
    f[3] = h[3] * f[0]
    f[4] = (h[4] - f[3] * f[1]) * f[2]
    f[5] = 1.0 / math.sqrt(max(a2 - f[3] * f[3] - f[4] * f[4], 1e-14 * a2))


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_landmark_sums(out, h, g):
    """Add Q'Q of one observation to h (6 entries, lower) and Q'r to g."""
    a0, b0 = out[LANDMARK], out[LANDMARK + 1]
    a1, b1 = out[LANDMARK + 2], out[LANDMARK + 3]
    a2, b2 = out[LANDMARK + 4], out[LANDMARK + 5]
    h[0] += a0 * a0 + b0 * b0
    h[1] += a1 * a0 + b1 * b0
    h[2] += a1 * a1 + b1 * b1
    h[3] += a2 * a0 + b2 * b0
    h[4] += a2 * a1 + b2 * b1
    h[5] += a2 * a2 + b2 * b2
    g[0] += a0 * out[0] + b0 * out[1]
    g[1] += a1 * out[0] + b1 * out[1]
    g[2] += a2 * out[0] + b2 * out[1]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def begin_landmark(points, prior, landmark, h, g):
    """Set h and g to the landmark's prior [place, weight], zero without one; return its rho."""
    h[:] = 0.0
    square = prior[landmark, 3] * prior[landmark, 3]
    h[0], h[2], h[5] = square, square, square
    total = 0.0
    for j in range(3):
        off = points[landmark, j] - prior[landmark, j]
        g[j] = square * off
        total += square * off * off
    return total
