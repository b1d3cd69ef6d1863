"""The panel beside the scene: checkboxes, legend, facts, slider.

The undo history of the map is a slider in it, with the errors of the map's states; above the layers may be a
motion that is asked of the person who carries the device: an arrow, and a bar that fills.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

from maplab_py.viewer import building, history
from maplab_py.viewer.colours import HIDDEN, from_hex
from maplab_py.viewer.display import camera, parts
from maplab_py.viewer.facts import Facts
from maplab_py.viewer.layers.closures import REFUSED
from maplab_py.viewer.options import COLOURINGS, VisualizationOptions
from maplab_py.viewer.scene import Layer, LegendEntry, MissionEntry, Scene

if TYPE_CHECKING:
    from maplab_py.online_calibration.suggestions import Motion
    from maplab_py.viewer.display.viewer import Viewer

MAX_SWITCHES = 24
"""Beyond this many missions the panel offers a list instead of a switch each."""

MAX_LAYERS = 9
"""Of more layers, those that are hidden at first are in a folder that is closed at first."""

_ALL = "all missions"
_ANY = "any reason"
_DEVICE = (
    '<rect x="-26" y="-17" width="52" height="34" rx="5" fill="none" stroke="currentColor" '
    'stroke-width="2.5"/><circle r="9" fill="none" stroke="currentColor" stroke-width="2.5"/>'
)
"""The camera as it is seen by the person who holds it; it looks away from them."""
_TURNS = (
    "M44 -30 C62 -14 62 14 44 30",  # up and down, about x
    "M-34 30 C-16 46 16 46 34 30",  # left and right, about y
    "M-42 8 A43 43 0 1 1 42 8",  # like a steering wheel, about z
)
_MOVES = (
    ("M-34 0 H-72", "M34 0 H72"),
    ("M0 -25 V-54", "M0 25 V54"),
    ("M-30 21 L-62 46", "M30 -21 L62 -46"),
)
"""Paths along x (right), y (down) and z (away) of the camera."""
_WALL = (
    '<rect x="-94" y="-64" width="188" height="128" fill="none" stroke="currentColor" '
    'stroke-width="3" stroke-dasharray="7 6"/>'
)
_NEAR_M = 1.0
"""Motions as close as this to a wall show it."""


class Panel:
    """The widgets and what they show."""

    def __init__(self, viewer: Viewer) -> None:
        """Make the widgets that every scene has."""
        self._gui = viewer.server.gui
        self._viewer = viewer
        self._checkboxes: dict[str, Any] = {}
        self._mission_of_label: dict[str, str] = {}
        self._mission_widgets: list[Any] = []
        self._signature: tuple[Any, ...] = ()
        self.header = self._gui.add_html("", order=0)
        self._layers = self._gui.add_folder("Layers", order=1)
        with self._layers:
            self._more_layers = self._gui.add_folder(
                "more layers", order=1e9, expand_by_default=False, visible=False
            )
        self._missions = self._gui.add_folder("Missions", order=2)
        with self._gui.add_folder("Colours", order=3):
            self.colouring: Any = self._gui.add_dropdown("landmarks by", COLOURINGS)
            self.coloured_mission: Any = self._gui.add_dropdown("of", (_ALL,), visible=False)
            self.refused: Any = self._gui.add_dropdown(
                "refused for", (_ANY,), visible=False, hint="show refused closures of this reason"
            )
            self.legend = self._gui.add_html("")
        self._bind(self.colouring, lambda _: self._choose_colouring())
        self._bind(self.coloured_mission, lambda _: self._choose_colouring())
        self._bind(self.refused, lambda event: self._choose_reason(event.target.value))
        self.selection = self._gui.add_folder("Selection", order=4)
        self._add_view()

    def _bind(self, widget: Any, action: Callable[[Any], None]) -> None:
        widget.on_update(self._viewer.by_user(action))

    def _choose_colouring(self) -> None:
        mission_id = self._mission_of_label.get(self.coloured_mission.value, "")
        self._viewer.set_colouring(self.colouring.value, mission_id)

    def _choose_reason(self, reason: str) -> None:
        self._viewer.set_refused_reason("" if reason == _ANY else reason)

    def show_reasons(self, scene: Scene, chosen: str) -> None:
        """Offer the reasons of the scene's refused closures, chosen = a part of one's text."""
        reasons = next((layer.choices for layer in scene.layers if layer.name == REFUSED), ())
        options = (_ANY, *reasons)
        value = next((reason for reason in reasons if chosen and chosen.lower() in reason), _ANY)
        parts.update(self.refused, options=options, value=value, visible=len(reasons) > 1)

    def show_colouring(
        self, options: VisualizationOptions, missions: tuple[MissionEntry, ...]
    ) -> None:
        """Show by which rule landmarks are coloured, and which mission the rule is for."""
        colouring, only = options.landmark_colouring, options.color_only_missions.strip().lower()
        parts.update(self.colouring, value=colouring)
        self._mission_of_label = {mission_label(m): m.id for m in missions}
        labels = (_ALL, *self._mission_of_label)
        keys = self._mission_of_label.items()
        chosen = next((label for label, key in keys if only and key.startswith(only)), _ALL)
        is_needed = len(missions) > 1
        parts.update(self.coloured_mission, options=labels, value=chosen, visible=is_needed)

    def _add_view(self) -> None:
        self.view = self._gui.add_folder("View", order=5, expand_by_default=False)
        with self.view:
            self.views = self._gui.add_button_group("look", camera.VIEWS)
            self.ground = self._gui.add_checkbox("ground grid", True)
            self.point_scale = self._gui.add_slider("point size", 0.2, 5.0, 0.1, 1.0)
        self.views.on_click(
            self._viewer.by_user(lambda event: self._viewer.look(event.client, event.target.value))
        )
        self._bind(self.ground, lambda event: self._viewer.set_ground(event.target.value))
        self._bind(self.point_scale, lambda event: self._viewer.set_point_scale(event.target.value))

    def show(self, scene: Scene, layers: set[str], missions: set[str]) -> None:
        """Say what the scene has: its counts, legend, layers and missions."""
        self._say_what_is_shown(scene)
        entries = [
            entry for layer in scene.layers if layer.name in layers for entry in layer.legend
        ]
        self.legend.content = legend(dict.fromkeys(entries))
        signature = (scene.names, scene.missions)
        if signature != self._signature:
            self._signature = signature
            self._make_layers(scene, layers)
            self._make_missions(scene, missions)
        for layer in scene.layers:
            box = self._checkboxes[layer.name]
            parts.update(box, label=layer_label(layer), value=layer.name in layers)

    def _say_what_is_shown(self, scene: Scene) -> None:
        """Fill the header; a map's only mission is named there and needs no folder."""
        is_single = len(scene.missions) == 1
        legend = mission_legend(scene.missions) if is_single else ""
        self.header.content = header(scene) + legend
        parts.update(self._missions, visible=not is_single)

    def say(self, message: str) -> None:
        """Show a message in the place of the header."""
        self.header.content = hint(message)

    def _make_layers(self, scene: Scene, layers: set[str]) -> None:
        for box in self._checkboxes.values():
            box.remove()
        self._checkboxes = {}
        has_many = len(scene.layers) > MAX_LAYERS
        for layer in scene.layers:
            is_extra = has_many and not layer.is_visible
            with self._more_layers if is_extra else self._layers:
                box = self._gui.add_checkbox(
                    layer_label(layer), layer.name in layers, hint=layer_hint(layer)
                )
            self._bind(box, self._layer_action(layer.name))
            self._checkboxes[layer.name] = box
        has_extra = has_many and not all(layer.is_visible for layer in scene.layers)
        parts.update(self._more_layers, visible=has_extra)

    def _layer_action(self, name: str) -> Callable[[Any], None]:
        return lambda event: self._viewer.set_layer(name, event.target.value)

    def _make_missions(self, scene: Scene, missions: set[str]) -> None:
        for widget in self._mission_widgets:
            widget.remove()
        self._mission_widgets = []
        with self._missions:
            if 1 < len(scene.missions) <= MAX_SWITCHES:
                self._add_mission_switches(scene, missions)
                return
            if len(scene.missions) > MAX_SWITCHES:
                legend = mission_legend(scene.missions)
                self._mission_widgets.append(self._gui.add_html(legend))
                names = (_ALL, *(mission_label(m) for m in scene.missions))
                self._add_mission_list(scene, names)

    def _add_mission_list(self, scene: Scene, names: tuple[str, ...]) -> None:
        chooser = self._gui.add_dropdown("show", names)
        ids = {name: {m.id} for name, m in zip(names[1:], scene.missions, strict=True)}
        everything = {mission.id for mission in scene.missions}
        self._bind(
            chooser,
            lambda event: self._viewer.set_missions(ids.get(event.target.value, everything)),
        )
        self._mission_widgets.append(chooser)

    def _add_mission_switches(self, scene: Scene, missions: set[str]) -> None:
        """Add a button per mission in its colour; grey = hidden."""
        shown = {mission.id: mission.id in missions for mission in scene.missions}

        def toggle(mission: MissionEntry, button: Any) -> None:
            shown[mission.id] = not shown[mission.id]
            button.color = _switch_colour(mission, is_shown=shown[mission.id])
            self._viewer.set_missions({key for key, is_shown in shown.items() if is_shown})

        for mission in scene.missions:
            button: Any = self._gui.add_button(
                mission_label(mission),
                color=_switch_colour(mission, is_shown=shown[mission.id]),
                hint=f"show or hide mission {mission.id}",
            )
            press = partial(lambda m, b, _: toggle(m, b), mission, button)
            button.on_click(self._viewer.by_user(press))
            self._mission_widgets.append(button)


