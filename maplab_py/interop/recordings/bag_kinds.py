"""Names of message types, and kinds of storage files."""

from pathlib import Path

SQLITE = b"SQLite format 3\x00"
_HEADS = ((b"#ROSBAG V2.", "ros1"), (SQLITE, "sqlite3"), (b"\x89MCAP0\r\n", "mcap"))
_ENDINGS = ((".mcap", "mcap"), (".db3", "sqlite3"), (".bag", "ros1"))


def full_type(name: str) -> str:
    """Return the name of a message type as package/msg/Name; ROS 1 writes package/Name."""
    package, _, rest = name.partition("/")
    return name if not rest or "/" in rest else f"{package}/msg/{rest}"


def storage_kind(path: Path) -> str:
    """Return ros1, sqlite3 or mcap: the kind of a bag's file by its first bytes, else by its name."""
    with path.open("rb") as stream:
        head = stream.read(len(SQLITE))
    by_content = (kind for start, kind in _HEADS if head.startswith(start))
    by_name = (kind for ending, kind in _ENDINGS if ending in path.name.lower())
    return next(by_content, "") or next(by_name, "")
