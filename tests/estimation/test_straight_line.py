"""Functions lowered to instructions give what Python gives, and refuse what has no instruction."""

import math

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.compilation import compiled, numba
from maplab_py.estimation.codegen.straight_line import row, rows_of_six, straight_line


def all_operations(x: F64, y: F64) -> None:
    a = x[0]
    b = x[1]
    y[0] = a + b
    y[1] = a - b
    y[2] = a * b
    y[3] = a / b
    y[4] = -a
    c = abs(b)
    y[5] = math.sqrt(c)
    y[6] = math.sin(a) * math.cos(a)
    y[7] = math.atan2(a, b)
    y[8] = math.copysign(1.0, b)
    y[9] = 1.0 if a < b else 0.0
    y[10] = a if b != 0.0 else 0.0
    y[11] = 1.0 if a == 0.0 else 0.0
    y[12] = math.exp(a) + math.log(c)


def remainder(x: F64, y: F64) -> None:
    y[0] = x[0] % 3.0


FIRST = 2


def of_rows(S: F64, k: int, Y: F64, z: float, y: F64) -> None:
    """Have rows, numbers, loops and computed indices."""
    p = Y[k + 1, 0]
    q = row(y[FIRST], y[3], y[4], y[5], y[6], z)
    for c in range(6):
        S[k, c] = S[k, c] - Y[k, 1, c] * p + q
    S[k + 1, 0] = z * q - p / y[FIRST + 2 * 1] + q[5] * p[k]


lowered, lowered_rows = straight_line(all_operations), rows_of_six(of_rows)
without_instruction = straight_line(remainder)


@compiled()
def run(x: F64, y: F64) -> None:
    lowered(x, y)


@compiled()
def run_rows(S: F64, k: int, Y: F64, z: float, y: F64) -> None:
    lowered_rows(S, k, Y, z, y)


@compiled()
def run_without(x: F64, y: F64) -> None:
    without_instruction(x, y)


@pytest.mark.parametrize("values", [(0.3, -0.7), (-2.0, 1e-9), (0.0, 5.0), (math.nan, 2.0)])
def test_it_computes_what_python_does(values: tuple[float, float]) -> None:
    x, expected, found = np.array(values), np.empty(13), np.empty(13)
    all_operations(x, expected)
    run(x, found)
    np.testing.assert_allclose(found, expected, rtol=1e-15)


def test_it_computes_rows_as_numpy_does() -> None:
    random = np.random.default_rng(4)
    S, Y, y = random.normal(size=(4, 6, 6)), random.normal(size=(4, 3, 6)), random.normal(size=9)
    expected = S.copy()
    of_rows(expected, 2, Y, 0.7, y)
    run_rows(S, 2, Y, 0.7, y)
    np.testing.assert_allclose(S, expected, rtol=1e-14, atol=1e-14)


def test_it_refuses_other_statements_and_other_arrays() -> None:
    with pytest.raises(ValueError, match=r"no instruction for .*Mod"):
        run_without(np.ones(1), np.ones(1))
    with pytest.raises(numba.core.errors.TypingError, match="all_operations"):
        run(np.ones(26)[::2], np.ones(13))
