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
    e, D = np.empty(6), np.empty((12, 6))
    for k in range(len(edges.first)):
        A, B = T[edges.first[k]], T[edges.second[k]]
        linearised(A, B, edges.T_A_B[k], e, D[:6].reshape(36), D[6:].reshape(36))
        whiten(edges.sqrt_information[k], e, D, whitened[k], J[k].reshape(12, 6))


@rows_of_six
def whiten(W, e, D, whitened, J):
    """Fill in W e and its derivatives, J (12, 6); D (12, 6) are J_B and C."""
    for i in range(6):
        x = W[i, 0] * e[0] + W[i, 1] * e[1] + W[i, 2] * e[2]
        whitened[i] = x + W[i, 3] * e[3] + W[i, 4] * e[4] + W[i, 5] * e[5]
        B = W[i, 0] * D[0] + W[i, 1] * D[1] + W[i, 2] * D[2]
        B = B + W[i, 3] * D[3] + W[i, 4] * D[4] + W[i, 5] * D[5]
        J[i + 6] = B
        A = B[0] * D[6] + B[1] * D[7] + B[2] * D[8]
        J[i] = A + B[3] * D[9] + B[4] * D[10] + B[5] * D[11]


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
    e, D = np.empty(6), np.empty((12, 6))
    whitened, J = np.empty(6), np.empty((12, 6))
    diagonal_block, gradient, diagonal = system.diagonal_block, system.gradient, system.diagonal
    total = 0.0
    for k in range(len(edges.first)):
        below = system.below[k]
        if not weights.is_active[k]:
            if below >= 0:
                system.blocks[below] = 0.0
            continue
        A, B = T[edges.first[k]], T[edges.second[k]]
        linearised(A, B, edges.T_A_B[k], e, D[:6].reshape(36), D[6:].reshape(36))
        whiten(edges.sqrt_information[k], e, D, whitened, J)
        s = 0.0
        for i in range(6):
            s += whitened[i] * whitened[i]
        kind = weights.loss if k >= weights.first_robust else 0
        rho, weight = rho_and_weight(kind, s, weights.scale2)
        total += rho
        for side in range(2):
            if system.node[k, side] >= 0:
                node = system.node[k, side]
                add_pose(J[6 * side :], whitened, weight, node, diagonal_block, gradient, diagonal)
        if below >= 0:
            row = 0 if system.node[k, 0] > system.node[k, 1] else 6
            product(J, row, 6 - row, weight, system.blocks, below)
    return total


@rows_of_six
def add_pose(J, whitened, weight, node, blocks, gradient, diagonal):
    """Add weight J' J to a pose's block, its diagonal apart as well, and weight J' W e to its gradient."""
    x0 = J[0]
    x1 = J[1]
    x2 = J[2]
    x3 = J[3]
    x4 = J[4]
    x5 = J[5]
    g = x0 * whitened[0] + x1 * whitened[1] + x2 * whitened[2]
    g = g + x3 * whitened[3] + x4 * whitened[4] + x5 * whitened[5]
    gradient[node] = gradient[node] + weight * g
    squares = x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 + x4 * x4 + x5 * x5
    diagonal[node] = diagonal[node] + weight * squares
    for i in range(6):
        x = x0 * J[0, i] + x1 * J[1, i] + x2 * J[2, i] + x3 * J[3, i] + x4 * J[4, i]
        blocks[node, i] = blocks[node, i] + weight * (x + x5 * J[5, i])


@rows_of_six
def product(J, first, second, weight, blocks, place):
    """Fill in weight A' B for matrices that begin at rows of J (12, 6)."""
    x0 = J[second]
    x1 = J[second + 1]
    x2 = J[second + 2]
    x3 = J[second + 3]
    x4 = J[second + 4]
    x5 = J[second + 5]
    for i in range(6):
        x = x0 * J[first, i] + x1 * J[first + 1, i] + x2 * J[first + 2, i]
        x = x + x3 * J[first + 3, i] + x4 * J[first + 4, i] + x5 * J[first + 5, i]
        blocks[place, i] = weight * x


@compiled()
def add_tilt(T, priors, system, is_wanted):
    """Return the sum of squares of tilts / sigma; add their normal equations if they are wanted."""
    e, D, J = np.zeros(6), np.empty(12), np.zeros((6, 6))
    total = 0.0
    for k in range(len(priors.vertex)):
        tilt(T[priors.vertex[k]], priors.q_G_I[k], e, D)
        total += priors.weight * (e[0] * e[0] + e[1] * e[1])
        if not is_wanted or priors.node[k] < 0:
            continue
        for i in range(2):
            for j in range(6):
                J[i, j] = D[2 * j + i]
        node = priors.node[k]
        add_pose(J, e, priors.weight, node, system.diagonal_block, system.gradient, system.diagonal)
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
