"""Loops over the edges of a pose graph: residuals, cost, normal equations, steps.

`error`, `linearised`, `second`, `tilt` and `retraction` are generated from `symbolic.pose_graph`. The loops
take some milliseconds for thousands of edges, less than it costs to wake threads on a busy machine:
they run on one. T is poses (V, 7); edges, weights and system are described in `terms.pose_graph` and
`problem.pose_graph`.
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---


@compiled()
def linearize(T, edges, whitened, J):
    """Fill in W e (E, 6) and its derivatives (E, 2, 6, 6) by twists of A and of B."""
    e, D = np.empty(6), np.empty((2, 36))
    for k in range(len(edges.first)):
        linearised(T[edges.first[k]], T[edges.second[k]], edges.T_A_B[k], e, D[0], D[1])
        whiten(edges.sqrt_information[k], e, D, whitened[k], J[k])


@compiled(forceinline=True)
def whiten(W, e, D, whitened, J):
    """Multiply the residual and both derivatives, D (2, 36) by columns, by W."""
    for i in range(6):
        total = 0.0
        for j in range(6):
            J[0, i, j], J[1, i, j] = 0.0, 0.0
        for k in range(6):
            w = W[i, k]
            if w == 0.0:  # half of them or more are
                continue
            total += w * e[k]
            for j in range(6):
                J[0, i, j] += w * D[0, 6 * j + k]
                J[1, i, j] += w * D[1, 6 * j + k]
        whitened[i] = total


@compiled()
def cost(T, edges, weights):
    """Return the sum of rho(|W e|^2) over the active edges."""
    e, total = np.empty(6), 0.0
    for k in range(len(edges.first)):
        if not weights.is_active[k]:
            continue
        error(T[edges.first[k]], T[edges.second[k]], edges.T_A_B[k], e)
        W = edges.sqrt_information[k]
        s = 0.0
        for i in range(6):
            whitened = 0.0
            for j in range(6):
                whitened += W[i, j] * e[j]
            s += whitened * whitened
        kind = weights.loss if k >= weights.first_robust else 0
        total += rho_and_weight(kind, s, weights.scale2)[0]
    return total


@compiled()
def normal_equations(T, edges, weights, system):
    """Add the normal equations of half the cost to a system; return the cost."""
    e, D = np.empty(6), np.empty((2, 36))
    whitened, J = np.empty(6), np.empty((2, 6, 6))
    total = 0.0
    for k in range(len(edges.first)):
        below = system.below[k]
        if not weights.is_active[k]:
            if below >= 0:
                system.blocks[below] = 0.0
            continue
        linearised(T[edges.first[k]], T[edges.second[k]], edges.T_A_B[k], e, D[0], D[1])
        whiten(edges.sqrt_information[k], e, D, whitened, J)
        s = 0.0
        for i in range(6):
            s += whitened[i] * whitened[i]
        kind = weights.loss if k >= weights.first_robust else 0
        rho, weight = rho_and_weight(kind, s, weights.scale2)
        total += rho
        for side in range(2):
            if system.node[k, side] >= 0:
                add_pose(J[side], whitened, 6, weight, system, system.node[k, side])
        if below >= 0:
            row = 0 if system.node[k, 0] > system.node[k, 1] else 1
            product(J[row], J[1 - row], weight, system.blocks[below])
    return total


@compiled(forceinline=True)
def add_pose(J, whitened, rows, weight, system, node):
    """Add weight J' J to the lower triangle of a pose's block and weight J' W e to its gradient."""
    block, gradient, diagonal = (
        system.diagonal_block[node],
        system.gradient[node],
        system.diagonal[node],
    )
    for k in range(rows):
        error = weight * whitened[k]
        for i in range(6):
            x = J[k, i]
            gradient[i] += x * error
            diagonal[i] += weight * x * x
            for j in range(i + 1):
                block[i, j] += weight * x * J[k, j]


@compiled(forceinline=True)
def product(A, B, weight, out):
    """Fill in weight A' B."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
    for k in range(6):
        for i in range(6):
            a = weight * A[k, i]
            for j in range(6):
                out[i, j] += a * B[k, j]


@compiled()
def add_tilt(T, priors, system, is_wanted):
    """Return the sum of squares of tilts / sigma; add their normal equations if they are wanted."""
    e, D, J = np.empty(2), np.empty(12), np.empty((2, 6))
    total = 0.0
    for k in range(len(priors.vertex)):
        tilt(T[priors.vertex[k]], priors.q_G_I[k], e, D)
        total += priors.weight * (e[0] * e[0] + e[1] * e[1])
        if not is_wanted or priors.node[k] < 0:
            continue
        for i in range(2):
            for j in range(6):
                J[i, j] = D[2 * j + i]
        add_pose(J, e, 2, priors.weight, system, priors.node[k])
    return total


@compiled()
def moved(T, vertices, twists):
    """Return poses (V, 7) of which some, vertices (N,), are moved by twists (N, 6)."""
    result = T.copy()
    for k in range(len(vertices)):
        retraction(T[vertices[k]], twists[k], result[vertices[k]])
    return result


@compiled()
def add_second_derivatives(T, edges, weights, system):
    """Add what second derivatives of the active edges, which have no loss, contribute."""
    e, g = np.empty(6), np.empty(6)
    H = np.empty((3, 36))
    for k in range(len(edges.first)):
        if not weights.is_active[k]:
            continue
        A, B, W = T[edges.first[k]], T[edges.second[k]], edges.sqrt_information[k]
        error(A, B, edges.T_A_B[k], e)
        g[:] = 0.0
        for i in range(6):
            whitened = 0.0
            for j in range(6):
                whitened += W[i, j] * e[j]
            for j in range(6):
                g[j] += W[i, j] * whitened
        second(A, B, edges.T_A_B[k], g, H[0], H[1], H[2])
        a, b, below = system.node[k, 0], system.node[k, 1], system.below[k]
        for i in range(6):
            for j in range(6):
                if a >= 0:
                    system.diagonal_block[a, i, j] += H[0, 6 * j + i]
                if b >= 0:
                    system.diagonal_block[b, i, j] += H[1, 6 * j + i]
                if below >= 0:
                    row, column = (i, j) if b > a else (j, i)
                    system.blocks[below, row, column] += H[2, 6 * j + i]
