"""Compiled kernels work where nothing can be written to disk."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import numba.core.caching as caching
for locator in caching.CacheImpl._locator_classes:
    locator.from_function = classmethod(lambda cls, function, source: None)
from maplab_py.estimation.linear.symbolic import postorder
import numpy as np
print(postorder(np.array([1, 2, -1])).tolist())
"""


def test_no_writable_cache_means_compiling_anew():
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[0, 1, 2]"
