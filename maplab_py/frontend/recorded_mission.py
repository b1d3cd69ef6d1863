"""One mission while it is recorded, and as tables of a map."""

from __future__ import annotations

import collections
import hashlib
from collections.abc import Sequence
from concurrent.futures import Future

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.frontend import backfill, dead_reckoning
from maplab_py.frontend.imu_buffer import joined_samples
from maplab_py.interop.recordings.protocol import RecordedSensors, TrackedFrame
from maplab_py.sensors import Imu
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import VIMap, descriptors, nav_state, tables
from maplab_py.vimap.ids import from_hex, random_ids
from maplab_py.vimap.table import object_column

Frame = TrackedFrame | None
VertexFrames = tuple[Frame, ...] | Future[tuple[TrackedFrame, ...]]
"""Keypoints of a vertex by camera, or those that a thread describes."""
_ALL = slice(None)
_KEPT = 128
"""Vertices at the end whose covariances are kept: a few seconds without tracks are removed again."""

_PRESENT = tables.FrameField.SIGMA | tables.FrameField.SCALE | tables.FrameField.TRACK_ID
"""Optional fields of keypoints that frames have; `LANDMARK_ID` follows with the landmarks."""


class RecordedMission:
    """Vertices of a mission with the IMU samples between them."""

    def __init__(self) -> None:
        self.states: list[nav_state.NavState] = []
        self.frames: list[VertexFrames] = []
        self.image_rows: list[Sequence[int]] = []  # of new resources, -1 = none
        self.edges: list[tuple[I64, F64]] = []  # times and samples between vertices
        self.is_doubtful = False  # it has diverged: nothing can be tied to its end
        self._samples: list[tuple[I64, F64]] = []  # since the last vertex
        self._covariances: collections.deque[tuple[int, F64]] = collections.deque(maxlen=_KEPT)
        self._row_of_time: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self.states)

    @property
    def last_ns(self) -> int | None:
        """Time of the last vertex, None if there is none."""
        return int(self.states[-1].time_ns[0]) if self.states else None

    def add_imu(self, times_ns: I64, accel_gyro: F64) -> None:
        """Add samples, the first being the last one before; until there is a vertex none are kept."""
        if self.states:
            self._samples.append((times_ns, accel_gyro))

    def add_imu_after_end(self, times_ns: I64, accel_gyro: F64) -> None:
        """Add samples that lead from the last vertex to the next mission, unless they are too many."""
        last_ns = self.last_ns
        if last_ns is None or self.is_doubtful:
            return
        self.add_imu(times_ns, accel_gyro)
        if times_ns[-1] - last_ns > dead_reckoning.LONGEST_S * 1e9:
            self.is_doubtful, self._samples = True, []

    def tie_to(self, following: RecordedMission, imu: Imu) -> dead_reckoning.Tie | None:
        """Return where the first vertex of the following mission is; None = nobody knows."""
        if not self.states or not following.states or self.is_doubtful:
            return None
        last, first_ns = self.states[-1], int(following.states[0].time_ns[0])
        times_ns, samples = merged_samples(self._samples)
        last_ns = int(last.time_ns[0])
        if not len(times_ns) or not times_ns[0] <= last_ns < first_ns <= times_ns[-1]:
            return None
        times_ns, samples = backfill.cut_samples(times_ns, samples, last_ns, first_ns)
        covariance = next((c for at_ns, c in self._covariances if at_ns == last_ns), None)
        return dead_reckoning.Tie.by_samples(imu, last, covariance, times_ns, samples)

    def add_vertex(
        self,
        state: nav_state.NavState,
        frames: VertexFrames,
        image_rows: Sequence[int],
        covariance: F64 | None = None,
    ) -> None:
        """Add a vertex; see `MapBuilder.add_vertex`.

        Raises:
            ValueError: The samples do not reach from the last vertex to this one.
        """
        if self.states:
            times_ns, accel_gyro = joined_samples(self._samples)
            ends = (self.last_ns, int(state.time_ns[0]))
            if len(times_ns) < 2 or (int(times_ns[0]), int(times_ns[-1])) != ends:
                raise ValueError(f"IMU samples do not reach from {ends[0]} to {ends[1]} ns")
            self.edges.append((times_ns, accel_gyro))
            self._samples = []
        time_ns = int(state.time_ns[0])
        self._row_of_time[time_ns] = len(self.states)
        if covariance is not None:
            self._covariances.append((time_ns, covariance))
        self.states.append(state)
        self.frames.append(frames)
        self.image_rows.append(image_rows)

    def described(self, rows: slice = _ALL) -> list[tuple[Frame, ...]]:
        """Return the keypoints of vertices; waits for those that a thread describes."""
        frames = [f.result() if isinstance(f, Future) else f for f in self.frames[rows]]
        self.frames[rows] = frames
        return frames

    def samples(self) -> tuple[I64, F64]:
        """Return the samples since the last vertex."""
        return joined_samples(self._samples)

    def has_samples_until(self, time_ns: int) -> bool:
        """Tell whether the samples since the last vertex reach to a time."""
        return bool(self._samples) and int(self._samples[-1][0][-1]) == time_ns

    def prepend(self, earlier: RecordedMission, edge: tuple[I64, F64]) -> None:
        """Put the vertices of another mission before the first, with the samples that lead to it."""
        self.states = [*earlier.states, *self.states]
        self.frames = [*earlier.frames, *self.frames]
        self.image_rows = [*earlier.image_rows, *self.image_rows]
        self.edges = [*earlier.edges, edge, *self.edges]
        times_ns = (int(state.time_ns[0]) for state in self.states)
        self._row_of_time = {time_ns: row for row, time_ns in enumerate(times_ns)}

    def drop_after(self, time_ns: int) -> None:
        """Remove vertices after a time; the samples that lead to them lead to the next mission."""
        kept = sum(int(state.time_ns[0]) <= time_ns for state in self.states)
        for column in (self.states, self.frames, self.image_rows):
            del column[kept:]
        first = max(kept - 1, 0)
        self._samples = [*self.edges[first:], *self._samples] if kept else []
        del self.edges[first:]
        self._row_of_time = {t: row for t, row in self._row_of_time.items() if row < kept}

    def forget_before(self, first: int) -> None:
        """Remove the vertices before a row, with the samples up to it."""
        for column in (self.states, self.frames, self.image_rows):
            del column[:first]
        del self.edges[:first]
        self._row_of_time = {int(s.time_ns[0]): row for row, s in enumerate(self.states)}

    def part(self, first: int, end: int | None = None) -> RecordedMission:
        """Return the vertices from a row on, before an end, with the samples between them."""
        result, rows = RecordedMission(), slice(first, end)
        result.states, result.frames = self.states[rows], [*self.described(rows)]
        result.image_rows = self.image_rows[rows]
        result.edges = self.edges[first : None if end is None else end - 1]
        return result

    def row_at(self, time_ns: int) -> int | None:
        """Return the vertex of a time, None if there is none."""
        return self._row_of_time.get(time_ns)

    def refine(self, states: nav_state.NavState) -> None:
        """Replace the states of vertices that have one of these times."""
        for index, time_ns in enumerate(states.time_ns.tolist()):
            row = self._row_of_time.get(time_ns)
            if row is not None:
                self.states[row] = states.row(index)


