"""Write the golden screens: python -m tests.console.screens [COMMAND ...]; without names all."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from maplab_py.console.commands.registry import load_registry
from tests.console.screens.collection import GOLDEN, Collection, recorded_commands


def main(names: list[str]) -> None:
    """Write the screens of the commands with these names."""
    recorded = recorded_commands(load_registry())
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = f"{folder}/state"
        os.environ["XDG_CONFIG_HOME"] = f"{folder}/config"
        collection = Collection(Path(folder))
        for name in names or recorded:
            text = collection.screens(name)
            (GOLDEN / f"{name}.txt").write_text(text, encoding="utf-8")
            print(name, flush=True)
    if not names:
        for path in GOLDEN.glob("*.txt"):
            if path.stem not in recorded:
                path.unlink()


if __name__ == "__main__":
    main(sys.argv[1:])
