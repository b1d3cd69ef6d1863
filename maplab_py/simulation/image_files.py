"""Rendered images and depth images as files; several threads render, one writes."""

from __future__ import annotations

import dataclasses
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64
from maplab_py.atomic import write_file
from maplab_py.cancellation import lasting_effect
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.simulation.brightness import make_brightness
from maplab_py.simulation.imaging import Imager
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.shading_kernels import PaintedBoxes
from maplab_py.simulation.simulate import RecordedSession

_NOISE_STREAM, _GAIN_STREAM = 22, 23
_PNG_LEVEL, _HUFFMAN_ONLY = 1, 2
"""Without a search for repetitions, which noise does not have, files are smaller and sooner written."""


@dataclasses.dataclass(frozen=True, eq=False)
class SessionFolders:
    """Destination of the images of a session."""

    images: Path  # has cam0, cam1, ...
    depths: Path  # gets depth0, depth1, ...


def write_images(
    scenario: Scenario,
    number: int,
    session: RecordedSession,
    painted: PaintedBoxes,
    folders: SessionFolders,
    *,
    threads: int | None = None,
    progress: Progress = SILENT,
) -> None:
    """Render and write all images of a session; the bytes do not depend on the number of threads.

    Args:
        scenario: The whole scenario.
        number: Which of its sessions.
        session: What was recorded, with the true motion and cameras.
        painted: The scene as this session sees it.
        folders: Where the images go.
        threads: How many images are rendered at a time; None = as many as there are processors.
        progress: Is told about every image.

    Raises:
        UserError: A file cannot be written.
        Cancelled: The user wants to stop.
    """
    count = len(session.recording.time_ns)
    seed = [scenario.seeds.measurement, _GAIN_STREAM, number]
    brightness = make_brightness(
        scenario.sessions[number].images,
        scenario.images.gain_swing,
        session.recording.spline.duration_s,
        np.random.default_rng(seed),
    )
    for row, camera in enumerate(session.device.true_rig.cameras):
        at_time, delay = _camera_motion(session, row), scenario.cameras[row].line_delay_s
        imager = Imager.of(painted, camera, scenario.images, delay, at_time, brightness)
        targets = folders.images / f"cam{row}" / "data", folders.depths / f"depth{row}"
        for target in targets[: 1 + scenario.images.depth]:
            target.mkdir(exist_ok=True)

        def rendered(frame: int, row: int = row, imager: Imager = imager) -> list[bytes]:
            random = [scenario.seeds.measurement, _NOISE_STREAM, number, row, frame]
            time_s = float(session.recording.frame_s[frame])
            image, depth = imager.image(time_s, np.random.default_rng(random))
            if not scenario.images.depth:
                return [_png(image)]
            millimetres = np.clip(np.round(1000.0 * depth), 0, 65535).astype(np.uint16)
            return [_png(image), _png(millimetres)]

        with closing(_in_order(rendered, range(count), threads or os.cpu_count() or 1)) as files:
            for frame, contents in enumerate(files):
                progress.step(frame, count, f"images of session {number + 1}, camera {row}")
                name = f"{session.recording.time_ns[frame]}.png"
                for target, content in zip(targets, contents, strict=False):
                    with lasting_effect():
                        write_file(target / name, [content], durable=False)


def _camera_motion(session: RecordedSession, row: int) -> Callable[[F64], F64]:
    """Return the poses T_G_C (N, 7) of a camera as a function of the times (N,) [s]."""
    T_I_C, spline = session.device.true_rig.T_B_C[row], session.recording.spline

    def at_time(time_s: F64) -> F64:
        inside = np.clip(time_s, 0.0, spline.duration_s)
        return se3.compose(spline.evaluate(inside).T_G_I, T_I_C)

    return at_time


def _in_order(
    function: Callable[[int], list[bytes]], items: Iterable[int], threads: int
) -> Generator[list[bytes]]:
    """Yield the values of a function that several threads compute, in the order of the items."""
    pending: deque[Future[list[bytes]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) > 2 * threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def _png(image: NDArray[np.generic]) -> bytes:
    import cv2

    settings = [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL, cv2.IMWRITE_PNG_STRATEGY, _HUFFMAN_ONLY]
    # one filter for all rows instead of the best of five for each: with noise there is nothing to choose
    # (1 % larger, encoded in half the time). Versions of OpenCV that have no such choice do so by themselves.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        settings += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG]
    done, data = cv2.imencode(".png", image, settings)
    if not done:
        raise UserError(f"an image of {image.shape[1]} x {image.shape[0]} pixels cannot be encoded")
    return bytes(data)
