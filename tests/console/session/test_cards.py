"""Cards of saved maps, and maps that are made again by them."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from maplab_py.console.session import cards
from maplab_py.console.session.cards import CARD_FILE, Card, CardInput, digest_of, input_of
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import EstimationError, UserError
from maplab_py.storage.native import load_map, save_map
from tests.vimap.builders import walk_map


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """Return the folder of a map that no session has saved."""
    folder = tmp_path / "with space" / "walk"
    save_map(walk_map(seed=1), folder)
    return folder


def edited(source: Path, target: Path, other_source: Path | None = None) -> Path:
    """Load a map, change it and save it."""
    session = Session()
    session.run("load", map_folder=source)
    if other_source is not None:
        session.run("load_merge_map", map_folder=other_source, assign_new_ids=True)
    session.run("reset_landmark_quality")
    session.run("keyframe_heuristic", kf_every_nth_vertex=2)
    session.run("save", map_folder=target)
    return target


def test_a_saved_map_is_made_again_to_the_last_bit(plain: Path, tmp_path: Path) -> None:
    result = edited(plain, tmp_path / "result")
    card = Card.read(result)
    assert card.commands[-1].startswith("keyframe_heuristic")
    assert card.inputs[0].path == str(plain)
    assert card.contents["vertices"] == len(load_map(result)[0].vertices)
    report = Session().run("reproduce", card=result).as_dict()
    assert report["differing"] == []
    assert report["result"] == "the maps are identical to the last bit"
    page = (result / CARD_FILE).read_text(encoding="utf-8")
    assert "<svg" in page
    assert "<polyline" in page


def test_a_map_that_was_saved_over_its_source_is_made_from_the_beginning(
    plain: Path, tmp_path: Path
) -> None:
    result = edited(plain, tmp_path / "result")
    edited(result, result)
    nested = Card.read(result).inputs[0].card
    assert nested is not None
    assert nested.inputs[0].path == str(plain)
    again = tmp_path / "again"
    report = Session().run("reproduce", card=result / CARD_FILE, map_folder=again).as_dict()
    assert (report["differing"], report["result"]) == ([], "the maps are identical to the last bit")
    assert Card.read(again).contents == Card.read(result).contents


def test_inputs_that_changed_are_named(plain: Path, tmp_path: Path) -> None:
    result = edited(plain, tmp_path / "result")
    save_map(walk_map(seed=2), plain, overwrite=True)
    report = Session().run("reproduce", card=result).as_dict()
    assert next(fact["what"] for fact in report["differing"]) == f"input {plain}"
    assert "no vertex is in both maps" in report["result"]
    plain.rename(plain.parent / "elsewhere")
    with pytest.raises(UserError, match="is not there any more"):
        Session().run("reproduce", card=result)


def test_a_map_that_changed_since_has_no_card_of_before(plain: Path, tmp_path: Path) -> None:
    result = edited(plain, tmp_path / "result")
    digest = digest_of(result)
    (result / CARD_FILE).write_text("", encoding="utf-8")
    assert digest_of(result) == digest  # of the map, not of its card
    save_map(load_map(result)[0], result, overwrite=True)
    with pytest.raises(UserError, match="there is no card"):
        Session().run("reproduce", card=result)


@pytest.mark.parametrize(
    "content", ["", "<html></html>", '<script type="application/json" id="card">{}']
)
def test_a_damaged_card_is_named(content: str, tmp_path: Path) -> None:
    (tmp_path / CARD_FILE).write_text(content, encoding="utf-8")
    with pytest.raises(UserError, match=r"card\.html: is damaged, or no card"):
        Session().run("reproduce", card=tmp_path)


def test_the_accuracy_is_that_of_the_saved_value(plain: Path, tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    session = Session()
    session.run("load", map_folder=plain)
    session.run("export_trajectory_to_csv", pose_export_file=truth, csv_export_format="rpg")
    session.run("evaluate_trajectory", ground_truth=truth)
    session.run("save", map_folder=tmp_path / "measured")
    assert Card.read(tmp_path / "measured").accuracy.startswith("RMSE 0.0000 m of")
    session.run("keyframe_heuristic", kf_every_nth_vertex=2)
    session.run("save", map_folder=tmp_path / "changed")
    assert Card.read(tmp_path / "changed").accuracy == ""


def test_two_replaced_inputs_are_both_made_again(plain: Path, tmp_path: Path) -> None:
    sources = [edited(plain, tmp_path / name) for name in "ab"]
    for source in sources:
        card = dataclasses.replace(Card.read(source), outputs=(str(tmp_path / "written"),))
        card.write(source, "")
    result = edited(*sources[:1], tmp_path / "result", sources[1])
    for source in sources:
        save_map(walk_map(seed=2), source, overwrite=True)
    report = Session().run("reproduce", card=result).as_dict()
    assert report["differing"] == []
    assert not (tmp_path / "written").exists()


def test_a_path_that_is_read_and_written_stays_as_it_is(plain: Path, tmp_path: Path) -> None:
    result = edited(plain, tmp_path / "result")
    card = dataclasses.replace(Card.read(result), outputs=(str(plain),))
    card.write(result, "")
    digest = digest_of(plain)
    with pytest.raises(EstimationError, match="load --map_folder"):
        Session().run("reproduce", card=result)
    assert digest_of(plain) == digest


def test_a_map_saved_below_its_source_has_a_card(plain: Path) -> None:
    session = Session()
    session.run("load_merge_all_maps", maps_folder=plain.parent)
    session.run("save", map_folder=plain.parent / "merged")
    assert Card.read(plain.parent / "merged").commands[0].startswith("load_merge_all_maps")


def test_a_map_that_is_saved_again_unchanged_keeps_a_card(plain: Path, tmp_path: Path) -> None:
    result = edited(plain, tmp_path / "result")
    session = Session()
    session.run("load", map_folder=result)
    session.run("save")
    nested = Card.read(result).inputs[0].card
    assert nested is not None
    assert nested.inputs[0].path == str(plain)


def test_the_card_of_a_map_that_was_replaced_is_not_taken_over(plain: Path, tmp_path: Path) -> None:
    result = edited(plain, tmp_path / "result")
    page = (result / CARD_FILE).read_text(encoding="utf-8")
    assert input_of(result).card is not None
    save_map(walk_map(seed=2), result, overwrite=True)
    (result / CARD_FILE).write_text(
        page, encoding="utf-8"
    )  # as a program leaves it that knows no cards
    assert input_of(result).card is None
    assert Session().run("load", map_folder=result)


def test_a_card_names_paths_that_are_no_text(tmp_path: Path) -> None:
    folder = tmp_path / "it's \u00fc"
    folder.mkdir()
    given = CardInput("/caf\udce9/<b>", "00")
    card = Card("m", "", {}, ("load",), (given,), (), {})
    card.write(folder, "")
    assert Card.read(folder) == card
    page = (folder / CARD_FILE).read_text(encoding="utf-8")
    assert "&lt;b&gt;</td>" in page
    assert "maplab reproduce &#x27;" in page


def test_a_card_that_cannot_be_written_leaves_the_map_saved(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> str:
        raise RecursionError("too deep")

    monkeypatch.setattr(cards, "picture_of", fail)
    notes: list[str] = []
    monkeypatch.setattr(SilentTerminal, "note", lambda _, text: notes.append(text))
    result = edited(plain, tmp_path / "result")
    assert len(load_map(result)[0].vertices)
    assert notes[-1] == f"{result.resolve()}: the card cannot be written: too deep"
