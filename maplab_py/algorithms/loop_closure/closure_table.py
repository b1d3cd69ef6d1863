"""Table of accepted and rejected closures."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.vimap.table import ragged_rows, starts_of_counts

VERDICTS = tuple(Verdict)
"""Codes of the `verdict` column are indices into this tuple."""


@dataclasses.dataclass(frozen=True, eq=False)
class Closures:
    """Poses of query vertices relative to places; M is the mission frame of the place."""

    id: NDArray[np.uint64]  # (N, 2)
    query_vertex: I64  # (N,)
    place_vertex: I64  # (N,)
    T_M_I: F64  # (N, 7) of the query, as verified
    T_A_B: F64  # (N, 7) pose of the place's vertex (B) in the query (A)
    covariance: F64  # (N, 6, 6) of T_M_I, [dp, dtheta]
    match_count: I64  # (N,) keypoints with a match in the place
    inlier_count: I64  # (N,)
    tilt_deg: F64  # (N,)
    correction_m: F64  # (N,) change of the query's position, in G
    correction_deg: F64  # (N,) change of the query's attitude
    verdict: NDArray[np.int8]  # (N,) index into VERDICTS
    support: I64  # (N,) number of other query vertices with consistent closures
    start: I64  # (N + 1,) inlier matches of closure i are rows start[i] .. start[i + 1] - 1
    keypoint: I64  # keypoint row of the map
    landmark: I64  # landmark row
    bits: NDArray[np.int32]  # different bits

    def __len__(self) -> int:
        return len(self.query_vertex)

    def take(self, rows: I64) -> Closures:
        """Return the closures of a mask or rows."""
        inliers = ragged_rows(self.start, rows)
        per_match = ("keypoint", "landmark", "bits")
        columns = {
            field.name: getattr(self, field.name)[inliers if field.name in per_match else rows]
            for field in dataclasses.fields(self)
            if field.name != "start"
        }
        return Closures(**columns, start=starts_of_counts(np.diff(self.start)[rows]))

    @property
    def accepted(self) -> Mask:
        """Mask (N,) of the closures that passed all gates."""
        return np.asarray(self.verdict == VERDICTS.index(Verdict.ACCEPTED))

    def refused_by_reason(self) -> dict[str, int]:
        """Count the rejected closures by reason."""
        count = np.bincount(self.verdict, minlength=len(VERDICTS))
        return {
            verdict.value: int(n)
            for verdict, n in zip(VERDICTS, count, strict=True)
            if n and verdict is not Verdict.ACCEPTED
        }