class TimeMachine:
    """The slider of the history; it is there when the map has more than one state."""

    def __init__(self, viewer: Viewer) -> None:
        self._lock, gui = viewer.lock, viewer.server.gui
        self._folder = gui.add_folder("History", order=1.5, visible=False)
        with self._folder:
            self.slider: Any = gui.add_slider(
                "state", 0, 1, 1, 1, hint="the map before and after each command"
            )
            self.swipe: Any = gui.add_checkbox(
                "swipe line", False, hint="the state left of a line, the map right of it"
            )
            self.chart = gui.add_html("")
        show = viewer.by_user(lambda _: viewer.set_state(int(self.slider.value)))
        self.swipe.on_update(show)
        self.slider.on_update(show)
        self._is_stopped = False
        self._subject: building.Subject | None = None
        self._curves: tuple[history.Curve, ...] = ()
        self._measured: building.Subject | None = None  # that the curves belong to

    @property
    def swipes(self) -> bool:
        """Tell whether states are shown left of a swipe line."""
        return bool(self.swipe.value)

    def show(self, subject: building.Subject) -> None:
        """Show the history of a subject, with the curves that are known of it."""
        self._subject = subject
        states = subject.history
        parts.update(self._folder, visible=len(states) > 1)
        if len(states) < 2:
            return
        is_swiped = subject.other is not None and subject.arrangement == "swipe"
        parts.update(self.swipe, value=is_swiped)
        parts.update(self.slider, max=len(states) - 1)
        place = subject.place
        if place < 0:  # another map is left of the swipe line
            place = max(subject.replace(other=None).place, 0)
        parts.update(self.slider, value=place)
        is_known = self._measured is not None and self._measured.history is states
        self.chart.content = history.history_chart(states, self._curves if is_known else (), place)

    def stop(self) -> None:
        """Change nothing any more: the server is about to stop."""
        self._is_stopped = True

    def measure(self) -> None:
        """Compute the curves of what is shown, unless they are known: this takes a moment in large maps."""
        subject = self._subject
        if subject is None or len(subject.history) < 2:
            return
        if self._measured is not None and self._measured.history is subject.history:
            return
        curves = history.error_curves(subject.history, subject.truth)
        with self._lock:
            if self._is_stopped:
                return
            self._curves, self._measured = curves, subject
            if self._subject is not None:
                self.show(self._subject)


