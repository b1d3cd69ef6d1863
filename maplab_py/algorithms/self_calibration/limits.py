"""Flags that make no sense are refused before anything is computed."""

from __future__ import annotations

import dataclasses

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.errors import UserError

_AT_LEAST = {
    "segments_per_group": 1,
    "segment_keyframes": 3,
    "num_iterations": 1,
    "min_shared_landmarks": 0,
    "min_parallax_deg": 0.0,
}


def checked(options: SelfCalibrationOptions) -> SelfCalibrationOptions:
    """Return the options if they can be used.

    Raises:
        UserError: A number is out of its range, or a name is unknown; the message names the flag.
    """
    options.estimated()
    options.grouping()
    for name, least in _AT_LEAST.items():
        value = getattr(options, name)
        if not value >= least:
            raise UserError(f"--{options.flag_prefix}{name}={value:g}: wants at least {least:g}")
    for field in dataclasses.fields(options):
        if field.name.startswith("prior_") and not getattr(options, field.name) > 0.0:
            value = getattr(options, field.name)
            raise UserError(
                f"--{options.flag_prefix}{field.name}={value:g}: wants a positive deviation; to "
                "hold something, leave it out of --sc_states"
            )
    return options
