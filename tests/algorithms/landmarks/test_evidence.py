"""Evidence of landmarks: records, histories of merged landmarks, the persistence filter."""

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.evidence import (
    LANDMARK_EVIDENCE,
    RECENT,
    Session,
    add_session,
    inherit,
    no_evidence,
    read_evidence,
    with_evidence,
)
from maplab_py.algorithms.landmarks.persistence import (
    Detection,
    PersistenceOptions,
    existence,
    learn_detection,
    match_rates,
    summarise_oldest,
)
from maplab_py.errors import MapError
from maplab_py.storage.extension_fields import with_extension
from tests.vimap.builders import walk_map

DAY_S = 86_400
OPTIONS = PersistenceOptions()
PRIOR = Detection(1.4, 0.6)


def histories(outcomes: np.ndarray, days: int = 10) -> np.ndarray:
    """Return records of landmarks (N,) with outcomes (N, sessions): 1 matched, 0 missed, -1 not seen."""
    evidence = no_evidence(len(outcomes))
    evidence["born_s"] = DAY_S
    for number, column in enumerate(outcomes.T):
        rows = np.flatnonzero(column >= 0)
        session = Session(
            DAY_S * (1 + days * (number + 1)), rows, np.full(len(rows), 3), 2 * column[rows]
        )
        _, full = add_session(evidence, session)
        evidence = summarise_oldest(evidence, full, OPTIONS, PRIOR)
        evidence, _ = add_session(evidence, session)
    return evidence


def by_definition(outcomes: list[int], days: int, options: PersistenceOptions) -> float:
    """Return the probability of existence by the sum over all times of vanishing."""
    from scipy.special import beta

    def survival(count: int) -> float:
        w = options.lasting_share
        return float(w + (1.0 - w) * np.exp(-days * count / options.lifetime_days))

    def likelihood(alive: int) -> float:
        hits = sum(outcomes[:alive])
        a, b = PRIOR.hits, PRIOR.misses
        value = beta(a + hits, b + alive - hits) / beta(a, b)
        for hit in outcomes[alive:]:
            value *= options.false_match if hit else 1.0 - options.false_match
        return float(value)

    n = len(outcomes)
    exists = likelihood(n) * survival(n)
    vanished = sum(likelihood(i) * (survival(i) - survival(i + 1)) for i in range(n))
    return exists / (exists + vanished)


def test_the_filter_is_the_sum_over_all_times_of_vanishing() -> None:
    for outcomes in ([1], [0], [1, 0, 0], [0, 0, 1], [1, 1, 1, 0, 0, 0]):
        evidence = histories(np.array([outcomes]))
        expected = by_definition(outcomes, 10, OPTIONS)
        assert existence(evidence, OPTIONS, detection=PRIOR) == pytest.approx(expected, rel=1e-6)


def test_summarised_sessions_count_like_recent_ones() -> None:
    outcomes = [1, 1, 0, 1, 1, 1, 0, 1, 1, 0, 0, 0, 0]
    assert len(outcomes) > RECENT
    evidence = histories(np.array([outcomes]))
    expected = by_definition(outcomes, 10, OPTIONS)
    assert existence(evidence, OPTIONS, detection=PRIOR) == pytest.approx(expected, rel=1e-5)
    assert evidence["hits"][0] + evidence["misses"][0] == len(outcomes) - RECENT


def test_misses_make_a_landmark_unlikely_and_a_match_brings_it_back() -> None:
    missed, seen_again = np.array([[1, 1] + [0] * 8]), np.array([[1, 1] + [0] * 4 + [1]])
    sure = Detection(14.0, 6.0)  # that seven of ten sessions match a landmark that exists
    assert existence(histories(missed), OPTIONS, detection=sure)[0] < 0.1
    assert existence(histories(seen_again), OPTIONS, detection=sure)[0] > 0.9


def test_the_probability_falls_with_time_and_earlier_dates_ignore_later_sessions() -> None:
    evidence = histories(np.array([[1, 1, 0, 0, 0]]))
    last = DAY_S * 51.0
    now, later, before = (
        existence(evidence, OPTIONS, at_s=t, detection=PRIOR)[0]
        for t in (last, last + 900 * DAY_S, DAY_S * 21.0)
    )
    assert later < now < before


def test_nothing_known_means_that_the_landmark_exists() -> None:
    assert existence(no_evidence(2), OPTIONS).tolist() == [1.0, 1.0]


def test_the_detection_prior_is_learned_from_many_outcomes() -> None:
    rng = np.random.default_rng(0)
    outcomes = (rng.uniform(size=(400, 6)) < 0.9).astype(np.int64)
    assert learn_detection(histories(outcomes), OPTIONS).mean == pytest.approx(0.9)
    few = learn_detection(histories(outcomes[:10]), OPTIONS)
    assert few.mean == pytest.approx(OPTIONS.detection)
    rates = match_rates(histories(np.array([[1, 1, 1], [0, 0, 0]])), OPTIONS, PRIOR)
    assert rates[0] > 0.8 > 0.4 > rates[1]


