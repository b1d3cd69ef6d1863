"""A small map with everything in it, and the tools to damage it."""

import dataclasses
import gzip
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.checksums import write as write_checksums
from maplab_py.storage.native import save_map
from maplab_py.vimap import ResourceOwner, Resources, random_ids
from tests.vimap.builders import walk_map

BOUND_MEGABYTES = 6
NAN = float("nan")
Change = Callable[[Any], object]


@dataclasses.dataclass(frozen=True)
class Damage:
    """What is done to a map folder, and what `load` must say about it."""

    apply: Callable[[Path], object]
    file: str  # the message begins with its path
    said: tuple[str, ...] = ()
    is_note: bool = False  # loaded, and the note says it


def write_whole_map(folder: Path) -> None:
    """Write a map of two vertex files, all kinds of edges and all kinds of resources."""
    vi_map = walk_map(vertices=60, landmarks=120)
    rng = np.random.default_rng(5)
    resources = Resources.filled(
        3,
        id=random_ids(3, rng),
        type=[0, 11, 16],
        owner_kind=[ResourceOwner.FRAME, ResourceOwner.MISSION, ResourceOwner.SENSOR],
        owner=[4, 0, 0],
        sensor_id=vi_map.missions.sensor_id[[0, 0, 0], 0],
        timestamp_ns=[0, 0, 10**9],
    )
    save_map(vi_map.replace(resources=resources), folder)
    (folder / "checksums.sha256").unlink()  # they would find every damage


def rewritten(name: str, change: Change, kind: type[Any] = pb.VIMap) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / name
        message = kind.FromString(gzip.decompress(path.read_bytes()))
        change(message)
        path.write_bytes(gzip.compress(message.SerializePartialToString()))

    return apply


def vertices(change: Change) -> Callable[[Path], None]:
    return rewritten("vi_map/vertices1", change)


def vertex(change: Change) -> Callable[[Path], None]:
    return vertices(lambda m: change(m.vertices[3]))


def frame(change: Change) -> Callable[[Path], None]:
    return vertex(lambda v: change(v.nframe.frames[0]))


def landmark(change: Change) -> Callable[[Path], None]:
    def first(message: Any) -> None:
        stores = (v.landmark_store.landmarks for v in message.vertices)
        change(next(lm for own in stores for lm in own if len(lm.keypoint_indices) > 1))

    return vertices(first)


def absolute_pose(change: Change) -> Callable[[Path], None]:
    return vertices(
        lambda m: change(next(v for v in m.vertices if v.absolute_poses).absolute_poses[0])
    )


def edges(change: Change) -> Callable[[Path], None]:
    return rewritten("vi_map/edges0", change)


def imu(change: Change) -> Callable[[Path], None]:
    return edges(lambda m: change(m.edges[7].imu))


def odometry(change: Change) -> Callable[[Path], None]:
    return edges(lambda m: change(m.edges[59 + 7].odometry))


def loop(change: Change) -> Callable[[Path], None]:
    return edges(lambda m: change(m.edges[-1].loop_closure))


def missions(change: Change) -> Callable[[Path], None]:
    return rewritten("vi_map/missions", change)


def mission(change: Change) -> Callable[[Path], None]:
    return missions(lambda m: change(m.missions[0]))


def baseframe(change: Change) -> Callable[[Path], None]:
    return missions(lambda m: change(m.baseframes[0]))


def index(change: Change) -> Callable[[Path], None]:
    return rewritten("vi_map/landmark_index", change)


def info(change: Change) -> Callable[[Path], None]:
    return rewritten("resource_info", change, pb.ResourceInfoMap)


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return apply


def content(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(data)


def appended(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes() + data)


def cut(name: str, size: int) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def flipped(name: str) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 0x55
        (folder / name).write_bytes(data)

    return apply


def removed(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def put(field: str, place: int, value: float) -> Change:
    return lambda message: getattr(message, field).__setitem__(place, value)


def other_id(message: Any, field: str) -> None:
    getattr(message, field).words[0] ^= 0xFFFF


def id_of(words: Any) -> str:
    """Return the 32 hexadecimal digits of an Id message."""
    return b"".join(struct.pack("<Q", word) for word in words).hex()


def clear(field: str) -> Change:
    return lambda message: message.ClearField(field)


def extra_word(field: str) -> Change:
    return lambda message: getattr(message, field).words.append(1)


def swap_ends(_: Any, edge: Any) -> None:
    words = list(edge.from_vertex_id.words)
    edge.from_vertex_id.CopyFrom(edge.to_vertex_id)
    del edge.to_vertex_id.words[:]
    edge.to_vertex_id.words.extend(words)


def back_to_the_vertex_before(message: Any, edge: Any) -> None:
    edge.to_vertex_id.CopyFrom(message.edges[60].odometry.from_vertex_id)


def redirected(row: int, kind: str, change: Callable[[Any, Any], None]) -> Callable[[Path], None]:
    """Change the ends of an edge and list it where it then begins and ends."""

    def apply(folder: Path) -> None:
        ends: list[Any] = []
        edge_ids: list[Any] = []

        def turn(m: Any) -> None:
            edge = getattr(m.edges[row], kind)
            change(m, edge)
            edge_ids.append(list(m.edge_ids[row].words))
            ends.extend([list(edge.from_vertex_id.words), list(edge.to_vertex_id.words)])

        edges(turn)(folder)

        def list_again(m: Any) -> None:
            for words, own in zip(m.vertex_ids, m.vertices, strict=True):
                for field, end in (("outgoing_edges", 0), ("incoming_edges", 1)):
                    kept = [list(i.words) for i in getattr(own, field)]
                    kept = [i for i in kept if i != edge_ids[0]]
                    kept += [edge_ids[0]] if list(words.words) == ends[end] else []
                    own.ClearField(field)
                    for one in kept:
                        getattr(own, field).add().words.extend(one)

        for name in ("vertices0", "vertices1"):
            rewritten(f"vi_map/{name}", list_again)(folder)

    return apply


def truncated_listing(folder: Path) -> None:
    path = folder / "vi_map/vi_map_metadata"
    path.write_text("\n".join(path.read_text().split("files")[:2]))


def unlisted(folder: Path, name: str) -> None:
    path = folder / "vi_map/vi_map_metadata"
    listing = path.read_text().split("files ")
    assert any(name in part for part in listing)
    path.write_text("files ".join(part for part in listing if f'"{name}"' not in part))


def swap_files(folder: Path, a: str, b: str) -> None:
    first, second = (folder / a).read_bytes(), (folder / b).read_bytes()
    (folder / a).write_bytes(second)
    (folder / b).write_bytes(first)


def other_checksum(folder: Path) -> None:
    write_checksums(folder)
    with (folder / "vi_map/sensors.yaml").open("a") as file:
        file.write("\n")


def alias_bomb(levels: int) -> str:
    """Return YAML whose aliases stand for 10 ** levels values."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, levels)]
    return "\n".join(lines) + "\n"


def yaml_bomb(folder: Path) -> None:
    path = folder / "vi_map/sensors.yaml"
    path.write_text(path.read_text() + alias_bomb(9))


def zeros(entry: bytes, size: int, *wrappers: int) -> bytes:
    """Return a gzip file of many equal entries within nested fields."""
    data = entry * (size // len(entry))
    for tag in wrappers:
        data = bytes([tag]) + varint(len(data)) + data
    return gzip.compress(data)


def varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])
