"""Compiled loops over relative-pose edges: whitened errors, normal equations, steps.

An edge measures T_A_B between poses A and B. Its residual [e_p, e_r] has e_r = Log(R_m^T R_A_B) and

- split: e_p = p_A_B - p_m, in A (as the map's covariances are meant), or
- logarithm: [e_p, e_r] = Log(T_m^-1 T_A_B) in SE(3), as public pose-graph files are meant.

Perturbations are twists in the body: T <- T exp([v, w]). The loops take some milliseconds for
thousands of edges, less than it costs to wake threads on a busy machine: they run on one.
"""

from __future__ import annotations

import numpy as np

from maplab_py.compilation import compiled


@compiled(forceinline=True)
def _conjugate_times(a, b, out):  # type: ignore[no-untyped-def]
    """Quaternion product conj(a) b, [x y z w]."""
    x, y, z, w = -a[0], -a[1], -a[2], a[3]
    out[0] = w * b[0] + x * b[3] + y * b[2] - z * b[1]
    out[1] = w * b[1] - x * b[2] + y * b[3] + z * b[0]
    out[2] = w * b[2] + x * b[1] - y * b[0] + z * b[3]
    out[3] = w * b[3] - x * b[0] - y * b[1] - z * b[2]


@compiled(forceinline=True)
def _matrix(q, R):  # type: ignore[no-untyped-def]
    x, y, z, w = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@compiled(forceinline=True)
def _log(q, angle):  # type: ignore[no-untyped-def]
    sign = -1.0 if q[3] < 0.0 else 1.0
    n = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    w = sign * q[3]
    factor = 2.0 / w * (1.0 - n * n / (3.0 * w * w)) if n < 1e-6 else 2.0 * np.arctan2(n, w) / n
    for i in range(3):
        angle[i] = sign * factor * q[i]


@compiled(forceinline=True)
def _curvature(t):  # type: ignore[no-untyped-def]
    """Return b of J^-1 = I -+ K/2 + b K^2, and b'(|t|) / |t|."""
    square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    if square < 1e-4:
        return (
            1.0 / 12.0 + square / 720.0 + square * square / 30240.0,
            1.0 / 360.0 + square / 7560.0,
        )
    a = np.sqrt(square)
    sine = np.sin(0.5 * a)
    cot = np.cos(0.5 * a) / sine
    b = 1.0 / square - cot / (2.0 * a)
    slope = -2.0 / (square * a) + cot / (2.0 * square) + 1.0 / (4.0 * a * sine * sine)
    return b, slope / a


@compiled(forceinline=True)
def _residual(A, B, measured, is_log, e, p, q_B_A, y, R, q_A_B, q):  # type: ignore[no-untyped-def]
    """Fill in the residual, p_A_B, the rotation that takes A to B, and R_m^T (p_A_B - p_m).

    R (3, 3), q_A_B (4,) and q (4,) are room to work in.
    """
    _matrix(A, R)
    d0, d1, d2 = B[4] - A[4], B[5] - A[5], B[6] - A[6]
    for i in range(3):
        p[i] = R[0, i] * d0 + R[1, i] * d1 + R[2, i] * d2
    _conjugate_times(A, B, q_A_B)
    q_B_A[0], q_B_A[1], q_B_A[2], q_B_A[3] = -q_A_B[0], -q_A_B[1], -q_A_B[2], q_A_B[3]
    _conjugate_times(measured, q_A_B, q)
    t = e[3:]
    _log(q, t)
    g0, g1, g2 = p[0] - measured[4], p[1] - measured[5], p[2] - measured[6]
    e[0], e[1], e[2] = g0, g1, g2
    if is_log:
        _matrix(measured, R)
        for i in range(3):
            y[i] = R[0, i] * g0 + R[1, i] * g1 + R[2, i] * g2
        b, _ = _curvature(t)
        dot = t[0] * y[0] + t[1] * y[1] + t[2] * y[2]
        square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
        e[0] = y[0] - 0.5 * (t[1] * y[2] - t[2] * y[1]) + b * (t[0] * dot - y[0] * square)
        e[1] = y[1] - 0.5 * (t[2] * y[0] - t[0] * y[2]) + b * (t[1] * dot - y[1] * square)
        e[2] = y[2] - 0.5 * (t[0] * y[1] - t[1] * y[0]) + b * (t[2] * dot - y[2] * square)


