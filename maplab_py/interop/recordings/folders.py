"""Recordings as folders in the form of EuRoC (ASL): `mav0/cam0`, `mav0/cam1`, `mav0/imu0`.

TUM-VI's folders have the same form, with images of 8 or 16 bits.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.input_files import read_text
from maplab_py.interop.images import CONTAINER_BITS, sampled
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.interop.recordings.clocks import (
    Dropped,
    check_common_time,
    check_dropped,
    common_part_count,
    dropped_note,
    listed_rows,
    parts_of,
    restart_error,
)
from maplab_py.interop.recordings.images import bits_note, camera_bits, image_file
from maplab_py.interop.recordings.options import ReadingOptions
from maplab_py.interop.recordings.protocol import (
    CameraImage,
    ImuBatch,
    Item,
    PartSpan,
    RecordedSensors,
)
from maplab_py.interop.stamps import IMAGES, parse_stamps
from maplab_py.sensors import Camera

_MAX_BYTES = 500_000_000
_LARGEST_BATCH = 1000
_DEFAULT = ReadingOptions()
_MOST_LINES = 10


def image_root(path: Path) -> Path | None:
    """Return the folder with cam0 of a recording (mav0 or the path itself), None if there is none."""
    for folder in (path / "mav0", path):
        if (folder / "cam0").is_dir():
            return folder
    return None


class FolderRecording:
    """Reads a folder in the form of EuRoC."""

    kind = "EuRoC folder"

    def __init__(
        self,
        root: Path,
        device: RecordedSensors,
        camera_folders: tuple[int, ...] = (),
        reading: ReadingOptions = _DEFAULT,
    ) -> None:
        """Open a recording.

        Args:
            root: Folder with cam0.
            device: Sensors.
            camera_folders: Number of the folder cam<number> of each camera; () = 0, 1, ...
            reading: How stamps and images are read.

        Raises:
            MapError: A table is missing, empty or wrong, or names an image that is not there.
            UserError: There is no such part.
        """
        self.name, self.device, self._root, self._reading = str(root), device, root, reading
        self._bits = [CONTAINER_BITS] * len(device.cameras)
        self._numbers = camera_folders or tuple(range(len(device.cameras)))
        self._names_all = not camera_folders
        self._is_apart = False
        self._cameras = [
            _ImageTable(root / f"cam{number}", camera, reading)
            for number, camera in zip(self._numbers, device.cameras, strict=True)
        ]
        missing = [file for camera in self._cameras for file in camera.missing]
        if missing and not reading.skip_missing_images:
            counts = ", ".join(
                f"{len(camera.missing)} of {len(camera.stamps_ns)} in {camera.name}"
                for camera in self._cameras
                if camera.missing
            )
            raise MapError(
                f"{missing[0]}: the image is missing ({counts}): copy them, remove their rows from data.csv, "
                "or leave them out by --skip_missing_images (recording_info --check_images lists them)"
            )
        self.missing_images = tuple(missing)

    @property
    def notes(self) -> tuple[str, ...]:
        """Parts of the recording that are not read, and how the others are."""
        notes = [bits_note(c, bits) for c, bits in enumerate(self._bits) if bits < CONTAINER_BITS]
        notes.extend(f"missing, left out: {file}" for file in self.missing_images)
        for table in self._tables:
            notes.extend(note for note in (table.note, table.dropped_note) if note)
        if not self.device.imu_id and (self._root / "imu0").is_dir():
            notes.append(
                "imu0 is not read: the calibration has no IMU, --imu_calibration_file names its file"
            )
        others = sorted(
            folder.name
            for folder in self._root.glob("cam[0-9]*")
            if folder.is_dir() and folder.name not in {f"cam{n}" for n in self._numbers}
        )
        if others and self._names_all:
            notes.append(
                f"{', '.join(others)}: not read: the cameras of the calibration ({len(self._numbers)}) are "
                "counted from cam0 without gaps"
            )
        return tuple(notes)

    @cached_property
    def _imu(self) -> _ImuTable | None:
        if not self.device.imu_id:
            return None
        return _ImuTable(self._root / "imu0" / "data.csv", self._reading)

    @cached_property
    def _tables(self) -> list[_Table]:
        return [*([] if self._imu is None else [self._imu]), *self._cameras]

    @cached_property
    def _part(self) -> int:
        """Row of the part that is read; tables are divided for it.

        Raises:
            MapError: The sensors have different numbers of parts.
            UserError: There is no such part.
        """
        part = self._reading.recording_part
        count = max(len(table.parts) for table in self._tables)
        if part > count:
            raise UserError(
                f"{self.name}: --recording_part={part}: the recording has {count} parts"
            )
        if part:
            imu = None if self._imu is None else len(self._imu.parts)
            common_part_count(self.name, imu, [len(camera.parts) for camera in self._cameras])
            restarting = next(table for table in self._tables if len(table.parts) == count)
            for table in self._tables:
                if len(table.parts) < count:
                    table.divide_like(restarting)
                    self._is_apart = part > 1
        return max(part - 1, 0)

    def check_common_time(self, *, has_shift: bool) -> None:
        """Check that IMU and images have some time in common.

        Args:
            has_shift: The shift between their clocks was given.

        Raises:
            MapError: They have none, or are of clocks that differ.
            UserError: There is no such part.
        """
        part = self._part
        if self._imu is not None:
            cameras = [camera.times(part) for camera in self._cameras]
            images_ns = min(int(t[0]) for t in cameras), max(int(t[-1]) for t in cameras)
            imu_ns = self._imu.times(part)
            span_ns = int(imu_ns[0]), int(imu_ns[-1])
            shift_ns = self.device.cameras[0].time_offset_ns + span_ns[0] - images_ns[0]
            proposal = f"{shift_ns} lets both begin together"
            is_apart = self._is_apart and not has_shift
            check_common_time(self.name, span_ns, images_ns, proposal, is_apart=is_apart)

    def parts(self) -> tuple[PartSpan, ...]:
        """Return the parts into which restarts of the clock divide the recording."""
        spans = []
        for part in range(max(len(table.parts) for table in self._tables)):
            having = [table for table in self._tables if part < len(table.parts)]
            first_ns = min(int(table.times(part)[0]) for table in having)
            last_ns = max(int(table.times(part)[-1]) for table in having)
            counts = [len(t.times(part)) if part < len(t.parts) else 0 for t in self._tables]
            samples = 0 if self._imu is None else counts.pop(0)
            spans.append(
                PartSpan(part + 1, first_ns, (last_ns - first_ns) * 1e-9, samples, sum(counts))
            )
        return tuple(spans)

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        return min(int(table.times(self._part)[0]) for table in self._tables)

    @property
    def first_sizes_px(self) -> dict[int, tuple[int, int]]:
        """Width and height of the first image of cameras, where it can be read."""
        sizes: dict[int, tuple[int, int]] = {}
        with contextlib.suppress(MaplabError):  # the run names it, if it is not skipped
            for row, camera in enumerate(self._cameras):
                image = camera.image(row, int(camera.rows(self._part, None, None)[0]))
                sizes[row] = image.data.size_px()
        return sizes

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        """Yield images and the IMU samples between them; see `Recording.items`."""
        for table in self._tables:
            table.check(self._part, start_ns, end_ns, self._reading.max_late_share)
        streams = []
        for row, camera in enumerate(self._cameras):
            kept = camera.rows(self._part, start_ns, end_ns)
            samples = (camera.image(row, int(kept[k])) for k in sampled(len(kept)))
            bits = self._reading.image_bits or camera_bits(samples)
            self._bits[row] = CONTAINER_BITS if bits == 8 or self._reading.image_bits else bits
            streams.append(camera.images(row, kept, bits))
        images = heapq.merge(*streams, key=lambda image: (image.time_ns, image.camera))
        imu, samples_table = self.device.imu, self._imu
        if imu is None or samples_table is None:
            yield from images
        else:
            rows = samples_table.rows(self._part, start_ns, end_ns)
            times_ns, values = samples_table.times_ns[rows], samples_table.accel_gyro[rows]
            row = 0
            for image in images:
                until = int(np.searchsorted(times_ns, image.time_ns, side="right"))
                while row < until:
                    part = slice(row, min(until, row + _LARGEST_BATCH))
                    yield ImuBatch.of(imu, times_ns[part], values[part])
                    row = part.stop
                yield image
            for first in range(row, len(times_ns), _LARGEST_BATCH):
                part = slice(first, first + _LARGEST_BATCH)
                yield ImuBatch.of(imu, times_ns[part], values[part])
        if not self._reading.recording_part:
            for table in self._tables:
                table.check_restart(end_ns)


class _Table:
    """Stamps of one sensor, divided where its clock starts again."""

    def __init__(
        self, path: Path, stamps_ns: I64, lines: I64, note: str, time_offset_ns: int = 0
    ) -> None:
        self._path, self.name, self.note = path, path.parent.name, note
        self.stamps_ns, self._lines = stamps_ns, lines
        self.times_ns = stamps_ns + time_offset_ns
        if len(stamps_ns) > 1 and not stamps_ns.any():
            raise MapError(
                f"{path}: all time stamps are 0, as of a driver that sets none: write the times at which the "
                "rows were recorded into the table"
            )
        self.parts, self._dropped = parts_of(stamps_ns)

    @property
    def dropped_note(self) -> str:
        """One line on rows that are left out; empty without any."""
        if not len(self._dropped):
            return ""
        lines = list(listed_rows(self._lines[self._dropped]))
        shown = ", ".join(lines[:_MOST_LINES]) + (", ..." if len(lines) > _MOST_LINES else "")
        note = dropped_note(str(self._path), len(self._dropped), self._first(self._dropped))
        return f"{note} (lines {shown})"

    def times(self, part: int) -> I64:
        """Return the times of a part."""
        return np.asarray(self.times_ns[self.parts[part]])

    def rows(self, part: int, start_ns: int | None, end_ns: int | None) -> I64:
        """Return the rows of a part from start_ns up to but not including end_ns."""
        times_ns, rows = self.times(part), self.parts[part]
        first = 0 if start_ns is None else int(np.searchsorted(times_ns, start_ns))
        end = len(rows) if end_ns is None else int(np.searchsorted(times_ns, end_ns))
        return rows[first : max(first, end)]

    def divide_like(self, other: _Table) -> None:
        """Divide the only part where the clock of another sensor, once the same, starts again.

        How long the other clock stood still is not known: a part begins once as much time has passed as
        the parts before it have, and only the first one also ends.

        Raises:
            MapError: There are no stamps of a part.
        """
        runs = [other.stamps_ns[rows] for rows in other.parts]
        lasting_ns = np.cumsum([0] + [int(run[-1] - run[0]) for run in runs[:-1]])
        (rows,) = self.parts
        places = np.searchsorted(
            self.stamps_ns[rows], int(runs[0][0]) + lasting_ns[1:], side="right"
        )
        self.parts = [rows[: places[0]], *(rows[place:] for place in places)]
        if not all(map(len, self.parts)):
            raise MapError(
                f"{self._path}: has no stamps beside a part of {other._path}, whose clock starts again: "
                "without --recording_part the first part is read, --vio_rosbag_end_s ends it"
            )

    def check(
        self, part: int, start_ns: int | None, end_ns: int | None, max_late_share: float
    ) -> None:
        """Check that few rows between those of a time are left out.

        Raises:
            MapError: There are too many.
        """
        rows = self.rows(part, start_ns, end_ns)
        if not len(self._dropped) or not len(rows):
            return
        first = -1 if start_ns is None and not part else rows[0]
        last = len(self.stamps_ns) if end_ns is None and part + 1 == len(self.parts) else rows[-1]
        inside = self._dropped[(self._dropped > first) & (self._dropped < last)]
        if len(inside):
            line = int(self._lines[inside[0]])
            count = len(rows) + len(inside)
            where = f"{self._path}:{line}"
            check_dropped(where, len(inside), count, self._first(inside), max_late_share)

    def check_restart(self, end_ns: int | None) -> None:
        """Check that the clock does not start again before a time.

        Raises:
            ClockRestart: It does.
        """
        if len(self.parts) > 1 and (end_ns is None or self.times(0)[-1] < end_ns):
            before, after = int(self.parts[0][-1]), int(self.parts[1][0])
            restart = Dropped(int(self.stamps_ns[after]), int(self.stamps_ns[before]))
            raise restart_error(f"{self._path}:{self._lines[after]}", restart)

    def _first(self, dropped: I64) -> Dropped:
        row = int(dropped[0])
        before = self.stamps_ns[row - 1] if row else self.stamps_ns[self.parts[0][0]]
        return Dropped(int(self.stamps_ns[row]), int(before))


class _ImuTable(_Table):
    """IMU samples of a folder."""

    def __init__(self, path: Path, reading: ReadingOptions) -> None:
        if not path.exists():
            raise MapError(
                f"{path}: the table is missing: copy the folder again, or give a calibration "
                "without IMU"
            )
        table = read_imu_csv(path, reading.time_unit, in_order=False)
        lines = np.arange(len(table.times_ns)) if table.lines is None else table.lines
        super().__init__(path, table.times_ns, lines, table.note)
        self.accel_gyro: F64 = table.accel_gyro


class _ImageTable(_Table):
    """The images of one camera: stamps and file names.

    Attributes:
        missing: Files that are not there.
    """

    def __init__(self, folder: Path, camera: Camera, reading: ReadingOptions) -> None:
        if not folder.is_dir():
            raise MapError(
                f"{folder}: the folder is missing, although the calibration has this camera: choose "
                "cameras with --rovio_active_camera_indices"
            )
        self._folder, self._camera = folder / "data", camera
        path = folder / "data.csv"
        tokens, self._files, lines, header = _image_rows(path)
        stamps = parse_stamps(
            tokens, IMAGES, str(path), lines, unit=reading.time_unit, header=header
        )
        super().__init__(path, stamps.times_ns, lines, stamps.note, camera.time_offset_ns)
        try:
            present = set(os.listdir(self._folder))
        except OSError as error:
            raise MapError(
                f"cannot read {self._folder}: {error.strerror}: copy the images there"
            ) from error
        is_there = np.array([name in present for name in self._files])
        self.missing = [self._folder / self._files[k] for k in np.flatnonzero(~is_there)]
        if self.missing and reading.skip_missing_images:
            self.parts = [rows[is_there[rows]] for rows in self.parts]
            if not all(map(len, self.parts)):
                raise MapError(f"{self._folder}: all images are missing: copy them there")

    def images(self, camera: int, rows: I64, bits: int) -> Iterator[CameraImage]:
        """Yield the images of rows as those of the camera with this number."""
        for row in rows.tolist():
            yield self.image(camera, row, bits)

    def image(self, camera: int, row: int, bits: int = CONTAINER_BITS) -> CameraImage:
        """Return the image of a row as that of the camera with this number."""
        data = image_file(self._folder / self._files[row], self._camera)
        times_ns = int(self.times_ns[row]), int(self.stamps_ns[row])
        return CameraImage(camera, *times_ns, data, bits)


def _image_rows(path: Path) -> tuple[list[str], list[str], I64, str]:
    """Return stamps, file names, lines and header of a table `stamp,file`.

    Names lead to no path outside the folder.
    """
    try:
        remedy = "split the recording"
        text = read_text(path, _MAX_BYTES, remedy=remedy, error=MapError, encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}: copy the folder again") from error
    tokens: list[str] = []
    files: list[str] = []
    lines: list[int] = []
    header = ""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.replace('"', "").strip()
        if not content:
            continue
        words = re.split(r"\s*[,\s]\s*", content, maxsplit=1)
        if content.startswith("#") or (not tokens and not header and not content[0].isdigit()):
            header = header or content.split(",")[0]
            continue
        name = words[-1].removeprefix("./").removeprefix("data/")
        if len(words) != 2 or "/" in name or not name:
            raise MapError(
                f"{path}:{number}: a row must be a time stamp and the name of an image in data/, not "
                f"'{content}'"
            )
        tokens.append(words[0])
        files.append(name)
        lines.append(number)
    if not tokens:
        raise MapError(f"{path}: the recording is empty: there are no images in the table")
    return tokens, files, np.array(lines, dtype=np.int64), header
