"""The session's viewer: started when first needed, kept in step with the selected map."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.cancellation import check_cancelled, lasting_effect
from maplab_py.options import Options, option
from maplab_py.plugin import Cancelled, CommandContext, Report, UserError

if TYPE_CHECKING:
    from maplab_py.console.session.maps import MapEntry, MapManager
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.display.viewer import Viewer
    from maplab_py.viewer.drawing import ImageOf
    from maplab_py.viewer.history import State
    from maplab_py.viewer.options import PlaybackOptions, VisualizationOptions
    from maplab_py.vimap import VIMap

NAME = "viewer"


class ViewerOptions(Options, prefix="viewer_"):
    """Program that shows the map; address and appearance of the page in the browser."""

    program: str = option("browser", choices=("browser", "rerun"), flag="viewer")
    """Program that shows the map: a page in the browser, or Rerun (extra rerun)"""
    file: Path | None = None
    """With --viewer=rerun: write this file .rrd in place of opening a window"""
    port: int = 8080
    """Port on this machine; a busy one gives the next, 0 = any."""
    dark: bool = False
    """Dark theme; the panel can change it."""
    open_page: bool = True
    """Open the page when a person is at the prompt and has a desktop."""


@dataclasses.dataclass(frozen=True)
class LayerLine:
    """One layer of the view."""

    layer: str
    in_map: int
    visible: bool


class ViewReport(Report):
    """Shown page and its address."""

    url: str
    map: str
    layers: tuple[LayerLine, ...]
    notes: tuple[str, ...]
    seconds: float


class Following:
    """Keeps a viewer in step with the selected map."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer

    def after_command(self, maps: MapManager) -> None:
        """Show the selected map when it is another value than the one that is shown."""
        from maplab_py.viewer.building import Subject
        from maplab_py.viewer.resource_clouds import VertexImages

        subject = self.viewer.wanted
        if subject is None or self.viewer.is_stopped or not maps.selected_key:
            return
        entry = maps.selected
        if entry.vi_map is subject.vi_map or not len(entry.vi_map.vertices):
            return
        if entry.key == subject.title:
            following = subject.replace(vi_map=entry.vi_map, note="", state=-1)
            if isinstance(subject.images, VertexImages):
                following = following.replace(images=subject.images.of_map(entry.vi_map))
        else:
            following = Subject(
                entry.vi_map,
                entry.key,
                subject.options,
                images=images_of(entry.vi_map, entry.folder),
            )
        self.viewer.follow(following.replace(history=states_of(entry)))

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Show where a running command has got to."""
        self.viewer.follow_live(make_map)

    def close(self) -> None:
        """Stop the server."""
        self.viewer.stop()


def states_of(entry: MapEntry) -> tuple[State, ...]:
    """Return the values of a map that undo and redo lead to and its present one, the oldest first."""
    from maplab_py.viewer.history import State

    commands = ("", *(step.command for step in entry.past))
    values = (*(step.vi_map for step in entry.past), entry.vi_map)
    states = [State(command, value) for command, value in zip(commands, values, strict=True)]
    states += [State(step.command, step.vi_map) for step in entry.future]
    return tuple(state for state in states if len(state.vi_map.vertices))


def _with_history(context: CommandContext, subject: Subject) -> Subject:
    """Return the subject with the history of its map, if that is the selected one."""
    entry = context.maps.selected if context.maps.selected_key else None
    if entry is None or entry.vi_map is not subject.vi_map:
        return subject
    return subject.replace(history=states_of(entry))


def in_colours(subject: Subject) -> Subject:
    """Return the subject in the colours that say most of a single mission, unless others are asked for.

    Landmarks have those of their pixels, without images those of their height; the path has those of time.
    """
    from maplab_py.viewer.resource_clouds import VertexImages

    options = subject.options
    if len(subject.vi_map.missions) != 1 or options.landmark_colouring != "mission":
        return subject
    has_images = isinstance(subject.images, VertexImages)
    options = options.with_colouring("pixels" if has_images else "height")
    return subject.replace(options=dataclasses.replace(options, color_paths_by_time=True))


def open_viewer(context: CommandContext) -> Viewer | None:
    """Return the viewer of the session, None where none is running."""
    following = context.session.watchers.find(NAME, Following)
    return None if following is None or following.viewer.is_stopped else following.viewer


def verdicts_of_page(context: CommandContext) -> list[list[str]]:
    """Return the ids of closures that were accepted, and of those refused, in the page; forget them there.

    Raises:
        UserError: None were.
    """
    viewer = open_viewer(context)
    if viewer is None:
        raise UserError(
            "judge_closures: give --accept or --refuse, or judge in the page: visualize"
        )
    verdicts = viewer.court.take_verdicts()
    if not verdicts:
        raise UserError(
            "judge_closures: no verdict was given in the page (Closure court); give --accept or --refuse"
        )
    return [[key for key, verdict in verdicts.items() if verdict is kind] for kind in (True, False)]


def running_viewer(context: CommandContext) -> Viewer:
    """Return the viewer of the session.

    Raises:
        UserError: None is running.
    """
    viewer = open_viewer(context)
    if viewer is None:
        raise UserError(f"{context.command}: no viewer is running; start one: visualize")
    return viewer


@contextmanager
def viewer_for_output(context: CommandContext) -> Iterator[Viewer]:
    """Give the viewer of the session; without one a viewer of the selected map that lasts as long.

    Raises:
        UserError: None is running, and the selected map cannot be shown.
    """
    if (running := open_viewer(context)) is not None:
        yield running
        return
    from maplab_py.viewer.building import Subject
    from maplab_py.viewer.display.viewer import Viewer

    viewer = Viewer(0)
    try:
        images = images_of(context.vi_map, context.map_folder)
        subject = Subject(context.vi_map, context.map_key, images=images)
        viewer.show(_with_history(context, in_colours(subject)))
        yield viewer
    finally:
        viewer.stop()


def ensure_viewer(context: CommandContext, options: ViewerOptions) -> Viewer:
    """Return the session's viewer; start one when none is running or another port is wanted."""
    from maplab_py.viewer.display.viewer import Viewer

    if (running := open_viewer(context)) is not None:
        return running
    viewer = Viewer(options.port, is_dark=options.dark)
    try:
        with lasting_effect():
            viewer.selections.on_pick = partial(context.session.variables.__setitem__, "pick")
            context.session.watchers.set(NAME, Following(viewer))
            context.announce(NAME, viewer.url)
    except Cancelled:
        viewer.stop()
        raise
    if options.open_page and context.terminal.is_interactive and _has_desktop():
        import webbrowser

        webbrowser.open(viewer.url)
    return viewer


