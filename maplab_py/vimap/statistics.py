"""Statistics of the content of a map, by mission."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import NDArray
from maplab_py.distinct import distinct
from maplab_py.report import Report, counted, view
from maplab_py.vimap import queries
from maplab_py.vimap.ids import distinct_prefixes, is_valid, to_hex, to_hex_list
from maplab_py.vimap.tables import Backbone, LandmarkQuality, ResourceOwner, TransformationKind
from maplab_py.vimap.vi_map import VIMap


@dataclasses.dataclass(frozen=True)
class CameraStatistics:
    """Landmarks and observations of one camera of a mission's rig."""

    camera_index: int
    frames: int
    keypoints: int
    observations: int
    landmarks_good: int  # distinct landmarks that the camera sees
    landmarks_bad: int
    landmarks_unknown: int


@dataclasses.dataclass(frozen=True)
class MissionStatistics:
    """Content of a mission."""

    id: str
    backbone: str
    T_G_M_known: bool
    vertices: int
    edges: dict[str, int]  # by kind, and by sensor where the edges name one
    loop_closure_edges: int  # with at least one end in the mission
    absolute_poses: int
    imu_samples: int
    landmarks_good: int  # stored in the mission
    landmarks_bad: int
    landmarks_unknown: int
    observations: int
    cameras: tuple[CameraStatistics, ...]
    distance_m: float = dataclasses.field(metadata={"title": "length", "unit": "m"})
    start_ns: int
    end_ns: int
    duration_s: float
    resources: int
    name: str = ""
    closures: int = 0  # recorded and accepted, with at least one end in the mission


@dataclasses.dataclass(frozen=True)
class MapTotals:
    """Content of all missions together."""

    missions: int
    vertices: int
    edges: int
    loop_closure_edges: int
    landmarks_good: int
    landmarks_bad: int
    landmarks_unknown: int
    keypoints: int
    observations: int
    distance_m: float
    duration_s: float
    resources: int


class MapStatistics(Report):
    """Report of `map_stats`."""

    missions: tuple[MissionStatistics, ...]
    total: MapTotals | None  # with more than one mission
    memory_megabytes: float

    def display(self) -> Any:
        """Return one row per mission."""
        has_unknown = any(mission.landmarks_unknown for mission in self.missions)
        ids = distinct_prefixes([mission.id for mission in self.missions])
        lines = [
            view(
                mission=mission.name or mission.id,
                id=id_,
                length_m=mission.distance_m,
                duration_s=mission.duration_s,
                vertices=mission.vertices,
                # landmarks; the summary says so, longer heads leave no room for names
                good=mission.landmarks_good,
                bad=mission.landmarks_bad,
                unknown=mission.landmarks_unknown if has_unknown else "",
                closures=mission.closures,
                known="yes" if mission.T_G_M_known else "no",
            )
            for mission, id_ in zip(self.missions, ids, strict=True)
        ]
        summary = f"{self.memory_megabytes:.1f} MB in memory"
        if self.total is not None:
            summary = (
                f"{counted(self.total.missions, 'mission')}: {self.total.distance_m:.1f} m in "
                f"{self.total.duration_s:.1f} s, "
                f"{counted(self.total.vertices, 'vertex', 'vertices')}, landmarks: "
                f"{self.total.landmarks_good} good, {self.total.landmarks_bad} bad, "
                f"{self.total.landmarks_unknown} unknown; {summary}"
            )
        return view({"missions": ""}, missions=lines, summary=summary)


class MapDetails(MapStatistics):
    """Report of `map_stats` with everything that is known of the chosen missions."""

    def display(self) -> MapDetails:
        """Return all fields."""
        return self


class CoobservabilityReport(Report):
    """Groups of missions that share landmarks."""

    missions: tuple[str, ...]
    clusters: tuple[tuple[str, ...], ...]
    shared_landmarks: tuple[tuple[int, ...], ...]  # [i][j]: landmarks that missions i and j observe

    def display(self) -> Any:
        """Return one row per mission."""
        cluster = {name: number for number, names in enumerate(self.clusters) for name in names}
        lines = []
        for row, mission in enumerate(self.missions):
            counts = self.shared_landmarks[row]
            others = sorted(
                (other for other in range(len(counts)) if other != row and counts[other]),
                key=lambda other: (-counts[other], other),
            )
            shared = ", ".join(f"{self.missions[other]}: {counts[other]}" for other in others)
            group = cluster[mission] + 1
            lines.append(
                view(
                    {"shared": "shared with"},
                    mission=mission,
                    group=group,
                    landmarks=counts[row],
                    shared=shared or "none",
                )
            )
        return view({"missions": ""}, missions=lines)


