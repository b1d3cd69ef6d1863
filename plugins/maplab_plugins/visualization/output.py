"""Commands that keep a view, and that keep or end the viewer."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from maplab_plugins.visualization.following import NAME, running_viewer, viewer_for_output
from maplab_py.cancellation import current_token, lasting_effect
from maplab_py.plugin import CommandContext, Message, Report, UserError, check_writable, command

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer


class SavedPicture(Report):
    """A picture that was saved."""

    file: Path
    size_px: str
    taken_by: str


class ExportedView(Report):
    """A page that was written."""

    file: Path
    megabytes: float


@command(
    "save_view",
    example="save_view --file=map.png",
    see_also=("export_view",),
    guards_effects=True,
)
def save_view(
    context: CommandContext,
    *,
    file: Path,
    width_px: int = 1600,
    height_px: int = 1000,
    view: Literal["", "overview", "top", "side"] = "",
    overwrite: bool = False,
) -> SavedPicture:
    """Save what the viewer shows as a picture; without a viewer the selected map.

    An open page takes the picture from where it looks; without one a Chromium without a window is
    started for as long as it takes. A .gif is an animation of the states that undo and redo lead to,
    with their errors; of more than 40 states 40 that are spread over all of them.

    Args:
        file: A .png, .jpg or .gif file.
        width_px: Width of the picture.
        height_px: Height of the picture.
        view: Where to look from; empty = as the newest open page does.
    """
    check_writable(file, overwrite=overwrite)
    for name, size in (("width_px", width_px), ("height_px", height_px)):
        if not 16 <= size <= 8192:
            raise UserError(f"--{name}={size}: must be 16 to 8192")
    with viewer_for_output(context) as viewer:
        pages, size_px = viewer.pages, (width_px, height_px)
        if file.suffix.lower() == ".gif":
            from maplab_py.viewer.display.animation import save_animation

            saved, states = save_animation(viewer, file, size_px, view)
            context.terminal.note(f"{saved} of {states} states are in the picture")
        else:
            viewer.save_picture(file, size_px, view)
    taken_by = "an open page" if pages else "a browser without a window"
    return SavedPicture(file, f"{width_px} x {height_px}", taken_by)


@command(
    "export_view", example="export_view --file=map.html", see_also=("save_view",), writes_files=True
)
def export_view(context: CommandContext, *, file: Path, overwrite: bool = False) -> ExportedView:
    """Write what the viewer shows to one HTML file that opens without a network.

    Without a viewer the page shows the selected map.

    Args:
        file: The file.
    """
    check_writable(file, overwrite=overwrite)
    with viewer_for_output(context) as viewer:
        return ExportedView(file, viewer.export(file) * 1e-6)


@command(
    "viewer_go_to",
    "go",
    example="viewer_go_to 59f0",
    see_also=("visualize", "why"),
    guards_effects=True,
)
def viewer_go_to(context: CommandContext, id_: str) -> Message:
    """Select a vertex, landmark, closure or mission in the viewer, and move the open pages there.

    $pick is the id of what was last selected, by a click in a page as well: `why $pick`.

    Args:
        id_: Beginning of the id, as other commands print it.
    """
    viewer = running_viewer(context)
    viewer.wait()
    viewer.fly_to(id_)
    return Message(f"{context.session.variables['pick'][:8]} is selected in the viewer")


@command("viewer_stop", needs_map=False, see_also=("visualize",), guards_effects=True)
def viewer_stop(context: CommandContext) -> Message:
    """Stop the viewer; its page stays open and shows nothing new."""
    url = running_viewer(context).url
    context.session.watchers.remove(NAME)
    context.announce(NAME, "")
    return Message(f"the viewer at {url} has stopped")


@command(
    "viewer_keep",
    example="viewer_keep --duration_s=1",
    needs_map=False,
    see_also=("visualize", "rovioli"),
    guards_effects=True,
)
def viewer_keep(context: CommandContext, *, duration_s: float = 0.0) -> Message:
    """Wait until Ctrl-C, so that the page of a script that would end here can be looked at.

    Args:
        duration_s: Time after which it ends by itself; 0 = only at Ctrl-C, or when the viewer stops.
    """
    viewer, start = running_viewer(context), time.monotonic()
    keep(context, viewer, duration_s)
    return Message(f"the viewer at {viewer.url} was kept for {time.monotonic() - start:.0f} s")


def keep(context: CommandContext, viewer: Viewer, duration_s: float = 0.0) -> None:
    """Wait until Ctrl-C, until the viewer stops, or for a time [s] that is not zero.

    What the command has made stays, however often Ctrl-C is pressed.
    """
    start, token = time.monotonic(), current_token()
    context.terminal.note(f"{viewer.url} until Ctrl-C")
    with lasting_effect(is_last=True):
        while not (token.cancelled or viewer.is_stopped):
            if 0.0 < duration_s <= time.monotonic() - start:
                break
            time.sleep(0.1)
    token.cancelled = False
