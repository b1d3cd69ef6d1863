"""Commands that optimise the selected map, and what compiles their kernels ahead of time."""

from maplab_plugins.map_optimization.compilation import compile_ahead, warmup
from maplab_plugins.map_optimization.optimization import optimize_visual, optimize_visual_inertial

__all__ = ["compile_ahead", "optimize_visual", "optimize_visual_inertial", "warmup"]
