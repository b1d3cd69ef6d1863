"""The table of closures, accepted and refused ones."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.report import Verdict

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

VERDICTS = tuple(Verdict)
"""Codes of the `verdict` column are indices into this tuple."""


@dataclasses.dataclass(frozen=True, eq=False)
class Closures:
    """Query vertices located in places of a mission; M is the frame of the place's mission."""

    query_vertex: I64  # (N,)
    place_vertex: I64  # (N,)
    T_M_I: F64  # (N, 7) of the query, as verified
    covariance: F64  # (N, 6, 6) of T_M_I, [dp, dtheta]
    match_count: I64  # (N,) keypoints with a match in the place
    inlier_count: I64  # (N,)
    tilt_deg: F64  # (N,)
    correction_m: F64  # (N,) change of the query's position, in G
    verdict: NDArray[np.int8]  # (N,) index into VERDICTS
    support: I64  # (N,) other query vertices whose closures agree
    start: I64  # (N + 1,) inlier matches of closure i are rows start[i] .. start[i + 1] - 1
    keypoint: I64  # keypoint row of the map
    landmark: I64  # landmark row
    bits: NDArray[np.int32]  # different bits

    def __len__(self) -> int:
        return len(self.query_vertex)

    @property
    def accepted(self) -> Mask:
        """Which closures (N,) passed all gates."""
        return np.asarray(self.verdict == VERDICTS.index(Verdict.ACCEPTED))

    def refused_by_reason(self) -> dict[str, int]:
        """Count the refused closures by reason."""
        count = np.bincount(self.verdict, minlength=len(VERDICTS))
        return {
            verdict.value: int(n)
            for verdict, n in zip(VERDICTS, count, strict=True)
            if n and verdict is not Verdict.ACCEPTED
        }
