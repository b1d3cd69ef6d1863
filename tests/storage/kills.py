"""Kill saves of maps with new resources: `python -m tests.storage.kills FOLDER RESOURCES KILLS [external]`.

Each save runs in a fork of this process, which ends by SIGKILL somewhere between the beginning and a little
after the usual end. Printed is one line of JSON: what each kill has left, "old", "new", or what is wrong.
"""

import dataclasses
import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np

from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import VIMap, to_hex
from tests.vimap.builders import walk_map

OLD_RESOURCES = 20
SIDE = 40
PAST_THE_END = 1.2
"""Kills are spread over this many times the duration of a save."""


Contents = dict[str, int]
"""Numbers of the images, by the ids of the resources."""


def with_images(vi_map: VIMap, first: int, count: int) -> tuple[VIMap, Contents]:
    """Return the map with images of numbered contents, and the new ones."""
    new = NewResources(seed=b"%d" % first)
    rows = [new.add_image(image(number)) for number in range(first, first + count)]
    frames = np.arange(count) % len(vi_map.frames)
    result = new.attached(vi_map, rows, frames)
    ids = map(to_hex, result.resources.id[-count:])
    return result, {name: first + place for place, name in enumerate(ids)}


def image(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (SIDE, SIDE), dtype=np.uint8)


def forked_save(vi_map: VIMap, folder: Path) -> int:
    """Start a save in a child; return its process."""
    child = os.fork()
    if child == 0:
        save_map(vi_map, folder, overwrite=True)
        os._exit(0)
    return child


def state(folder: Path, old: Contents, new: Contents) -> str:
    """Return which map the folder holds, with all its files, or what is wrong."""
    loaded, _ = load_map(folder)
    ids = [to_hex(words) for words in loaded.resources.id]
    held = [name for name, wanted in (("old", old), ("new", new)) if wanted.keys() == set(ids)]
    if not held:
        return f"{len(ids)} resources, neither those of the old nor of the new map"
    store = ResourceStore(loaded, folder)
    for row, name in enumerate(ids):
        if not np.array_equal(store.load(row), image(new[name])):
            return f"resource {name} has another content"
    left = [path.name for path in folder.parent.iterdir() if path.name.startswith(".")]
    is_tidy = not any(name.endswith((".saving", ".old")) for name in left)
    return held[0] if is_tidy else f"files are left: {left}"


def main() -> None:
    """Kill and print."""
    base, resources, kills = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    template, folder, outside = base / "template" / "map", base / "here" / "map", base / "outside"
    first, old_contents = with_images(walk_map(vertices=4, landmarks=6), 0, OLD_RESOURCES)
    save_map(first, template)
    loaded, _ = load_map(template)
    if sys.argv[4:] == ["external"]:
        outside.mkdir()
        metadata = dataclasses.replace(
            loaded.metadata,
            external_resource_folders=(str(outside),),
            resource_folder_in_use=0,
        )
        loaded = loaded.replace(metadata=metadata)
    new, new_contents = with_images(loaded, OLD_RESOURCES, resources)
    contents = old_contents, {**old_contents, **new_contents}

    def put_back() -> None:
        shutil.rmtree(folder.parent, ignore_errors=True)
        shutil.copytree(template.parent, folder.parent)
        for file in outside.rglob("*"):
            if file.is_file():
                file.unlink()

    def save_duration_s() -> float:
        put_back()
        start = time.perf_counter()
        os.waitpid(forked_save(new, folder), 0)
        return time.perf_counter() - start

    # the shortest of three: the first save of a busy machine takes several times as long as those
    # that are killed, and most kills would come too late
    duration_s = min(save_duration_s() for _ in range(3))
    outcomes = [state(folder, *contents)]
    for kill in range(kills):
        put_back()
        child = forked_save(new, folder)
        time.sleep(PAST_THE_END * duration_s * (kill + 0.5) / kills)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        outcomes.append(state(folder, *contents))
    sys.stdout.write(json.dumps(outcomes))


if __name__ == "__main__":
    main()
