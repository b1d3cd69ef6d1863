"""Detection of calibrations that new segments contradict, and sums of the segments' information.

Evidence of a segment is its score (gradient of the log likelihood at the current calibration) and its
information; both add up over segments. Every family of parameters is tested over all time spans that
end with the newest segment, as in a generalised likelihood ratio test for a change at an unknown time.
"""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.pruning import SegmentEstimate
from maplab_py.array_types import F64, I64

CONTRADICTED_SIGMAS = 5.0
"""Of a standard normal variable. With 12 families and 9 spans a segment, chance exceeds it once in 10^4
segments of four seconds, half a day."""
_SPANS = 8
_AXIS_WORDS = {"about", "x", "y", "z", "xy", "xz", "yz", "u", "v", "w"}


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """Score and information of a segment's data on errors of the current calibration."""

    begin_ns: int
    end_ns: int
    score: F64  # (k,)
    information: F64  # (k, k) of the data, without the prior
    score_covariance: F64  # (k, k) if the calibration is right


@dataclasses.dataclass(frozen=True)
class Contradiction:
    """A family of parameters whose calibration the data contradict."""

    family: str
    since_ns: int
    sigmas: float

    @property
    def is_significant(self) -> bool:
        """Whether chance is no explanation."""
        return self.sigmas >= CONTRADICTED_SIGMAS


def evidence_of(estimate: SegmentEstimate, begin_ns: int, end_ns: int) -> Evidence:
    """Return the evidence of a segment that was calibrated alone.

    The estimate c is shrunk by the prior: with the posterior information L, the score of the data is L c.
    """
    prior = np.diag(estimate.parameters.prior_sigma**-2.0)
    information = np.linalg.inv(estimate.formal)
    covariance = information @ estimate.actual @ information - prior
    return Evidence(
        begin_ns, end_ns, information @ estimate.change, information - prior, covariance
    )


def families(parameters: Parameters) -> dict[str, I64]:
    """Return the rows of the parameters that change together, such as "gyroscope scale", by name."""
    rows: dict[str, list[int]] = {}
    for row, parameter in enumerate(parameters.each):
        words = [word for word in parameter.name.split() if word not in _AXIS_WORDS]
        if "distortion" in words:
            words = words[: words.index("distortion") + 1]
        rows.setdefault(" ".join(words), []).append(row)
    return {name: np.array(of_family) for name, of_family in rows.items()}


def strongest_contradiction(
    evidence: Sequence[Evidence], parameters: Parameters, tolerance: F64
) -> Contradiction | None:
    """Return the strongest contradiction of the newest segments; None of a single segment, an accident maybe.

    Args:
        evidence: Of the segments of a session, in the order of time.
        parameters: What is calibrated.
        tolerance: Errors (k,) of the calibration that are no contradiction, as standard deviations.
    """
    last, best = len(evidence), None
    firsts = {0, *range(max(last - _SPANS, 0), last - 1)} if last > 1 else set()
    of_family = families(parameters)
    for first in sorted(firsts):
        span = evidence[first:]
        score = np.sum([each.score for each in span], axis=0)
        information = np.sum([each.information for each in span], axis=0)
        covariance = np.sum([each.score_covariance for each in span], axis=0)
        spread = covariance + (information * tolerance**2) @ information
        sigmas = max(_sigmas(score, spread, rows) for rows in of_family.values())
        if best is None or sigmas > best.sigmas:
            # the family that explains the data best by itself
            name = max(of_family, key=lambda name: _sigmas(score, covariance, of_family[name]))
            best = Contradiction(name, span[0].begin_ns, sigmas)
    return best


def _sigmas(score: F64, covariance: F64, rows: I64) -> float:
    """Return how improbable some rows of a score are, as a deviation of a standard normal variable."""
    from scipy.special import chdtrc, erfcinv

    variance = np.maximum(np.diag(covariance)[rows], 1e-300)
    scaled = score[rows] / np.sqrt(variance)
    correlation = covariance[np.ix_(rows, rows)] / np.sqrt(np.outer(variance, variance))
    chi_square = float(scaled @ np.linalg.lstsq(correlation, scaled, rcond=1e-9)[0])
    probability = float(chdtrc(len(rows), max(chi_square, 0.0)))
    if probability > 1e-300:
        return float(np.sqrt(2.0) * erfcinv(probability))
    return float(np.sqrt(chi_square))


def joint_covariance(covariances: Iterable[F64], prior_sigma: F64) -> F64:
    """Return the covariance (k, k) that segments leave together, from those they leave alone.

    Args:
        covariances: (k, k) of the calibration given one segment and the prior.
        prior_sigma: (k,) prior deviations, part of each of them.
    """
    prior = np.diag(prior_sigma**-2.0)
    information = prior + sum((np.linalg.inv(each) - prior for each in covariances), 0.0 * prior)
    return np.asarray(np.linalg.inv(information))
