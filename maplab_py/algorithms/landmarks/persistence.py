"""Probability that landmarks still exist: a persistence filter on the evidence of sessions.

D. M. Rosen, J. Mason, J. J. Leonard: Towards lifelong feature-based mapping in semi-static environments,
ICRA 2016, sections III and IV. A landmark vanishes at an unknown time T with a survival prior
S(t) = P(T > t). While it exists a session that should see it matches it with probability d, afterwards by
mistake with probability f. With outcomes y_1 .. y_N at times t_1 .. t_N

    L_i = p(y_1 .. y_i | T > t_i),
    V_i = p(y_1 .. y_i, T <= t_i) = f(y_i) (V_{i-1} + L_{i-1} (S(t_{i-1}) - S(t_i))),
    P(T > t | y_1 .. y_N) = L_N S(t) / (V_N + L_N S(t_N))  for t >= t_N.

Beyond the paper d is not known but has a beta prior, since some landmarks are rarely detected: L_i is the
beta-binomial probability of the hits and misses so far, which needs no more than their numbers.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.algorithms.landmarks.evidence import NEVER, RECENT
from maplab_py.array_types import F64, Mask, NDArray
from maplab_py.options import Options, option

_DAY_S = 86_400.0
_MEANS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_STRENGTHS = (1.0, 2.0, 4.0, 8.0)
_MIN_SESSIONS = 500
"""Outcomes from which the detection prior is learned from the map instead of being taken as given."""


class PersistenceOptions(Options, prefix="persistence_"):
    """Prior knowledge about landmarks that vanish and about matches."""

    lasting_share: float = option(0.6, ge=0, le=1)
    """Share of landmarks that never vanish: walls, windows, lamps"""
    lifetime_days: float = option(365.0, gt=0, unit="days")
    """Mean lifetime of the others"""
    false_match: float = option(0.01, gt=0, lt=1)
    """Probability that a landmark which does not exist is matched in a session that should see it"""
    detection: float = option(0.7, gt=0, lt=1)
    """Mean probability that a session which should see a landmark matches it, until the map tells"""


@dataclasses.dataclass(frozen=True)
class Detection:
    """Beta prior of the probability that an existing landmark is matched in a session."""

    hits: float
    misses: float

    @property
    def mean(self) -> float:
        """Mean of the probability."""
        return self.hits / (self.hits + self.misses)


def existence(
    evidence: NDArray[Any],
    options: PersistenceOptions,
    *,
    at_s: float | None = None,
    detection: Detection | None = None,
) -> F64:
    """Return the probability (L,) that landmarks exist; 1 where nothing is known.

    Args:
        evidence: Records (L,).
        at_s: Time [s since 1970]; later evidence is ignored as far as it is not summarised. None = the
            last session of each landmark.
        detection: Detection prior; None = learned from the evidence.
    """
    prior = detection or learn_detection(evidence, options)
    state = _State.of(evidence, options, prior)
    for column in range(RECENT):
        entry = evidence["recent"][:, column]
        counts = entry["time_s"] > 0
        if at_s is not None:
            counts &= entry["time_s"] <= at_s
        state = state.after(entry["time_s"], entry["matched"] > 0, counts)
    end_s = state.time_s if at_s is None else np.maximum(state.time_s, at_s)
    alive = state.exists + state.log_survival(end_s)
    both = np.logaddexp(state.vanished, state.exists + state.log_survival(state.time_s))
    return np.where(evidence["born_s"] > 0, np.exp(np.minimum(alive - both, 0.0)), 1.0)


def match_rates(
    evidence: NDArray[Any], options: PersistenceOptions, detection: Detection | None = None
) -> F64:
    """Return the mean probability (L,) that a session matches a landmark, if it exists."""
    prior = detection or learn_detection(evidence, options)
    recent = evidence["recent"]
    is_hit = recent["matched"] > 0
    hits = evidence["hits"] + is_hit.sum(axis=1)
    misses = evidence["misses"] + ((recent["time_s"] > 0) & ~is_hit).sum(axis=1)
    return np.asarray((prior.hits + hits) / (prior.hits + prior.misses + hits + misses))


def learn_detection(evidence: NDArray[Any], options: PersistenceOptions) -> Detection:
    """Return the detection prior under which the outcomes of all landmarks are most likely.

    With few outcomes the mean is that of the options.
    """
    used = evidence[evidence["recent"]["time_s"][:, -1] > 0]
    given = Detection(2.0 * options.detection, 2.0 * (1.0 - options.detection))
    if int(np.count_nonzero(used["recent"]["time_s"])) < _MIN_SESSIONS:
        return given
    best, learned = -np.inf, given
    for mean in _MEANS:
        for strength in _STRENGTHS:
            prior = Detection(strength * mean, strength * (1.0 - mean))
            state = _State.of(used, options, prior)
            for column in range(RECENT):
                entry = used["recent"][:, column]
                state = state.after(entry["time_s"], entry["matched"] > 0, entry["time_s"] > 0)
            alive = state.exists + state.log_survival(state.time_s)
            total = float(np.logaddexp(state.vanished, alive).sum())
            if total > best:
                best, learned = total, prior
    return learned


def summarise_oldest(
    evidence: NDArray[Any], full: Mask, options: PersistenceOptions, detection: Detection
) -> NDArray[Any]:
    """Return records (L,) whose oldest session is summarised where `full` (L,)."""
    evidence = evidence.copy()
    state = _State.of(evidence, options, detection)
    oldest = evidence["recent"][:, 0].copy()
    after = state.after(oldest["time_s"], oldest["matched"] > 0, full & (oldest["time_s"] > 0))
    evidence["time_s"] = np.where(full, oldest["time_s"], evidence["time_s"])
    evidence["hits"] = np.minimum(after.hits, 65535)
    evidence["misses"] = np.minimum(after.misses, 65535)
    evidence["vanished"] = np.maximum(after.vanished, NEVER)
    recent = evidence["recent"]
    recent["time_s"][full, 0] = 0
    evidence["recent"] = recent
    return evidence


@dataclasses.dataclass(frozen=True, eq=False)
class _State:
    """The filter after some sessions; logarithms of L_i and V_i."""

    options: PersistenceOptions
    detection: Detection
    born_s: F64
    time_s: F64
    hits: F64
    misses: F64
    vanished: F64

    @classmethod
    def of(
        cls, evidence: NDArray[Any], options: PersistenceOptions, detection: Detection
    ) -> _State:
        """Return the filter after the summarised sessions."""
        born = evidence["born_s"].astype(np.float64)
        time_s = np.maximum(evidence["time_s"].astype(np.float64), born)
        hits, misses = (evidence[name].astype(np.float64) for name in ("hits", "misses"))
        vanished = evidence["vanished"].astype(np.float64)
        return cls(options, detection, born, time_s, hits, misses, vanished)

    @property
    def exists(self) -> F64:
        """Logarithm of the beta-binomial probability of the outcomes (L,)."""
        from scipy.special import betaln

        a, b = self.detection.hits, self.detection.misses
        return np.asarray(betaln(a + self.hits, b + self.misses) - betaln(a, b))

    def log_survival(self, time_s: F64) -> F64:
        """Return the logarithm of the survival prior (L,) at times (L,)."""
        days = np.maximum(time_s - self.born_s, 0.0) / _DAY_S
        share = self.options.lasting_share
        lasting = share + (1.0 - share) * np.exp(-days / self.options.lifetime_days)
        return np.asarray(np.log(np.maximum(lasting, 1e-300)))

    def after(self, time_s: NDArray[Any], is_hit: Mask, counts: Mask) -> _State:
        """Return the filter after one more outcome (L,) where it counts (L,)."""
        f = self.options.false_match
        time = np.where(counts, np.maximum(time_s.astype(np.float64), self.time_s), self.time_s)
        died = np.exp(self.log_survival(self.time_s)) - np.exp(self.log_survival(time))
        newly = self.exists + np.log(np.maximum(died, 1e-300))
        false = np.where(is_hit, np.log(f), np.log1p(-f))
        vanished = np.where(counts, np.logaddexp(self.vanished, newly) + false, self.vanished)
        return dataclasses.replace(
            self,
            time_s=time,
            hits=self.hits + (counts & is_hit),
            misses=self.misses + (counts & ~is_hit),
            vanished=vanished,
        )
