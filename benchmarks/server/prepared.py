"""What a worker makes of a submap, in this process."""

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.vimap import VIMap


def prepared(submap: VIMap) -> VIMap:
    """Return a submap optimised by itself."""
    judged, _ = evaluate_quality(submap, LandmarkQualityOptions())
    return optimize(judged, VIOptimizationOptions(hide_iterations_console_output=True))[0]
