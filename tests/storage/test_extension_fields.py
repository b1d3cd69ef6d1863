from __future__ import annotations

import pytest

from maplab_py.errors import MapError
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.extension_fields import read_extension, with_extension
from maplab_py.storage.protobuf.ids import unknown_bytes


@pytest.mark.parametrize("size", [0, 1, 127, 128, 70_000])
def test_a_field_comes_back(size: int) -> None:
    content = bytes(range(256)) * (size // 256 + 1)
    field = with_extension(b"", 1000, content[:size])
    assert read_extension(field, 1000) == content[:size]
    assert read_extension(field, 999) is None
    assert with_extension(field, 1000, None) == b""


def test_other_fields_stay_and_a_field_is_there_once() -> None:
    foreign = (
        bytes([0xA0, 0x3F, 0x05]) + bytes([0xA9, 0x3F]) + bytes(8) + bytes([0xAD, 0x3F, 1, 2, 3, 4])
    )
    both = with_extension(foreign, 1000, b"one")
    both = with_extension(both, 1000, b"two")
    assert read_extension(both, 1000) == b"two"
    assert with_extension(both, 1000, None) == foreign


def test_protobuf_reads_and_writes_it_as_an_unknown_field() -> None:
    mission = pb.Mission(backbone=1)
    mission.MergeFromString(with_extension(b"", 1000, b"closures"))
    again = pb.Mission()
    again.ParseFromString(mission.SerializeToString())
    assert again.backbone == 1
    assert read_extension(unknown_bytes(again), 1000) == b"closures"


@pytest.mark.parametrize("damaged", [b"\xc2\x3e\x05ab", b"\xc2", b"\xc7\x3e"])
def test_damaged_fields_are_an_error(damaged: bytes) -> None:
    with pytest.raises(MapError, match="damaged"):
        read_extension(damaged, 1000)
