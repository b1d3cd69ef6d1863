"""The panel's texts as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from maplab_py.viewer.facts import Facts
from maplab_py.viewer.scene import Layer, LegendEntry, MissionEntry, Scene

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


def mission_legend(missions: Iterable[MissionEntry], limit: int = 24) -> str:
    """Return the missions' colours."""
    entries = [LegendEntry(mission_label(m), (m.colour,)) for m in missions]
    more = f"<div style='opacity:0.6'>and {len(entries) - limit} more</div>"
    return legend(entries[:limit], more if len(entries) > limit else "")


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


def hint(text: str) -> str:
    """Return a quiet line."""
    return f"<div style='{_SMALL}{_PADDED}opacity:0.6'>{escape(text)}</div>"
