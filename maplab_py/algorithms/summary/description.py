"""The content of a summary map in numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.algorithms.summary.reports import SummaryMapContent
from maplab_py.sensors import CameraRig
from maplab_py.storage.summary_map import SummaryMap


def describe(summary: SummaryMap, file: Path) -> SummaryMapContent:
    """Describe a summary map that was read from a file."""
    sigma = None
    if summary.landmark_covariance is not None and len(summary.p_G):
        variance = np.trace(summary.landmark_covariance, axis1=1, axis2=2)
        sigma = float(np.sqrt(np.median(variance)))
    extent = np.ptp(summary.p_G_observer, axis=0) if len(summary.p_G_observer) else np.zeros(3)
    sensors = summary.sensors.sensors.values() if summary.sensors is not None else ()
    return SummaryMapContent(
        landmarks=len(summary.p_G),
        observations=len(summary.descriptors),
        observers=len(summary.p_G_observer),
        descriptor_dimensions=summary.descriptors.shape[1],
        has_ids=summary.landmark_id is not None,
        has_projection=summary.projection is not None,
        cameras=sum(len(rig.cameras) for rig in sensors if isinstance(rig, CameraRig)),
        median_position_sigma_m=sigma,
        extent_m=(float(extent[0]), float(extent[1]), float(extent[2])),
        megabytes=file.stat().st_size * 1e-6,
    )