def merged_samples(parts: list[tuple[I64, F64]]) -> tuple[I64, F64]:
    """Join pieces in the order of time, each time once; images that got another delay let pieces overlap."""
    times_ns, samples = joined_samples(parts)
    times_ns, rows = np.unique(times_ns, return_index=True)
    return times_ns, samples[rows]


def mission_map(
    device: RecordedSensors, mission: RecordedMission, images: NewResources | None
) -> VIMap:
    """Return a map of one mission with at least two vertices; keypoints have no landmarks.

    Ids follow from the sensors and the time of the first vertex: equal input gives equal maps.
    """
    states = nav_state.NavState.stack(mission.states)
    seed = np.random.default_rng(_id_seed(device, int(states.time_ns[0])))
    # one for each table, so that an id stays while the mission grows
    rng, edge_rng, frame_rng, vertex_rng, set_rng = seed.spawn(5)
    count = len(states)
    sensor_id = np.zeros((1, len(tables.MissionSensor), 2), dtype=np.uint64)
    sensor_id[0, tables.MissionSensor.IMU] = from_hex(device.imu_id)
    sensor_id[0, tables.MissionSensor.NCAMERA] = from_hex(device.rig_id)
    edges, samples = _imu_tables(mission, edge_rng)
    described = mission.described()
    frames = _frame_table(mission, described, frame_rng)
    vi_map = VIMap(
        sensors=device.sensors,
        missions=tables.Missions.filled(
            1, id=random_ids(1, rng), baseframe=[0], root_vertex=[0], sensor_id=sensor_id
        ),
        baseframes=tables.BaseFrames.filled(1, id=random_ids(1, rng)),
        vertices=tables.Vertices.filled(
            count,
            id=random_ids(count, vertex_rng),
            mission=np.zeros(count, dtype=np.int32),
            T_M_I=states.T_M_I,
            v_M=states.v_M,
            accel_bias=states.accel_bias,
            gyro_bias=states.gyro_bias,
            timestamp_ns=states.time_ns,
            nframe_id=random_ids(count, set_rng),
        ),
        frames=frames,
        keypoints=_keypoint_table(described),
        imu_edges=edges,
        imu_samples=samples,
    )
    rows = np.array(mission.image_rows, dtype=np.int64).reshape(-1)
    if images is None or not np.any(rows >= 0):
        return vi_map
    return images.attached(vi_map, rows[rows >= 0], np.flatnonzero(rows >= 0))


