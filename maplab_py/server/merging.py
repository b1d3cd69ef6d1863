"""Merge one prepared submap after the other into a map, and optimise what it touches.

A submap is appended to its mission, or begins it. Then the parts of the map that look most like it and
those nearest to it are searched: a mission of unknown base frame is anchored, loops are closed. Last
the new vertices and what they touch are optimised, everything else is held fixed. All of this works
on excerpts of bounded size. A joint optimisation closes the loops of the whole map and optimises it.
"""

import contextlib
import dataclasses
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.loop_closure.features import PlaceIndex, ProjectionMemory, SearchScope
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.algorithms.pose_graph_manipulation.layout import LayoutOptions, distribute_missions
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.algorithms.vi_optimization.local import LocalReport, optimize_around
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.errors import EstimationError
from maplab_py.progress import SILENT, Progress
from maplab_py.server import alignments, spool
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.vimap import IdArray, VIMap, excerpts, from_hex, merge, submaps, to_hex, to_hex_list

_LOCAL_ITERATIONS, _LOCAL_TOLERANCE = 10, 1e-3
"""Limits of a local optimisation: its vertices are optimised again with the next submaps, and jointly."""


@dataclasses.dataclass(frozen=True)
class Stretch:
    """The part of a mission that a submap brought."""

    mission: str  # id
    first_ns: int
    last_ns: int

    def vertices(self, vi_map: VIMap) -> I64:
        """Return its vertices (rows); none where the mission is not in the map any more."""
        row = int(vi_map.mission_index.rows(from_hex(self.mission)[None])[0])
        v = vi_map.vertices
        inside = (v.timestamp_ns >= self.first_ns) & (v.timestamp_ns <= self.last_ns)
        return np.flatnonzero(inside & (v.mission == row)) if row >= 0 else np.zeros(0, np.int64)

    def is_in(self, vi_map: VIMap) -> bool:
        """Tell whether a map has both ends; neighbours in the map would bring one of them each."""
        times_ns = vi_map.vertices.timestamp_ns[self.vertices(vi_map)]
        return self.first_ns in times_ns and self.last_ns in times_ns


def stretches_of(submap: VIMap) -> list[Stretch]:
    """Return the stretch of each mission of a submap."""
    result = []
    for row, mission in enumerate(to_hex_list(submap.missions.id)):
        times_ns = submap.vertices.timestamp_ns[submap.vertices.mission == row]
        result.append(Stretch(mission, int(times_ns.min()), int(times_ns.max())))
    return result


@dataclasses.dataclass(frozen=True)
class MergeSteps:
    """Outcome of a submap, and the processor time [s] of each step."""

    anchored: tuple[str, ...]  # missions
    landmarks_merged: int
    free_vertices: int
    fixed_vertices: int
    joint_is_due: bool  # a loop or a mission needs a joint optimisation
    seconds: dict[str, float]
    note: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class _NewPart:
    """Contents of a submap, and the scope of its search for loops."""

    stretches: list[Stretch]  # of its missions
    rows: I64  # its vertices in the map
    part: excerpts.Excerpt  # they and their surroundings
    searched: list[int]  # numbers of the submaps in the part, the new ones last
    frequencies: F64  # of the words (W,) of the submap


@dataclasses.dataclass(frozen=True)
class _ClosedLoops:
    """Outcome of the loops of a submap."""

    landmarks_merged: int = 0  # landmarks that became one
    has_large_gap: bool = False  # some do not meet: a joint optimisation is needed
    note: str = ""  # why no loops could be looked for