@compiled()
def relative_pose_errors(T, from_vertex, to_vertex, measured, W, is_log, out):  # type: ignore[no-untyped-def]
    """Fill in the whitened residuals W e (E, 6) for poses (V, 7)."""
    e, p, q_B_A, y = np.empty(6), np.empty(3), np.empty(4), np.empty(3)
    R, q_A_B, q = np.empty((3, 3)), np.empty(4), np.empty(4)
    for edge in range(len(from_vertex)):
        A, B = T[from_vertex[edge]], T[to_vertex[edge]]
        _residual(A, B, measured[edge], is_log[edge], e, p, q_B_A, y, R, q_A_B, q)
        for i in range(6):
            total = 0.0
            for j in range(6):
                total += W[edge, i, j] * e[j]
            out[edge, i] = total


@compiled(forceinline=True)
def _skew(v, K):  # type: ignore[no-untyped-def]
    K[0, 0], K[0, 1], K[0, 2] = 0.0, -v[2], v[1]
    K[1, 0], K[1, 1], K[1, 2] = v[2], 0.0, -v[0]
    K[2, 0], K[2, 1], K[2, 2] = -v[1], v[0], 0.0


@compiled(forceinline=True)
def _derivatives(measured, is_log, e, p, q_B_A, y, J_a, J_b, work):  # type: ignore[no-untyped-def]
    """Fill in the derivatives (6, 6) of the residual by [v, w] of A and of B."""
    R_B_A, K, R_m, M, N, D = work
    _matrix(q_B_A, R_B_A)
    t = e[3:]
    b, slope = _curvature(t)
    square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    J_a[:], J_b[:] = 0.0, 0.0
    _skew(t, K)
    for i in range(3):  # Jr^-1(t) = I + K/2 + b K^2, and K^2 = t t^T - |t|^2 I
        for j in range(3):
            J_b[3 + i, 3 + j] = 0.5 * K[i, j] + b * t[i] * t[j]
        J_b[3 + i, 3 + i] += 1.0 - b * square
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += J_b[3 + i, 3 + k] * R_B_A[k, j]
            J_a[3 + i, 3 + j] = -total
    _skew(p, K)
    if not is_log:
        for i in range(3):
            J_a[i, i] = -1.0
            for j in range(3):
                J_b[i, j] = R_B_A[j, i]
                J_a[i, 3 + j] = K[i, j]
        return
    # e_p = M y with M = Jl^-1(t); y = R_m^T (p_A_B - p_m)
    _matrix(measured, R_m)
    dot = t[0] * y[0] + t[1] * y[1] + t[2] * y[2]
    _skew(t, M)
    _skew(y, D)
    for i in range(3):
        bend = t[i] * dot - y[i] * square  # K^2 y
        for j in range(3):
            M[i, j] = -0.5 * M[i, j] + b * t[i] * t[j]
            D[i, j] = 0.5 * D[i, j] + b * (t[i] * y[j] - 2.0 * y[i] * t[j]) + slope * bend * t[j]
        M[i, i] += 1.0 - b * square
        D[i, i] += b * dot
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += M[i, k] * R_m[j, k]
            N[i, j] = total
    for i in range(3):
        for j in range(3):
            by_p, by_turn, by_a, by_b = 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                by_p += N[i, k] * R_B_A[j, k]
                by_turn += N[i, k] * K[k, j]
                by_a += D[i, k] * J_a[3 + k, 3 + j]
                by_b += D[i, k] * J_b[3 + k, 3 + j]
            J_b[i, j], J_a[i, j] = by_p, -N[i, j]
            J_a[i, 3 + j] = by_turn + by_a
            J_b[i, 3 + j] = by_b


