"""Advice: one line at the prompt where a result shows what to do next, and nowhere else."""

from __future__ import annotations

import dataclasses

import pytest

from maplab_py.algorithms.anchoring.options import AnchoringReport
from maplab_py.algorithms.landmarks.options import LandmarkQualityReport
from maplab_py.algorithms.loop_closure.reports import LoopClosureReport, Verdict
from maplab_py.console.commands.registry import Plugin
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.plugin import CommandContext, Report, command
from tests.console.sample_plugin import make_session


@dataclasses.dataclass(frozen=True)
class Advised(Report):
    value: int = 1

    @property
    def advice(self) -> str:
        return "go on"


@command("advised", needs_map=False)
def advised(context: CommandContext) -> Advised:
    """Give advice."""
    return Advised()


@pytest.mark.parametrize(
    ("is_prompt", "line", "is_shown"),
    [
        (True, "advised", True),
        (False, "advised", False),
        (True, "set advice=false; advised", False),
        (True, "set advice=false; unset advice; advised", True),
    ],
)
def test_advice_is_shown_at_the_prompt_unless_it_is_disabled(
    is_prompt: bool, line: str, is_shown: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = ConsoleTerminal()
    terminal.is_prompt = is_prompt
    runner = Runner(make_session(), terminal)
    runner.session.registry.add(advised.maplab_command, Plugin("p"))  # type: ignore[attr-defined]
    assert runner.run_text(line) == Status.OK
    assert ("next: go on" in capsys.readouterr().out) == is_shown


QUALITY = LandmarkQualityReport(100, 6, 94, 0, 50, 50, 0, too_few_observers=90, too_far=10)


@pytest.mark.parametrize(
    ("report", "part"),
    [
        (QUALITY, "94 % of the landmarks are bad, 90 of them for too few observers"),
        (QUALITY, "--elq_min_observers"),
        (dataclasses.replace(QUALITY, good=60, bad=40), ""),
        (LoopClosureReport(candidates=9, refused={Verdict.IMPLAUSIBLE.value: 9}), "relax first"),
        (LoopClosureReport(candidates=9), "lc_report --which=refused"),
        (LoopClosureReport(candidates=9, accepted=9), ""),
        (LoopClosureReport(candidates=9, accepted=9, landmarks_merged=4), "optvi"),
        (AnchoringReport((), (), {"61dc0de3": "reason"}, ()), "see `why 61dc0de3`"),
        (AnchoringReport((), ("61dc0de3",), {}, ()), ""),
    ],
)
def test_reports_advise_where_it_is_earned(report: Report, part: str) -> None:
    assert part in report.advice
    assert bool(part) == bool(report.advice)
