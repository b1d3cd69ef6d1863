"""The table of localised queries as CSV."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.localization.localization import Localizations, Reference, pose_errors
from maplab_py.array_types import F64
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex_list

_HEADER = (
    "vertex,timestamp_ns,outcome,keypoints,matches,inliers,"
    "q_x,q_y,q_z,q_w,p_x,p_y,p_z,position_error_m,orientation_error_deg,matching_ms,ransac_ms\n"
)


def csv_lines(
    query: VIMap, localizations: Localizations, reference: Reference, T_R_G: F64 | None
) -> list[str]:
    """Return a header and one line per query; errors are empty where T_R_G (7,) is not known."""
    nan = np.full(len(localizations.vertex), np.nan)
    position, orientation = (
        (nan, nan) if T_R_G is None else pose_errors(localizations, reference, T_R_G)
    )
    lines = [_HEADER]
    names = to_hex_list(query.vertices.id[localizations.vertex])
    times = query.vertices.timestamp_ns[localizations.vertex].tolist()
    for row, answer in enumerate(localizations.answers):
        pose = (
            ",".join(f"{value:.9g}" for value in answer.T_G_I)
            if localizations.is_localized[row]
            else ",,,,,,"
        )
        errors = f"{position[row]:.6g},{orientation[row]:.6g}" if position[row] >= 0.0 else ","
        spent = f"{1e3 * answer.matching_s:.3f},{1e3 * answer.ransac_s:.3f}"
        counts = f"{answer.keypoints},{answer.matches},{answer.inliers}"
        lines.append(
            f"{names[row]},{times[row]},{answer.outcome.value},{counts},{pose},{errors},{spent}\n"
        )
    return lines