@compiled()
def relative_pose_jacobians(  # type: ignore[no-untyped-def]
    T, from_vertex, to_vertex, measured, W, is_log, error, J_a, J_b
):
    """Fill in W e (E, 6) and its derivatives (E, 6, 6) by [v, w] of A and of B."""
    e, p, q_B_A, y = np.empty(6), np.empty(3), np.empty(4), np.empty(3)
    R, q_A_B, q = np.empty((3, 3)), np.empty(4), np.empty(4)
    D_a, D_b, work = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 3, 3))
    parts = (work[0], work[1], work[2], work[3], work[4], work[5])
    for edge in range(len(from_vertex)):
        A, B = T[from_vertex[edge]], T[to_vertex[edge]]
        _residual(A, B, measured[edge], is_log[edge], e, p, q_B_A, y, R, q_A_B, q)
        _derivatives(measured[edge], is_log[edge], e, p, q_B_A, y, D_a, D_b, parts)
        _whitened(W[edge], e, D_a, D_b, error[edge], J_a[edge], J_b[edge])


@compiled(forceinline=True)
def _whitened(W, e, D_a, D_b, error, J_a, J_b):  # type: ignore[no-untyped-def]
    for i in range(6):
        total = 0.0
        for j in range(6):
            J_a[i, j], J_b[i, j] = 0.0, 0.0
        for k in range(6):
            w = W[i, k]
            if w == 0.0:  # half of them or more are
                continue
            total += w * e[k]
            for j in range(6):
                J_a[i, j] += w * D_a[k, j]
                J_b[i, j] += w * D_b[k, j]
        error[i] = total


QUADRATIC, SWITCHABLE, SCALED, CAUCHY = 0, 1, 2, 3
"""Losses: see `algorithms.relaxation.losses`."""


@compiled(forceinline=True)
def _loss(code, u, phi):  # type: ignore[no-untyped-def]
    """Return rho(u), rho'(u)."""
    if code == SWITCHABLE:
        s = phi / (phi + u)
        return s * u, s * s
    if code == SCALED and u > phi:
        s = 2.0 * phi / (phi + u)
        return phi * (3.0 * u - phi) / (u + phi), s * s
    if code == CAUCHY:
        return phi * np.log1p(u / phi), 1.0 / (1.0 + u / phi)
    return u, 1.0


@compiled()
def losses(code, u, phi):  # type: ignore[no-untyped-def]
    """Return rho(u) and rho'(u) of squared errors (E,)."""
    rho, weight = np.empty(len(u)), np.empty(len(u))
    for i in range(len(u)):
        rho[i], weight[i] = _loss(code, u[i], phi)
    return rho, weight


@compiled()
def robust_cost(  # type: ignore[no-untyped-def]
    T, from_vertex, to_vertex, measured, W, is_log, trust, first_robust, code, phi
):
    """Return the sum of trust rho(|W e|^2); edges before `first_robust` have no loss."""
    e, p, q_B_A, y = np.empty(6), np.empty(3), np.empty(4), np.empty(3)
    R, q_A_B, q = np.empty((3, 3)), np.empty(4), np.empty(4)
    cost = 0.0
    for edge in range(len(from_vertex)):
        if trust[edge] == 0.0:
            continue
        A, B = T[from_vertex[edge]], T[to_vertex[edge]]
        _residual(A, B, measured[edge], is_log[edge], e, p, q_B_A, y, R, q_A_B, q)
        u = 0.0
        for i in range(6):
            total = 0.0
            for j in range(6):
                total += W[edge, i, j] * e[j]
            u += total * total
        if edge >= first_robust:
            u, _ = _loss(code, u, phi)
        cost += trust[edge] * u
    return cost


