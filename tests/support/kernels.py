"""Compile all kernels before tests start in several processes, so that none is compiled twice."""

from __future__ import annotations

import multiprocessing
import time

from maplab_py.algorithms.warmup import compile_kernels
from maplab_py.compilation import is_missing_on_disk
from maplab_py.estimation.codegen.kernels import visual_module_name
from maplab_py.estimation.codegen.modules import is_generated
from maplab_py.estimation.terms import visual
from maplab_py.progress import SILENT
from maplab_py.sensors import Distortion, Projection
from maplab_py.simulation.warmup import RENDERING, compile_rendering
from maplab_py.vision.pose_kernels import search_poses
from maplab_py.vision.search_kernels import search_cells

TWO_MODELS = ((Projection.PINHOLE, Distortion.FOV), (Projection.PINHOLE, Distortion.NONE))
"""A rig that tests use and that `maplab warmup` does not compile."""


def compiled_ahead() -> str:
    """Compile the kernels if some are missing on the disk; say how long it took, else nothing."""
    written_by_hand = (search_poses, search_cells)
    has_rig = is_generated(visual_module_name(TWO_MODELS))
    if has_rig and not any(is_missing_on_disk(kernel) for kernel in written_by_hand):
        return ""
    began = time.perf_counter()
    rig = multiprocessing.get_context("spawn").Process(target=compile_two_models)
    rig.start()
    compile_kernels(SILENT, {RENDERING: compile_rendering})
    rig.join()
    return f"compiled the kernels in {time.perf_counter() - began:.0f} s"


def compile_two_models() -> None:
    """Compile the rig of two models."""
    visual.compile_kernels(TWO_MODELS, calibrating=False)
