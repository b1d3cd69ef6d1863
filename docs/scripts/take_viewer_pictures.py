"""Take the pictures of docs/viewer.md with a real browser: of the demo, and of a recorded map.

python docs/scripts/take_viewer_pictures.py /path/to/tango_handheld [/path/to/keep/demo]
"""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from maplab_plugins.visualization.following import Following
from playwright.sync_api import sync_playwright

from maplab_py.console.session.session import Session
from maplab_py.viewer.display.picture import HEADLESS_FLAGS, find_browser
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.picking import Pick
from maplab_py.viewer.scene import Entity
from maplab_py.vimap.queries import observation_counts

TARGET = Path(__file__).resolve().parents[1] / "images"
SIZE = {"width": 1360, "height": 850}
NO_NOTICES = ".mantine-Notifications-root { display: none !important; }"


@contextmanager
def _page(viewer: Viewer) -> Iterator[Any]:
    """Open a page on the viewer."""
    flags = [flag for flag in HEADLESS_FLAGS if not flag.startswith("--headless")]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=find_browser(), args=["--no-sandbox", *flags]
        )
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(120_000)
        page.goto(viewer.url)
        page.wait_for_selector("canvas")
        page.add_style_tag(content=NO_NOTICES)
        while not viewer.pages:
            page.wait_for_timeout(100)
        yield page
        browser.close()


def _take(page: Any, name: str) -> None:
    """Save what the page shows, once it has stopped changing."""
    before = np.zeros(0)
    for _ in range(30):
        page.wait_for_timeout(1500)
        data = np.frombuffer(page.screenshot(), dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
        if np.array_equal(picture, before):
            break
        before = picture
    cv2.imwrite(str(TARGET / name), before, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _viewer(session: Session) -> Viewer:
    following = session.watchers.find("viewer", Following)
    if following is None:
        raise SystemExit("no viewer is running")
    return following.viewer


def _demo(folder: Path) -> None:
    """Show the merged demo, and what the workflow has moved; the maps are kept in the folder."""
    with Session() as session:
        session.set_flags(["--viewer_port=0"])
        if not (folder / "merged").is_dir():
            session.run("demo", map_folder=folder / "merged")
            session.maps.add("odometry", session.maps.selected.past[0].vi_map)
            session.run("save", map_folder=folder / "odometry")
            session.run("clear_storage", yes=True)
        session.run("load", map_folder=folder / "odometry")
        session.run("load", map_folder=folder / "merged")
        session.run("visualize")
        viewer = _viewer(session)
        with _page(viewer) as page:
            _take(page, "viewer_demo.png")
            session.run("visualize_difference", with_map_key="odometry")
            viewer.set_layer("landmarks", False)
            viewer.look_at_everything()
            _take(page, "viewer_difference.png")
            session.run("visualize_difference", with_map_key="odometry", side_by_side=True)
            viewer.set_layer("landmarks", True)
            viewer.look_at_everything()
            _take(page, "viewer_side_by_side.png")
            session.run("visualize_difference", with_map_key="odometry", swipe=True)
            viewer.look_at_everything()
            _take(page, "viewer_swipe.png")


def _recording(folder: Path) -> None:
    """Show a recorded walk by height, a picked landmark, and the middle of the walk."""
    with Session() as session:
        session.set_flags(["--viewer_port=0", "--viewer_dark"])
        session.run("load", map_folder=folder)
        session.run("visualize", vis_color_landmarks_by_height=True)
        viewer = _viewer(session)
        with _page(viewer) as page:
            _take(page, "viewer_height.png")
            viewer.open_time_line()
            viewer.set_step(110)
            _take(page, "viewer_playback.png")
            viewer.playback.time_line.panel.minimize()
            viewer.set_step(10_000)
            viewer.set_dark(False)
            viewer.set_colouring("observations")
            viewer.wait()
            viewer.set_point_scale(0.35)
            _pick(viewer, session)
            _take(page, "viewer_pick.png")


def _history(folder: Path) -> None:
    """Show a recorded walk as it was before its loop was closed, with the errors of all states."""
    with Session() as session:
        session.set_flags(["--viewer_port=0"])
        session.run("load", map_folder=folder)
        for command in ("relax", "lc", "optvi", "visualize"):
            session.run(command)
        viewer = _viewer(session)
        with _page(viewer) as page:
            viewer.set_state(0)
            viewer.wait()
            _take(page, "viewer_history.png")


def _pick(viewer: Viewer, session: Session) -> None:
    """Pick a good landmark that a long piece of the walk has seen, and look at it from near."""
    vi_map = session.vi_map
    counts = np.where(vi_map.landmarks.quality == 2, observation_counts(vi_map), 0)
    candidates = np.flatnonzero((counts >= 12) & (counts <= 30))
    baseline = [
        np.ptp(
            vi_map.T_G_I[vi_map.keypoint_vertex[vi_map.landmark(row).keypoints], 4:], axis=0
        ).max()
        for row in candidates.tolist()
    ]
    row = int(candidates[np.argmax(baseline)])
    drawing = viewer.drawing
    viewer.select(Pick(Entity.LANDMARK, row, drawing.p_landmarks[row], 0.0))
    observers = vi_map.keypoint_vertex[vi_map.landmark(row).keypoints]
    middle = 0.5 * (drawing.p_landmarks[row] + drawing.p_vertices[observers].mean(axis=0))
    away = 6.0 + 2.0 * float(np.linalg.norm(drawing.p_landmarks[row] - middle))
    for client in viewer.server.get_clients().values():
        with client.atomic():
            client.camera.position = middle + away * np.array([-0.5, -0.7, 0.55])
            client.camera.look_at = middle + away * np.array([0.12, -0.1, 0.0])


def main() -> None:
    """Take all pictures."""
    TARGET.mkdir(exist_ok=True)
    _recording(Path(sys.argv[1]))
    _history(Path(sys.argv[1]))
    if len(sys.argv) > 2:
        _demo(Path(sys.argv[2]))
        return
    with tempfile.TemporaryDirectory() as folder:
        _demo(Path(folder))


if __name__ == "__main__":
    main()
