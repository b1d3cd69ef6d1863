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
from maplab_py.errors import MapError, MaplabError
from maplab_py.input_files import read_foreign_text
from maplab_py.interop.images import CONTAINER_BITS, sampled
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.interop.recordings import clocks, options, protocol
from maplab_py.interop.recordings.images import bits_note, camera_bits, image_file
from maplab_py.interop.stamps import IMAGES, parse_stamps
from maplab_py.interop.text_table import is_time_name
from maplab_py.sensors import Camera

_MAX_BYTES = 500_000_000
_LARGEST_BATCH = 1000
_DEFAULT = options.ReadingOptions()
_MOST_LINES = 10
_IMAGE_NAME = re.compile(r"\.[a-z]{2,5}$", re.IGNORECASE)


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
        device: protocol.RecordedSensors,
        camera_folders: tuple[int, ...] = (),
        reading: options.ReadingOptions = _DEFAULT,
    ) -> None:
        """Open a recording.

        Args:
            root: Folder with cam0.
            camera_folders: Number of the folder cam<number> of each camera; () = 0, 1, ...

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
        imus = sorted(f.name for f in self._root.glob("imu[1-9]*") if f.is_dir())
        if imus:
            notes.append(f"{', '.join(imus)}: not read: the IMU is imu0")
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
        clocks.check_part(self.name, part, count)
        if part:
            imu = None if self._imu is None else len(self._imu.parts)
            clocks.common_part_count(
                self.name, imu, [len(camera.parts) for camera in self._cameras]
            )
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
            clocks.check_common_time(self.name, span_ns, images_ns, proposal, is_apart=is_apart)

    def parts(self) -> tuple[protocol.PartSpan, ...]:
        """Return the parts into which restarts of the clock divide the recording."""
        spans = []
        for part in range(max(len(table.parts) for table in self._tables)):
            having = [table for table in self._tables if part < len(table.parts)]
            first_ns = min(int(table.times(part)[0]) for table in having)
            last_ns = max(int(table.times(part)[-1]) for table in having)
            counts = [len(t.times(part)) if part < len(t.parts) else 0 for t in self._tables]
            samples = 0 if self._imu is None else counts.pop(0)
            spans.append(
                protocol.PartSpan(
                    part + 1, first_ns, (last_ns - first_ns) * 1e-9, samples, sum(counts)
                )
            )
        return tuple(spans)

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        return min(int(table.times(self._part)[0]) for table in self._tables)

    @property
    def end_ns(self) -> int:
        """Time of the last item."""
        return max(int(table.times(self._part)[-1]) for table in self._tables)

    @property
    def first_sizes_px(self) -> dict[int, tuple[int, int]]:
        """Width and height of the first image of cameras, where it can be read."""
        sizes: dict[int, tuple[int, int]] = {}
        with contextlib.suppress(MaplabError):  # the run names it, if it is not skipped
            for row, camera in enumerate(self._cameras):
                image = camera.image(row, int(camera.rows(self._part, None, None)[0]))
                sizes[row] = image.data.size_px()
        return sizes

    def items(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[protocol.Item]:
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
                    yield protocol.ImuBatch.of(imu, times_ns[part], values[part])
                    row = part.stop
                yield image
            for first in range(row, len(times_ns), _LARGEST_BATCH):
                part = slice(first, first + _LARGEST_BATCH)
                yield protocol.ImuBatch.of(imu, times_ns[part], values[part])
        if not self._reading.recording_part:
            for table in self._tables:
                table.check_restart(end_ns)


class _Table:
    """Stamps of one sensor, divided where its clock starts again."""

    def __init__(
        self, path: Path, stamps_ns: I64, lines: I64, note: str, time_offset_ns: int = 0
    ) -> None:
        self._path, self.name = path, path.parent.name
        self.order = clocks.order_of_time(stamps_ns)  # row of the file of each stamp
        is_sorted = bool(np.all(np.diff(self.order) == 1))
        sorting = "" if is_sorted else f"{path}: rows are not in the order of time: they are sorted"
        self.note = "; ".join(filter(None, (note, sorting)))
        self.stamps_ns, self._lines = stamps_ns[self.order], lines[self.order]
        self.times_ns = self.stamps_ns + time_offset_ns
        if len(stamps_ns) > 1 and not stamps_ns.any():
            raise MapError(
                f"{path}: all time stamps are 0, as of a driver that sets none: write the times at which the "
                "rows were recorded into the table"
            )
        self.parts, self._dropped = clocks.parts_of(self.stamps_ns)

    @property
    def dropped_note(self) -> str:
        """One line on rows that are left out; empty without any."""
        if not len(self._dropped):
            return ""
        lines = list(clocks.listed_rows(self._lines[self._dropped]))
        shown = ", ".join(lines[:_MOST_LINES]) + (", ..." if len(lines) > _MOST_LINES else "")
        note = clocks.dropped_note(str(self._path), len(self._dropped), self._first(self._dropped))
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
            clocks.check_dropped(where, len(inside), count, self._first(inside), max_late_share)

    def check_restart(self, end_ns: int | None) -> None:
        """Check that the clock does not start again before a time.

        Raises:
            ClockRestart: It does.
        """
        if len(self.parts) > 1 and (end_ns is None or self.times(0)[-1] < end_ns):
            before, after = int(self.parts[0][-1]), int(self.parts[1][0])
            restart = clocks.Dropped(int(self.stamps_ns[after]), int(self.stamps_ns[before]))
            raise clocks.restart_error(f"{self._path}:{self._lines[after]}", restart)

    def _first(self, dropped: I64) -> clocks.Dropped:
        row = int(dropped[0])
        before = self.stamps_ns[row - 1] if row else self.stamps_ns[self.parts[0][0]]
        return clocks.Dropped(int(self.stamps_ns[row]), int(before))


class _ImuTable(_Table):
    """IMU samples of a folder."""

    def __init__(self, path: Path, reading: options.ReadingOptions) -> None:
        if not path.exists():
            raise MapError(
                f"{path}: the table is missing: copy the folder again, or give a calibration "
                "without IMU"
            )
        table = read_imu_csv(path, reading.time_unit, in_order=False)
        lines = np.arange(len(table.times_ns)) if table.lines is None else table.lines
        super().__init__(path, table.times_ns, lines, table.note)
        self.accel_gyro: F64 = table.accel_gyro[self.order]


class _ImageTable(_Table):
    """The images of one camera: stamps and file names."""

    def __init__(self, folder: Path, camera: Camera, reading: options.ReadingOptions) -> None:
        if not folder.is_dir():
            raise MapError(
                f"{folder}: the folder is missing, although the calibration has this camera: choose "
                "cameras with --rovio_active_camera_indices"
            )
        self._folder, self._camera = folder / "data", camera
        path = folder / "data.csv"
        tokens, files, lines, header = _image_rows(path)
        stamps = parse_stamps(
            tokens, IMAGES, str(path), lines, unit=reading.time_unit, header=header
        )
        super().__init__(path, stamps.times_ns, lines, stamps.note, camera.time_offset_ns)
        self._files = [files[row] for row in self.order.tolist()]
        try:
            present = set(os.listdir(self._folder))
        except OSError as error:
            raise MapError(
                f"cannot read {self._folder}: {error.strerror}: copy the images there"
            ) from error
        is_there = np.array([name in present for name in self._files])
        # files that are not there
        self.missing = [self._folder / self._files[k] for k in np.flatnonzero(~is_there)]
        if self.missing and reading.skip_missing_images:
            self.parts = [rows[is_there[rows]] for rows in self.parts]
            if not all(map(len, self.parts)):
                raise MapError(f"{self._folder}: all images are missing: copy them there")

    def images(self, camera: int, rows: I64, bits: int) -> Iterator[protocol.CameraImage]:
        """Yield the images of rows as those of the camera with this number."""
        for row in rows.tolist():
            yield self.image(camera, row, bits)

    def image(self, camera: int, row: int, bits: int = CONTAINER_BITS) -> protocol.CameraImage:
        """Return the image of a row as that of the camera with this number."""
        data = image_file(self._folder / self._files[row], self._camera)
        times_ns = int(self.times_ns[row]), int(self.stamps_ns[row])
        return protocol.CameraImage(camera, *times_ns, data, bits)


def _image_rows(path: Path) -> tuple[list[str], list[str], I64, str]:
    """Return stamps, file names, lines and the header of the stamps of a table `stamp,file`.

    Of further columns, or another order, the header names that of the stamps. Names lead to no path outside
    the folder.
    """
    tokens: list[str] = []
    files: list[str] = []
    lines: list[int] = []
    columns: list[str] = []
    text = read_foreign_text(path, _MAX_BYTES, remedy="split the recording")
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.replace('"', "").strip()
        if not content:
            continue
        if content.startswith("#") or (
            not tokens and not columns and not re.search(r"\d{2}", content)
        ):
            columns = columns or _cells(content.lstrip("# "), -1)
            continue
        words = _cells(content, max(len(columns), 2) - 1)
        place = next((k for k, name in enumerate(columns) if is_time_name(name.lower())), 0)
        names = [word for k, word in enumerate(words) if k != place and _IMAGE_NAME.search(word)]
        if len(words) == 2 and (names or not re.search("[,;]", words[1 - place])):
            names = [words[1 - place]]
        name = _file_name(names[0], path.parent.name) if len(names) == 1 else ""
        if len(words) != max(len(columns), 2) or not name:
            raise MapError(
                f"{path}:{number}: a row must be a time stamp and the name of an image in data/, not "
                f"'{content}'"
            )
        tokens.append(words[place])
        files.append(name)
        lines.append(number)
    if not tokens:
        raise MapError(f"{path}: the recording is empty: there are no images in the table")
    header = next((name for name in columns if is_time_name(name.lower())), "".join(columns[:1]))
    return tokens, files, np.array(lines, dtype=np.int64), header


def _cells(content: str, most_cuts: int) -> list[str]:
    separator = next((character for character in ",;\t" if character in content), None)
    return [cell.strip() for cell in content.split(separator, most_cuts)]


def _file_name(word: str, sensor: str) -> str:
    """Return the name of a file in data/ of a sensor's folder; empty if it is elsewhere."""
    *folders, name = (part for part in re.split(r"[\\/]", word) if part != ".")
    is_here = not folders or (folders[-1] == "data" and folders[-2:-1] in ([], [sensor]))
    return name if is_here else ""
