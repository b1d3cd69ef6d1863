"""Commands that optimise the selected map, and `warmup`."""

from maplab_plugins.map_optimization.compilation import warmup
from maplab_plugins.map_optimization.optimization import optimize_visual, optimize_visual_inertial

__all__ = ["optimize_visual", "optimize_visual_inertial", "warmup"]
