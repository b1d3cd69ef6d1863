"""Compile all kernels before tests start in several processes, so that none is compiled twice."""

import time

from maplab_py.compilation import TARGET
from maplab_py.estimation.codegen.modules import is_generated
from maplab_py.kernel_cache import PACKAGED, cache_folder
from maplab_py.progress import SILENT
from maplab_py.warmup import compile_kernels


def compiled_ahead() -> str:
    """Compile the kernels if some are missing on the disk; say how long it took, else nothing."""
    has_searches = any(cache_folder(TARGET).glob("search_kernels.search_cells-*"))
    if (PACKAGED / TARGET).is_dir() or (is_generated("visual") and has_searches):
        return ""
    began = time.perf_counter()
    compile_kernels(SILENT)
    return f"compiled the kernels in {time.perf_counter() - began:.0f} s"
