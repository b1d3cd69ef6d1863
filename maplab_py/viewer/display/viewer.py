"""One viewer: a server, what it shows, and how it follows the map.

Three kinds of threads meet here: the console's, viser's pool that runs what pages ask for, and
the viewer's own that builds scenes, so that no command waits for a picture. All state is changed
under one lock; maps are values, so what is being drawn cannot change underneath.
"""

import atexit
import dataclasses
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maplab_py.errors import MaplabError, UserError
from maplab_py.viewer import ground, picking
from maplab_py.viewer.building import Subject, make_checked_drawing, scene_of
from maplab_py.viewer.display.camera import Cameras, aim
from maplab_py.viewer.display.court import Court
from maplab_py.viewer.display.links import Links
from maplab_py.viewer.display.panel import MotionRequest, Panel, TimeMachine
from maplab_py.viewer.display.parts import Nodes, by_user
from maplab_py.viewer.display.picture import (
    export_html,
    save_picture,
    states_to_choose,
    take_picture,
)
from maplab_py.viewer.display.playback_control import Playback
from maplab_py.viewer.display.player import Player
from maplab_py.viewer.display.selection import Selection, Selections, fly
from maplab_py.viewer.display.server import LOOPBACK, Themes, start_server
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.layers.closures import REFUSED
from maplab_py.viewer.options import PlaybackOptions
from maplab_py.viewer.playback import moved_scene, without_played
from maplab_py.viewer.scene import Scene
from maplab_py.vimap import VIMap

_MAX_SHARE = 0.02
"""Part of the time that following a running command may take."""

logger = logging.getLogger(__name__)