class MotionRequest:
    """Place above the layers that asks for the motion which a calibration lacks."""

    def __init__(self, viewer: Viewer) -> None:
        self._lock = viewer.lock
        self._html = viewer.server.gui.add_html("", order=0.5, visible=False)

    def show(self, words: str, known_share: float) -> None:
        """Show a motion, or that none is missing, in all pages; see `_motion_card`."""
        with self._lock:
            self._html.content = _motion_card(words, known_share)
            self._html.visible = True


def _switch_colour(mission: MissionEntry, *, is_shown: bool) -> tuple[int, int, int]:
    """Return the colour of a mission's button."""
    red, green, blue = (from_hex(mission.colour)[0] if is_shown else HIDDEN).tolist()
    return red, green, blue


_SMALL = "font-size:0.78em;line-height:1.45;"
_NAMES = "38%"
"""Width of the names in a table of facts."""
_PADDED = "padding:0.15em 0.9em 0.45em 0.9em;"


def header(scene: Scene) -> str:
    """Say what is shown."""
    counts = [f"{len(scene.missions)} mission{'s' if len(scene.missions) != 1 else ''}"]
    for name, word in (("vertices", "vertices"), ("landmarks", "landmarks")):
        if name in scene.names:
            counts.append(f"{scene.layer(name).total:,} {word}")
    notes = "".join(f"<div style='opacity:0.6'>{escape(note)}</div>" for note in scene.notes)
    return (
        f"<div style='{_SMALL}{_PADDED}padding-top:0.6em'>"
        f"<div style='font-weight:600;font-size:1.15em'>{escape(scene.title)}</div>"
        f"<div style='opacity:0.75'>{' &middot; '.join(counts)}</div>{notes}</div>"
    )


