"""A side file with the names of a map's missions; C++ maplab ignores it."""

import re
from pathlib import Path

from maplab_py.errors import MapError
from maplab_py.input_files import read_text
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import HEX_DIGITS, to_hex_list
from maplab_py.vimap.table import object_column

FILE_NAME = "mission_names.txt"
MAX_NAME_LENGTH = 60
_MAX_BYTES = 16_000_000
_LINE = re.compile(rf"([0-9a-f]{{{HEX_DIGITS}}})  (\S.*)")
_SUBMAP = re.compile(r"[_-]submap[_-]?\d+$")


def text_of_names(vi_map: VIMap) -> str:
    """Return the content of the side file: one line `id  name` per named mission."""
    pairs = zip(to_hex_list(vi_map.missions.id), vi_map.missions.name, strict=True)
    return "".join(f"{id_}  {name}\n" for id_, name in pairs if name)


def with_names(vi_map: VIMap, folder: Path) -> VIMap:
    """Return a map with the names that the side file of its folder gives to its missions.

    Lines for other missions are ignored.

    Raises:
        MapError: The file is damaged.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return vi_map
    without = "delete it to load the map without names"
    try:
        text = read_text(path, _MAX_BYTES, remedy=without, error=MapError)
    except UnicodeDecodeError:
        raise MapError(f"{path}: is damaged: it is not text; {without}") from None
    names = {}
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line)
        if match is None or not is_name(match[2]):
            raise MapError(f"{path}: line {number} is not an id and a name; {without}")
        names[match[1]] = match[2]
    ids = to_hex_list(vi_map.missions.id)
    return named(vi_map, [names.get(id_, "") for id_ in ids])


def with_folder_names(vi_map: VIMap, folder: Path) -> VIMap:
    """Return a map whose unnamed missions are named after the map's folder.

    Several missions are numbered; the ending of a submap's folder, `_submap_3`, is left out.
    """
    if all(vi_map.missions.name):
        return vi_map
    base = _SUBMAP.sub(
        "", "".join(c if c.isprintable() and c != "," else "_" for c in folder.resolve().name)
    )
    base = base.strip()[:MAX_NAME_LENGTH] or "map"
    several = len(vi_map.missions) > 1
    return named(
        vi_map,
        [
            name or (f"{base}-{row + 1}" if several else base)
            for row, name in enumerate(vi_map.missions.name)
        ],
    )


def named(vi_map: VIMap, names: list[str]) -> VIMap:
    """Return a map with other names of its missions (M)."""
    return vi_map.replace(missions=vi_map.missions.replace(name=object_column(names)))


def is_name(text: str) -> bool:
    """Tell whether a text can be the name of a mission."""
    return (
        0 < len(text) <= MAX_NAME_LENGTH
        and text == text.strip()
        and text.isprintable()
        and "," not in text
    )
