"""Processor time that the self-calibration beside an odometry takes.

python -m benchmarks.calibration_beside [FOLDER] [--seconds=60]

A recording (simulated keypoints, or a folder) is read with `--self_calibrate`, as fast as it was recorded.
Prints processor time a frame, its ratio to that without the collector (its part of the frame, and the thread
that asks the other process), and the share of a core of the other process.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import threading
import time
from pathlib import Path

from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.online_calibration.beside import CalibrationBeside
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.simulation.scenario_file import load_scenario
from studies.data_sets import data_set


class _OverError(Exception):
    """The part of the recording that is measured is over."""


class _Paced:
    """Hands updates on, and waits until as much time has passed as in the recording."""

    def __init__(self, beside: CalibrationBeside, seconds: float) -> None:
        self._beside, self._seconds = beside, seconds
        self._began_s, self._first_ns = time.monotonic(), 0
        self.frames, self.collector_s, self.thread_s = 0, 0.0, 0.0

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Count a frame."""
        self._first_ns = self._first_ns or update.time_ns
        self.frames += 1
        began_s = time.thread_time()
        self._beside.after_frame(update, mapping)
        self.collector_s += time.thread_time() - began_s
        for thread in threading.enumerate():
            if thread.name == "self-calibration" and thread.ident is not None:
                self.thread_s = time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
        over_s = 1e-9 * (update.time_ns - self._first_ns)
        if over_s > self._seconds:
            raise _OverError
        left_s = over_s - (time.monotonic() - self._began_s)
        if left_s > 0.0:
            time.sleep(left_s)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    recording: Recording
    if arguments.folder is None:
        recording = MapRecording(data_set(load_scenario("ar_room"), 1).maps[0], 0)
    else:
        recording = open_recording(arguments.folder, SourceOptions())
    with tempfile.TemporaryDirectory() as folder:
        options = OnlineCalibrationOptions(is_on=True, database=Path(folder) / "device.segments")
        beside = CalibrationBeside(options)
        observer = _Paced(beside, arguments.seconds)
        mapping = Mapping(
            recording, RunOptions(output=OutputOptions(run_map_builder=True)), observer=observer
        )
        began_s, wall_s = time.process_time(), time.monotonic()
        with contextlib.suppress(_OverError):
            mapping.run()
        spent_s, lasted_s = time.process_time() - began_s, time.monotonic() - wall_s
        other_s = beside.evaluation.processor_s
        beside.close()
    more_s = observer.collector_s + observer.thread_s
    print(
        f"{1e3 * spent_s / observer.frames:.1f} ms a frame, {spent_s / (spent_s - more_s):.3f} times that "
        f"without; other process {other_s / lasted_s:.2f} of a core, "
        f"{beside.evaluation.evaluated} segments"
    )


if __name__ == "__main__":
    main()