def _id_seed(device: RecordedSensors, start_ns: int) -> int:
    text = f"{device.rig_id} {device.imu_id} {start_ns}"
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=16).digest(), "little")


def _imu_tables(
    mission: RecordedMission, rng: np.random.Generator
) -> tuple[tables.ImuEdges, tables.ImuSamples]:
    count = len(mission.edges)
    table = tables.ImuEdges.filled(
        count,
        id=random_ids(count, rng),
        from_vertex=np.arange(count),
        to_vertex=np.arange(1, count + 1),
        sample_count=np.array([len(times) for times, _ in mission.edges], dtype=np.int32),
    )
    times = np.concatenate([times for times, _ in mission.edges])
    samples = np.concatenate([accel_gyro for _, accel_gyro in mission.edges])
    return table, tables.ImuSamples.filled(len(times), timestamp_ns=times, accel_gyro=samples)


def _frame_table(
    mission: RecordedMission, described: list[tuple[Frame, ...]], rng: np.random.Generator
) -> tables.Frames:
    """Return a row for each camera of each vertex; frames that are missing have no id."""
    cameras = len(described[0])
    frames = [frame for of_vertex in described for frame in of_vertex]
    count = len(frames)
    is_there = np.array([frame is not None for frame in frames])
    ids = random_ids(count, rng)
    ids[~is_there] = 0
    times_ns = np.repeat([int(state.time_ns[0]) for state in mission.states], cameras)
    return tables.Frames.filled(
        count,
        id=ids,
        vertex=np.repeat(np.arange(len(mission)), cameras),
        camera_index=np.tile(np.arange(cameras), len(mission)),
        timestamp_ns=times_ns,
        is_valid=is_there,
        keypoint_count=np.array([0 if f is None else len(f.uv_px) for f in frames]),
        present=np.where(is_there, int(_PRESENT), 0),
        descriptor_blocks=object_column([_blocks(frame) for frame in frames]),
    )


def _blocks(frame: Frame) -> tuple[descriptors.DescriptorBlock, ...] | None:
    """Return the runs of keypoints with descriptors of equal size, None without keypoints."""
    if frame is None or not len(frame.descriptor_size):
        return None
    size = frame.descriptor_size
    first = np.concatenate([[0], np.flatnonzero(np.diff(size)) + 1])
    counts = np.diff(np.append(first, len(size)))
    return tuple(
        descriptors.DescriptorBlock(count, width, frame.depth, frame.feature_type)
        for count, width in zip(counts.tolist(), size[first].tolist(), strict=True)
    )


def _keypoint_table(described: list[tuple[Frame, ...]]) -> tables.Keypoints:
    frames = [frame for of_vertex in described for frame in of_vertex if frame is not None]
    width = max((frame.descriptor.shape[1] for frame in frames), default=0)
    count = sum(len(frame.uv_px) for frame in frames)
    descriptor: U8 = np.zeros((count, width), dtype=np.uint8)
    row = 0
    for frame in frames:
        end = row + len(frame.uv_px)
        descriptor[row:end, : frame.descriptor.shape[1]] = frame.descriptor
        row = end
    columns = {
        name: np.concatenate([getattr(frame, name) for frame in frames] or [np.zeros(0)])
        for name in ("sigma_px", "scale", "track_id")
    }
    uv_px = np.concatenate([frame.uv_px for frame in frames] or [np.zeros((0, 2))])
    return tables.Keypoints.filled(count, uv_px=uv_px, descriptor=descriptor, **columns)
