"""The bar of bags: 20,000 IMU messages are written in a second and read in another, equal to the last bit."""

import pytest

from maplab_py.interop.recordings.bag_writing import BagFormat

pytest.importorskip("rosbags")

from benchmarks.bags import measure


@pytest.mark.parametrize("kind", list(BagFormat))
@pytest.mark.slow
def test_20_000_imu_messages(kind: BagFormat) -> None:
    figures = measure(kind)
    assert figures.is_equal
    assert figures.write_s <= 1.0
    assert figures.read_s <= 1.0
