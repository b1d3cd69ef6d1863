"""Chronicle of updates: what each did, and the maps before them."""

import dataclasses
import gzip
import shutil
import signal
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.evidence import LANDMARK_EVIDENCE, read_evidence, with_evidence
from maplab_py.algorithms.map_update import chronicle
from maplab_py.algorithms.map_update.options import UpdateOptions
from maplab_py.algorithms.map_update.update import update_map
from maplab_py.console.session.cards import Card
from maplab_py.console.session.session import Session
from maplab_py.errors import MapError, UserError
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.checksums import fingerprint
from maplab_py.storage.extension_fields import PACKED, unpacked
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.files import missing_files
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import resource_path
from maplab_py.vimap import ResourceOwner, VIMap, without_resources
from maplab_py.vimap.edits import remove_landmarks, remove_missions
from tests.algorithms.map_update.test_update import first, sessions, updated
from tests.support.data import REPOSITORY

BUDGET = UpdateOptions(max_landmarks=300, max_vertices=25)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a map that was updated twice by commands and saved in between."""
    folder = tmp_path_factory.mktemp("year")
    save_map(first(), folder / "office")
    for number in (1, 2):
        save_map(sessions().maps[number], folder / f"visit{number}")
    session = Session()
    session.run("load", map_folder=folder / "office")
    session.run("update_map", session=str(folder / "visit1"))
    session.run("save", map_folder=folder / "one")
    session.run("update_map", session=str(folder / "visit2"), max_landmarks=300, max_vertices=25)
    session.run("save", map_folder=folder / "two")
    return folder


def test_the_log_tells_what_updates_did(folders: Path) -> None:
    session = Session()
    session.run("load", map_folder=folders / "two")
    log = session.run("map_log")
    early, late = log.updates
    assert early.date == "2020-10-13 12:26" < late.date
    assert early.landmarks_thinned == early.vertices_removed == 0 < late.landmarks_thinned
    assert late.localized_before > 0.8
    assert late.localized_after > 0.8
    assert 0.0 < log.stored_kb < 1e-3 * updated()[0].nbytes()


def test_earlier_states_are_the_same_to_the_last_bit(folders: Path) -> None:
    session = Session()
    session.run("load", map_folder=folders / "two")
    now = session.vi_map
    assert "it was before the update of 2020-11-12" in session.run("map_at", date="2020-10-20").text
    then = load_map(folders / "one")[0]
    assert chronicle.checksum(session.vi_map) == chronicle.checksum(then)
    assert len(session.run("map_log").updates) == 1
    session.run("map_at", date="2020-10-01")
    start = load_map(folders / "office")[0]
    assert chronicle.checksum(session.vi_map) == chronicle.checksum(start)
    session.run("undo")
    session.run("undo")
    assert session.vi_map is now
    assert "is as it was" in session.run("map_at", date="2021-01-01").text
    assert session.vi_map is now


def test_states_before_other_commands_are_refused(folders: Path) -> None:
    session = Session()
    session.run("load", map_folder=folders / "two")
    session.run("reset_landmark_quality")
    with pytest.raises(
        MapError, match="other commands changed the map after the update of 2020-11"
    ):
        session.run("map_at", date="2020-10-20")
    assert len(session.run("map_log").updates) == 2
    session.run("load", map_folder=folders / "office")
    with pytest.raises(UserError, match="no chronicle: update_map"):
        session.run("map_at", date="2020-10-20")
    with pytest.raises(UserError, match="not a date"):
        session.run("map_at", date="then")


def test_the_session_is_an_input_of_the_card(folders: Path) -> None:
    card = Card.read(folders / "two")
    paths = [given.path for given in card.inputs]
    assert paths == [str(folders / name) for name in ("office", "visit1", "visit2")]
    assert Session().run("reproduce", card=folders / "two").as_dict()["differing"] == []


def test_damaged_records_are_refused(folders: Path) -> None:
    vi_map = load_map(folders / "two")[0]
    record = chronicle.records(vi_map, folders / "two")[-1]
    plain = bytes(unpacked(record.differences))
    of_content = [
        PACKED + zlib.compress(plain.replace(old, new))
        for old, new in ((b'"<u8"', b'",,,"'), (b'"vertices"', b'"vertexes"'), (b"[[", b"[" * 9999))
    ]
    whole = record.differences
    for content in (b"", whole[:-9], whole[:3] + b"x", *of_content):
        with pytest.raises(MapError, match="record of the update of 2020-11-12 12:26 is damaged"):
            chronicle.map_before(vi_map, dataclasses.replace(record, differences=content))
    file = next((folders / "two").rglob("text/*.txt"))
    text = file.read_text(encoding="utf-8")
    file.unlink()
    with pytest.raises(MapError, match=r"\.txt: the record cannot be read"):
        chronicle.records(vi_map, folders / "two")
    file.write_text(text[:200], encoding="utf-8")
    with pytest.raises(MapError, match=r"\.txt: the record of an update is damaged"):
        chronicle.records(vi_map, folders / "two")
    file.write_text(text, encoding="utf-8")


def test_differences_hold_only_what_differs() -> None:
    vi_map = updated()[0]
    same = chronicle.difference(vi_map, vi_map)
    assert len(same) < 0.05 * vi_map.nbytes()
    order = np.random.default_rng(0).permutation(len(vi_map.landmarks))
    place = np.append(np.argsort(order), -1)
    mixed = vi_map.replace(
        landmarks=vi_map.landmarks.take(order),
        keypoints=vi_map.keypoints.replace(landmark=place[vi_map.keypoints.landmark]),
    )
    back = chronicle.restored(mixed, chronicle.difference(vi_map, mixed))
    assert chronicle.checksum(back) == chronicle.checksum(vi_map)


def test_records_stay_when_their_mission_goes() -> None:
    vi_map, _ = update_map(updated()[0], sessions().maps[2], BUDGET)
    assert len(chronicle.records(vi_map, None)) == 2
    assert set(vi_map.resources.owner.tolist()) == {len(vi_map.missions) - 1}
    shorter = remove_missions(vi_map, [len(vi_map.missions) - 1])
    assert chronicle.records(shorter, None) == chronicle.records(vi_map, None)
    assert set(shorter.resources.owner.tolist()) == {len(shorter.missions) - 1}
    with pytest.raises(MapError, match="other commands changed the map"):
        chronicle.map_at(shorter, None, "2020-10-20")
    assert len(remove_missions(vi_map, [0, 1, 2]).resources) == 0


def test_a_map_keeps_few_states_and_all_facts() -> None:
    vi_map, report = updated()
    vi_map = chronicle.stored_order(without_resources(vi_map, vi_map.resources.type >= 0))
    states = {chronicle.checksum(vi_map): 0}
    for number in range(1, 25):
        line = dataclasses.replace(report.sessions[0], date=f"2021-01-{number:02d} 12:00")
        after = chronicle.stored_order(remove_landmarks(vi_map, np.arange(3)))
        numbered = dataclasses.replace(report, sessions=(line,))
        vi_map = chronicle.with_record(vi_map, after, numbered)
        states[chronicle.checksum(vi_map)] = number
    known = chronicle.records(vi_map, None)
    assert [fact.date[8:10] for r in known for fact in r.facts] == [
        f"{n:02d}" for n in range(1, 25)
    ]
    assert len(known) == len([r for r in known if r.differences]) == 12
    for day in (1, 7, 20, 23, 24):
        then, update = chronicle.map_at(vi_map, None, f"2021-01-{day:02d} 24")
        state = states[chronicle.checksum(then)]
        if day == 24:
            assert update is None
            assert state == 24
            continue
        assert update is not None
        assert state == int(update.date[8:10]) - 1
        assert 0 <= day - state <= (0 if day >= 20 else 4)
        facts = [fact for r in chronicle.records(then, None) for fact in r.facts]
        assert len(facts) == state
    # differences of states that other commands have left behind go
    changed = chronicle.stored_order(remove_landmarks(vi_map, np.arange(3)))
    after = chronicle.stored_order(remove_landmarks(changed, np.arange(3)))
    later = chronicle.records(chronicle.with_record(changed, after, report), None)
    assert [bool(record.differences) for record in later] == [False] * 12 + [True]


def test_updates_go_on_after_damage_of_records() -> None:
    vi_map, report = updated()
    vi_map = chronicle.stored_order(without_resources(vi_map, vi_map.resources.type >= 0))
    for _ in range(12):
        after = chronicle.stored_order(remove_landmarks(vi_map, np.arange(3)))
        vi_map = chronicle.with_record(vi_map, after, report)
    after = chronicle.stored_order(remove_landmarks(vi_map, np.arange(3)))
    oldest = chronicle.records(vi_map, None)[0]
    paths = [resource_path(vi_map, row, Path()) for row in range(len(vi_map.resources))]
    (file,) = (path for path in paths if path.read_bytes() == oldest.content())
    file.write_bytes(dataclasses.replace(oldest, differences=b"x").content())
    known = chronicle.records(chronicle.with_record(vi_map, after, report), None)
    assert [bool(record.differences) for record in known] == [False] * 8 + [True] * 5
    facts = chronicle.Record(1, (), oldest.before, oldest.after, b"x").content()
    for content in (facts, b"maplab-py update 2\nx"):
        file.write_bytes(content)
        again = chronicle.with_record(vi_map, after, report)
        assert len(again.resources) == 13
        with pytest.raises(MapError, match=f"{file}: the record of an update is damaged"):
            chronicle.records(again, None)


def test_texts_of_other_missions_stay_with_them() -> None:
    vi_map = updated()[0]
    new = NewResources(seed=b"texts")
    missions = np.arange(len(vi_map.missions))
    rows = [new.add(11, b"text %d" % mission) for mission in missions]
    vi_map = without_resources(vi_map, vi_map.resources.type >= 0)
    vi_map = new.attached(vi_map, rows, missions, ResourceOwner.MISSION)
    assert len(missions) > 1
    newest = len(missions) - 1
    shorter = remove_missions(vi_map, [newest])
    assert shorter.resources.owner.tolist() == [*range(newest), newest - 1]


def test_readers_of_the_original_layout_skip_what_updates_add(tmp_path: Path) -> None:
    vi_map, _ = update_map(updated()[0], sessions().maps[2], BUDGET)
    save_map(vi_map, tmp_path / "evidence")
    save_map(with_evidence(vi_map, None), tmp_path / "plain")
    skipped = 0
    for path in sorted((tmp_path / "evidence" / "vi_map").glob("vertices*")):
        content = gzip.decompress(path.read_bytes())
        message = pb.VIMap.FromString(content)
        message.DiscardUnknownFields()
        plain = gzip.decompress((tmp_path / "plain" / "vi_map" / path.name).read_bytes())
        assert message == pb.VIMap.FromString(plain)
        skipped += len(content) - message.ByteSize()
    known = {field.number for field in pb.Landmark.DESCRIPTOR.fields}
    assert LANDMARK_EVIDENCE not in known
    assert skipped > 64 * np.count_nonzero(read_evidence(vi_map)["born_s"])


KILLED = """
import sys
from maplab_py.algorithms.map_update import thinning
from maplab_py.console.session.session import Session

