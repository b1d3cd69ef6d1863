"""How long big maps take to open in a browser, how smoothly they turn, and what following costs.

python -m benchmarks.viewer
"""

import json
import os
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.console.session.session import open_map
from maplab_py.geometry import se3, so3
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.picking import pick
from maplab_py.vimap import (
    BaseFrames,
    Frames,
    Keypoints,
    LandmarkQuality,
    Landmarks,
    Missions,
    Vertices,
    VIMap,
)
from maplab_py.vimap.ids import random_ids
from tests.support.machine import descendants_cpu_s
from tests.viewer.display.browsing import HEIGHT, WIDTH, Page, chromium, is_blank
from tests.viewer.display.page_messages import Message, decoded, is_replayed, open_page

PAIRS = 5
VISITS = 5

_WATCH = """
(() => {
  const look = () => {
    const points = window.__viserTestpoints?.rendererInfo.render.points ?? 0;
    if (points <= %d) return requestAnimationFrame(look);
    const drawn = performance.now();
    requestAnimationFrame(() => requestAnimationFrame(() => {
      window.firstPicture = [drawn, performance.now()];
    }));
  };
  requestAnimationFrame(look);
})();
"""
"""Notes when a frame with more points than this was drawn, and when two more frames have begun: the
browser then has shown it."""


def big_map(vertices: int, landmarks: int, observations: int, missions: int = 4) -> VIMap:
    """Return missions that walk round a block, each landmark seen from near where it is stored."""
    rng = np.random.default_rng(0)
    mission = np.sort(np.arange(vertices) % missions)
    angle = 4.0 * np.pi * np.arange(vertices) * missions / vertices
    p = np.stack([60.0 * np.cos(angle), 40.0 * np.sin(angle), 2.0 * mission], axis=1)
    q = so3.exp(np.stack([0.0 * angle, 0.0 * angle, angle], axis=1))
    store = np.sort(rng.integers(0, vertices, landmarks))
    offset = rng.normal(scale=[4.0, 4.0, 1.5], size=(landmarks, 3))
    landmark = np.sort(rng.integers(0, landmarks, observations))
    seen_from = np.clip(store[landmark] + rng.integers(-5, 6, observations), 0, vertices - 1)
    order = np.argsort(seen_from, kind="stable")
    times = 10**9 + 200_000_000 * np.arange(vertices)
    return VIMap(
        missions=Missions.filled(
            missions, id=random_ids(missions, rng), baseframe=np.arange(missions),
            root_vertex=np.searchsorted(mission, np.arange(missions)),
        ),
        baseframes=BaseFrames.filled(missions, id=random_ids(missions, rng)),
        vertices=Vertices.filled(
            vertices, id=random_ids(vertices, rng), mission=mission, T_M_I=se3.make(q, p),
            timestamp_ns=times,
        ),
        frames=Frames.filled(
            vertices, id=random_ids(vertices, rng), vertex=np.arange(vertices), timestamp_ns=times,
            keypoint_count=np.bincount(seen_from, minlength=vertices),
        ),
        keypoints=Keypoints.filled(observations, landmark=landmark[order]),
        landmarks=Landmarks.filled(
            landmarks, id=random_ids(landmarks, rng), vertex=store, p_I=offset,
            quality=np.full(landmarks, LandmarkQuality.GOOD),
        ),
    )  # fmt: skip


def opening(subject: Subject, layer: str) -> dict[str, float]:
    """Return the seconds from the command to a page that shows a layer, and of its parts."""
    with chromium() as browser:
        began, cpu = time.perf_counter(), descendants_cpu_s()
        viewer = Viewer(0)
        scene = viewer.show(subject)
        served = time.perf_counter()
        page = Page(browser, viewer.url)
        shown = page.wait_until(lambda: not is_blank(page.picture()), 60.0)
        done, page_cpu = time.perf_counter(), descendants_cpu_s() - cpu
        sent = sent_bytes(viewer)
        viewer.stop()
    drawn = scene.layer(layer).drawn
    return {
        "drawn": drawn, "shown": float(shown), "served_s": served - began, "page_s": done - served,
        "total_s": done - began, "page_cpu_s": page_cpu, "sent_megabytes": 1e-6 * sent,
        "load": os.getloadavg()[0],
    }  # fmt: skip


