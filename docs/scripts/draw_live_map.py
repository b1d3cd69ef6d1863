"""Draw docs/images/live_map.webp: the viewer's page while `rovioli` maps a real recording.

python docs/scripts/draw_live_map.py EUROC_FOLDER
"""

from __future__ import annotations

import io
import sys
import time
from pathlib import Path

import numpy as np
from maplab_plugins.visualization.following import Following
from PIL import Image
from playwright.sync_api import sync_playwright

from maplab_py.console.session.session import Session
from maplab_py.viewer.display.picture import HEADLESS_FLAGS, find_browser
from maplab_py.viewer.display.viewer import Viewer

TARGET = Path(__file__).resolve().parents[1] / "images" / "live_map.webp"
PAGE = {"width": 1080, "height": 640}
WIDTH_PX = 900
MOST_PICTURES = 14
PLAYBACK_RATE = 0.2
"""Of the recording, so slow that there are many pictures."""
SHOWN_MS, LAST_MS = 350, 2500
"""Time that a picture is shown, and the last one."""


def viewer_of(session: Session) -> Viewer:
    """Return the viewer as soon as the command has opened it."""
    for _ in range(600):
        following = session.watchers.find("viewer", Following)
        if following is not None:
            return following.viewer
        time.sleep(0.1)
    raise SystemExit("no viewer was opened")


def pictures(recording: Path) -> list[Image.Image]:
    """Return what the page shows during the run and after it."""
    shown: list[Image.Image] = []
    flags = [flag for flag in HEADLESS_FLAGS if not flag.startswith("--headless")]
    with Session() as session, sync_playwright() as playwright:
        job = session.start(
            "rovioli",
            datasource_folder=recording,
            rovioli_visualize_map=True,
            map_publish_interval_s=1.0,
            vio_rosbag_realtime_playback_rate=PLAYBACK_RATE,
        )
        browser = playwright.chromium.launch(
            executable_path=find_browser(), args=["--no-sandbox", *flags]
        )
        page = browser.new_page(viewport=PAGE)
        page.set_default_timeout(120_000)
        page.goto(viewer_of(session).url)
        page.wait_for_selector("canvas")
        page.add_style_tag(content=".mantine-Notifications-root { display: none !important; }")
        while job.state == "running":
            shown.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
            page.wait_for_timeout(1000)
        page.wait_for_timeout(5000)
        shown.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        browser.close()
        if job.problem:
            raise SystemExit(job.problem)
    return shown


def has_scene(picture: Image.Image) -> bool:
    """Return whether the part of a page beside the panel shows anything."""
    return float(np.asarray(picture)[: PAGE["height"] // 2, : PAGE["width"] // 2].std()) > 2.0


def main() -> None:
    """Record, choose pictures at even intervals and write them as an animation."""
    taken = [picture for picture in pictures(Path(sys.argv[1])) if has_scene(picture)]
    step = -(-len(taken) // MOST_PICTURES)
    chosen = taken[len(taken) - 1 :: -step][::-1]
    height_px = WIDTH_PX * PAGE["height"] // PAGE["width"]
    first, *others = (picture.resize((WIDTH_PX, height_px), Image.LANCZOS) for picture in chosen)
    first.save(
        TARGET,
        save_all=True,
        append_images=others,
        duration=[SHOWN_MS] * len(others) + [LAST_MS],
        loop=0,
        quality=70,
        method=6,
    )
    sys.stdout.write(f"{TARGET.name}: {len(chosen)} of {len(taken)} pictures\n")


if __name__ == "__main__":
    main()
