"""Findings of the checks, their order, and the report on a recording."""

import dataclasses
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from maplab_py.report import Report, view


class Verdict(Enum):
    """Judgement on one check."""

    OK = "ok"
    UNKNOWN = "not seen"  # the recording does not show it
    NOTE = "note"  # works, but could be better
    WRONG = "wrong"
    HOPELESS = "cannot work"


_WEIGHT = {
    Verdict.HOPELESS: 3,
    Verdict.WRONG: 2,
    Verdict.NOTE: 1,
    Verdict.OK: 0,
    Verdict.UNKNOWN: 0,
}


@dataclasses.dataclass(frozen=True)
class Finding:
    """Result of one check: observed value, expected value, and remedy."""

    check: str
    observed: str
    expected: str
    verdict: Verdict
    remedy: str = ""  # names the line of the calibration or the flag

    @property
    def line(self) -> str:
        """Return the finding in one line."""
        text = f"{self.check}: {self.observed}, expected {self.expected}"
        return f"{text}: {self.remedy}" if self.remedy else text


@dataclasses.dataclass(frozen=True)
class Check:
    """A check with its expectation; its finding follows from the observed value."""

    name: str
    expected: str

    def ok(self, observed: str) -> Finding:
        """Return a finding without fault."""
        return Finding(self.name, observed, self.expected, Verdict.OK)

    def unknown(self, reason: str) -> Finding:
        """Return a finding that the recording cannot decide."""
        return Finding(self.name, reason, self.expected, Verdict.UNKNOWN)

    def note(self, observed: str, remedy: str) -> Finding:
        """Return a finding that can be improved."""
        return Finding(self.name, observed, self.expected, Verdict.NOTE, remedy)

    def wrong(self, observed: str, remedy: str) -> Finding:
        """Return a finding of a fault."""
        return Finding(self.name, observed, self.expected, Verdict.WRONG, remedy)

    def hopeless(self, observed: str, remedy: str) -> Finding:
        """Return a finding that prevents any map."""
        return Finding(self.name, observed, self.expected, Verdict.HOPELESS, remedy)


def cause(findings: Sequence[Finding]) -> Finding | None:
    """Return the finding to repair first: the first of the most severe; None without a fault.

    Checks run in the order of causes: what an earlier one finds may be why a later one complains.
    """
    worst = max((_WEIGHT[finding.verdict] for finding in findings), default=0)
    return next((f for f in findings if worst and _WEIGHT[f.verdict] == worst), None)


class RecordingCheck(Report):
    """Findings on a recording, causes before effects."""

    recording: str
    duration_s: float
    checked_images: int
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    sensors_file: Path | None = None  # that was written

    @property
    def cause(self) -> Finding | None:
        """The finding to repair first."""
        return cause(self.findings)

    @property
    def failure(self) -> str:
        """Return why no map can be made of the recording; empty if one can."""
        first = self.cause
        return first.line if first is not None and first.verdict is Verdict.HOPELESS else ""

    @property
    def advice(self) -> str:
        """Return the remedy to apply first."""
        first = self.cause
        if first is None:
            return f"rovioli {self.recording} --save_map_folder=FOLDER makes a map of it"
        if first.verdict is Verdict.HOPELESS:
            return ""
        return f"first: {first.check}{': ' + first.remedy if first.remedy else ''}"

    def display(self) -> Any:
        """Return the table, with the remedies below it."""
        names = ("check", "observed", "expected")
        return view(
            recording=self.recording,
            duration_s=self.duration_s,
            checked_images=self.checked_images,
            findings=[
                view(**{n: getattr(f, n) for n in names}, verdict=f.verdict.value)
                for f in self.findings
            ],
            remedies=remedies(self.findings),
            notes=self.notes,
            sensors_file=self.sensors_file,
        )


def remedies(findings: Sequence[Finding]) -> list[str]:
    """Return the remedies of findings with the names of their checks."""
    return [f"{f.check}: {f.remedy}" for f in findings if f.remedy]
