"""A view as one HTML file that opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from maplab_py.output_files import write_text
from maplab_py.viewer.display import text
from maplab_py.viewer.display.camera import aim_initially
from maplab_py.viewer.scene import Scene

_OVERLAY = """
<div style="position:fixed;left:14px;bottom:14px;max-width:19em;padding:4px 2px;border-radius:8px;
font-family:system-ui,sans-serif;font-size:15px;z-index:10;pointer-events:none;
background:{ground};color:{ink}">{header}{missions}{legend}</div>
"""


def export_html(server: Any, scene: Scene, layers: set[str], path: Path, *, is_dark: bool) -> int:
    """Write what is visible to a file; return its size in bytes.

    Args:
        server: The viser server that shows the scene.
        scene: What it shows.
        layers: Names of the visible layers, for the legend.
        path: The file.
        is_dark: Theme.

    Raises:
        UserError: The file cannot be written.
    """
    aim_initially(server.initial_camera, scene.extent, beside_panel=False)
    page = server.scene.as_html(dark_mode=is_dark)
    aim_initially(server.initial_camera, scene.extent)
    entries = [entry for layer in scene.layers if layer.name in layers for entry in layer.legend]
    overlay = _OVERLAY.format(
        ground="rgba(24,26,31,0.82)" if is_dark else "rgba(255,255,255,0.82)",
        ink="#d8dbe0" if is_dark else "#2a2d33",
        header=text.header(scene),
        missions=text.mission_legend(scene.missions),
        legend=text.legend(dict.fromkeys(entries)),
    )
    end = page.rindex("</body>")
    page = f"{page[:end]}{overlay}{page[end:]}"
    write_text(path, [page], overwrite=True)
    return len(page.encode())
