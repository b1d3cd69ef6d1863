"""What one frame of the viewer costs where Chromium draws in software, cause by cause.

python -m benchmarks.viewer_frames [LANDMARKS]

Frames are drawn one after the other, each waited for, on one page of 1000 x 700 pixels; the figures
are processor time of the browser, which depends little on what else the machine does.
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.viewer import big_map
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.options import VisualizationOptions
from tests.support.machine import descendants_cpu_s
from tests.viewer.display.browsing import Page, chromium, is_blank

FRAMES = 6

_DRAW = """(frames) => {
  let store = null;
  window.__viserMutable.scene.traverse((o) => { store = store || (o.__r3f && o.__r3f.root); });
  const { gl, scene, camera } = store.getState();
  const context = gl.getContext(), pixel = new Uint8Array(4), took = [];
  for (let i = 0; i < frames; i++) {
    const began = performance.now();
    gl.render(scene, camera);
    context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, pixel);
    took.push(performance.now() - began);
  }
  return took;
}"""

_CHANGE = """([hidden, pointPart, pointScale, shape, ratio]) => {
  let store = null;
  const ground = window.__viserMutable.nodeRefFromName["/ground"], inGround = new Set();
  if (ground) ground.traverse((o) => inGround.add(o));
  window.__viserMutable.scene.traverse((o) => {
    store = store || (o.__r3f && o.__r3f.root);
    const kind = o.isPoints ? "points" : o.isLineSegments2 ? "lines" : inGround.has(o) ? "grid" : "other";
    if (!o.isPoints && !o.isMesh && !o.isLine) return;
    if (hidden.includes(kind)) o.layers.disable(0); else o.layers.enable(0);
    if (!o.isPoints) return;
    o.geometry.setDrawRange(0, Math.ceil(pointPart * o.geometry.attributes.position.count));
    const { scale, point_ball_norm: ball } = o.material.uniforms;
    if (o.__scale === undefined) [o.__scale, o.__ball] = [scale.value, ball.value];
    scale.value = o.__scale * pointScale * ratio;
    ball.value = shape === "square" ? 1e9 : o.__ball;
  });
  store.getState().gl.setPixelRatio(ratio);
}"""

_NO_ANTIALIASING = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (type, options) {
  return get.call(this, type, type.startsWith("webgl") ? { ...options, antialias: false } : options);
};
"""


def causes(landmarks: int) -> dict[str, tuple[list[str], float, float, str, float]]:
    """Return what to draw: hidden kinds, part of the points, their scale, shape, and pixel ratio."""
    few = min(1.0, 10_000 / landmarks)
    return {
        "everything": ([], 1.0, 1.0, "circle", 1.0),
        "without points": (["points"], 1.0, 1.0, "circle", 1.0),
        "without lines": (["lines"], 1.0, 1.0, "circle", 1.0),
        "without the grid": (["grid"], 1.0, 1.0, "circle", 1.0),
        "points half as large": ([], 1.0, 0.5, "circle", 1.0),
        "points of one pixel": ([], 1.0, 0.01, "circle", 1.0),
        "square points": ([], 1.0, 1.0, "square", 1.0),
        "a fifth of the points": ([], 0.2, 1.0, "circle", 1.0),
        "half the pixel ratio": ([], 1.0, 1.0, "circle", 0.5),
        "while the camera moves": (["grid"], 0.2, 1.0, "circle", 0.5),
        "while it moves, 10,000 points": (["grid"], few, 1.0, "circle", 0.5),
        "the same without lines": (["grid", "lines"], few, 1.0, "circle", 0.5),
        "the same without points": (["grid", "points"], few, 1.0, "circle", 0.5),
        "everything again": ([], 1.0, 1.0, "circle", 1.0),
    }


@contextmanager
def open_page(landmarks: int, *, is_antialiased: bool) -> Iterator[Page]:
    """Open a page on a map whose landmarks are all drawn, and wait until it is shown."""
    options = VisualizationOptions(max_points=landmarks)
    subject = Subject(big_map(2_000, landmarks, 3 * landmarks), "frames", options)
    with chromium() as browser:
        viewer = Viewer(0)
        viewer.show(subject)
        script = "" if is_antialiased else _NO_ANTIALIASING
        page = Page(browser, viewer.url, frame_ms=300, script=script)
        page.wait_until(lambda: not is_blank(page.picture()), 120.0)
        page.settle(3000)
        yield page
        viewer.stop()


def frame_costs(landmarks: int, *, is_antialiased: bool = True) -> Iterator[dict[str, Any]]:
    """Yield the processor time [ms] of a frame, and the shortest time that one took, per cause."""
    with open_page(landmarks, is_antialiased=is_antialiased) as page:
        whole = np.nan
        for name, change in causes(landmarks).items():
            page.page.evaluate(_CHANGE, change)
            page.page.evaluate(_DRAW, 2)
            before = descendants_cpu_s()
            took_ms = page.page.evaluate(_DRAW, FRAMES)
            cpu_ms = 1e3 * (descendants_cpu_s() - before) / FRAMES
            whole = cpu_ms if name == "everything" else whole
            yield {
                "landmarks": landmarks, "antialiased": is_antialiased, "drawn": name,
                "cpu_ms": round(cpu_ms), "ratio": round(cpu_ms / whole, 2),
                "shortest_ms": round(min(took_ms)), "load": round(os.getloadavg()[0], 1),
            }  # fmt: skip


def main() -> None:
    """Measure and print, one JSON object a line."""
    landmarks = int(sys.argv[1]) if len(sys.argv) > 1 else 200_000
    for is_antialiased in (True, False):
        for line in frame_costs(landmarks, is_antialiased=is_antialiased):
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