def layer_label(layer: Layer) -> str:
    """Return the words beside a layer's checkbox."""
    return f"{layer.title} {short_count(layer.total)}"


def layer_switches(layers: Iterable[Layer], visible: set[str]) -> str:
    """Return a checkbox for each layer of an exported page."""
    lines = "".join(
        f"<label style='display:block;pointer-events:auto;cursor:pointer'>"
        f"<input type='checkbox' data-layer='{escape(layer.name)}'"
        f"{' checked' if layer.name in visible else ''}> {escape(layer_label(layer))}</label>"
        for layer in layers
    )
    return f"<div style='{_SMALL}{_PADDED}'>{lines}</div>" if lines else ""


def short_count(count: int) -> str:
    """Return a count in at most five characters."""
    if count < 10_000:
        return str(count)
    if count < 1_000_000:
        return f"{count / 1e3:.1f}k" if count < 100_000 else f"{count / 1e3:.0f}k"
    return f"{count / 1e6:.1f}M"


def layer_hint(layer: Layer) -> str:
    """Return what is shown while the pointer rests on a layer's checkbox."""
    return ". ".join((f"{layer.title}: {layer.total:,} in the map", *layer.notes))


def mission_label(mission: MissionEntry) -> str:
    """Return the words beside a mission's checkbox."""
    minutes, seconds = divmod(round(mission.duration_s), 60)
    return f"{mission.name}  {mission.length_m:.0f} m  {minutes}:{seconds:02d}"


def mission_legend(missions: Iterable[MissionEntry]) -> str:
    """Return the missions' colours."""
    entries = [LegendEntry(mission_label(m), (m.colour,)) for m in missions]
    more = f"<div style='opacity:0.6'>and {len(entries) - MAX_SWITCHES} more</div>"
    return legend(entries[:MAX_SWITCHES], more if len(entries) > MAX_SWITCHES else "")


def legend(entries: Iterable[LegendEntry], more: str = "") -> str:
    """Return swatches and ramps; an empty text when there are none."""
    lines = "".join(_legend_line(entry) for entry in entries)
    return f"<div style='{_SMALL}{_PADDED}'>{lines}{more}</div>" if lines else ""


