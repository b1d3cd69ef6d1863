"""A recorded flight: six of its pieces make the map, the two others are localised in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.console.session.session import Session
from tests.support.data import shared_data

pytestmark = pytest.mark.slow

SUBMAPS = "maplab_maps/euroc_v1_01"
TRUTH = "euroc_imu/V101.gt.csv"


@pytest.mark.parametrize("left_out", [(3, 6), (2, 5)])
def test_pieces_of_the_flight_are_localised_in_the_others(
    tmp_path: Path, left_out: tuple[int, int]
) -> None:
    session = Session()
    folders = [shared_data(f"{SUBMAPS}/euroc_v1_01_submap_{i}") for i in range(8)]
    for number, folder in enumerate(folders):
        if number not in left_out:
            command = "load_merge_map" if len(session.maps) else "load"
            session.run(command, map_folder=folder, assign_new_ids=True)
    # the submaps are keyframed already; as raw maps they do not know their base frames
    session.run("set_all_mission_baseframes_to_unknown")
    session.run("clsm", kf_every_nth_vertex=1, summary_map_save_path=tmp_path / "summary")
    session.run("save", map_folder=tmp_path / "full")
    success = queries = wrong = in_summary = 0
    for number in left_out:
        session.run("load", map_folder=folders[number], map_key=f"query_{number}")
        report = session.run(
            "localize",
            localization_map=str(tmp_path / "full"),
            ground_truth=shared_data(TRUTH),
            success_error_m=0.1,
        )
        success += report.success
        wrong += report.wrong
        queries += report.queries_with_reference
        summary = session.run("localize", localization_map=str(tmp_path / "summary"))
        in_summary += summary.localized
    assert queries >= 39
    assert success >= 0.8 * queries
    assert wrong <= 0.1 * queries
    assert in_summary >= 0.6 * queries