def map_statistics(vi_map: VIMap) -> MapStatistics:
    """Count the entities of a map."""
    distances, spans = queries.mission_distances_m(vi_map), queries.mission_time_spans_ns(vi_map)
    missions = tuple(
        _mission(vi_map, row, float(distances[row]), spans[row, 0], spans[row, 1])
        for row in range(len(vi_map.missions))
    )
    total = None
    if len(missions) > 1:
        total = MapTotals(
            missions=len(missions),
            vertices=len(vi_map.vertices),
            edges=len(vi_map.imu_edges) + len(vi_map.transformation_edges),
            loop_closure_edges=len(vi_map.loop_closure_edges),
            **_by_quality(vi_map.landmarks.quality),
            keypoints=len(vi_map.keypoints),
            observations=len(vi_map.observations),
            distance_m=float(distances.sum()),
            duration_s=sum(mission.duration_s for mission in missions),
            resources=len(vi_map.resources),
        )
    return MapStatistics(missions, total, vi_map.nbytes() / 2**20)


def coobservability(vi_map: VIMap) -> CoobservabilityReport:
    """Group missions that observe common landmarks."""
    names = to_hex_list(vi_map.missions.id)
    label = queries.mission_clusters(vi_map)
    clusters = tuple(
        tuple(names[row] for row in np.flatnonzero(label == value)) for value in np.unique(label)
    )
    counts = queries.coobservation_counts(vi_map).tolist()
    return CoobservabilityReport(tuple(names), clusters, tuple(tuple(row) for row in counts))


def _mission(
    vi_map: VIMap, row: int, distance_m: float, start_ns: int, end_ns: int
) -> MissionStatistics:
    of_vertex = vi_map.vertices.mission == row
    stored = of_vertex[vi_map.landmarks.vertex]
    imu, loops = vi_map.imu_edges, vi_map.loop_closure_edges
    of_imu = of_vertex[imu.from_vertex]
    cameras = _cameras(vi_map, row)
    resources = vi_map.resources
    by_frame = resources.owner_kind == ResourceOwner.FRAME
    frame_mission = vi_map.vertices.mission[vi_map.frames.vertex]
    owned = np.where(by_frame, -1, resources.owner) == row
    owned[by_frame] = frame_mission[resources.owner[by_frame]] == row
    return MissionStatistics(
        id=to_hex(vi_map.missions.id[row]),
        backbone=Backbone(int(vi_map.missions.backbone[row])).name.lower(),
        T_G_M_known=bool(vi_map.baseframes.is_known[vi_map.missions.baseframe[row]]),
        vertices=int(of_vertex.sum()),
        edges=_edge_counts(vi_map, row),
        loop_closure_edges=int(
            np.count_nonzero(of_vertex[loops.from_vertex] | of_vertex[loops.to_vertex])
        ),
        absolute_poses=int(np.count_nonzero(of_vertex[vi_map.absolute_poses.vertex])),
        imu_samples=int(imu.sample_count[of_imu].sum()),
        **_by_quality(vi_map.landmarks.quality[stored]),
        observations=sum(camera.observations for camera in cameras),
        cameras=cameras,
        distance_m=distance_m,
        start_ns=int(start_ns),
        end_ns=int(end_ns),
        duration_s=float(end_ns - start_ns) * 1e-9,
        resources=int(np.count_nonzero(owned)),
        name=str(vi_map.missions.name[row]),
    )


def _by_quality(quality: NDArray[np.int8]) -> dict[str, int]:
    """Return the fields with the numbers of landmarks of each quality."""
    counts = np.bincount(quality, minlength=len(LandmarkQuality))
    return {f"landmarks_{kind.name.lower()}": int(counts[kind]) for kind in LandmarkQuality}


def _edge_counts(vi_map: VIMap, row: int) -> dict[str, int]:
    of_vertex = vi_map.vertices.mission == row
    counts = {"imu": int(np.count_nonzero(of_vertex[vi_map.imu_edges.from_vertex]))}
    edges = vi_map.transformation_edges.take(of_vertex[vi_map.transformation_edges.from_vertex])
    for kind in TransformationKind:
        of_kind = edges.take(edges.kind == kind)
        for words in np.unique(of_kind.sensor_id, axis=0):
            name = kind.name.lower() + (f" {to_hex(words)}" if is_valid(words) else "")
            counts[name] = int(np.count_nonzero(np.all(of_kind.sensor_id == words, axis=1)))
    return counts


def _cameras(vi_map: VIMap, row: int) -> tuple[CameraStatistics, ...]:
    of_mission = vi_map.vertices.mission[vi_map.frames.vertex] == row
    index = vi_map.frames.camera_index
    cameras = []
    for camera in np.unique(index[of_mission]).tolist():
        chosen = of_mission & (index == camera)
        landmark = vi_map.keypoints.landmark[chosen[vi_map.keypoint_frame]]
        observing = landmark[landmark >= 0]
        cameras.append(
            CameraStatistics(
                camera_index=camera,
                frames=int(np.count_nonzero(chosen)),
                keypoints=len(landmark),
                observations=len(observing),
                **_by_quality(vi_map.landmarks.quality[distinct(observing)]),
            )
        )
    return tuple(cameras)