def _legend_line(entry: LegendEntry) -> str:
    if len(entry.colours) == 1:
        swatch = (
            "display:inline-block;width:0.75em;height:0.75em;border-radius:50%;"
            f"margin-right:0.55em;background:{entry.colours[0]}"
        )
        return (
            f"<div style='white-space:pre'><span style='{swatch}'></span>{escape(entry.text)}</div>"
        )
    ramp = f"linear-gradient(90deg,{','.join(entry.colours)})"
    return (
        f"<div style='margin-top:0.3em'>{escape(entry.text)}</div>"
        f"<div style='height:0.5em;border-radius:0.25em;background:{ramp}'></div>"
        "<div style='display:flex;justify-content:space-between;opacity:0.7'>"
        f"<span>{escape(entry.low)}</span><span>{escape(entry.high)}</span></div>"
    )


def fact_table(facts: Facts) -> str:
    """Return names and values as a table."""
    rows = "".join(
        f"<tr><td style='opacity:0.65;padding:0 0.8em 0 0;vertical-align:top;width:{_NAMES}'>"
        f"{escape(name)}</td><td style='overflow-wrap:anywhere'>{escape(value)}</td></tr>"
        for name, value in facts
    )
    return f"<div style='{_SMALL}{_PADDED}'><table style='border:0;width:100%'>{rows}</table></div>"


def small(html: str) -> str:
    """Return HTML in the panel's small type."""
    return f"<div style='{_SMALL}{_PADDED}'>{html}</div>"


def hint(text: str) -> str:
    """Return a quiet line."""
    return f"<div style='{_SMALL}{_PADDED}opacity:0.6'>{escape(text)}</div>"


def _motion_card(words: str, known_share: float) -> str:
    """Return HTML: arrows of a motion about or along the axes of the camera, and how much is known.

    Args:
        words: Of a motion of `suggestions.MOTIONS`; empty = nothing more is missing.
        known_share: Part of the calibration's way to the wanted deviations.
    """
    from maplab_py.online_calibration.suggestions import MOTIONS

    percent = int(100.0 * min(max(known_share, 0.0), 1.0))
    bar = (
        f"<div role='progressbar' aria-label='calibration known' aria-valuenow='{percent}' "
        "style='height:0.6em;border-radius:0.3em;background:#8886;margin:0.3em 0'><div style='height:100%;"
        f"width:{percent}%;border-radius:0.3em;background:#1f8a4c'></div></div>"
    )
    if not words:
        return small(f"<b>Calibration known as well as wanted</b>{bar}")
    arrows = "".join(_arrows(motion) for motion in MOTIONS if motion.words == words)
    asked = escape(words[0].upper() + words[1:])
    return small(f"<b>{asked}</b>{arrows}{bar}calibration known: {percent} % of what is wanted")


def _arrows(motion: Motion) -> str:
    paths = [path for path, angle in zip(_TURNS, motion.turn_deg, strict=True) if angle]
    paths += [p for pair, each in zip(_MOVES, motion.move_m, strict=True) if each for p in pair]
    tip, both = "marker-end='url(#maplab-tip)'", "marker-start='url(#maplab-tip)'"
    lines = "".join(f"<path d='{p}' {tip} {both if p in _TURNS else ''}/>" for p in paths)
    return (
        f"<svg viewBox='-100 -68 200 136' role='img' aria-label='{escape(motion.words)}' "
        "style='display:block;width:100%;max-height:8em'><defs><marker id='maplab-tip' viewBox='0 0 8 8' "
        "refX='5' refY='4' markerWidth='4' markerHeight='4' orient='auto-start-reverse'>"
        "<path d='M0 0 L8 4 L0 8 z' fill='#d9480f'/></marker></defs>"
        f"{_WALL if motion.wall_m <= _NEAR_M else ''}{_DEVICE}"
        f"<g fill='none' stroke='#d9480f' stroke-width='4' stroke-linecap='round'>{lines}</g></svg>"
    )
