"""Cards of saved maps: inputs, versions, commands, accuracy, picture; a map can be made again by its card."""

from __future__ import annotations

import dataclasses
import hashlib
import html
import json
import shlex
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from maplab_py import atomic, input_files
from maplab_py.errors import UserError
from maplab_py.report import to_html
from maplab_py.storage import checksums
from maplab_py.storage.map_saving import CARD_FILE

if TYPE_CHECKING:
    from maplab_py.console.session.maps import MapEntry
    from maplab_py.vimap import VIMap

_BEGIN, _END = '<script type="application/json" id="card">', "</script>"
_MAX_BYTES = 16_000_000
_PACKAGES = ("maplab-py", "numpy", "numba", "opencv-python-headless")
_END_BYTES = 16_384
"""Read at either end of a file for its digest: a recording of hours takes a second, not minutes."""


@dataclasses.dataclass(frozen=True)
class CardInput:
    """File or folder that a command has read."""

    path: str
    digest: str
    card: Card | None = dataclasses.field(default=None, compare=False)  # of a map: how it was made


@dataclasses.dataclass(frozen=True)
class Card:
    """Origin of a saved map."""

    map_key: str
    fingerprint: str  # of the map's files
    versions: dict[str, str]
    commands: tuple[str, ...]
    inputs: tuple[CardInput, ...]
    outputs: tuple[str, ...]  # paths that the commands have written
    contents: dict[str, int]
    accuracy: str = ""  # as it was measured last in the session

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Self:
        """Return the card of plain JSON types."""
        inputs = tuple(
            CardInput(
                str(given["path"]),
                str(given["digest"]),
                None if given["card"] is None else Card.from_dict(given["card"]),
            )
            for given in fields["inputs"]
        )
        tuples = {name: tuple(map(str, fields[name])) for name in ("commands", "outputs")}
        return cls(**{**fields, **tuples, "inputs": inputs})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the card of a map folder, or a file.

        Raises:
            UserError: There is none, or it is damaged.
        """
        file = path / CARD_FILE if path.is_dir() else path
        if not file.is_file():
            raise UserError(
                f"{file}: there is no card: maps have one that a session of this version has saved"
            )
        try:
            text = input_files.read_text(file, _MAX_BYTES, remedy="it is no card")
            return cls.from_dict(json.loads(text.partition(_BEGIN)[2].partition(_END)[0]))
        except (ValueError, KeyError, TypeError, RecursionError):
            raise UserError(f"{file}: is damaged, or no card: save the map again") from None

    def write(self, folder: Path, picture: str) -> None:
        """Write the card into a map folder as a page with its content as JSON.

        Raises:
            OSError: It cannot be written.
            RecursionError: Too many cards are within each other.
        """
        facts: dict[str, Any] = {
            **self.contents,
            "accuracy": self.accuracy or "not measured in the session that saved the map",
            "versions": ", ".join(f"{name} {text}" for name, text in self.versions.items()),
            "inputs": [{"path": given.path, "sha256": given.digest[:12]} for given in self.inputs],
        }
        content = json.dumps(dataclasses.asdict(self)).replace("</", "<\\/")
        title = html.escape(f"Map {self.map_key}")
        commands = html.escape("\n".join(self.commands))
        line = html.escape(f"maplab reproduce {shlex.quote(str(folder))}")
        page = (
            f'<!doctype html><meta charset="utf-8"><title>{title}</title>\n'
            "<style>body{font:15px sans-serif;max-width:50em;margin:2em auto;padding:0 1em}"
            "th{text-align:left;vertical-align:top;padding-right:1em}pre{overflow-x:auto}</style>\n"
            f"<h1>{title}</h1>\n{picture}\n{to_html(facts)}\n"
            f"<h2>Commands</h2>\n<pre>{commands}</pre>\n"
            f"<p><code>{line}</code> runs them again. A digest is of "
            "the names, the sizes and both ends of the files.</p>\n"
            f"{_BEGIN}{content}{_END}\n"
        )
        # a name of a file may hold bytes that are no text
        atomic.write_file(folder / CARD_FILE, [page.encode(errors="backslashreplace")])


def digest_of(path: Path) -> str:
    """Return the SHA-256 of the names, sizes and both ends of a file or of all files of a folder.

    Cards are left out. A path that cannot be read has an empty digest.
    """
    digest = hashlib.sha256()
    try:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if not file.is_file() or file.name == CARD_FILE:
                continue
            size = file.stat().st_size
            name = "" if file == path else file.relative_to(path).as_posix()
            digest.update(f"{name}\0{size}\0".encode())
            with file.open("rb") as stream:
                digest.update(stream.read(_END_BYTES))
                stream.seek(max(_END_BYTES, size - _END_BYTES))
                digest.update(stream.read(_END_BYTES))
    except OSError:
        return ""
    return digest.hexdigest() if path.exists() else ""


def input_of(path: Path, fingerprint: str = "") -> CardInput:
    """Return an input as it is now, with the card of a map that has one of its own.

    Args:
        path: File or folder.
        fingerprint: Of the files of a map, if it is known.
    """
    card = None
    try:
        if (path / CARD_FILE).is_file():
            card = Card.read(path)
            if card.fingerprint != (fingerprint or checksums.fingerprint(path)):
                card = None  # another program has replaced the map
    except (UserError, OSError):
        card = None
    return CardInput(str(path.absolute()), digest_of(path), card)


def present_versions() -> dict[str, str]:
    """Return the versions of this package and of those that decide the last digits."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def write_card(
    entry: MapEntry,
    commands: Sequence[str],
    inputs: Sequence[CardInput],
    outputs: Sequence[str],
    accuracy: str,
) -> None:
    """Write the card of a map that has just been saved.

    Raises:
        OSError: It cannot be written.
    """
    assert entry.disk_copy is not None
    tables = ("missions", "vertices", "landmarks", "observations")
    contents = {name: len(getattr(entry.vi_map, name)) for name in tables}
    card = Card(
        entry.key,
        entry.disk_copy.fingerprint,
        present_versions(),
        tuple(commands),
        tuple(inputs),
        tuple(outputs),
        contents,
        accuracy,
    )
    card.write(entry.disk_copy.folder, picture_of(entry.vi_map))