def thin(*_):
    print("ready", flush=True)
    sys.stdin.read()

thinning.thin = thin
session = Session()
session.run("load", map_folder=sys.argv[1])
session.run("update_map", session=sys.argv[2])
session.run("save")
"""


def test_a_killed_update_leaves_the_stored_map_whole(folders: Path, tmp_path: Path) -> None:
    office = tmp_path / "office"
    shutil.copytree(folders / "one", office)
    before = fingerprint(office)
    arguments = [sys.executable, "-c", KILLED, str(office), str(folders / "visit2")]
    with subprocess.Popen(
        arguments, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        while child.stdout.readline() not in ("ready\n", ""):
            pass
        child.kill()
    assert child.returncode == -signal.SIGKILL
    assert fingerprint(office) == before
    session = Session()
    session.run("load", map_folder=office)
    session.run("update_map", session=str(folders / "visit2"))
    session.run("save")
    assert len(session.run("map_log").updates) == 2


def with_images(vi_map: VIMap) -> VIMap:
    """Return a map with an image of every frame, and a text that is no record."""
    new = NewResources(seed=vi_map.missions.id.tobytes())
    image = np.zeros((4, 4), dtype=np.uint8)
    rows = [new.add_image(image) for _ in range(len(vi_map.frames))]
    vi_map = new.attached(vi_map, rows, np.arange(len(rows)))
    return new.attached(vi_map, [new.add(11, b"caf\xe9")], [0], ResourceOwner.MISSION)


def test_sessions_of_any_order_bring_their_images(tmp_path: Path) -> None:
    save_map(with_images(first()), tmp_path / "office")
    for number in (1, 2):
        save_map(with_images(sessions().maps[number]), tmp_path / f"visit{number}")
    session = Session()
    session.run("load", map_folder=tmp_path / "office")
    assert session.run("map_log").updates == ()
    session.run("update_map", session=str(tmp_path / "visit2"))
    session.run("save", map_folder=tmp_path / "late")
    session.run("update_map", session=str(tmp_path / "visit1"), max_vertices=25)
    session.run("save", map_folder=tmp_path / "early")
    assert missing_files(session.vi_map, tmp_path / "early") == []
    session = Session()
    session.run("load", map_folder=tmp_path / "early")
    late, early = session.run("map_log").updates
    assert early.date < late.date
    vi_map = session.vi_map
    then = chronicle.map_before(vi_map, chronicle.records(vi_map, tmp_path / "early")[-1])
    before = load_map(tmp_path / "late")[0].resources
    kept = np.lexsort(before.id.T), np.lexsort(then.resources.id.T)
    for name in ("id", "type", "owner_kind"):
        columns = before.columns()[name][kept[0]], then.resources.columns()[name][kept[1]]
        np.testing.assert_array_equal(*columns)
    text = session.run("map_at", date="2020-10-20").text
    assert "before the update of 2020-11-12 12:26, without" in text
    assert missing_files(session.vi_map, tmp_path / "early") == []
    assert chronicle.checksum(session.vi_map) == chronicle.checksum(
        load_map(tmp_path / "office")[0]
    )
