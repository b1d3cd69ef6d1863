"""A view as one HTML file that opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from maplab_py.output_files import write_text
from maplab_py.viewer.display import text
from maplab_py.viewer.display.camera import aim_initially
from maplab_py.viewer.display.server import page_script
from maplab_py.viewer.scene import Scene

_OVERLAY = """
<div style="position:fixed;left:14px;bottom:14px;max-width:19em;padding:4px 2px;border-radius:8px;
font-family:system-ui,sans-serif;font-size:15px;z-index:10;pointer-events:none;
background:{ground};color:{ink};max-height:calc(100vh - 40px);overflow:auto">{header}{missions}
{switches}{legend}</div>
"""

_SCRIPT = """
<script>
document.querySelectorAll("input[data-layer]").forEach(box => box.addEventListener("change", () => {
  const nodes = window.__viserSceneTree.getState();
  const paths = ["/map/" + box.dataset.layer + "/", "/labels/map/" + box.dataset.layer + "/"];
  for (const name in nodes)
    if (nodes[name] && paths.some(path => name.startsWith(path)))
      nodes[name].overrideVisibility = nodes[name].effectiveVisibility = box.checked;
  window.dispatchEvent(new Event("resize"));
}));
</script>
"""
"""Switches layers by the scene tree that viser's page offers to its tests."""


def export_html(server: Any, scene: Scene, layers: set[str], path: Path, *, is_dark: bool) -> int:
    """Write what the server shows to a file, with a switch per layer; return its size in bytes.

    Args:
        server: The viser server that shows the scene.
        scene: What it shows.
        layers: Names of the layers that are visible at first; the others have nodes that are hidden.
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
        switches=text.layer_switches(scene.layers, layers),
        legend=text.legend(dict.fromkeys(entries)),
    )
    end = page.rindex("</body>")
    page = f"{page[:end]}{overlay}{_SCRIPT}{page_script()}{page[end:]}"
    write_text(path, [page], overwrite=True)
    return len(page.encode())
