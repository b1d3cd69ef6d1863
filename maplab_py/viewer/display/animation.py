"""The undo history of a map as an animated picture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maplab_py.array_types import I64, U8
from maplab_py.cancellation import check_cancelled
from maplab_py.errors import UserError
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.viewer.display.picture import open_client, point_camera, render
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.history import MAX_STATES, Curve, error_curves, state_facts

if TYPE_CHECKING:
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.display.viewer import Viewer

_SHOWN_MS, _LAST_SHOWN_MS = 1200, 3000
_COLOURS = 128
_CAPTION_HEIGHT = 0.042
"""Height of a line of the caption, as a part of the picture's."""


def save_animation(
    viewer: Viewer, path: Path, size_px: tuple[int, int], view: str = ""
) -> tuple[int, int]:
    """Save a GIF of the states of the map that is shown, all seen from one place.

    Args:
        viewer: Shows the map; it shows the same state afterwards.
        size_px: Width and height.
        view: One of `camera.VIEWS`; empty = as the newest open page looks.

    Returns:
        The number of states in the picture, and that of all.

    Raises:
        UserError: The map has one state only, the file cannot be written, or there is no browser.
        EstimationError: The browser gave no picture.
    """
    check_writable(path, overwrite=True)
    subject = viewer.wanted
    states = () if subject is None else subject.history
    if subject is None or len(states) < 2:
        raise UserError(f"--file={path}: the map has no history to animate: no command changed it")
    chosen = evenly_spread(len(states))
    curves = error_curves([states[place] for place in chosen.tolist()], subject.truth)
    drawings = (make_drawing(states[place].vi_map, subject.options) for place in chosen.tolist())
    extent = max((drawing.extent for drawing in drawings), key=lambda each: each.radius_m)
    pages = viewer.pages
    try:
        with open_client(viewer.server, viewer.url, size_px) as client:
            pose = point_camera(client, extent, view or ("" if pages else "overview"))
            picture = gif(_frames(viewer, subject, client, chosen, curves, size_px, pose))
    finally:
        viewer.follow(subject)
        viewer.wait()
    write_bytes(path, [picture], overwrite=True)
    return len(chosen), len(states)


def _frames(
    viewer: Viewer,
    subject: Subject,
    client: Any,
    chosen: I64,
    curves: tuple[Curve, ...],
    size_px: tuple[int, int],
    pose: dict[str, Any],
) -> Iterator[U8]:
    """Give a picture (H, W, 3) RGB of each chosen state, without a state left of a swipe line."""
    is_dark, states = viewer.is_dark, subject.history
    if subject.arrangement == "swipe":
        subject = subject.replace(other=None, arrangement="over")
    for number, place in enumerate(chosen.tolist()):
        check_cancelled()
        viewer.follow(subject.replace(state=place))
        viewer.wait()
        picture = render(client, size_px, is_dark=is_dark, pose=pose)
        title = f"{place + 1} of {len(states)}: {states[place].command or 'at first'}"
        yield with_caption(picture, (title, *state_facts(curves, number)), is_dark=is_dark)


def evenly_spread(count: int) -> I64:
    """Return at most `MAX_STATES` of the numbers below a count, the first and the last included."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_STATES)).round().astype(np.int64))


def with_caption(picture: U8, lines: tuple[str, ...], *, is_dark: bool) -> U8:
    """Write lines into the lower left corner of a picture (H, W, 3) RGB."""
    import cv2

    result = picture.copy()
    height = max(_CAPTION_HEIGHT * len(picture), 12.0)
    ink, ground = ((230, 230, 230), (20, 20, 20)) if is_dark else ((40, 40, 40), (255, 255, 255))
    for number, line in enumerate(reversed(lines)):
        place = round(0.5 * height), round(len(picture) - height * (number + 0.6))
        for colour, thickness in ((ground, 0.2), (ink, 0.055)):
            width = max(1, round(thickness * height))
            scale = height / 42.0
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(result, line, place, font, scale, colour, width, cv2.LINE_AA)
    return result


def gif(frames: Iterable[U8]) -> bytes:
    """Return a file of frames (H, W, 3) RGB that is played again and again."""
    import io

    from PIL import Image

    pictures: list[Any] = [
        Image.fromarray(frame).quantize(_COLOURS, dither=Image.Dither.NONE) for frame in frames
    ]
    file = io.BytesIO()
    shown_ms = [_SHOWN_MS] * (len(pictures) - 1) + [_LAST_SHOWN_MS]
    pictures[0].save(
        file, format="GIF", save_all=True, append_images=pictures[1:], duration=shown_ms, loop=0
    )
    return file.getvalue()
