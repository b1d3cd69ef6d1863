"""Compile all kernels before tests start in several processes, so that none is compiled twice."""

from __future__ import annotations

import time

from maplab_py.compilation import is_missing_on_disk
from maplab_py.estimation.codegen.modules import is_generated
from maplab_py.progress import SILENT
from maplab_py.vision.pose_kernels import search_poses
from maplab_py.vision.search_kernels import search_cells
from maplab_py.warmup import compile_kernels


def compiled_ahead() -> str:
    """Compile the kernels if some are missing on the disk; say how long it took, else nothing."""
    written_by_hand = (search_poses, search_cells)
    has_searches = not any(is_missing_on_disk(kernel) for kernel in written_by_hand)
    if is_generated("visual") and has_searches:
        return ""
    began = time.perf_counter()
    compile_kernels(SILENT)
    return f"compiled the kernels in {time.perf_counter() - began:.0f} s"
