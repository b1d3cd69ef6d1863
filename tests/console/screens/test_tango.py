"""Reports on a recorded map at 80 columns: whole words, rows under every head, one table per thing."""

import re
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.maps import MapsState
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.drawing import drawn, fitted
from maplab_py.console.terminal.layout import Block, Pairs, Paragraph, Table
from maplab_py.vimap.ids import to_hex
from tests.console.screens.recording import Screen, screen_of
from tests.support.data import shared_data
from tests.support.machine import slowness

COLUMNS = 80
MOST_SECONDS_WITHOUT_BAR = 1.0

LINES = (
    "artificially_disturb_vertices",
    "check_map_consistency",
    "clean_up_resource_folders",
    "compare_calibrations --calibration=here",
    "compare_maps here",
    "copy_map --target_map_key=second",
    "csv_export_vertices_only --csv_export_path=csv",
    "delete_loopclosure_edges",
    "elq",
    "encc --ncamera_calibration_export_folder=calibration",
    "ettc --pose_export_file=poses.csv",
    "evaluate_trajectory truth.csv",
    "export_bag tango.bag",
    "export_calibration --format=kalibr --folder=kalibr",
    "export_g2o graph.g2o",
    "export_mission_info --mission_info_export_path=info.yaml",
    "flags",
    "flags lc_",
    "get_map_folder",
    "help",
    "help optvi",
    "kfh",
    "list",
    "list_maps_on_file_system .",
    "list_resource_folders",
    "list_scenarios",
    "load here --map_key=second",
    "map_size",
    "map_stats",
    "map_stats --map_mission=tango_handheld",
    "memory",
    "mission_coobservability_stats",
    "optvi --ba_num_iterations=2",
    "plugins",
    "print_baseframes",
    "print_camera_calibrations",
    "remove_mission --map_mission=tango_handheld --dry_run",
    "resource_statistics",
    "rbl",
    "rio",
    "rlq",
    "save --map_folder=saved --dry_run",
    "sbk",
    "snapshot before",
    "split_map --cell_count=2",
    "statistics",
    "timing",
    "why tango_handheld",
)
LONG_LINES = (
    "rtl",
    "save --map_folder=saved",
    "plot_errors --ground_truth=truth.csv --plot_file=errors.png",
    "lsparsify --num_landmarks_to_keep=500",
    "itl",
    "export_colmap --colmap_folder=colmap --undistort",
    "load here --map_key=second --dry_run",
    "visualize --viewer_port=0",
    "optv --ba_num_iterations=2",
    "collect_segments --database=tango.segments",
    "csv_export --csv_export_path=csv",
    "evaluate_segment_information",
    "lc --lc_insert_lc_edge_instead_of_merging",
    "lc --lc_max_merge_gap_m=2; lc_report; lc_report --which=refused --sort_by=near_miss; why {closure}",
    "relax",
    "why {landmark}",
    "srelax",
)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MapsState]:
    """Return a folder with the map, and the state of a session that has loaded it."""
    folder = tmp_path_factory.mktemp("tango")
    recorded = shared_data("maplab_maps/tango_handheld")
    (folder / "here").symlink_to(recorded)
    with Session() as session:
        session.run("load", map_folder=recorded)
        session.run("ettc", pose_export_file=folder / "truth.csv", csv_export_format="rpg")
        return folder, session.maps.state


@pytest.fixture
def runner(
    loaded: tuple[Path, MapsState], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Runner]:
    folder, state = loaded
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    screen = Screen()
    session = Session(load_registry(), screen)
    session.maps.state = state
    yield Runner(session, screen)
    session.watchers.close()


@pytest.mark.parametrize(
    "line", [*LINES, *(pytest.param(line, marks=pytest.mark.slow) for line in LONG_LINES)]
)
def test_reports(runner: Runner, line: str) -> None:
    for each in line.split("; "):
        check(runner, with_ids(runner.session, each))


def check(runner: Runner, line: str) -> None:
    screen = runner.terminal
    assert isinstance(screen, Screen)
    screen.steps, start = 0, time.process_time()
    shown = screen_of(runner, screen, line)
    seconds = time.process_time() - start
    assert shown
    assert screen.steps or seconds < MOST_SECONDS_WITHOUT_BAR * slowness(), f"{seconds:.1f} s"
    errors = [item for item in shown if isinstance(item, str) and item.startswith("error: ")]
    assert errors == []
    blocks = [item for item in shown if not isinstance(item, str)]
    for block in blocks:
        assert_whole_words(block)
        assert_not_empty(block)
        if isinstance(block, Table):
            assert_same_decimals(block)
    assert_one_table_for_one_thing([block for block in blocks if isinstance(block, Table)])


def with_ids(session: Session, line: str) -> str:
    """Return a line with the id of a refused closure or of a landmark where it wants one."""
    if "{closure}" in line:
        report = session.run("lc_report", which="refused").as_dict()
        return line.format(closure=report["closures"][0]["id"])
    return line.format(landmark=to_hex(session.vi_map.landmarks.id[0]))


def assert_whole_words(block: Block) -> None:
    """Every word of every cell stands whole in some line, and no line is too wide without need."""
    lines = drawn(block, COLUMNS, coloured=False).splitlines()
    words = {word for line in lines for word in line.split()}
    for text in texts_of(block):
        assert set(text.split()) <= words, text
    longest = max(map(len, words), default=0)
    assert max(map(len, lines)) <= COLUMNS or longest > COLUMNS / 2, lines


def texts_of(block: Block) -> list[str]:
    """Return the texts of a block that are drawn at this width."""
    if isinstance(block, Paragraph):
        return [block.text]
    if isinstance(block, Pairs):
        return [text for row in block.rows for text in row]
    if block.are_entries:
        return [block.title, *(cell for row in block.rows for cell in (row[0], row[-1]))]
    shown = fitted(block, COLUMNS).table
    return [block.title, *shown.heads, *(cell for row in shown.rows for cell in row)]


def assert_not_empty(block: Block) -> None:
    """A table has rows, pairs have values, a paragraph says something behind its colon."""
    if isinstance(block, Paragraph):
        assert block.text.strip()
        assert not re.fullmatch(r"[^\n]*:", block.text.strip())
    else:
        assert block.rows, block
        assert any(cell.strip() for row in block.rows for cell in row[1:]), block


def assert_same_decimals(table: Table) -> None:
    """The numbers of a column have the same number of decimals, or all of them exponents."""
    for column, head in enumerate(table.heads):
        if not table.is_number[column]:
            continue
        cells = [row[column] for row in table.rows]
        numbers = [cell for cell in cells if re.fullmatch(r"-?\d+\.\d+(e[+-]\d+)?", cell)]
        forms = {re.sub(r"^-?\d+", "", re.sub(r"e[+-]\d+", "e", number)) for number in numbers}
        assert len({len(form) for form in forms}) <= 1, (head, numbers)


def assert_one_table_for_one_thing(tables: list[Table]) -> None:
    """No two tables have the same title, or the same rows by their first column."""
    titles = [table.title for table in tables if table.title]
    assert len(titles) == len(set(titles))
    subjects = [(table.heads[0], tuple(row[0] for row in table.rows)) for table in tables]
    assert len(subjects) == len(set(subjects)), textwrap.shorten(str(subjects), 300)
