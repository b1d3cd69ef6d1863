"""A track is matched with a landmark in one frame, and must have observed it in the others, too."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.map_tracks import MapMatches
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.localization.track_check import observed_throughout
from maplab_py.geometry import se3, so3
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)
T_G_M = se3.make(so3.exp([0.0, 0.0, 0.7]), [3.0, -2.0, 0.5])
ELSEWHERE = se3.make(so3.exp([0.0, 0.0, 1.2]), [1.0, 2.0, 0.5])
LAST = 12


@pytest.fixture(scope="module")
def tracks() -> SimulatedTracks:
    return simulated(scenario(duration_s=2.0, keypoints=80))


def replayed(tracks: SimulatedTracks, came_from_elsewhere: I64) -> FixedLagSmoother:
    """Return a smoother whose tracks with some ids observed other points in the first frames."""
    options = WindowOptions()
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, options)
    smoother.start(tracks.frames[0], tracks.start_state(SIGMA))
    for number, frame in enumerate(tracks.frames[1 : LAST + 1], start=1):
        uv_px = frame.uv_px.copy()
        if number < LAST - 1:
            uv_px[np.isin(frame.track_id, came_from_elsewhere)] += [60.0, 35.0]
        smoother.add(dataclasses.replace(frame, uv_px=uv_px))
    return smoother


def long_tracks(tracks: SimulatedTracks) -> I64:
    """Return ids of tracks that frames 5 to LAST observe, each of another point."""
    ids = tracks.frames[LAST].track_id
    for frame in tracks.frames[5:LAST]:
        ids = np.intersect1d(ids, frame.track_id)
    _, first = np.unique(tracks.point[ids], return_index=True)
    return ids[np.sort(first)]


def checked(tracks: SimulatedTracks, smoother: FixedLagSmoother, ids: I64, bases: list[F64]):
    point = tracks.point[ids]
    matches = MapMatches(ids, point, se3.transform(T_G_M, tracks.p_G[point]))
    return observed_throughout(matches, bases, smoother, tracks.cameras, tracks.T_I_C, sigma_px=1.0)


def test_tracks_that_came_from_another_point_are_told(tracks: SimulatedTracks) -> None:
    ids = long_tracks(tracks)
    assert len(ids) > 8
    strangers = ids[::4]
    smoother = replayed(tracks, strangers)
    result = checked(tracks, smoother, ids, [T_G_M])
    np.testing.assert_array_equal(result, ~np.isin(ids, strangers))


def test_the_base_frame_that_explains_most_is_believed(tracks: SimulatedTracks) -> None:
    ids = long_tracks(tracks)
    smoother = replayed(tracks, ids[:1])
    for bases in ([ELSEWHERE, T_G_M], [T_G_M, ELSEWHERE]):
        assert np.flatnonzero(~checked(tracks, smoother, ids, bases)).tolist() == [0]
    assert not checked(tracks, smoother, ids, [ELSEWHERE]).any()


def test_without_matches_nothing_is_told(tracks: SimulatedTracks) -> None:
    smoother = replayed(tracks, np.zeros(0, dtype=np.int64))
    assert not len(checked(tracks, smoother, np.zeros(0, dtype=np.int64), [T_G_M]))
