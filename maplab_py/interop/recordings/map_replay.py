"""A mission of a map as a recording: its keypoints as if just tracked, its IMU samples as measured."""

from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.interop.recordings import protocol
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id, ragged_rows, to_hex
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType, sizes_of_type, types_of


def mission_sample_rows(vi_map: VIMap, mission: int) -> I64:
    """Return the rows (N,) of the IMU samples of a mission in the order of time, each time once.

    Raises:
        MapError: The samples run backwards.
    """
    edges = np.flatnonzero(vi_map.vertices.mission[vi_map.imu_edges.from_vertex] == mission)
    edges = edges[np.argsort(vi_map.imu_edges.from_vertex[edges], kind="stable")]
    rows = ragged_rows(vi_map.sample_start, edges)
    step_ns = np.diff(vi_map.imu_samples.timestamp_ns[rows])
    if np.any(step_ns < 0):
        at = rows[np.flatnonzero(step_ns < 0)[0] + 1]
        edge = int(np.searchsorted(vi_map.sample_start, at, side="right")) - 1
        raise MapError(
            f"mission {to_hex(vi_map.missions.id[mission])}: samples of IMU edge "
            f"{to_hex(vi_map.imu_edges.id[edge])} run backwards: check_map_consistency tells more"
        )
    is_new = np.concatenate([np.ones(min(len(rows), 1), dtype=np.bool_), step_ns > 0])
    return np.asarray(rows[is_new], dtype=np.int64)


class MapRecording:
    """Replays a mission: frame sets are its vertices, IMU samples those of its edges.

    Neighbouring edges repeat the sample at their common vertex; it is delivered once.
    """

    kind = "mission of a map"
    notes: tuple[str, ...] = ()

    def __init__(self, vi_map: VIMap, mission: int) -> None:
        """Open the mission in a row of the map.

        Raises:
            MapError: It has no vertices, no camera rig, or IMU samples that run backwards.
        """
        mission_id = to_hex(vi_map.missions.id[mission])
        self.name = f"mission {mission_id}"
        self._map = vi_map
        self._vertices = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
        rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
        if not len(self._vertices) or not rig_id:
            raise MapError(
                f"{self.name} has no {'camera rig' if len(self._vertices) else 'vertices'}: choose "
                "another mission"
            )
        imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
        self.device = protocol.RecordedSensors(vi_map.sensors, rig_id, imu_id)
        self._times_ns = vi_map.vertices.timestamp_ns[self._vertices]
        self._samples = (
            mission_sample_rows(vi_map, mission) if imu_id else np.zeros(0, dtype=np.int64)
        )
        self._sample_times_ns = vi_map.imu_samples.timestamp_ns[self._samples]
        self._feature_type, self._depth = FeatureType.BINARY, DescriptorDepth.UINT8
        if types_of(vi_map.frames) == {FeatureType.XFEAT}:
            self._feature_type, self._depth = FeatureType.XFEAT, DescriptorDepth.FLOAT32
        self._descriptor_size = sizes_of_type(vi_map.frames, self._feature_type, self._depth)

    @property
    def start_ns(self) -> int:
        """Time of the first item."""
        starts = [int(times[0]) for times in (self._times_ns, self._sample_times_ns) if len(times)]
        return min(starts)

    @property
    def end_ns(self) -> int:
        """Time of the last vertex."""
        return int(self._times_ns[-1])

    def parts(self) -> tuple[protocol.PartSpan, ...]:
        """Return no parts: the clock of a mission runs on."""
        return ()

    def items(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[protocol.Item]:
        """Yield frame sets and the IMU samples between them; see `Recording.items`."""
        row, last = np.searchsorted(
            self._sample_times_ns,
            [
                self.start_ns if start_ns is None else start_ns,
                np.iinfo(np.int64).max if end_ns is None else end_ns,
            ],
        ).tolist()
        for vertex, time_ns in zip(self._vertices.tolist(), self._times_ns.tolist(), strict=True):
            if (start_ns is not None and time_ns < start_ns) or (
                end_ns is not None and time_ns >= end_ns
            ):
                continue
            until = int(np.searchsorted(self._sample_times_ns, time_ns, side="right"))
            if row < until:
                yield self._batch(row, until)
                row = until
            yield self._frame_set(vertex, time_ns)
        if row < last:
            yield self._batch(row, last)

    def _batch(self, first: int, end: int) -> protocol.ImuBatch:
        imu = self.device.imu
        assert imu is not None  # there are samples
        rows = self._samples[first:end]
        return protocol.ImuBatch.of(
            imu, self._sample_times_ns[first:end], self._map.imu_samples.accel_gyro[rows]
        )

    def _frame_set(self, vertex: int, time_ns: int) -> protocol.TrackedFrameSet:
        first, end = self._map.frame_start[vertex : vertex + 2].tolist()
        frames: list[protocol.TrackedFrame | None] = [None] * len(self.device.cameras)
        for row in range(first, end):
            camera = int(self._map.frames.camera_index[row])
            if self._map.frames.id[row].any() and self._map.frames.is_valid[row]:
                frames[camera] = self._frame(row, camera)
        return protocol.TrackedFrameSet(time_ns, tuple(frames))

    def _frame(self, row: int, camera: int) -> protocol.TrackedFrame:
        vi_map, table = self._map, self._map.keypoints
        rows = slice(*vi_map.keypoint_start[row : row + 2].tolist())
        return protocol.TrackedFrame(
            camera=camera,
            stamp_ns=int(vi_map.frames.timestamp_ns[row]),
            uv_px=table.uv_px[rows],
            sigma_px=table.sigma_px[rows],
            scale=table.scale[rows],
            track_id=table.track_id[rows],
            descriptor=table.descriptor[rows],
            descriptor_size=self._descriptor_size[rows],
            feature_type=self._feature_type,
            depth=self._depth,
        )
