"""Bags with messages of unknown types: listed, copied with their definition, refused without it."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags.importing import import_bag_resources
from maplab_py.interop.bags.listing import bag_info
from maplab_py.interop.bags.options import BagImportOptions
from maplab_py.interop.bags.poses import add_poses_to_bag
from maplab_py.interop.recordings.bag_files import message_types, opened_bag
from maplab_py.interop.recordings.bag_writing import BagFormat, BagMessage, Channel, write_bag
from tests.interop.bags.small_bags import FORMATS, named
from tests.interop.small_map import make_map

pytest.importorskip("rosbags")

from rosbags.typesys import get_types_from_msg

ODD = "odd_msgs/msg/Odd"


def odd_bag(path: Path, kind: BagFormat) -> Path:
    """Write a bag whose messages have a type of their own."""
    store = message_types(is_ros_2=kind.is_ros_2)
    store.register(get_types_from_msg("uint32 number\nstring text\n", ODD))
    definition, md5 = store.generate_msgdef(ODD, ros_version=2 if kind.is_ros_2 else 1)
    digest = store.hash_rihs01(ODD) if kind.is_ros_2 else md5
    channel = Channel("/odd", ODD, definition, digest)
    message = store.types[ODD](7, "seven")
    serialize = store.serialize_cdr if kind.is_ros_2 else store.serialize_ros1
    data = bytes(serialize(message, ODD))
    write_bag(path, kind, [BagMessage(time_ns, channel, data) for time_ns in (10, 20)])
    return path


@pytest.mark.parametrize("kind", FORMATS)
def test_unknown_types_are_listed_and_copied(tmp_path: Path, kind: BagFormat) -> None:
    source = odd_bag(named(tmp_path, kind, "odd"), kind)
    (topic,) = bag_info(source).topics
    assert (topic.topic, topic.type, topic.messages) == ("/odd", ODD, 2)
    target = named(tmp_path, kind, "out")
    add_poses_to_bag(make_map(), source, target, missions=np.array([0]))
    with opened_bag(target) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/odd"]
        read = [reader.deserialize(data, ODD) for _, _, data in reader.messages([connection])]
    assert [(message.number, message.text) for message in read] == [(7, "seven")] * 2
    with pytest.raises(UserError, match=f"/odd has messages of type {ODD}"):
        import_bag_resources(make_map(), 0, source, BagImportOptions("/odd"))


def test_types_without_definition_are_refused_by_name(tmp_path: Path) -> None:
    source = odd_bag(tmp_path / "odd", BagFormat.SQLITE3)
    with sqlite3.connect(source / "odd.db3") as database:
        database.execute("UPDATE message_definitions SET encoding = 'unknown'")
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type_description_hash = ''")
    with pytest.raises(MapError, match=f"odd.*{ODD}") as error:
        add_poses_to_bag(make_map(), source, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()
