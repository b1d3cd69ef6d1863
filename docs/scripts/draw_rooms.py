"""Draw docs/images/rooms.svg: packages in the order of their layers, areas proportional to lines.

    python docs/scripts/draw_rooms.py [FILE]

The layers are those that `lint-imports` checks: a package may use those below it.
"""

import re
import sys
import tomllib
from collections.abc import Iterator
from html import escape
from pathlib import Path

from measure_sources import REPOSITORY, ROOTS, measure

TARGET = REPOSITORY / "docs" / "images" / "rooms.svg"
BASE = "maplab_py"
WIDTH_PX, LINES_PER_PX2, LEAST_ROW_PX, HEAD_PX, GAP_PX = 960.0, 0.14, 26.0, 18.0, 4.0
LETTER = 0.6
"""Mean width of a letter in units of its height."""
COLOURS = ("#e8f1fa", "#e9f5ec", "#fdf3e3", "#f4ecf8")

Box = tuple[float, float, float, float]
"""Left, top, width and height [px]."""


def layers() -> list[list[str]]:
    """Return the names of the packages of every layer, top to bottom; modules without a folder are one."""
    tools = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    contract = tools["importlinter"]["contracts"][0]
    rows = [[name.strip(" ()") for name in row.split("|")] for row in contract["layers"]]
    folders = [[name for name in row if folder_of(name).is_dir()] for row in rows]
    return [row for row in folders if row] + [[BASE]]


def folder_of(name: str) -> Path:
    """Return the folder of a package."""
    return ROOTS[name.partition(".")[0]].joinpath(*name.split("."))


def lines_of(folder: Path, pattern: str) -> int:
    """Return the lines of the modules in a folder that a pattern selects."""
    paths = [path for path in folder.glob(pattern) if not path.name.endswith("_pb2.py")]
    return measure(paths)[1]


def parts_of(name: str) -> list[tuple[str, int]]:
    """Return the folders of a package with their lines, the largest first; "" = its own modules."""
    folder = folder_of(name)
    if name == BASE:
        return [("", lines_of(folder, "*.py"))]
    inner = [path for path in folder.iterdir() if any(path.glob("**/*.py"))]
    parts = [(path.name, lines_of(path, "**/*.py")) for path in inner if path.is_dir()]
    parts.append(("", lines_of(folder, "*.py")))
    return sorted((part for part in parts if part[1]), key=lambda part: -part[1])


def split(parts: list[tuple[str, int]], box: Box) -> Iterator[tuple[str, int, Box]]:
    """Yield the parts with their boxes: the parts are halved, across the longer side of the box."""
    if len(parts) == 1:
        yield *parts[0], box
        return
    total, first, count = sum(lines for _, lines in parts), 0, 0
    while count == 0 or (count < len(parts) - 1 and first + parts[count][1] / 2 < total / 2):
        first += parts[count][1]
        count += 1
    left, top, width, height = box
    share = first / total
    if width > 2.0 * height:
        boxes = (
            (left, top, width * share, height),
            (left + width * share, top, width * (1 - share), height),
        )
    else:
        boxes = (
            (left, top, width, height * share),
            (left, top + height * share, width, height * (1 - share)),
        )
    yield from split(parts[:count], boxes[0])
    yield from split(parts[count:], boxes[1])


def rectangle(box: Box, colour: str, text: str, size_px: float, name: str) -> str:
    """Return a box with a text at its top, in smaller letters or without its number where room is short."""
    left, top, width, height = box
    choices = [
        (t, s) for t in (text, re.sub(r" [\d,]+$", "", text)) for s in (size_px, 0.75 * size_px)
    ]
    fitting = [(t, s) for t, s in choices if len(t) * LETTER * s <= width - 6 and height >= 1.3 * s]
    label, letters_px = fitting[0] if fitting else ("", size_px)
    sizes = f'width="{max(width - 1, 0.5):.1f}" height="{max(height - 1, 0.5):.1f}"'
    return (
        f'<g><title>{escape(name)}</title><rect x="{left:.1f}" y="{top:.1f}" {sizes} fill="{colour}" '
        f'stroke="#8a97a3" stroke-width="0.6"/><text x="{left + 4:.1f}" y="{top + letters_px + 1:.1f}" '
        f'font-size="{letters_px:g}">{escape(label)}</text></g>'
    )


def drawing() -> str:
    """Return the picture."""
    shapes, top = [], 0.0
    for number, row in enumerate(layers()):
        parts = {name: parts_of(name) for name in row}
        sizes = {name: sum(lines for _, lines in parts[name]) for name in row}
        area = sum(sizes.values()) / LINES_PER_PX2
        height = max(area / WIDTH_PX, LEAST_ROW_PX)
        left = 0.0
        widths = {name: max(WIDTH_PX * sizes[name] / sum(sizes.values()), 54.0) for name in row}
        for name in row:
            width = WIDTH_PX * widths[name] / sum(widths.values())
            title = "modules without a folder" if name == BASE else name.removeprefix(f"{BASE}.")
            text = f"{title} {sizes[name]:,}"
            box = (left, top, width, height)
            shapes.append(rectangle(box, COLOURS[number % len(COLOURS)], text, 12, text))
            inner = (left + 3, top + HEAD_PX, width - 7, height - HEAD_PX - 4)
            if len(parts[name]) > 1 and inner[3] > 12.0:
                for part, lines, place in split(parts[name], inner):
                    text = f"{part or 'modules'} {lines:,}"
                    shapes.append(
                        rectangle(place, "#ffffff", text, 11, f"{title}/{part}: {lines:,} lines")
                    )
            left += width
        top += height + GAP_PX
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX:g} {top:.0f}" '
        f'font-family="sans-serif" fill="#1d2b36">\n' + "\n".join(shapes) + "\n</svg>\n"
    )


if __name__ == "__main__":
    (Path(sys.argv[1]) if sys.argv[1:] else TARGET).write_text(drawing(), encoding="utf-8")