class Merger:
    """Merges submaps into a map; see the module."""

    def __init__(
        self,
        merging: MergingOptions,
        incremental: IncrementalOptions,
        *,
        map_folder: Path | None = None,
    ) -> None:
        """Start without a map.

        Args:
            merging: How submaps become one map.
            incremental: How much is looked at.
            map_folder: Where the map is published, for its clouds; None = clouds are not looked at.
        """
        self.vi_map: VIMap | None = None  # the map; None before the first submap
        # note: what the last joint optimisation had to leave out
        # radius: trust region of the last joint optimisation; 0 = the default
        self.radius, self.note = 0.0, ""
        self._map_folder = map_folder
        self._merging, self._incremental = merging, incremental
        self._loops = LoopClosureOptions()
        self._optimization = VIOptimizationOptions(
            hide_iterations_console_output=True, include_absolute_pose_constraints=True
        )
        self._places = PlaceIndex()
        self._projections = ProjectionMemory()
        self._stretches: list[Stretch] = []
        self._open_alignments = alignments.OpenAlignments()

    def restore(self, vi_map: VIMap, stretches: list[Stretch]) -> None:
        """Continue with a map that has been merged from some submaps."""
        self.vi_map, self._places, self._stretches = vi_map, PlaceIndex(), []
        self._open_alignments = alignments.OpenAlignments()
        for stretch in stretches:
            rows = stretch.vertices(vi_map)
            if len(rows):
                self._remember(stretch, excerpts.excerpt(vi_map, rows).vi_map)

    def add(self, submap: VIMap, *, progress: Progress = SILENT) -> MergeSteps:
        """Merge a submap.

        Raises:
            MapError: It does not fit the map; see `append_submap`. The map is as before.
            EstimationError: The optimisation failed. The map is as before.
            Cancelled: The map is as before.
        """
        clock = _Clock()
        whole = self._append(submap)
        clock.lap("append")
        new = self._surroundings(whole, submap)
        pairs = self._open_alignments.copy()
        edited, anchored, joint_is_due = self._anchor(
            new.part.vi_map, progress, pairs, new.searched
        )
        clock.lap("anchor")
        edited, loops = self._with_loops(edited, new, anchored, progress)
        whole = new.part.written_back(edited)
        clock.lap("close loops")
        waiting = pairs.take(anchored, self._incremental.similar_stretches)
        known_stretches = [*self._stretches, *new.stretches]
        whole, others = self._anchored_through(whole, waiting, known_stretches, progress)
        clock.lap("anchor others")
        whole, local = self._optimized_around(whole, new.rows, progress)
        clock.lap("optimise")
        self.vi_map, self._open_alignments = self._lay_out(whole), pairs
        is_whole = len(new.stretches) == 1 and self._places.is_trained
        for stretch in new.stretches:
            self._remember(stretch, submap, new.frequencies if is_whole else None)
        return MergeSteps(
            (*anchored, *others),
            loops.landmarks_merged,
            local.free_vertices,
            local.fixed_vertices,
            joint_is_due or loops.has_large_gap or bool(others),
            clock.seconds,
            loops.note,
        )

    def optimize_jointly(self, *, progress: Progress = SILENT) -> float:
        """Anchor, close the loops of the whole map and optimise it.

        Returns:
            The largest move of a vertex that was anchored before [m].

        Raises:
            EstimationError: The optimisation failed. The map is as before.
            Cancelled: The map is as before.
        """
        before = self.vi_map
        if before is None:
            return 0.0
        vi_map, _ = evaluate_quality(before, LandmarkQualityOptions())
        vi_map, _, _ = self._anchor(vi_map, progress)
        options, notes = self._optimization, [""]
        if self._merging.enable_visual_loop_closure:
            vi_map, notes[0] = self._with_all_loops(vi_map, progress)
        if self._merging.enable_lidar_loop_closure and self._map_folder is not None:
            vi_map, note = alignments.with_cloud_loops(vi_map, self._map_folder, progress)
            notes.append(note)
            options = dataclasses.replace(options, include_loop_closure_edges=True)
        if self.radius > 0.0 and self._merging.preserve_trust_region_radius_across_merging:
            options = dataclasses.replace(options, initial_trust_region_radius=self.radius)
        self.note = "; ".join(filter(None, notes))
        vi_map, report = optimize(vi_map, options, progress=progress)
        self.vi_map, self.radius = vi_map, report.trust_region_radius
        known = before.baseframes.is_known[before.missions.baseframe][before.vertices.mission]
        moved_m = np.linalg.norm(vi_map.T_G_I[:, 4:] - before.T_G_I[:, 4:], axis=1)
        return float(moved_m[known].max(initial=0.0))

    def _append(self, submap: VIMap) -> VIMap:
        base = self.vi_map
        if base is None:
            is_known = np.zeros(len(submap.baseframes), dtype=np.bool_)
            if self._merging.set_first_robot_map_baseframe_to_known:
                is_known[submap.missions.baseframe[0]] = True
            return submap.replace(
                baseframes=submap.baseframes.replace(is_known=is_known | _place(submap))
            )
        if (base.mission_index.rows(submap.missions.id) >= 0).any():
            return spool.with_resources_taken_in(submaps.append_submap(base, submap)[0], submap)
        frames = submap.baseframes.replace(is_known=_place(submap))
        whole, _ = merge.merge_maps(base, submap.replace(baseframes=frames))
        return spool.with_resources_taken_in(whole, submap)

    def _similar(self, frequencies: F64) -> list[int]:
        """Return the numbers of the submaps that look most like one of some word frequencies (W,)."""
        if not self._merging.enable_visual_loop_closure:
            return []
        numbers = self._places.similar(frequencies, self._incremental.similar_stretches)
        return numbers.tolist()  # type: ignore[no-any-return]

    def _surroundings(self, whole: VIMap, submap: VIMap) -> _NewPart:
        """Return the new vertices with the part of the map in which their loops are looked for."""
        stretches = stretches_of(submap)
        rows = np.unique(np.concatenate([s.vertices(whole) for s in stretches]))
        frequencies = self._places.frequencies(submap)
        similar, known = self._similar(frequencies), len(self._stretches)
        part = excerpts.excerpt(whole, self._searched_vertices(whole, rows, similar))
        searched = [*similar, *range(known, known + len(stretches))]
        return _NewPart(stretches, rows, part, searched, frequencies)

    def _searched_vertices(self, whole: VIMap, rows: I64, similar: Sequence[int]) -> Mask:
        """Return the vertices (V,) in which loops with new ones (rows) are looked for."""
        result = mask_of(len(whole.vertices), rows)
        if not self._merging.enable_visual_loop_closure:
            return result
        for number in similar:
            result[self._stretches[number].vertices(whole)] = True
        mission = whole.vertices.mission
        known = whole.baseframes.is_known[whole.missions.baseframe]
        touched = np.unique(mission[result])
        result |= np.isin(mission, touched[~known[touched]])  # unanchored missions as a whole
        if known[mission[rows]].all():
            result |= _nearest(whole.T_G_I[:, 4:], rows, known[mission], self._incremental)
        return result

    def _with_loops(
        self, edited: VIMap, new: _NewPart, anchored: Sequence[str], progress: Progress
    ) -> tuple[VIMap, _ClosedLoops]:
        """Close the loops of new vertices, and of missions that have just been anchored (ids).

        Loops between older vertices were looked for when the later of them came.
        """
        is_alone = len(new.part.vertices) == len(new.rows)
        if is_alone or not self._merging.enable_visual_loop_closure:
            return edited, _ClosedLoops()
        asked = np.isin(new.part.vertices, new.rows)
        for mission in edited.mission_index.rows(_ids(anchored)):
            asked |= edited.vertices.mission == mission
        scope = SearchScope(asked, self._projections)
        try:
            edited, report = close_loops(edited, self._loops, scope=scope, progress=progress)
        except EstimationError as error:
            return edited, _ClosedLoops(note=str(error))
        has_large_gap = _has_large_gap(report.merges_refused)
        return edited, _ClosedLoops(report.landmarks_merged, has_large_gap)

    def _optimized_around(
        self, whole: VIMap, rows: I64, progress: Progress
    ) -> tuple[VIMap, LocalReport]:
        """Optimise new vertices (rows) and what they touch."""
        options = dataclasses.replace(
            self._optimization,
            num_iterations=_LOCAL_ITERATIONS,
            function_tolerance=_LOCAL_TOLERANCE,
        )
        return optimize_around(
            whole,
            rows,
            options,
            max_free=self._incremental.local_free_vertices,
            max_fixed=self._incremental.local_fixed_vertices,
            progress=progress,
        )

    def _lay_out(self, whole: VIMap) -> VIMap:
        """Set missions that are not anchored apart from the others."""
        if not self._merging.spatially_distribute_missions:
            return whole
        return distribute_missions(whole, LayoutOptions())[0]

    def _anchor(
        self,
        vi_map: VIMap,
        progress: Progress,
        pairs: alignments.OpenAlignments | None = None,
        searched: Sequence[int] = (),
    ) -> tuple[VIMap, tuple[str, ...], bool]:
        """Anchor what can be; also tell whether one of the missions has several submaps.

        Args:
            vi_map: The part of the map in which submaps (numbers `searched`) are compared.
            pairs: Gets the pairs of missions that are aligned and not anchored.
            searched: Their submaps.
        """
        known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
        is_wanted = self._merging.enable_visual_loop_closure_based_map_anchoring
        if not is_wanted or known.all() or not known.any():
            return vi_map, (), False
        try:
            result, report = anchor_missions(
                vi_map, loop_options=self._loops, projections=self._projections, progress=progress
            )
        except EstimationError:  # no descriptors or too few tracks: it stays unknown
            return vi_map, (), False
        names = {id_[:8]: id_ for id_ in map(to_hex, vi_map.missions.id)}
        if pairs is not None:
            pairs.note(report, names, searched)
        anchored = tuple(names[name] for name in report.anchored)
        known_stretches = [stretch.mission for stretch in self._stretches]
        return result, anchored, any(known_stretches.count(id_) > 0 for id_ in anchored)

    def _anchored_through(
        self,
        whole: VIMap,
        waiting: Mapping[str, set[int]],
        stretches: Sequence[Stretch],
        progress: Progress,
    ) -> tuple[VIMap, tuple[str, ...]]:
        """Anchor missions that were aligned before with missions that have just been anchored.

        Args:
            whole: The map.
            waiting: The missions, with the numbers of the submaps that showed the alignments.
            stretches: All submaps by number.
        """
        if not waiting:
            return whole, ()
        searched = sorted(set().union(*waiting.values()))
        rows = [stretches[number].vertices(whole) for number in searched]
        missions = whole.mission_index.rows(_ids(waiting))
        inside = np.isin(whole.vertices.mission, missions)
        inside[np.concatenate(rows)] = True
        part = excerpts.excerpt(whole, inside)
        edited, anchored, _ = self._anchor(part.vi_map, progress)
        return (part.written_back(edited) if anchored else whole), anchored

    def _with_all_loops(self, vi_map: VIMap, progress: Progress) -> tuple[VIMap, str]:
        """Close the loops of the whole map; also return why there are none to look for."""
        try:
            closed, report = close_loops(vi_map, self._loops, progress=progress)
            if not _has_large_gap(report.merges_refused):
                return closed, ""
            edges = search_loops(vi_map, self._loops, progress=progress)[0].edges
            relaxed, _ = relax(vi_map, RelaxationOptions(), loop_closures=edges, progress=progress)
            return close_loops(relaxed, self._loops, progress=progress)[0], ""
        except EstimationError as error:
            return vi_map, f"no loops were closed: {error}"

    def _remember(self, stretch: Stretch, submap: VIMap, frequencies: F64 | None = None) -> None:
        """Make a stretch known to place recognition; its word frequencies (W,) may be given."""
        if not self._places.is_trained:
            with contextlib.suppress(EstimationError):  # another submap will have enough tracks
                self._places.train(submap)
        self._stretches.append(stretch)
        if frequencies is None:
            frequencies = self._places.frequencies(submap, stretch.vertices(submap))
        self._places.add(frequencies)


