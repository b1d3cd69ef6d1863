"""Missions that were aligned with each other are anchored as soon as one of them is."""

from __future__ import annotations

from maplab_py.algorithms.anchoring.options import AnchoringReport, MissionAlignment
from maplab_py.server.alignments import OpenAlignments

A, B, C, D = (letter * 32 for letter in "abcd")
NAMES = {id_[:8]: id_ for id_ in (A, B, C, D)}


def report(*pairs: tuple[str, str], known: str = "", verdict: str = "used") -> AnchoringReport:
    unknown = {id_[:8]: "" for pair in pairs for id_ in pair if id_ != known}
    alignments = tuple(
        MissionAlignment(f"{a[:8]} - {b[:8]}", 5, 5, 0.01, verdict) for a, b in pairs
    )
    return AnchoringReport((known[:8],), (), unknown, alignments)


def test_pairs_wait_for_one_of_their_missions() -> None:
    pairs = OpenAlignments()
    pairs.note(report((A, B), (B, C)), NAMES, [0, 1])
    pairs.note(report((B, C)), NAMES, [2])
    assert pairs.take([D], 5) == {}
    assert pairs.take([C], 5) == {B: {0, 1, 2}}
    assert pairs.take([C], 5) == {}
    assert pairs.take([B], 5) == {A: {0, 1}}


def test_alignments_that_do_not_hold_and_known_missions_are_not_remembered() -> None:
    pairs = OpenAlignments()
    pairs.note(report((A, B), verdict="3 closures agree, 4 are needed"), NAMES, [0])
    pairs.note(report((C, D), known=C), NAMES, [1])
    assert pairs.take([A, C], 5) == {}


def test_a_step_takes_as_many_as_it_may_and_a_copy_is_independent() -> None:
    pairs = OpenAlignments()
    pairs.note(report((A, B), (A, C), (A, D)), NAMES, [0])
    copy = pairs.copy()
    assert list(copy.take([A], 2)) == [B, C]
    assert list(copy.take([A], 2)) == [D]
    assert len(pairs.take([A], 5)) == 3