_SIZE_PX = 400.0
_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
_MOST_POINTS = 800


def picture_of(vi_map: VIMap) -> str:
    """Draw the missions and some landmarks from above as SVG; an empty text without vertices."""
    from maplab_py.vimap.queries import limits_from_above

    if not len(vi_map.vertices):
        return ""
    low, high = limits_from_above(vi_map)
    scale = _SIZE_PX / max(float((high - low).max()), 1e-9)
    width, height = (scale * (high - low)).tolist()

    def pixels(p_G: Any) -> Any:
        return scale * (p_G[:, :2] - low) * [1.0, -1.0] + [0.0, height]

    landmarks = pixels(vi_map.p_G[:: -(-max(len(vi_map.landmarks), 1) // _MOST_POINTS)])
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in landmarks.tolist())
    parts = [f'<path d="{dots}" stroke="#bbb" stroke-width="2" stroke-linecap="round"/>']
    for mission in range(len(vi_map.missions)):
        p_G = vi_map.T_G_I[vi_map.vertices.mission == mission, 4:]
        line = pixels(p_G[:: -(-max(len(p_G), 1) // _MOST_POINTS)]).tolist()
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in line)
        colour = _COLOURS[mission % len(_COLOURS)]
        parts.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>'
        )
    metres = max(float((high - low).max()), 0.0)
    return (
        f'<svg width="{width:.0f}" height="{height:.0f}" viewBox="0 0 {width:.1f} {height:.1f}" role="img" '
        f'aria-label="The map from above">{"".join(parts)}</svg><p>From above, {metres:.1f} m at most.</p>'
    )