def test_a_session_counts_once() -> None:
    evidence = histories(np.array([[1, 0]]))
    rows = np.array([0])
    again = Session(DAY_S * 21, rows, np.array([5]), np.array([1]))
    united, full = add_session(evidence, again)
    assert not full.any()
    assert united["recent"][0, -1].tolist() == (DAY_S * 21, 5, 1)
    assert (united["recent"]["time_s"][0] > 0).sum() == 2


def with_sessions(evidence: np.ndarray, days: list[int]) -> np.ndarray:
    rows = np.arange(len(evidence))
    for day in days:
        session = Session(DAY_S * day, rows, np.full(len(rows), 3), np.full(len(rows), day % 2))
        _, full = add_session(evidence, session)
        evidence = summarise_oldest(evidence, full, OPTIONS, PRIOR)
        evidence, _ = add_session(evidence, session)
    return evidence


def test_the_order_in_which_sessions_are_added_does_not_matter() -> None:
    born = no_evidence(2)
    born["born_s"] = DAY_S
    in_order = with_sessions(born, [5, 10, 20, 40])
    mixed = with_sessions(born, [40, 10, 5, 20])
    assert mixed.tobytes() == in_order.tobytes()


def test_summarised_sessions_are_not_counted_again() -> None:
    born = no_evidence(2)
    born["born_s"] = DAY_S
    days = list(range(2, 2 + RECENT + 4))
    full = with_sessions(born, days)
    assert full["hits"][0] + full["misses"][0] == 4
    assert with_sessions(full, days).tobytes() == full.tobytes()
    missing = with_sessions(born, [d for d in days if d != 4])
    assert with_sessions(missing, [4]).tobytes() == missing.tobytes()


def test_summaries_of_merged_landmarks_are_not_added_up() -> None:
    born = no_evidence(2)
    born["born_s"] = DAY_S
    evidence = with_sessions(born, list(range(2, 2 + RECENT + 4)))
    assert inherit(evidence, np.array([1]), np.array([0]))[0] == evidence[0]
    evidence[1] = with_sessions(born, [2, 3, 30])[1]
    merged = inherit(evidence, np.array([1]), np.array([0]))[0]
    assert merged["hits"] == evidence["hits"][0]
    days = merged["recent"]["time_s"] // DAY_S
    assert days.tolist() == [*range(7, 2 + RECENT + 4), 30]


def test_the_filter_is_the_sum_over_uneven_times() -> None:
    from scipy.special import beta

    days, hits = [3, 10, 60, 61], [1, 1, 0, 0]
    w, life, f = OPTIONS.lasting_share, OPTIONS.lifetime_days, OPTIONS.false_match
    survival = [w + (1 - w) * np.exp(-day / life) for day in (0, *days)]
    table = []  # joint probability of the outcomes and of vanishing after so many of them
    for alive in range(len(days) + 1):
        n = sum(hits[:alive])
        seen = beta(PRIOR.hits + n, PRIOR.misses + alive - n) / beta(PRIOR.hits, PRIOR.misses)
        after = np.prod([f if hit else 1 - f for hit in hits[alive:]])
        until = survival[alive + 1] if alive < len(days) else 0.0
        table.append(seen * after * (survival[alive] - until))
    evidence = no_evidence(1)
    evidence["born_s"] = DAY_S
    for day, hit in zip(days, hits, strict=True):
        session = Session(DAY_S * (1 + day), np.array([0]), np.array([1]), np.array([hit]))
        evidence, _ = add_session(evidence, session)
    expected = table[-1] / sum(table)
    assert existence(evidence, OPTIONS, detection=PRIOR) == pytest.approx(expected, rel=1e-9)


def test_a_merged_landmark_inherits_both_histories() -> None:
    evidence = histories(np.array([[1, 0, -1], [-1, 1, 0], [1, 1, 1]]))
    merged = inherit(evidence, np.array([1]), np.array([0]))
    recent = merged["recent"][0]
    known = recent["time_s"] > 0
    assert recent["matched"][known].tolist() == [2, 2, 0]
    assert merged[2] == evidence[2]
    twice = inherit(evidence, np.array([1, 2]), np.array([0, 0]))
    assert (twice["recent"]["matched"][0][-3:] > 0).tolist() == [True, True, True]


def test_evidence_is_kept_in_the_map_and_can_be_forgotten() -> None:
    vi_map = walk_map()
    count = len(vi_map.landmarks)
    assert (read_evidence(vi_map)["born_s"] == 0).all()
    outcomes = np.random.default_rng(1).integers(-1, 2, (count, 4))
    evidence = histories(outcomes)
    kept = with_evidence(vi_map, evidence)
    assert read_evidence(kept).tobytes() == evidence.tobytes()
    assert not any(with_evidence(kept, None).landmarks.unknown)


def test_damaged_evidence_is_refused_with_a_remedy() -> None:
    vi_map = walk_map()
    unknown = vi_map.landmarks.unknown.copy()
    unknown[0] = with_extension(b"", LANDMARK_EVIDENCE, b"short")
    damaged = vi_map.replace(landmarks=vi_map.landmarks.replace(unknown=unknown))
    with pytest.raises(MapError, match="gather_evidence --forget"):
        read_evidence(damaged)
