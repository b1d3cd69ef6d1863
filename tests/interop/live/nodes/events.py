"""What a robot sends, in its order and at its pace; for nodes that have numpy alone."""

import argparse
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

Event = tuple[int, int, Any]  # stamp_ns, camera or -1 = IMU, pixels or [ax ay az gx gy gz]
_SETTLE_S = 1.0  # both sides learn of each other
_LONGEST_WAIT_S = 10.0
_QUIET_S, _LONGEST_QUIET_S = 5.0, 150.0


def options() -> argparse.Namespace:
    """Read the command line that all players have."""
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--limit", type=int, default=0, help="events to send; 0 = all")
    parser.add_argument("--rounds", type=int, default=1, help="forward and backward in turn")
    parser.add_argument("--ahead_s", type=float, default=0.0, help="before the odometry; 0 = any")
    parser.add_argument("--begin_s", type=float, default=0.0, help="leave out the first seconds")
    parser.add_argument("--last_s", type=float, default=0.0, help="end after so long; 0 = never")
    parser.add_argument("--killed", action="store_true", help="die without a word at the end")
    parser.add_argument("--best_effort", action="store_true", help="ROS 2")
    parser.add_argument("--wait_s", type=float, default=60.0, help="for subscribers")
    return parser.parse_args()


class Player:
    """Sends events, and keeps account of the poses that come back."""

    def __init__(self, chosen: argparse.Namespace) -> None:
        self._options = chosen
        self._sent_s: dict[int, float] = {}
        self._latencies_ms: list[float] = []
        self._last_ns, self._last_s = 0, 0.0
        self.cameras = range(chosen.cameras)
        self.odometry = 0
        self.problem = ""

    def take(self, stamp_ns: int) -> None:
        """Note a pose that has come."""
        self.odometry += 1
        self._last_ns, self._last_s = stamp_ns, time.monotonic()
        sent_s = self._sent_s.pop(stamp_ns, None)
        if sent_s is not None:
            self._latencies_ms.append(1e3 * (self._last_s - sent_s))

    def play(self, is_connected: Callable[[], bool], send: Callable[[int, int, Any], None]) -> None:
        """Wait for subscribers, send everything, and wait until no more poses come."""
        deadline_s = time.monotonic() + self._options.wait_s
        while time.monotonic() < deadline_s and not is_connected():
            time.sleep(0.05)
        time.sleep(_SETTLE_S)
        self._sent = dict.fromkeys((-1, *self.cameras), 0)
        self._largest_delay_s = 0.0
        for stamp_ns, sensor, content in self._paced():
            if sensor == 0:
                self._sent_s[stamp_ns] = time.monotonic()
            send(stamp_ns, sensor, content)
            self._sent[sensor] += 1
        if self._options.killed:
            os.kill(os.getpid(), signal.SIGKILL)
        deadline_s, count = time.monotonic() + _LONGEST_QUIET_S, -1
        while self.odometry != count and time.monotonic() < deadline_s:
            count = self.odometry
            time.sleep(_QUIET_S)

    def report(self, **more: Any) -> None:
        """Print what was sent and seen, as the last line."""
        seen = {
            "sent": {str(sensor): count for sensor, count in self._sent.items()},
            "odometry": self.odometry,
            "latency_ms": sorted(self._latencies_ms),
            "behind_pace_ms": 1e3 * self._largest_delay_s,
            **more,
        }
        print(json.dumps(seen), flush=True)

    def _paced(self) -> Iterator[Event]:
        """Yield the events at a multiple of real time, not too far before the odometry."""
        chosen, first_ns, begin_s = self._options, 0, time.monotonic()
        pause_s = 0.0
        for stamp_ns, sensor, content in self._events():
            first_ns = first_ns or stamp_ns
            while self._is_to_wait(stamp_ns):
                time.sleep(0.002)
                pause_s += 0.002
            due_s = begin_s + pause_s + (stamp_ns - first_ns) * 1e-9 / chosen.rate
            left_s = due_s - time.monotonic()
            if left_s > 0.0:
                time.sleep(left_s)
            self._largest_delay_s = max(self._largest_delay_s, -left_s)
            if 0.0 < chosen.last_s < time.monotonic() - begin_s:
                return
            yield stamp_ns, sensor, content

    def _is_to_wait(self, stamp_ns: int) -> bool:
        ahead_s = self._options.ahead_s
        if not ahead_s or time.monotonic() - self._last_s > _LONGEST_WAIT_S:
            return False
        return stamp_ns - self._last_ns > 1e9 * ahead_s

    def _events(self) -> Iterator[Event]:
        """Yield the events of all rounds.

        Every second round is the flight backward: where it begins and ends at rest, there is no jump. Of
        the samples only turn rates change their sign; biases have to be zero.
        """
        chosen = self._options
        events = _load(chosen.recording, chosen.cameras)[: chosen.limit or None]
        begin_ns, end_ns = events[0][0], events[-1][0]
        events = [e for e in events if e[0] >= begin_ns + round(1e9 * chosen.begin_s)]
        for number in range(chosen.rounds):
            offset_ns = number * (end_ns - begin_ns)
            is_backward = number % 2 == 1
            for stamp_ns, sensor, content in reversed(events) if is_backward else events:
                since_ns = end_ns - stamp_ns if is_backward else stamp_ns - begin_ns
                if number and since_ns == 0:
                    continue  # the last of the round before
                turned = is_backward and sensor < 0
                yield (
                    begin_ns + offset_ns + since_ns,
                    sensor,
                    content * [1, 1, 1, -1, -1, -1] if turned else content,
                )


def _load(path: Path, cameras: int) -> list[Event]:
    """Return the events in the order of their stamps."""
    with np.load(path) as arrays:
        samples = [
            (int(t), -1, row) for t, row in zip(arrays["imu_ns"], arrays["imu"], strict=True)
        ]
        images = []
        for camera in range(cameras):
            stamps, pixels = arrays[f"stamps_ns{camera}"], arrays[f"pixels{camera}"]
            images += [(int(t), camera, image) for t, image in zip(stamps, pixels, strict=True)]
    return sorted(samples + images, key=lambda event: event[:2])
