"""The calibration of cameras in a window: times of image rows, and columns of the dense system.

An image may be later than its frame, and its rows one after the other: a point is moved back by the frame's
velocity and turn over that time, to second order in the turn. That time, and all else of the cameras, may
have columns in the system behind those of the frames, given by `columns`. They are estimated from all
observations, so a landmark has one dense row of them, whichever frames see it.
"""


# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---
@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def turned(twist, k, t, x, y, z):
    """Return exp(-t omega_k) (x, y, z) to second order."""
    r0, r1, r2 = t * twist[k, 3], t * twist[k, 4], t * twist[k, 5]
    a0, a1, a2 = cross(r0, r1, r2, x, y, z)
    b0, b1, b2 = cross(r0, r1, r2, a0, a1, a2)
    return x - a0 + 0.5 * b0, y - a1 + 0.5 * b1, z - a2 + 0.5 * b2


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def moved(twist, k, w, t, x, y, z):
    """Return a point times 1 / z, given in the body k, as the body sees it t later."""
    s = w * t
    return turned(twist, k, t, x - s * twist[k, 0], y - s * twist[k, 1], z - s * twist[k, 2])


@compiled(fastmath={"contract", "nsz"})
def by_turn(twist, k, w, t, b, s):
    """Return the rate at which a point of the body k, times 1 / z, moves along s by the turn alone."""
    v, omega = w * t, twist[k, 3:6]
    x, y, z = b[0] - v * twist[k, 0], b[1] - v * twist[k, 1], b[2] - v * twist[k, 2]
    r0, r1, r2 = cross(omega[0], omega[1], omega[2], x, y, z)
    x, y, z = x - t * r0, y - t * r1, z - t * r2
    r0, r1, r2 = cross(omega[0], omega[1], omega[2], x, y, z)
    return s[0] * r0 + s[1] * r1 + s[2] * r2


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def lateness(timing, twist, k, c, row):
    """Return how much later than its frame k a row of an image of camera c was taken."""
    if len(twist) == 0:
        return 0.0
    return timing[c, 0] + timing[c, 1] * row - twist[k, 6]


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_columns(J, i, columns, c, first, x, y, z):
    """Add three numbers to row i of J at the columns of camera c from `first` on."""
    k0, k1, k2 = columns[c, first], columns[c, first + 1], columns[c, first + 2]
    if k0 >= 0:
        J[i, k0] += x
    if k1 >= 0:
        J[i, k1] += y
    if k2 >= 0:
        J[i, k2] += z


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def add_rotation(J, i, columns, slope, c, x, y, z):
    """Add a row by a right perturbation of R_I_C, of which the states are the rotation vector."""
    add_columns(
        J, i, columns, c, 3,
        x * slope[c, 0, 0] + y * slope[c, 1, 0] + z * slope[c, 2, 0],
        x * slope[c, 0, 1] + y * slope[c, 1, 1] + z * slope[c, 2, 1],
        x * slope[c, 0, 2] + y * slope[c, 1, 2] + z * slope[c, 2, 2],
    )  # fmt: skip


@compiled(fastmath={"contract", "nsz"})
def add_intrinsics(J, columns, parameters, c, x, y, z):
    """Add what a pixel of camera c depends on its intrinsic parameters to J."""
    count, any_free = parameters.shape[1] - 1, False
    for i in range(count):
        any_free = any_free or columns[c, INTRINSICS + i] >= 0
    if not any_free:
        return
    by_parameters = np.empty(2 * count)
    project_by_parameters(parameters, c, x, y, z, by_parameters, 0)
    for i in range(count):
        k = columns[c, INTRINSICS + i]
        if k >= 0:
            J[0, k] += by_parameters[2 * i]
            J[1, k] += by_parameters[2 * i + 1]


@compiled(fastmath={"contract", "nsz"})
def add_calibration(out, J, factor, rows, n, Y, matrix, gradient, diagonal):
    """Add one observation's W, J'J, J'P, J'A and J'r of the calibration; J is not whitened yet."""
    a, k, first = rows
    r, s = out[0], out[1]
    for j in range(J.shape[1]):
        x, y = factor * J[0, j], factor * J[1, j]
        J[0, j], J[1, j] = x, y
        if x == 0.0 and y == 0.0:
            continue
        row = first + j
        gradient[row] += x * r + y * s
        diagonal[row] += x * x + y * y
        for i in range(3):
            Y[n, i, j] += x * out[LANDMARK + 2 * i] + y * out[LANDMARK + 2 * i + 1]
        for e in range(j + 1):
            matrix[row, first + e] += x * J[0, e] + y * J[1, e]
        if k == a:
            continue
        for c in range(6):
            matrix[row, 15 * a + c] += x * out[ANCHOR + 2 * c] + y * out[ANCHOR + 2 * c + 1]
            matrix[row, 15 * k + c] += x * out[POSE + 2 * c] + y * out[POSE + 2 * c + 1]


@compiled(fastmath={"contract", "nsz"})
def subtract_calibration(n, count, slots, first, Y_frames, Y, f, g, matrix, reduced_gradient):
    """Turn W of the calibration into Y = L^-1 W; subtract its products with everything and Y'z."""
    z0 = g[0] * f[0]
    z1 = (g[1] - f[1] * z0) * f[2]
    z2 = (g[2] - f[3] * z0 - f[4] * z1) * f[5]
    for j in range(Y.shape[2]):
        y0 = Y[n, 0, j] * f[0]
        y1 = (Y[n, 1, j] - f[1] * y0) * f[2]
        y2 = (Y[n, 2, j] - f[3] * y0 - f[4] * y1) * f[5]
        Y[n, 0, j], Y[n, 1, j], Y[n, 2, j] = y0, y1, y2
        row = first + j
        reduced_gradient[row] -= y0 * z0 + y1 * z1 + y2 * z2
        for e in range(j + 1):
            matrix[row, first + e] -= y0 * Y[n, 0, e] + y1 * Y[n, 1, e] + y2 * Y[n, 2, e]
        for s in range(count):
            k = 15 * slots[n, s]
            for c in range(6):
                p, q, r = Y_frames[n, s, 0, c], Y_frames[n, s, 1, c], Y_frames[n, s, 2, c]
                matrix[row, k + c] -= y0 * p + y1 * q + y2 * r
