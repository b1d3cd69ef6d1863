"""The command that makes a map again from its card."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from maplab_py.plugin import CommandContext, EstimationError, Report, UserError, command

if TYPE_CHECKING:
    from maplab_py.console.session.cards import Card, CardInput
    from maplab_py.console.session.session import Session
    from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class CardFact:
    """One fact of a card, and what it is now."""

    what: str
    recorded: str
    now: str


class Reproduction(Report):
    """A map that was made again, compared with its card and with the map beside that."""

    commands: int
    differing: tuple[CardFact, ...]
    result: str


@command(
    "reproduce",
    example="reproduce merged",
    needs_map=False,
    guards_effects=True,
    reads=("card",),
    see_also=("history", "compare_maps", "save"),
)
def reproduce(
    context: CommandContext, card: Path, *, map_folder: Path | None = None
) -> Reproduction:
    """Run the commands of a saved map's card again, and say what differs.

    `save` writes the card beside the map: inputs, versions, commands, accuracy and a picture. Inputs are
    compared by the names, sizes and both ends of their files. A map that was saved over the map that it was
    loaded from is made from the beginning. What the commands write goes to a temporary folder.

    Args:
        card: Folder of the map, or its card.html.
        map_folder: Save the map that was made here; empty = do not keep it.
    """
    from maplab_py.console.session.cards import Card, present_versions
    from maplab_py.storage.native import check_target, load_map

    if map_folder is not None:
        check_target(map_folder)
    read = Card.read(card)
    differing = [
        CardFact(name, text, now)
        for name, text in read.versions.items()
        if (now := present_versions().get(name, "not installed")) != text
    ]
    with tempfile.TemporaryDirectory(prefix="maplab-reproduce-") as temporary:
        session, changed = _make(context, read, Path(temporary))
        made = map_folder or Path(temporary) / "result"
        session.run("save", map_folder=made)  # files round the last bit of rotations
        vi_map = load_map(made)[0]
    differing += changed
    for what, count in read.contents.items():
        if (now_count := len(getattr(vi_map, what))) != count:
            differing.append(CardFact(what, str(count), str(now_count)))
    folder = card if card.is_dir() else card.parent
    return Reproduction(len(read.commands), tuple(differing), _result(folder, read, vi_map))


def _make(context: CommandContext, card: Card, folder: Path) -> tuple[Session, list[CardFact]]:
    """Run the commands of a card; return the session with its map selected, and the inputs that differ.

    What they write goes into new folders in `folder`, also where a later one reads it.

    Raises:
        UserError: An input is missing.
        EstimationError: A command failed.
    """
    from maplab_py.console.commands.lines import split_commands
    from maplab_py.console.session.session import Session
    from maplab_py.errors import MaplabError

    paths: dict[str, str] = {}
    differing: list[CardFact] = []
    for given in card.inputs:
        path, changed = _input(context, given, folder)
        paths[given.path] = str(path)
        differing += changed
    for text in card.outputs:
        if paths.get(text, text) == text:
            paths[text] = str(Path(tempfile.mkdtemp(dir=folder), Path(text).name))
    session = Session(context.session.registry, context.terminal)
    for line in card.commands:
        for words in split_commands(line):
            context.terminal.note(f"reproduce: {line}")
            try:
                session.execute(session.parse([_with_path(word, paths) for word in words]))
            except MaplabError as error:
                raise EstimationError(f"{line}: {error}") from error
    session.maps.select(card.map_key)
    return session, differing


def _input(context: CommandContext, given: CardInput, folder: Path) -> tuple[Path, list[CardFact]]:
    """Return the path of an input: as recorded, or made again where it was replaced."""
    from maplab_py.console.session.cards import digest_of

    path = Path(given.path)
    now = digest_of(path)
    if now == given.digest:
        return path, []
    if given.card is not None:
        session, differing = _make(context, given.card, folder)
        made = Path(tempfile.mkdtemp(dir=folder), path.name)
        session.run("save", map_folder=made)
        return made, differing
    if not now:
        raise UserError(f"{path}: the input of the map is not there any more: put it back")
    return path, [CardFact(f"input {path}", given.digest[:12], now[:12])]


def _with_path(word: str, paths: Mapping[str, str]) -> str:
    """Return a word of a command with the path that takes the place of the recorded one."""
    name, equals, value = word.partition("=")
    if equals and value in paths:
        return f"{name}={paths[value]}"
    return paths.get(word, word)


def _result(folder: Path, card: Card, vi_map: VIMap) -> str:
    """Say how a map differs from the one beside its card."""
    from maplab_py.algorithms.evaluation.map_comparison import compare_maps
    from maplab_py.storage import checksums, native

    if not native.is_map_folder(folder):
        return "there is no map beside the card to compare with"
    if checksums.fingerprint(folder) != card.fingerprint:
        return f"{folder} has changed since its card was written: not compared"
    return compare_maps(vi_map, native.load_map(folder)[0]).in_words
