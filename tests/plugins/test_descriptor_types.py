"""Commands on maps with descriptors of several types, from files in both layouts."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, UserError
from maplab_py.storage import native, summary_map
from tests.support import descriptor_blocks as by_hand
from tests.support.data import shared_data

SUBMAP = "maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("several") / "several"
    return by_hand.reencode(shared_data(SUBMAP), folder, by_hand.THREE_TYPES)


@pytest.fixture(scope="module")
def floats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("floats") / "floats"
    return by_hand.reencode(shared_data(SUBMAP), folder, by_hand.THREE_TYPES[1:])


def test_save_writes_the_layout_that_is_asked_for(several: Path, tmp_path: Path) -> None:
    with Session() as session:
        session.run("load", map_folder=shared_data(SUBMAP), map_key="legacy")
        bare = by_hand.described(shared_data(SUBMAP))
        session.run("save", map_folder=tmp_path / "as_loaded")
        assert by_hand.described(tmp_path / "as_loaded") == bare
        session.run("save", map_folder=tmp_path / "new", descriptor_layout="2.2")
        assert {types for types, _ in by_hand.described(tmp_path / "new").values()} == {(0,)}
        session.run("load", map_folder=several)
        for arguments in ({}, {"dry_run": True}):
            with pytest.raises(UserError, match="which the legacy layout cannot hold"):
                session.run(
                    "save_all",
                    maps_folder=tmp_path / "all",
                    descriptor_layout="legacy",
                    **arguments,
                )
        assert not native.is_map_folder(tmp_path / "all" / "legacy")
        session.run("save_all", maps_folder=tmp_path / "all", descriptor_layout="2.2")
        saved = by_hand.described(tmp_path / "all" / "several")
        assert saved == by_hand.described(several)


def test_places_and_summary_maps_take_binary_descriptors(several: Path, tmp_path: Path) -> None:
    with Session() as session:
        session.run("load", map_folder=several)
        session.run("elq")
        session.run("train_projection_matrix", file=tmp_path / "projection.npz")
        session.run("generate_summary_map_and_save_to_disk", summary_map_save_path=tmp_path)
        vi_map = session.vi_map
        good = np.append(vi_map.landmarks.quality == 2, False)[vi_map.keypoints.landmark]
        usable = np.count_nonzero(good & (vi_map.binary_descriptor_size > 0))
        observations = len(summary_map.read_summary_map(tmp_path).descriptors)
        assert 0.95 * usable < observations <= usable
        assert session.run("map_size").kinds[0].rows == len(vi_map.keypoints)


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("loopclosure_all_missions", {}),
        ("relax", {}),
        ("train_projection_matrix", {"file": "projection.npz"}),
        ("generate_summary_map_and_save_to_disk", {"summary_map_save_path": "summary"}),
        ("localize", {"localization_map": "floats"}),
    ],
)
def test_maps_without_binary_descriptors_are_refused_in_one_line(
    floats: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    arguments: dict[str, str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with Session() as session:
        session.run("load", map_folder=floats)
        before = session.vi_map
        with pytest.raises(
            EstimationError,
            match="no Binary descriptors, only SuperPoint, SIFT: --lc_feature_type=SuperPoint",
        ):
            session.run(command, **{name: Path(value) for name, value in arguments.items()})
        assert session.vi_map is before
    assert list(tmp_path.iterdir()) == []
