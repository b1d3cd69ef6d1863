"""The VI-map: a frozen value that holds all tables."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, Self

import numpy as np

from maplab_py.array_types import F64, NDArray
from maplab_py.geometry import se3
from maplab_py.report import counted, to_html
from maplab_py.sensors import SensorSet
from maplab_py.vimap import descriptors, ids, staged_folder, tables
from maplab_py.vimap.table import starts_of_counts


@dataclasses.dataclass(frozen=True, eq=False)
class MissionView:
    """One mission."""

    row: int
    id: str
    T_G_M: F64  # (7,)
    is_T_G_M_known: bool
    vertices: range  # rows


@dataclasses.dataclass(frozen=True, eq=False)
class VertexView:
    """One vertex."""

    row: int
    id: str
    mission: int  # row
    timestamp_ns: int
    T_M_I: F64  # (7,)
    T_G_I: F64  # (7,)
    v_M: F64  # (3,) [m/s]
    accel_bias: F64  # (3,) [m/s^2]
    gyro_bias: F64  # (3,) [rad/s]
    frames: range  # rows


@dataclasses.dataclass(frozen=True, eq=False)
class LandmarkView:
    """One landmark."""

    row: int
    id: str
    vertex: int  # row of the vertex that stores it
    p_I: F64  # (3,) in that vertex' body frame [m]
    p_G: F64  # (3,) [m]
    quality: tables.LandmarkQuality
    keypoints: NDArray[np.int64]  # rows of its observations


def mission_view(vi_map: VIMap, row: int) -> MissionView:
    """Return mission `row`; negative rows count from the end."""
    row = range(len(vi_map.missions))[row]
    baseframe = vi_map.missions.baseframe[row]
    return MissionView(
        row=row,
        id=ids.to_hex(vi_map.missions.id[row]),
        T_G_M=vi_map.baseframes.T_G_M[baseframe],
        is_T_G_M_known=bool(vi_map.baseframes.is_known[baseframe]),
        vertices=range(int(vi_map.vertex_start[row]), int(vi_map.vertex_start[row + 1])),
    )


def vertex_view(vi_map: VIMap, row: int) -> VertexView:
    """Return vertex `row`; negative rows count from the end."""
    row = range(len(vi_map.vertices))[row]
    v = vi_map.vertices
    return VertexView(
        row=row,
        id=ids.to_hex(v.id[row]),
        mission=int(v.mission[row]),
        timestamp_ns=int(v.timestamp_ns[row]),
        T_M_I=v.T_M_I[row],
        T_G_I=vi_map.T_G_I[row],
        v_M=v.v_M[row],
        accel_bias=v.accel_bias[row],
        gyro_bias=v.gyro_bias[row],
        frames=range(int(vi_map.frame_start[row]), int(vi_map.frame_start[row + 1])),
    )


def landmark_view(vi_map: VIMap, row: int) -> LandmarkView:
    """Return landmark `row`; negative rows count from the end."""
    row = range(len(vi_map.landmarks))[row]
    table, start = vi_map.landmarks, vi_map.observation_start
    return LandmarkView(
        row=row,
        id=ids.to_hex(table.id[row]),
        vertex=int(table.vertex[row]),
        p_I=table.p_I[row],
        p_G=vi_map.p_G[row],
        quality=tables.LandmarkQuality(int(table.quality[row])),
        keypoints=vi_map.observations[start[row] : start[row + 1]],
    )


@dataclasses.dataclass(frozen=True)
class MapMetadata:
    """Content of the `metadata` file of a map folder, and resource files that are not saved yet."""

    description: str = ""
    map_folder: str = ""
    resource_folder_in_use: int = -1  # -1 = the map's own
    map_resource_folder: str = "./resources/"
    external_resource_folders: tuple[str, ...] = ()
    # temporary folders among the external ones, not in the file: saving empties them into the
    # resource folder in use
    staged_folders: tuple[staged_folder.StagedFolder, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class VIMap:
    """An immutable visual-inertial map. Edits return a new map that shares columns.

    Derived look-ups (offsets, observations by landmark, id indices) are computed at first use
    and kept with the value.
    """

    sensors: SensorSet = dataclasses.field(default_factory=SensorSet)
    metadata: MapMetadata = dataclasses.field(default_factory=MapMetadata)
    missions: tables.Missions = dataclasses.field(default_factory=tables.Missions.empty)
    baseframes: tables.BaseFrames = dataclasses.field(default_factory=tables.BaseFrames.empty)
    vertices: tables.Vertices = dataclasses.field(default_factory=tables.Vertices.empty)
    frames: tables.Frames = dataclasses.field(default_factory=tables.Frames.empty)
    keypoints: tables.Keypoints = dataclasses.field(default_factory=tables.Keypoints.empty)
    landmarks: tables.Landmarks = dataclasses.field(default_factory=tables.Landmarks.empty)
    imu_edges: tables.ImuEdges = dataclasses.field(default_factory=tables.ImuEdges.empty)
    imu_samples: tables.ImuSamples = dataclasses.field(default_factory=tables.ImuSamples.empty)
    transformation_edges: tables.TransformationEdges = dataclasses.field(
        default_factory=tables.TransformationEdges.empty
    )
    loop_closure_edges: tables.LoopClosureEdges = dataclasses.field(
        default_factory=tables.LoopClosureEdges.empty
    )
    absolute_poses: tables.AbsolutePoses = dataclasses.field(
        default_factory=tables.AbsolutePoses.empty
    )
    resources: tables.Resources = dataclasses.field(default_factory=tables.Resources.empty)

    def __repr__(self) -> str:
        """Return the content of the map in one line."""
        numbers = self._contents()
        nouns = ("mission", "vertex", "landmark", "keypoint", "closure")
        pairs = zip(numbers.values(), nouns, numbers, strict=True)
        contents = ", ".join(counted(*pair) for pair in pairs)
        return f"VIMap({contents})"

    def _repr_html_(self) -> str:
        """Return the missions and the size of the map as tables, for notebooks."""
        of_mission = np.bincount(self.vertices.mission, minlength=len(self.missions))
        words = ids.to_hex_list(self.missions.id)
        missions = [
            {"mission": str(name) or word[:8], "id": word[:8], "vertices": int(count)}
            for name, word, count in zip(self.missions.name, words, of_mission, strict=True)
        ]
        return to_html(self._contents()) + (to_html(missions) if missions else "")

    def _contents(self) -> dict[str, int]:
        return {
            "missions": len(self.missions),
            "vertices": len(self.vertices),
            "landmarks": len(self.landmarks),
            "keypoints": len(self.keypoints),
            "closures": len(self.loop_closure_edges),
        }

    def replace(self, **parts: Any) -> Self:
        """Return a map with some tables exchanged and all others shared."""
        return dataclasses.replace(self, **parts)

    # -- offsets of ragged tables ---------------------------------------------------------------

    @cached_property
    def keypoint_start(self) -> NDArray[np.int64]:
        """Offsets (F + 1): keypoints of frame f are rows start[f] .. start[f + 1] - 1."""
        return starts_of_counts(self.frames.keypoint_count)

    @cached_property
    def sample_start(self) -> NDArray[np.int64]:
        """Offsets (E + 1): samples of IMU edge e are rows start[e] .. start[e + 1] - 1."""
        return starts_of_counts(self.imu_edges.sample_count)

    @cached_property
    def frame_start(self) -> NDArray[np.int64]:
        """Offsets (V + 1): frames of vertex v are rows start[v] .. start[v + 1] - 1."""
        return starts_of_counts(np.bincount(self.frames.vertex, minlength=len(self.vertices)))

    @cached_property
    def vertex_start(self) -> NDArray[np.int64]:
        """Offsets (M + 1): vertices of mission m are rows start[m] .. start[m + 1] - 1."""
        return starts_of_counts(np.bincount(self.vertices.mission, minlength=len(self.missions)))

    # -- keypoints and observations -------------------------------------------------------------

    @cached_property
    def keypoint_frame(self) -> NDArray[np.int32]:
        """Frame row of every keypoint (K,)."""
        rows = np.arange(len(self.frames), dtype=np.int32)
        return np.repeat(rows, self.frames.keypoint_count)

    @cached_property
    def keypoint_vertex(self) -> NDArray[np.int32]:
        """Vertex row of every keypoint (K,)."""
        return self.frames.vertex[self.keypoint_frame]

    @cached_property
    def binary_descriptor_size(self) -> NDArray[np.int32]:
        """Bytes (K,) of each keypoint's binary descriptor, 0 where it has none."""
        return descriptors.binary_descriptor_sizes(self.frames)

    @cached_property
    def feature_type(self) -> NDArray[np.int32]:
        """Feature type (K,) of each keypoint's descriptor, -1 where it has none."""
        return descriptors.feature_types(self.frames)

    @cached_property
    def observations(self) -> NDArray[np.int64]:
        """Keypoint rows (O,) that observe a landmark, sorted by landmark row, then keypoint row."""
        observing = np.flatnonzero(self.keypoints.landmark >= 0)
        order = np.argsort(self.keypoints.landmark[observing], kind="stable")
        return observing[order]

    @cached_property
    def observation_start(self) -> NDArray[np.int64]:
        """Offsets (L + 1) into `observations` by landmark row."""
        observed = self.keypoints.landmark[self.observations]
        return starts_of_counts(np.bincount(observed, minlength=len(self.landmarks)))

    # -- poses in G -----------------------------------------------------------------------------

    @cached_property
    def T_G_M(self) -> NDArray[np.float64]:
        """Base-frame pose of every mission (M, 7)."""
        return self.baseframes.T_G_M[self.missions.baseframe]

    @cached_property
    def T_G_I(self) -> NDArray[np.float64]:
        """Pose of every vertex in G (V, 7)."""
        return se3.compose(self.T_G_M[self.vertices.mission], self.vertices.T_M_I)

    @cached_property
    def p_G(self) -> NDArray[np.float64]:
        """Position of every landmark in G (L, 3); not finite where p_I is not."""
        with np.errstate(invalid="ignore"):  # infinite positions: the sums are not numbers
            return se3.transform(self.T_G_I[self.landmarks.vertex], self.landmarks.p_I)

    # -- ids ------------------------------------------------------------------------------------

    @cached_property
    def mission_index(self) -> ids.IdIndex:
        """Look-up of mission rows by id."""
        return ids.IdIndex(self.missions.id)

    @cached_property
    def vertex_index(self) -> ids.IdIndex:
        """Look-up of vertex rows by id."""
        return ids.IdIndex(self.vertices.id)

    @cached_property
    def landmark_index(self) -> ids.IdIndex:
        """Look-up of landmark rows by id."""
        return ids.IdIndex(self.landmarks.id)

    # -- rows as objects ------------------------------------------------------------------------

    def mission(self, row: int) -> MissionView:
        """Return one mission as an object."""
        return mission_view(self, row)

    def vertex(self, row: int) -> VertexView:
        """Return one vertex as an object."""
        return vertex_view(self, row)

    def landmark(self, row: int) -> LandmarkView:
        """Return one landmark as an object."""
        return landmark_view(self, row)

    def nbytes(self) -> int:
        """Return the memory of all tables in bytes (shared columns counted once each)."""
        values = (getattr(self, field.name) for field in dataclasses.fields(self))
        return sum(value.nbytes() for value in values if hasattr(value, "nbytes"))