def show(
    context: CommandContext,
    display: ViewerOptions,
    options: VisualizationOptions | None = None,
    *,
    vi_map: VIMap | None = None,
    title: str = "",
    playback: PlaybackOptions | None = None,
    image_of: ImageOf | None = None,
    plays: bool = False,
    **drawn: Any,
) -> ViewReport:
    """Show a map in the session's viewer and say what is to be seen.

    Args:
        context: Of the command.
        display: Where.
        options: Layers and their style; None = the defaults.
        vi_map: The map; None = the selected one.
        title: Its name; empty = the key of the selected map.
        playback: How the time slider plays it.
        image_of: Images of vertices; those that the map has as resources when not given.
        plays: Start to play at once.
        drawn: What else is drawn, see `Subject`.
    """
    from maplab_py.viewer import building
    from maplab_py.viewer.options import VisualizationOptions

    subject = building.Subject(
        vi_map or context.vi_map,
        title or context.map_key,
        options or VisualizationOptions(),
        **drawn,
    )
    began = time.perf_counter()
    images = image_of or images_of(subject.vi_map, context.map_folder)
    if display.program == "rerun":
        return _show_in_rerun(subject, display, images)
    if display.file is not None:
        raise UserError(
            "--viewer_file is for --viewer=rerun; export_view writes the page to a file"
        )
    context.progress.step(0, 2, "start the viewer")
    viewer = ensure_viewer(context, display)
    check_cancelled()
    context.progress.step(1, 2, "draw the map")
    subject = _with_history(context, in_colours(subject.replace(images=images)))
    viewer.show(subject, playback=playback)
    if plays:
        viewer.open_time_line()
        viewer.set_playing(True)
    scene = viewer.scene
    if scene is None:
        raise UserError(f"{context.command}: nothing is shown")
    visible = viewer.visible_layers
    lines = tuple(LayerLine(la.title, la.total, la.name in visible) for la in scene.layers)
    return ViewReport(viewer.url, subject.title, lines, scene.notes, time.perf_counter() - began)


def _show_in_rerun(subject: Subject, options: ViewerOptions, images: ImageOf) -> ViewReport:
    """Show a subject in Rerun, or write it to a file."""
    from maplab_py.viewer.display.rerun_scene import show_in_rerun
    from maplab_py.viewer.resource_clouds import VertexImages

    if options.file is None and not _has_desktop():
        raise UserError(
            "--viewer=rerun opens a window, and there is no desktop here: give --viewer_file=map.rrd and "
            "open the file elsewhere, or leave out --viewer to see the map in a browser"
        )
    began = time.perf_counter()
    of_vertices = images if isinstance(images, VertexImages) else None
    scene = show_in_rerun(subject, of_vertices, options.file)
    lines = tuple(LayerLine(la.title, la.total, la.is_visible) for la in scene.layers)
    place = "Rerun" if options.file is None else str(options.file)
    return ViewReport(place, subject.title, lines, scene.notes, time.perf_counter() - began)


def images_of(vi_map: VIMap, folder: Path | None) -> ImageOf:
    """Return the images and depth maps that a map keeps as resources; none when it was never loaded."""
    from maplab_py.viewer.drawing import no_image
    from maplab_py.viewer.resource_clouds import VertexImages

    if folder is None or not len(vi_map.resources):
        return no_image
    images = VertexImages(vi_map, folder, with_depth=True)
    return images if len(images) else no_image


def _has_desktop() -> bool:
    """Tell whether a browser would open a window instead of taking the terminal."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
