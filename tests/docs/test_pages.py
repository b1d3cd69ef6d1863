"""The documentation does what it says: commands run, links lead somewhere, pages are up to date."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from maplab_py.console.commands.lines import split_commands
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.report import Report
from maplab_py.simulation.scenario_file import parse_scenario
from tests.docs.markdown import blocks, links
from tests.support.data import REPOSITORY

DOCS = REPOSITORY / "docs"
PAGES = sorted([*REPOSITORY.glob("*.md"), *DOCS.rglob("*.md")])


def script_module(name: str) -> ModuleType:
    """Return a script of docs/scripts as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_command_pages_are_those_of_the_registry() -> None:
    registry = load_registry()
    assert registry.problems == []
    expected = script_module("generate_command_pages").pages(registry)
    present = {path.name: path.read_text() for path in (DOCS / "commands").glob("*.md")}
    assert sorted(present) == sorted(expected)
    stale = [name for name, text in expected.items() if present[name] != text]
    assert stale == [], "run docs/scripts/generate_command_pages.py"


def test_the_picture_shows_every_package_with_about_its_lines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(DOCS / "scripts")
    script = script_module("draw_rooms")
    title = re.compile(r"<title>(\S+?):? ([\d,]+)(?: lines)?</title>")
    shown, present = (
        {name: int(lines.replace(",", "")) for name, lines in title.findall(text)}
        for text in (script.TARGET.read_text(), script.drawing())
    )
    assert {"maplab_plugins", "estimation", "estimation/window", "vimap"} <= set(present)
    assert set(shown) == set(present), "run docs/scripts/draw_rooms.py"
    stale = [name for name, lines in shown.items() if abs(lines - present[name]) > 0.25 * lines]
    assert stale == [], "run docs/scripts/draw_rooms.py"


def _flag_sections() -> dict[str, tuple[set[str], set[str]]]:
    """Return the flags that each section and each entry tells, and its links, by page#anchor."""
    entry = re.compile(r"^\[`--(\w+)`\]\(#([\w-]+)\)\{#\2\}.*\n: ", re.MULTILINE)
    sections: dict[str, tuple[set[str], set[str]]] = {}
    for path in (DOCS / "commands").glob("*.md"):
        text = path.read_text()
        anchors = {anchor: name for name, anchor in entry.findall(text)}
        assert len(anchors) == len(entry.findall(text)), f"{path.name} has an anchor twice"
        sections |= {f"{path.name}#{anchor}": ({name}, set()) for anchor, name in anchors.items()}
        parts = re.split(r"^##+ (.*)$", text, flags=re.MULTILINE)
        for title, body in zip(parts[1::2], parts[2::2], strict=True):
            links = re.findall(r"\]\(([\w.]*)#([\w-]+)\)(?!\{)", body)
            sections[f"{path.name}#{title.lower().replace(' ', '-')}"] = (
                {name for name, _ in entry.findall(body)},
                {f"{page or path.name}#{anchor}" for page, anchor in links},
            )
    return sections


def test_every_flag_of_a_command_has_an_entry_that_can_be_linked() -> None:
    sections = _flag_sections()
    registry = load_registry()
    for command in registry.commands:
        told: set[str] = set()
        pending = [f"{registry.owner(command)}.md#{command.name}"]
        while pending:
            flags, links = sections.get(pending.pop(), (set(), set()))
            told |= flags
            pending += links
        assert set(command.flags) <= told, command.name


def test_generated_pages_are_up_to_date() -> None:
    migration = script_module("generate_migration_page")
    for path, text in (
        (migration.PAGE, migration.page(load_registry())),
        (migration.FLAGS_PAGE, migration.flags_page(load_registry())),
    ):
        assert path.read_text() == text, "run docs/scripts/generate_migration_page.py"
    api = script_module("generate_api_page")
    assert api.PAGE.read_text() == api.page(), "run docs/scripts/generate_api_page.py"
    script = script_module("generate_command_pages")
    for folder, expected in (("decisions", script.decisions()), ("studies", script.studies())):
        assert (DOCS / folder / "index.md").read_text() == expected, (
            "run docs/scripts/generate_command_pages.py"
        )


