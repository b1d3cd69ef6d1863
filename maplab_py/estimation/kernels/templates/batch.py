"""Residuals and Jacobians of many factors of one kind, whitened; see `codegen.factor_kernels`.

`residual` is generated, and how many numbers go in and come out: INPUTS, ROWS and COLUMNS.
"""

# ruff: noqa: F821
# mypy: ignore-errors
# --- kernels ---


@compiled(parallel=True)
def evaluate(arguments, sqrt_information, whitened, jacobian):
    """Evaluate N factors.

    In: arguments (N, A) all inputs side by side, sqrt_information (N, m, m).
    Out: whitened (N, m) and jacobian (N, m, D), both multiplied by the square-root information.
    """
    count, size = whitened.shape
    columns = jacobian.shape[2]
    for n in prange(count):
        r, J = np.empty(size), np.empty(size * columns)
        residual(arguments[n], r, J)
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += sqrt_information[n, i, j] * r[j]
            whitened[n, i] = total
            for c in range(columns):
                total = 0.0
                for j in range(size):
                    total += sqrt_information[n, i, j] * J[c * size + j]
                jacobian[n, i, c] = total


def evaluated(arguments, sqrt_information):
    """Return whitened residuals (N, ROWS) and Jacobians (N, ROWS, COLUMNS) of N factors."""
    count = len(arguments)
    whitened, jacobian = np.empty((count, ROWS)), np.empty((count, ROWS, COLUMNS))
    evaluate(arguments, sqrt_information, whitened, jacobian)
    return whitened, jacobian


def compile_kernel():
    """Compile `evaluate` by one call."""
    evaluated(np.ones((1, INPUTS)), np.eye(ROWS)[None])