def first_pictures(subject: Subject) -> dict[str, float]:
    """Return the seconds from the address to the picture of a map in a browser that runs already.

    The browser has another page open. The picture is there when a frame with half of the landmarks
    has been drawn and shown. The first visit is the first page that uses WebGL.
    """
    viewer = Viewer(0)
    scene = viewer.show(subject)
    shown = []
    with chromium() as browser:
        context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT})
        context.new_page().goto("data:text/html,<p>another page</p>")
        for _ in range(VISITS):
            page = context.new_page()
            page.add_init_script(_WATCH % (scene.layer("landmarks").drawn // 2))
            page.goto(viewer.url, wait_until="commit")
            page.wait_for_function("window.firstPicture", timeout=60_000)
            shown.append(page.evaluate("window.firstPicture"))
            page.close()
    viewer.stop()
    drawn_s, shown_s = 1e-3 * np.array(shown).T
    return {
        "first_visit_drawn_s": drawn_s[0], "first_visit_s": shown_s[0],
        "later_visits_drawn_s": float(np.median(drawn_s[1:])),
        "later_visits_s": float(np.median(shown_s[1:])), "load": os.getloadavg()[0],
    }  # fmt: skip


def sent_bytes(viewer: Viewer) -> int:
    """Return how many bytes a page that is opened now is sent, the page itself included."""
    packed = {"Accept-Encoding": "gzip"}
    with urllib.request.urlopen(urllib.request.Request(viewer.url, headers=packed)) as answer:
        total = len(answer.read())
    with open_page(viewer) as page:
        messages: list[Message] = []
        while not any(is_replayed(message) for message in messages):
            data = page.recv(timeout=60.0)
            total += len(data)
            messages = decoded(bytes(data))
    return total


def many_landmarks(landmarks: int) -> Subject:
    """Return a map all of whose landmarks are drawn."""
    options = VisualizationOptions(max_points=landmarks)
    return Subject(big_map(2_000, landmarks, 3 * landmarks), "turned", options)


def large_mesh(rows: int) -> Subject:
    """Return a small map with a hilly mesh of twice the square of `rows` triangles."""
    x, y = np.meshgrid(*2 * [np.linspace(-60.0, 60.0, rows + 1)], indexing="ij")
    z = 5.0 * np.sin(0.2 * x) * np.cos(0.15 * y)
    p = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    a = (np.arange(rows)[:, None] * (rows + 1) + np.arange(rows)).reshape(-1)
    faces = np.concatenate(
        [np.stack([a, a + rows + 1, a + 1], 1), np.stack([a + 1, a + rows + 1, a + rows + 2], 1)]
    )
    colour = np.clip(127.0 + 20.0 * p[:, [2, 2, 2]], 0, 255).astype(np.uint8)
    mesh = Cloud("mesh", p, colour, faces=faces.astype(np.int32))
    return Subject(big_map(300, 5_000, 20_000), "mesh", clouds=(mesh,))


def frame_rate(subject: Subject, seconds: float = 10.0) -> dict[str, float]:
    """Return the frames a second while the view is turned with the mouse, and their cost."""
    counter = "() => window.__viserTestpoints.rendererInfo.render.frame"
    with chromium() as browser:
        viewer = Viewer(0)
        viewer.show(subject)
        page = Page(browser, viewer.url, frame_ms=0)
        page.wait_until(lambda: not is_blank(page.picture()), 120.0)
        page.settle(3000)
        page.page.mouse.move(300.0, 400.0)
        page.page.mouse.down()
        before, began = page.page.evaluate(counter), time.perf_counter()
        cpu = descendants_cpu_s()
        step = 0
        while time.perf_counter() - began < seconds:
            step += 1
            page.page.mouse.move(300.0 + 4.0 * (step % 60), 400.0)
        frames = page.page.evaluate(counter) - before
        took, cpu = time.perf_counter() - began, descendants_cpu_s() - cpu
        viewer.stop()
    return {
        "frames_per_s": frames / took, "cpu_ms_per_frame": 1e3 * cpu / frames,
        "load": os.getloadavg()[0],
    }  # fmt: skip


def picking(subject: Subject) -> float:
    """Return the seconds that one click takes to be understood."""
    scene = build_scene(subject)
    eye = scene.extent.centre + np.array([30.0, -80.0, 60.0])
    ray = subject.vi_map.T_G_I[100, 4:] - eye
    return float(np.median([_seconds(lambda: pick(scene, eye, ray))[0] for _ in range(5)]))


def following(folder: Path) -> dict[str, float]:
    """Return what an open page costs the optimiser: medians of runs in turn, and their ratio."""
    with open_map(folder) as session, chromium() as browser:
        vi_map = session.vi_map
        viewer = Viewer(0)
        viewer.show(Subject(vi_map, "map"))
        page = Page(browser, viewer.url)
        page.wait_until(lambda: viewer.pages == 1)
        page.settle(2000)
        options = VIOptimizationOptions(num_iterations=15, hide_iterations_console_output=True)
        optimize(vi_map, options)
        updates = 0

        def watch(make_map: Callable[[], VIMap]) -> None:
            nonlocal updates
            updates += viewer.follow_live(make_map)

        alone, followed = [], []
        for _ in range(PAIRS):
            alone.append(_seconds(lambda: optimize(vi_map, options)))
            followed.append(_seconds(lambda: optimize(vi_map, options, watch=watch)))
        viewer.stop()
    wall, cpu = (np.array(followed) / np.array(alone)).T
    return {
        "alone_s": float(np.median(np.array(alone)[:, 0])),
        "followed_s": float(np.median(np.array(followed)[:, 0])),
        "ratio_of_time": float(np.median(wall)), "ratio_of_cpu": float(np.median(cpu)),
        "updates_per_run": updates / PAIRS,
    }  # fmt: skip


def _seconds(action: Callable[[], object]) -> tuple[float, float]:
    """Return the time and the processor time of this process."""
    began, cpu = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - began, time.process_time() - cpu


def main() -> None:
    """Measure and print, one JSON object a line."""
    keyframes = Subject(big_map(3_000, 150_000, 1_200_000), "3000 keyframes")
    large = Subject(big_map(20_000, 1_000_000, 3_000_000), "a million landmarks")
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(2_000_000, 3))
    sphere *= 30.0 / np.linalg.norm(sphere, axis=1)[:, None]
    dense = Cloud("dense", sphere)
    small = big_map(300, 5_000, 20_000)
    few = Subject(big_map(100, 100, 500), "nearly empty")
    print(json.dumps({"first picture of a nearly empty map": first_pictures(few)}))
    print(json.dumps({"a nearly empty map, for comparison": opening(few, "landmarks")}))
    print(json.dumps({"3000 keyframes, 150k landmarks": opening(keyframes, "landmarks")}))
    print(json.dumps({"20000 keyframes, 1M landmarks": opening(large, "landmarks")}))
    for limit in (300_000, VisualizationOptions().max_points, 2_000_000):
        options = VisualizationOptions(max_points=limit)
        subject = Subject(small, "dense", options, clouds=(dense,))
        print(json.dumps({f"2M points, {limit} drawn": opening(subject, "cloud_0")}))
    for landmarks in (200_000, 1_000_000):
        title = f"turning {landmarks} landmarks, in software"
        print(json.dumps({title: frame_rate(many_landmarks(landmarks))}))
    print(json.dumps({"turning a million triangles, in software": frame_rate(large_mesh(707))}))
    print(json.dumps({"picking among 150k landmarks [s]": picking(keyframes)}))
    for folder in sys.argv[1:]:
        with open_map(Path(folder)) as session:
            recorded = Subject(session.vi_map, Path(folder).name)
        print(json.dumps({f"first picture of {recorded.title}": first_pictures(recorded)}))
        print(
            json.dumps({"the same with the start of the browser": opening(recorded, "landmarks")})
        )
        print(json.dumps({f"optvi on {Path(folder).name}": following(Path(folder))}))


if __name__ == "__main__":
    main()