def test_tables_of_contents_are_the_menu() -> None:
    menu = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text())["nav"]
    titles = [title for entry in menu for title in entry]
    assert len(titles) == 6
    for path in (REPOSITORY / "README.md", DOCS / "index.md"):
        table = path.read_text().split("| contents | |\n|---|---|\n", 1)[1].split("\n\n", 1)[0]
        cells = [row.split("|")[1].strip() for row in table.splitlines()]
        assert [re.sub(r"\[(.*)\]\(.*\)|\*\*(.*)\*\*", r"\1\2", cell) for cell in cells] == titles


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_links_lead_somewhere(path: Path) -> None:
    missing = [target for target in links(path) if not (path.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_commands_on_pages_exist_with_their_flags(path: Path) -> None:
    session = Session()
    for _, text in blocks(path, "maplab"):
        for words in split_commands(text):
            call = session.parse(words)
            assert call.arguments() is not None


def _tutorial(part: str) -> list[tuple[str, str]]:
    """Return the blocks of the tutorial before or after the heading of its second part."""
    every = list(blocks(DOCS / "tutorial.md", "maplab", "python"))
    second = next(i for i, (_, text) in enumerate(every) if "three_sessions" in text)
    return every[:second] if part == "recording" else every[second:]


def _run(session: Session, texts: list[str], shown: str) -> list[Report]:
    """Run the commands of some blocks; return the reports of one of the commands."""
    reports = []
    for words in (words for text in texts for words in split_commands(text)):
        report = session.execute(session.parse(words))
        assert report.failure == ""
        if words[0] == shown:
            reports.append(report)
    return reports


def test_tutorial_of_three_sessions_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    parts = _tutorial("sessions")
    with Session() as session:
        before, after = _run(
            session, [text for kind, text in parts if kind == "maplab"], "evaluate_map"
        )
    assert after.ate_m <= 0.25 * before.ate_each_m
    assert (tmp_path / "merged" / "vi_map").is_dir()
    assert (tmp_path / "trajectory.csv").is_file()
    ((_, code),) = (block for block in parts if block[0] == "python")
    exec(compile(code, "tutorial.md", "exec"), {})


@pytest.mark.slow
def test_tutorial_of_a_recording_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with Session() as session:
        odometry, closed = _run(
            session, [text for _, text in _tutorial("recording")], "evaluate_trajectory"
        )
    assert odometry.ape_m.rmse <= 0.02
    assert closed.ape_m.rmse <= 0.5 * odometry.ape_m.rmse
    assert (tmp_path / "flight_map" / "vi_map").is_dir()


@pytest.mark.slow
def test_dense_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with Session() as session:
        for _, text in blocks(DOCS / "tutorial_dense.md", "maplab"):
            for words in split_commands(text):
                assert session.execute(session.parse(words)).failure == ""
    for name in ("odometry.ply", "optimised.glb", "distances.ply"):
        assert (tmp_path / name).stat().st_size > 100_000
    assert len(list((tmp_path / "dense_room" / "resources" / "voxblox_esdf_map").iterdir())) == 1
    assert (tmp_path / "dense_colmap" / "stereo" / "patch-match.cfg").is_file()


def test_scenario_of_the_simulation_page_is_one() -> None:
    (_, text), *_ = blocks(DOCS / "simulation.md", "yaml")
    scenario = parse_scenario(text, "simulation.md")
    assert len(scenario.cameras) == 2
    assert len(scenario.sessions) == 2


def test_commands_of_the_readme_are_known() -> None:
    names = load_registry().names
    prompts = [
        line.split("$", 1)[1].split("#")[0].split()
        for _, text in blocks(REPOSITORY / "README.md", "")
        for line in text.splitlines()
        if line.startswith("maplab <")
    ]
    assert len(prompts) > 10
    assert [words[0] for words in prompts if words[0] not in [*names, "quit"]] == []


def test_python_blocks_compile() -> None:
    compiled = 0
    for path in PAGES:
        for _, text in blocks(path, "python"):
            compile(text, str(path), "exec")
            compiled += 1
    assert compiled >= 5


def test_decisions_say_why_and_what_was_rejected_on_a_page() -> None:
    decisions = sorted((DOCS / "decisions").glob("0*.md"))
    numbers = [int(path.name[:4]) for path in decisions]
    assert numbers == list(range(1, len(decisions) + 1))
    for number, path in zip(numbers, decisions, strict=True):
        text = path.read_text()
        assert text.startswith(f"# {number}. "), f"{path.name} has another number in its title"
        for part in ("**Decision.**", "**Reasons.**", "**Rejected.**"):
            assert part in text, f"{path.name} lacks {part}"
        assert len(text.split()) <= 450, f"{path.name} is longer than a page"


def test_studies_begin_with_question_answer_and_limits() -> None:
    studies = [path for path in (DOCS / "studies").glob("*.md") if path.name != "index.md"]
    assert len(studies) >= 10
    for path in studies:
        paragraphs = path.read_text().split("\n\n")
        for paragraph, part in zip(paragraphs[1:], ("Question", "Answer", "Limits"), strict=False):
            assert paragraph.startswith(f"**{part}.** "), f"{path.name} lacks {part}"