def _ids(names: Iterable[str]) -> IdArray:
    """Return the words (N, 2) of ids."""
    words = [from_hex(name) for name in names]
    return np.stack(words) if words else np.zeros((0, 2), dtype=np.uint64)


def _place(vi_map: VIMap) -> Mask:
    """Return which base frames (B,) absolute poses determine."""
    result = np.zeros(len(vi_map.baseframes), dtype=np.bool_)
    mission = vi_map.vertices.mission[vi_map.absolute_poses.vertex]
    result[vi_map.missions.baseframe[np.unique(mission)]] = True
    return result


def _nearest(p_G: F64, rows: I64, wanted: Mask, options: IncrementalOptions) -> Mask:
    """Return the wanted vertices (V,) that are nearest to some vertices (rows)."""
    from scipy.spatial import KDTree

    result = np.zeros(len(p_G), dtype=np.bool_)
    others = np.flatnonzero(wanted & ~np.isin(np.arange(len(p_G)), rows))
    if len(others) and options.near_vertices:
        distance, _ = KDTree(p_G[rows]).query(p_G[others])
        result[others[np.argsort(distance, kind="stable")[: options.near_vertices]]] = True
    return result


def _has_large_gap(refused: dict[str, int]) -> bool:
    from maplab_py.algorithms.loop_closure.reports import GAP

    return GAP in refused


class _Clock:
    """Processor time of this process by step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, name: str) -> None:
        now = time.process_time()
        self.seconds[name] = now - self._last
        self._last = now