class Viewer:
    """A running viewer."""

    def __init__(self, port: int = 8080, *, is_dark: bool = False) -> None:
        """Start the server.

        Args:
            port: Wanted port; a busy one is replaced by the next, 0 = any.
            is_dark: Let pages be dark, whatever theme their systems have.

        Raises:
            UserError: No port is free.
        """
        self.lock = threading.RLock()  # held while a page is served
        self.server = start_server(port, self._go)  # the viser server
        self._cameras = Cameras(self.server)
        self._nodes = Nodes(self.server)
        self._panel = Panel(self)
        self.selections = Selections(self, self._panel.selection)  # what each page has selected
        self.show_image = self.selections.show_image  # shows an image (H, W, 3) in the panel
        self._choices: dict[str, bool] = {}  # layers that the user has switched
        self._hidden: set[str] = set()  # ids of missions that the user has hidden
        self.playback = Playback(self)  # the time line, and what it plays
        self._time_machine = TimeMachine(self)
        self.court = Court(self)  # where closures are judged
        self.motion = MotionRequest(self)  # asks for the motion that a calibration lacks
        self.links = Links(self, self._panel.view)  # makes and opens links to a view
        self._themes = Themes(self, self._panel.view, is_dark=is_dark)
        self._drawing: Drawing | None = None
        self.scene: Scene | None = None  # what is shown
        self.subject: Subject | None = None  # what it was made of
        self._pending: Subject | None = None
        self._building: Subject | None = None
        self._wake = threading.Event()
        self._idle = threading.Event()
        self._idle.set()
        self._is_stopped = False
        self._next_live = 0.0
        self.server.scene.on_click()(self.by_user(self._click))
        self._worker = threading.Thread(target=self._work, name="maplab viewer", daemon=True)
        self._worker.start()
        atexit.register(self.stop)

    def by_user(self, action: Callable[[Any], None]) -> Callable[[Any], None]:
        """Make a callback of what a page does; see `parts.by_user`."""
        return by_user(self.lock, action, self.say)

    def say(self, message: str) -> None:
        """Show a message in all pages."""
        self._panel.say(message)

    # -- what the console does --------------------------------------------------------------------

    @property
    def port(self) -> int:
        """The port that is served, which need not be the one asked for."""
        return int(self.server.get_port())

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{LOOPBACK}:{self.port}"

    @property
    def is_dark(self) -> bool:
        """Tell the theme of the newest page."""
        pages = sorted(self.server.get_clients().items())
        return self._themes.is_dark(pages[-1][1] if pages else None)

    @property
    def wanted(self) -> Subject | None:
        """Subject that is shown, or soon will be."""
        with self.lock:
            return self._pending or self._building or self.subject

    @property
    def pages(self) -> int:
        """The number of open pages."""
        return len(self.server.get_clients())

    def show(self, subject: Subject, *, playback: PlaybackOptions | None = None) -> Scene:
        """Show a subject now.

        Raises:
            UserError: There is nothing to show.
        """
        drawing = make_checked_drawing(subject)
        scene = scene_of(drawing, subject)
        with self.lock:
            self.playback.configure(playback or PlaybackOptions())
            self._choices = {}
            self._show(subject, drawing, scene)
        self._wake.set()  # measures the history
        return scene

    def follow(self, subject: Subject) -> None:
        """Show another state soon, without waiting for it; only the latest request counts."""
        with self.lock:
            self._pending = subject
            self._idle.clear()
        self._wake.set()

    def follow_live(self, make_map: Callable[[], VIMap]) -> bool:
        """Show where a running command has got to, if that costs the command next to nothing.

        Only positions are followed. After each update the viewer lets fifty times as long pass as
        the update took.

        Args:
            make_map: Makes the map as it is now; not called when it is too early.

        Returns:
            Whether it was shown.
        """
        began = time.perf_counter()
        if began < self._next_live or self._pending is not None or not self.pages:
            return False
        with self.lock:
            if self._drawing is None or self.scene is None or self.player is not None:
                return False
            scene = moved_scene(self.scene, self._drawing, make_map())
            self._nodes.show(scene, self.visible_layers, self.visible_missions)
        took = time.perf_counter() - began
        self._next_live = began + took / _MAX_SHARE
        return True

    def wait(self, timeout_s: float = 60.0) -> bool:
        """Wait until everything requested is shown; return whether it is."""
        return self._idle.wait(timeout_s)

    def look_at_everything(self) -> None:
        """Let all pages, and those that will be opened, see the whole map."""
        if self.scene is not None:
            self._cameras.show_all(self.scene.extent)

    def save_picture(self, path: Path, size_px: tuple[int, int], view: str = "") -> int:
        """Save a picture of the scene; return the number of open pages that could have taken it.

        Args:
            path: A .png or .jpg file.
            size_px: Width and height.
            view: One of `camera.VIEWS`; empty = as the newest open page looks.

        Raises:
            UserError: Nothing is shown, the file cannot be written, or there is no browser.
            EstimationError: The browser gave no picture.
        """
        scene = self._shown()
        self.wait()
        pages = self.pages
        view = view or ("" if pages else "overview")
        picture = take_picture(
            self.server, self.url, scene.extent, view, size_px, is_dark=self.is_dark
        )
        save_picture(picture, path)
        return pages

    def export(self, path: Path) -> int:
        """Write all layers to one HTML file with switches; return its size in bytes.

        Raises:
            UserError: Nothing is shown, or the file cannot be written.
        """
        scene = self._shown()
        self.wait()
        layers = self.visible_layers
        with self.lock, self._nodes.with_hidden(self._draw(scene), layers, self.visible_missions):
            try:
                server, is_dark = self.server, self.is_dark
                with states_to_choose(server, self.drawing, self.subject) as chooser:
                    return export_html(server, scene, layers, path, chooser, is_dark=is_dark)
            finally:
                self._cameras.aim_new_pages(scene.extent)

    def _shown(self) -> Scene:
        if self.scene is None:
            raise UserError("nothing is shown yet: visualize")
        return self.scene

    def stop(self) -> None:
        """Stop the server; harmless when it has stopped already."""
        atexit.unregister(self.stop)
        with self.lock:
            if self._is_stopped:
                return
            self._is_stopped = True
            self._time_machine.stop()
        self.playback.end()
        self._wake.set()
        self._idle.set()
        self.server.stop()

    @property
    def is_stopped(self) -> bool:
        """Tell whether the server has been stopped."""
        return self._is_stopped

    # -- what is visible --------------------------------------------------------------------------

    @property
    def visible_layers(self) -> set[str]:
        """Names of the layers that are drawn."""
        if self.scene is None:
            return set()
        return {
            layer.name
            for layer in self.scene.layers
            if self._choices.get(layer.name, layer.is_visible)
        }

    @property
    def visible_missions(self) -> set[str]:
        """Ids of the missions that are drawn."""
        if self.scene is None:
            return set()
        return {m.id for m in self.scene.missions} - self._hidden

    @property
    def drawing(self) -> Drawing:
        """The map as it is drawn; raises UserError while nothing is shown."""
        if self._drawing is None:
            raise UserError("nothing is shown yet: visualize")
        return self._drawing

    @property
    def selection(self) -> Selection:
        """Selection that was changed last."""
        return self.selections.newest

    def set_layer(self, name: str, is_visible: bool) -> None:
        """Show or hide a layer."""
        with self.lock:
            self._choices[name] = is_visible
            self.redraw()

    def set_layers(self, visible: set[str]) -> set[str]:
        """Show these layers and no others; return those that the map has not."""
        with self.lock:
            names = set(self._shown().names)
            self._choices |= {name: name in visible for name in names}
            self.redraw()
        return visible - names

    def set_missions(self, visible: set[str]) -> None:
        """Show these missions and no others."""
        with self.lock:
            self._hidden = {mission.id for mission in self._shown().missions} - visible
            self.playback.stop()
            self.redraw()

    def set_colouring(self, colouring: str, only_mission: str = "") -> None:
        """Colour landmarks by another rule, all or those of a mission (id) alone."""
        with self.lock:
            if self.subject is None:
                return
            options = self.subject.options.with_colouring(colouring, only_mission)
            self.follow(self.subject.replace(options=options))

    def set_refused_reason(self, reason: str) -> None:
        """Show refused closures whose reason contains a text only, empty = all."""
        with self.lock:
            if self.subject is None:
                return
            options = dataclasses.replace(self.subject.options, refused_closures_reason=reason)
            self._choices[REFUSED] = True
            self.follow(self.subject.replace(options=options))

    def set_state(self, place: int) -> None:
        """Show a state of the map by its place in the undo history; the map stays as it is."""
        with self.lock:
            subject = self.wanted
            if subject is not None and 0 <= place < len(subject.history):
                self.follow(subject.at_state(place, swipes=self._time_machine.swipes))

    def set_point_scale(self, factor: float) -> None:
        """Draw points larger or smaller."""
        with self.lock:
            self._nodes.scale_points(factor)

    def set_dark(self, is_dark: bool) -> None:
        """Change the theme of all pages."""
        with self.lock:
            self._themes.set_all(is_dark=is_dark)

    def set_ground(self, is_visible: bool) -> None:
        """Show or hide the grid."""
        with self.lock:
            self._nodes.set_ground_visible(is_visible)

    def look(self, client: Any, view: str) -> None:
        """Move the camera of one page."""
        if client is not None and self.scene is not None:
            with client.atomic():
                aim(client.camera, self.scene.extent, view)

    # -- the time line ----------------------------------------------------------------------------

    @property
    def player(self) -> Player | None:
        """Playback; None while the whole map is shown."""
        return self.playback.player

    def set_step(self, step: int) -> None:
        """Show the map as it was after a step; the last step is the whole map."""
        with self.lock:
            self.playback.set_step(step)

    def set_playing(self, is_playing: bool) -> None:
        """Play or pause; playing from the end starts again at the beginning."""
        with self.lock:
            self.playback.set_playing(is_playing)

    def open_time_line(self) -> None:
        """Open the window of the time line."""
        with self.lock:
            self.playback.time_line.open()

    # -- picking ----------------------------------------------------------------------------------

    def select(self, picked: picking.Pick) -> None:
        """Mark a thing and show its facts in all pages, as if it had been clicked in each."""
        with self.lock:
            self.selections.pick(self.drawing, picked)

    def fly_to(self, text: str) -> None:
        """Select what an id means in all pages, and move their cameras there.

        Raises:
            UserError: Nothing has an id that starts so, or several have.
        """
        with self.lock:
            picked = self.selections.jump(self.drawing, text)
            for page in self.server.get_clients().values():
                fly(page, self.drawing, picked)

    def _go(self, id_: str) -> str:
        return self.links.go(id_)

    def _click(self, event: Any) -> None:
        if self.scene is None:
            return
        picked = picking.pick(
            self.scene, event.ray_origin, event.ray_direction,
            layers=self.visible_layers, missions=self.visible_missions,
        )  # fmt: skip
        if picked is not None:
            self.selections.pick(self.drawing, picked, event.client)

    # -- drawing ----------------------------------------------------------------------------------

    def _work(self) -> None:
        """Build and show what is asked for; the latest request only."""
        while not self._is_stopped:
            self._wake.wait()
            self._wake.clear()
            with self.lock:
                subject, self._pending = self._pending, None
                self._building = subject
            if subject is not None and not self._is_stopped:
                self._show_safely(subject)
            if not self._is_stopped:
                self._time_machine.measure()
            with self.lock:
                self._building = None
                if self._pending is None:
                    self._idle.set()

    def _show_safely(self, subject: Subject) -> None:
        try:
            drawing = make_checked_drawing(subject)
            scene = scene_of(drawing, subject)
            with self.lock:
                if not self._is_stopped:
                    self._show(subject, drawing, scene)
        except MaplabError as error:
            with self.lock:
                self._panel.say(str(error))
        except Exception:
            logger.exception("the viewer could not follow the map")
            with self.lock:
                self._panel.say(
                    "this state of the map cannot be shown: the log file has the reason"
                )

    def _show(self, subject: Subject, drawing: Drawing, scene: Scene) -> None:
        is_new_map = self.subject is None or self.subject.shown is not subject.shown
        is_new_place = self.scene is None or self.scene.extent.radius_m != scene.extent.radius_m
        is_other_map = self.scene is None or self.scene.title != scene.title
        self.subject, self.scene, self._drawing = subject, scene, drawing
        if is_new_map:
            self.selections.clear()
        self.playback.stop()
        if is_new_place:
            self._nodes.show_ground(ground.make_ground(scene.extent, scene.origin_G))
        if is_other_map:
            self._cameras.show_all(scene.extent)
        else:
            self._cameras.keep_in_view(scene.extent)
        self._panel.show_colouring(subject.options, scene.missions)
        self._time_machine.show(subject)
        self.court.show(subject.shown)
        self._panel.show_reasons(scene, subject.options.refused_closures_reason)
        self.redraw()

    def redraw(self) -> None:
        """Draw what is visible; only differences are sent."""
        if self.scene is None:
            return
        layers, missions = self.visible_layers, self.visible_missions
        self._nodes.show(self._draw(self.scene), layers, missions)
        self._panel.show(self.scene, layers, missions)

    def _draw(self, scene: Scene) -> Scene:
        return scene if self.player is None else without_played(scene)
