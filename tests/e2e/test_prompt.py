"""The interactive console, key by key, in a pseudo-terminal."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.storage.native import save_map
from maplab_py.vimap.merge import merge_maps
from tests.e2e.support import Console
from tests.support.machine import libraries_start_s
from tests.vimap.builders import walk_map

CTRL_C, CTRL_D, CTRL_R, UP, TAB = "\x03", "\x04", "\x12", "\x1b[A", "\t"


@pytest.fixture
def console(tmp_path: Path) -> Iterator[Console]:
    console = Console(tmp_path)
    console.wait_for_prompt()
    yield console
    console.close()


def test_typing_runs_commands_and_prints_their_time(console: Console) -> None:
    console.enter("create_new_map euroc")
    console.wait_for_prompt("maplab <euroc>:/$")
    assert re.search(r"create_new_map: \d+\.\d\d s", console.text)
    console.enter("nosuch")
    console.wait_for_text("error: unknown command 'nosuch'")
    console.enter("quit")
    assert console.status() == 0


def test_tab_completes_commands_flags_and_values(console: Console, tmp_path: Path) -> None:
    console.type("transc" + TAB)
    console.wait_for(lambda _: console.last_line.endswith("$ transcript"))
    (tmp_path / "folder_of_maps").mkdir()
    console.type(" --fi" + TAB)
    console.wait_for(lambda _: console.last_line.endswith("transcript --file="))
    console.type("folder_" + TAB)
    console.wait_for(lambda _: console.last_line.endswith("--file=folder_of_maps/"))


def test_an_unknown_command_is_red_while_it_is_typed(console: Console) -> None:
    console.type("hel")
    console.wait_for(lambda _: console.last_line.endswith("hel"))
    row = max(r for r, line in enumerate(console.screen.display) if line.strip())
    column = console.screen.display[row].index("hel")
    console.wait_for(lambda _: console.screen.buffer[row][column].fg == "red")
    console.type("p")
    console.wait_for(lambda _: console.screen.buffer[row][column].fg == "cyan")


def test_ctrl_c_at_the_prompt_clears_the_line(console: Console) -> None:
    console.type("some words" + CTRL_C)
    console.wait_for_prompt()
    console.enter("enable_sheep")
    console.wait_for_text("\N{SHEEP}")


def test_ctrl_c_in_a_command_cancels_it_and_the_console_lives(console: Console) -> None:
    console.enter("watch timing")
    console.wait_for_text("no command has run yet")
    console.type(CTRL_C)
    console.wait_for_text("stopped after")
    console.wait_for_prompt()


def test_ctrl_d_leaves(console: Console) -> None:
    console.type(CTRL_D)
    assert console.status() == 0


def test_history_is_kept_between_sessions(console: Console, tmp_path: Path) -> None:
    console.enter("create_new_map remembered")
    console.wait_for_prompt("maplab <remembered>:/$")
    console.enter("exit")
    assert console.status() == 0
    assert (tmp_path / "state" / "maplab" / "history").is_file()
    assert not [path for path in tmp_path.iterdir() if "history" in path.name]
    again = Console(tmp_path)
    again.wait_for_prompt()
    again.type("crea")
    again.wait_for_text("create_new_map remembered")  # the grey suggestion
    again.type(CTRL_C)
    again.wait_for_prompt()
    again.type(CTRL_R + "remem")
    again.wait_for_text("create_new_map remembered")
    again.close()


def test_a_broken_user_configuration_only_warns(tmp_path: Path) -> None:
    folder = tmp_path / "config" / "maplab"
    folder.mkdir(parents=True)
    (folder / "flags").write_text("--nosuch_flag=1\n")
    console = Console(tmp_path)
    console.wait_for_text("warning:")
    console.wait_for_prompt()
    console.close()


def test_no_color_is_respected(tmp_path: Path) -> None:
    console = Console(tmp_path, NO_COLOR="1")
    console.wait_for_prompt()
    console.enter("help")
    console.wait_for_text("help: 0.")
    cells = [cell for row in console.screen.buffer.values() for cell in row.values()]
    assert {cell.fg for cell in cells} == {"default"}
    console.close()


def test_the_prompt_comes_soon(tmp_path: Path) -> None:
    """The prompt waits hardly longer than for the libraries; the first start warms the caches."""
    starts, peers = [], []
    for _ in range(4):
        console = Console(tmp_path)
        console.wait_for_prompt()
        starts.append(console.processor_seconds())
        console.close()
        peers.append(libraries_start_s())
    assert min(starts[1:]) <= 1.25 * min(peers[1:])


def test_the_shell_is_one_mark_away(console: Console, tmp_path: Path) -> None:
    (tmp_path / "a_file_in_the_folder").touch()
    console.enter("!ls")
    console.wait_for_text("a_file_in_the_folder")
    console.enter("help | grep -c transcript")
    console.wait_for(lambda _: re.search(r"^1$", console.text, re.MULTILINE) is not None)


def test_a_job_announces_its_end_above_the_prompt(console: Console) -> None:
    console.enter("watch timing --every=0.2 --repetitions=3 &")
    console.wait_for_text("[1] watch timing")
    console.type("create_new")
    console.wait_for_text("[1] watch: done after")
    console.wait_for(lambda _: console.last_line.endswith("$ create_new"))
    console.type(CTRL_C)
    console.enter("join")
    console.wait_for_text("3 runs")


def test_leaving_with_a_running_job_asks(console: Console) -> None:
    console.enter("watch timing --every=30 &")
    console.wait_for_text("[1] watch timing")
    console.wait_for_text("running [1] watch")
    console.wait_until_still()  # what the job prints takes the keys for a moment
    console.type(CTRL_D)
    console.wait_for_text("leave and stop it? [y/N]")
    console.enter("y")
    assert console.status() == 0


def test_long_output_goes_through_the_pager(tmp_path: Path) -> None:
    console = Console(tmp_path, MAPLAB_PAGER="more")
    console.wait_for_prompt()
    console.enter("help")
    console.wait_for_text("--More--")
    console.type("q")
    console.wait_for_prompt()
    console.close()


@pytest.mark.skipif(shutil.which("less") is None, reason="less is not installed")
def test_ctrl_c_leaves_the_pager_and_the_prompt_has_the_keys(tmp_path: Path) -> None:
    console = Console(tmp_path, MAPLAB_PAGER="less -FRXK")  # as it is without the variable
    console.wait_for_prompt()
    console.enter("help")
    console.wait_for(lambda _: console.last_line == ":")
    console.type(CTRL_C)
    console.wait_for(lambda _: console.last_line.endswith("maplab <>:/$"))
    console.enter("create_new_map a")
    console.wait_for_prompt("maplab <a>:/$")
    console.close()


STAYS = (
    "sh -c \"trap 'echo once more' INT; echo 'it' runs; "
    'until read a < /dev/tty; do true; done; echo got \\$a"'
)
"""A shell command that Ctrl-C does not end: it wants a line."""


def test_ctrl_c_at_a_pager_that_stays_ends_nothing_else(tmp_path: Path) -> None:
    console = Console(tmp_path, MAPLAB_PAGER=f"tail -n 1; {STAYS}")
    console.wait_for_prompt()
    console.enter("help")
    console.wait_for_text("\nit runs")
    console.type(CTRL_C)
    console.wait_for_text("once more")
    console.enter("a line for the pager")
    console.wait_for_text("got a line for the pager")
    console.wait_for_prompt()
    assert "unknown command" not in console.text
    console.close()


@pytest.mark.parametrize("line", ["!sleep 30", "!sleep 30; true"])
def test_ctrl_c_ends_a_shell_command(console: Console, line: str) -> None:
    console.enter(line)
    console.wait_for(lambda _: any("sleep 30" in child for child in console.children()))
    console.type(CTRL_C)
    console.wait_for(lambda _: console.last_line.endswith("maplab <>:/$"))
    console.enter("create_new_map a")
    console.wait_for_prompt("maplab <a>:/$")


def test_a_shell_command_that_survives_ctrl_c_keeps_the_keys(console: Console) -> None:
    console.enter("!" + STAYS)
    console.wait_for_text("\nit runs")
    console.type(CTRL_C)
    console.wait_for_text("once more")
    console.enter("a line for the shell")
    console.wait_for_text("got a line for the shell")
    console.wait_for_prompt()
    assert "unknown command" not in console.text


def test_a_command_that_says_nothing_for_a_second_shows_that_it_lives(console: Console) -> None:
    console.enter("watch timing --every=30")
    console.wait_for(lambda screen: "watch" in screen and "0:00:0" in screen)
    console.type(CTRL_C)
    console.wait_for_text("stopped after 1 run")
    console.wait_for_prompt()


def test_ctrl_c_at_a_question_is_no(console: Console) -> None:
    console.enter("create_new_map a")
    console.wait_for_prompt("maplab <a>:/$")
    console.enter("delete_map")
    console.wait_for_text("remove map 'a' from memory? [y/N]")
    console.type(CTRL_C)
    console.wait_for_text("delete_map: cancelled")
    console.wait_for_prompt("maplab <a>:/$")


def test_missions_are_removed_by_questions_and_ctrl_c_removes_none(
    console: Console, tmp_path: Path
) -> None:
    save_map(merge_maps(walk_map(), walk_map(vertices=7, seed=4))[0], tmp_path / "walks")
    console.enter("load walks")
    console.wait_for_prompt("maplab <walks>:/$")
    console.enter("remove_mission_interactive")
    console.wait_for_text("mission 1 of 2")
    console.enter("y")
    console.wait_for_text("mission 2 of 2")
    console.type(CTRL_C)
    console.wait_for_text("remove_mission_interactive: cancelled")
    console.wait_for_prompt("maplab <walks>:/$")
    console.enter("rmi")
    console.wait_for_text("[y/n/q]")
    console.enter("q")
    console.wait_for_text("no mission is removed")
