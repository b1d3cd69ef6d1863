"""What the joint filter tells, in the form of the other calibrations."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.self_calibration.calibration import starting_values
from maplab_py.algorithms.self_calibration.information import name_direction, spectrum
from maplab_py.algorithms.self_calibration.joint_ekf import FilteredCalibration
from maplab_py.algorithms.self_calibration.reports import ParameterEstimate, SelfCalibrationReport

_UNKNOWN = 0.5
"""Share of the prior's variance beyond which the data say less than the prior."""


def report_of(result: FilteredCalibration) -> SelfCalibrationReport:
    """Return the report; a filter has no costs and no iterations."""
    found = spectrum(result.covariance, result.parameters)
    directions = found.unobservable(_UNKNOWN)
    return SelfCalibrationReport(
        parameters=_estimates(result),
        unobservable=tuple(name_direction(one, result.parameters) for one in directions.T),
        without_scale=(),
        segments=0,
        partitions=1,
        gaps=0,
        keyframes=len(result.history),
        landmarks=result.tracks,
        observations=result.observations,
        inconsistent_landmarks=result.tracks_rejected,
        keypoint_noise_factor=1.0,  # the filter believes what the map says
        track_deviation_factor=1.0,
        cost_before=float("nan"),
        cost_after=float("nan"),
        chi_square_per_freedom=result.mean_square,
        iterations=0,
        termination=f"filtered once; {result.tracks_rejected} tracks rejected",
        seconds_pose=0.0,
        seconds_solve=result.seconds,
    )


def _estimates(result: FilteredCalibration) -> tuple[ParameterEstimate, ...]:
    sigma = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    before = starting_values(result.parameters, result.before)
    rows = []
    for k, (one, change) in enumerate(zip(result.parameters.each, result.change, strict=True)):
        share = (sigma[k] / one.prior_sigma) ** 2
        verdict = "well determined" if share < 0.01 else "weakly determined"
        rows.append(
            ParameterEstimate(
                one.name,
                one.unit,
                float(before[k]),
                float(before[k] + change),
                float(sigma[k]),
                float(change / max(sigma[k], 1e-300)),
                "not excited, left at its prior" if share > _UNKNOWN else verdict,
            )
        )
    return tuple(rows)