@compiled()
def normal_equations(  # type: ignore[no-untyped-def]
    T,
    from_vertex,
    to_vertex,
    measured,
    W,
    is_log,
    trust,
    first_robust,
    code,
    phi,
    bend,
    slot,
    node_a,
    node_b,
    blocks,
    gradient,
    diagonal,
):
    """Fill in the normal equations of `robust_cost` / 2; return the cost.

    Args:
        T: Poses (V, 7).
        from_vertex: A (E,).
        to_vertex: B (E,).
        measured: T_A_B (E, 7).
        W: (E, 6, 6).
        is_log: (E,).
        trust: (E,) factor of each edge's cost.
        first_robust: First edge that has a loss.
        code: Loss.
        phi: Price of the loss.
        bend: Whether to add the second derivatives of logarithmic residuals (see `_bend`).
        slot: Rows (E, 3) of `blocks` for A with A, B with B, and the block below the diagonal;
            -1 = not wanted. The last is (B, A); where A comes after B it is -2 - row, for (A, B).
            The first two are shared by the edges of a pose, the last is the edge's own.
        node_a: Node (E,) of A, -1 where A does not move.
        node_b: Node (E,) of B.
        blocks: (N, 6, 6); those below the diagonal are written, lower triangles of the others added.
        gradient: (nodes, 6), J^T W e is added.
        diagonal: (nodes, 6), the diagonals of the Gauss-Newton blocks are added.
    """
    e, p, q_B_A, y = np.empty(6), np.empty(3), np.empty(4), np.empty(3)
    R, q_A_B, q = np.empty((3, 3)), np.empty(4), np.empty(4)
    D_a, D_b, work = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 3, 3))
    parts = (work[0], work[1], work[2], work[3], work[4], work[5])
    E, J_a, J_b = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    room, dual = np.empty((7, 6, 6)), np.empty((3, 6))
    cost = 0.0
    for edge in range(len(from_vertex)):
        A, B = T[from_vertex[edge]], T[to_vertex[edge]]
        a, b, below = slot[edge, 0], slot[edge, 1], slot[edge, 2]
        if trust[edge] == 0.0:
            _clear(blocks, below)
            continue
        _residual(A, B, measured[edge], is_log[edge], e, p, q_B_A, y, R, q_A_B, q)
        _derivatives(measured[edge], is_log[edge], e, p, q_B_A, y, D_a, D_b, parts)
        _whitened(W[edge], e, D_a, D_b, E, J_a, J_b)
        u, w = 0.0, 1.0
        for i in range(6):
            u += E[i] * E[i]
        if edge >= first_robust:
            u, w = _loss(code, u, phi)
        cost += trust[edge] * u
        w *= trust[edge]
        if a >= 0:
            _add(J_a, E, w, blocks[a], gradient[node_a[edge]], diagonal[node_a[edge]])
        if b >= 0:
            _add(J_b, E, w, blocks[b], gradient[node_b[edge]], diagonal[node_b[edge]])
        if below >= 0:
            _product(J_b, J_a, w, blocks[below])
        elif below < -1:
            _product(J_a, J_b, w, blocks[-below - 2])
        if bend and is_log[edge]:
            _bend(W[edge], E, e, D_a, D_b, room, dual)
            _add_bend(room, w, a, b, below, blocks)
    return cost


@compiled()
def _clear(blocks, below):  # type: ignore[no-untyped-def]
    """Set the own block of an edge without weight to zero."""
    if below != -1:
        blocks[below if below >= 0 else -below - 2] = 0.0


@compiled(forceinline=True)
def _ad(x, out):  # type: ignore[no-untyped-def]
    """Fill in ad_x (6, 6) of a twist [v, w]: ad_x y = [w_x x v_y + v_x x w_y, w_x x w_y]."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
    for first, offset in ((3, 0), (0, 3)):
        a, b, c = x[first], x[first + 1], x[first + 2]
        out[0, offset + 1], out[0, offset + 2] = -c, b
        out[1, offset + 0], out[1, offset + 2] = c, -a
        out[2, offset + 0], out[2, offset + 1] = -b, a
    out[3, 4], out[3, 5] = -x[5], x[4]
    out[4, 3], out[4, 5] = x[5], -x[3]
    out[5, 3], out[5, 4] = -x[4], x[3]


@compiled(forceinline=True)
def _dual(f, out):  # type: ignore[no-untyped-def]
    """Fill in C (6, 6) with x^T C y = f^T ad_x y: antisymmetric, as ad_x y = -ad_y x."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
    for row, col, part in ((3, 0, 0), (0, 3, 0), (3, 3, 3)):
        a, b, c = f[part], f[part + 1], f[part + 2]
        out[row + 0, col + 1], out[row + 0, col + 2] = c, -b
        out[row + 1, col + 0], out[row + 1, col + 2] = -c, a
        out[row + 2, col + 0], out[row + 2, col + 1] = b, -a


