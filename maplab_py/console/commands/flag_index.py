"""An index of the flags of plugins, so that one flag is known without importing all of them."""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec

from maplab_py import atomic, kernel_cache
from maplab_py.console.commands.flags import CONSOLE_FLAGS, Flag
from maplab_py.errors import MaplabError

Index = Mapping[str, Sequence[str]]
"""Names of the plugins whose commands have a flag, by the flag's name."""
_PACKAGES = ("maplab_py", "maplab_plugins")
_KEPT = 8
"""Indexes that are kept, of as many installations."""


class Flags(Mapping[str, Flag]):
    """The console's own flags and those of all commands; a plugin is loaded for a flag that is looked at."""

    def __init__(self, names: Iterable[str], find: Callable[[str], Flag]) -> None:
        """Make the mapping.

        Args:
            names: Flags of commands.
            find: Returns a flag of a command by its name.
        """
        self._names = {**dict.fromkeys(CONSOLE_FLAGS, False), **dict.fromkeys(names, True)}
        self._find = find

    def __getitem__(self, name: str) -> Flag:
        return self._find(name) if self._names[name] else CONSOLE_FLAGS[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def kept_index(plugins: Iterable[str], make: Callable[[], tuple[Index, bool]]) -> Index:
    """Return the index of built-in plugins as it was kept for these sources; else make and keep it.

    Args:
        plugins: Names of the plugins.
        make: Makes the index, for which it imports all plugins; tells whether none of them is broken.
    """
    path = kernel_cache.cache_root() / "flags" / f"{_state_of_sources(plugins)}.json"
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(index, dict) and all(isinstance(names, list) for names in index.values()):
            return index
    except (OSError, ValueError):
        pass
    index, is_whole = make()
    if not is_whole:
        return index
    with contextlib.suppress(OSError, MaplabError):  # else it is made again each time
        kernel_cache.cache_root().mkdir(mode=0o700, parents=True, exist_ok=True)
        atomic.write_file(path, [json.dumps(index).encode()])
        for former in sorted(path.parent.glob("*.json"), key=os.path.getmtime)[:-_KEPT]:
            former.unlink()
    return index


def _state_of_sources(plugins: Iterable[str]) -> str:
    """Return a digest of the names, sizes and times of all sources that flags can come from."""
    state = [*plugins]
    for package in _PACKAGES:
        spec = find_spec(package)
        for folder in spec.submodule_search_locations or () if spec is not None else ():
            for where, _, names in os.walk(folder):
                for name in (name for name in names if name.endswith(".py")):
                    with contextlib.suppress(OSError):  # a link of an editor that leads nowhere
                        stat = os.stat(path := os.path.join(where, name))
                        state.append(f"{path} {stat.st_size} {stat.st_mtime_ns}")
    return hashlib.sha256("\n".join(sorted(state)).encode()).hexdigest()[:32]