@compiled(forceinline=True)
def _bend(W, E, e, J_a, J_b, room, dual):  # type: ignore[no-untyped-def]
    """Fill room[0], [1], [2] with what second derivatives add to the blocks AA, BB and BA.

    With d = x_b - Ad x_a (+ [-Ad x_a, x_b] / 2 + ..), e changes by Jr^-1(e) d + Jr^-1'(e)[Jr^-1 d] d / 2,
    Jr^-1 = I + ad_e / 2 + ad_e^2 / 12 - ..: J_b is Jr^-1 and J_a is -Jr^-1 Ad. The slope of Jr^-1 is
    taken to the first order in e, which is enough for steps that converge almost as Newton's.
    """
    AA, BB, BA, ad, C, M, Ad = room[0], room[1], room[2], room[3], room[4], room[5], room[6]
    f, g, h = dual[0], dual[1], dual[2]
    for j in range(6):  # f = W^T W e
        total = 0.0
        for i in range(6):
            total += W[i, j] * E[i]
        f[j] = total
    _ad(e, ad)
    for j in range(6):
        total, other = 0.0, 0.0
        for i in range(6):
            total += ad[i, j] * f[i]
            other += J_b[i, j] * f[i]
        g[j], h[j] = total, other
    _dual(f, C)
    _dual(g, M)
    for i in range(6):  # M = C(f) / 2 + (C(f) ad_e + C(ad_e^T f)) / 12
        for j in range(6):
            total = M[i, j]
            for k in range(6):
                total += C[i, k] * ad[k, j]
            BA[i, j] = 0.5 * C[i, j] + total / 12.0
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += J_b[k, i] * BA[k, j]
            M[i, j] = total
    for i in range(6):
        for j in range(6):
            BB[i, j] = 0.5 * (M[i, j] + M[j, i])
    _solve_six(J_b, J_a, Ad, M)
    _dual(h, C)
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += (0.5 * C[i, k] - BB[i, k]) * Ad[k, j]
            BA[i, j] = total
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += BB[i, k] * Ad[k, j]
            M[i, j] = total
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += Ad[k, i] * M[k, j]
            AA[i, j] = total


@compiled(forceinline=True)
def _solve_six(J_b, J_a, out, work):  # type: ignore[no-untyped-def]
    """Fill in -J_b^-1 J_a (6, 6) by elimination; J_b is near the identity, so without pivoting."""
    for i in range(6):
        for j in range(6):
            work[i, j] = J_b[i, j]
            out[i, j] = -J_a[i, j]
    for k in range(6):
        for i in range(6):
            if i == k or work[i, k] == 0.0:
                continue
            factor = work[i, k] / work[k, k]
            for j in range(k, 6):
                work[i, j] -= factor * work[k, j]
            for j in range(6):
                out[i, j] -= factor * out[k, j]
    for i in range(6):
        for j in range(6):
            out[i, j] /= work[i, i]


@compiled(forceinline=True)
def _add_bend(room, w, a, b, below, blocks):  # type: ignore[no-untyped-def]
    for i in range(6):
        for j in range(6):
            if a >= 0:
                blocks[a, i, j] += w * room[0, i, j]
            if b >= 0:
                blocks[b, i, j] += w * room[1, i, j]
            if below >= 0:
                blocks[below, i, j] += w * room[2, i, j]
            elif below < -1:
                blocks[-below - 2, j, i] += w * room[2, i, j]


@compiled(forceinline=True)
def _add(J, E, w, block, gradient, diagonal):  # type: ignore[no-untyped-def]
    """Add w J^T J to the lower triangle of a block, its diagonal and w J^T E to the others."""
    for k in range(6):
        e = w * E[k]
        for i in range(6):
            x = J[k, i]
            gradient[i] += x * e
            diagonal[i] += w * x * x
            for j in range(i + 1):
                block[i, j] += w * x * J[k, j]


@compiled(forceinline=True)
def _product(A, B, w, out):  # type: ignore[no-untyped-def]
    """Fill in w A^T B."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
    for k in range(6):
        for i in range(6):
            a = w * A[k, i]
            for j in range(6):
                out[i, j] += a * B[k, j]
