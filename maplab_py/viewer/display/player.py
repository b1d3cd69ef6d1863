"""The time slider: the map grows in the order in which it was recorded.

Each step adds a separate node, made once; moving the slider shows and hides nodes,
which costs a few bytes per step however large the map is.
"""

from typing import Any

import numpy as np
import viser

from maplab_py.array_types import I64
from maplab_py.geometry import se3
from maplab_py.viewer import colours, playback
from maplab_py.viewer.display.parts import add_part
from maplab_py.viewer.drawing import Drawing, make_points, make_segments, rows_by_value, spread_rows
from maplab_py.viewer.layers import cameras, landmarks
from maplab_py.viewer.layers.clouds import Cloud, cloud_colours, colour_ranges
from maplab_py.viewer.options import PlaybackOptions
from maplab_py.viewer.scene import Part


class Player:
    """The nodes of one playback."""

    def __init__(
        self,
        server: viser.ViserServer,
        drawing: Drawing,
        missions: set[str],
        options: PlaybackOptions,
        clouds: tuple[Cloud, ...] = (),
    ) -> None:
        """Send the nodes of all steps, hidden.

        Args:
            clouds: Dense clouds, each shown from the vertex on at which it was recorded.
        """
        self._server = server
        self._drawing = drawing
        self._fades = options.landmark_fadeout
        self.timeline: playback.Timeline = playback.make_timeline(drawing, options)
        self._plays = np.array([m in missions for m in drawing.mission_ids], dtype=np.bool_)
        self._recent: list[Any] = []
        self.step = -1
        with server.atomic():
            self._chunks: dict[int, list[Any]] = {}  # hidden nodes by step
            self._add_steps()
            self._add_clouds(clouds)
            self._heads = self._make_heads()

    def go(self, step: int) -> None:
        """Show the map as it was after a step."""
        before, self.step = self.step, step
        with self._server.atomic():
            low, high = min(before, step) + 1, max(before, step) + 1
            for number in range(low, high):
                for handle in self._chunks.get(number, ()):
                    handle.visible = step > before
            self._place_heads(step)
            if self._fades:
                self._show_recent(step)

    def missions(self) -> I64:
        """Return the rows of the missions that are played and have vertices."""
        counts = np.diff(self._drawing.vi_map.vertex_start)
        return np.flatnonzero(self._plays & (counts > 0))

    def head(self, mission: int = -1) -> int:
        """Return the vertex (row) that a mission, -1 = the first, has reached; -1 = none."""
        if mission < 0:
            played = self.missions()
            if not len(played):
                return -1
            mission = int(played[0])
        return int(self.timeline.head[self.step, mission])

    def note(self) -> str:
        """Return the words beside the slider."""
        timeline = self.timeline
        shown = int(np.count_nonzero(timeline.vertex_step <= self.step))
        return f"{timeline.seconds[self.step]:.1f} s, {shown:,} of {len(timeline.vertex_step):,} vertices"

    def remove(self) -> None:
        """Take all nodes away."""
        with self._server.atomic():
            for handles in (*self._chunks.values(), *self._heads.values(), self._recent):
                for handle in handles:
                    handle.remove()
        self._chunks, self._heads, self._recent = {}, {}, []

    def _add_hidden(self, step: int, name: str, part: Part) -> None:
        for handle in add_part(self._server, f"/play/{step}/{name}", part):
            handle.visible = False
            self._chunks.setdefault(step, []).append(handle)

    def _add_steps(self) -> None:
        """Add the piece of the paths, and the landmarks, of each step."""
        drawing, timeline = self._drawing, self.timeline
        mission = drawing.vi_map.vertices.mission
        start = np.flatnonzero((mission[1:] == mission[:-1]) & self._plays[mission[1:]])
        paths = rows_by_value(timeline.vertex_step[start + 1], start)
        rows = timeline.landmarks[self._plays[drawing.landmark_mission[timeline.landmarks]]]
        clouds = rows_by_value(timeline.landmark_step[rows], rows)
        every, _ = landmarks.landmark_colours(drawing)
        p = drawing.p_vertices
        for step, members in paths.items():
            colour, ends = drawing.mission_colours[mission[members]], (p[members], p[members + 1])
            self._add_hidden(step, "path", make_segments(*ends, colour, members, 3.0))
        for step, members in clouds.items():
            size_m, p_L = landmarks.point_size(drawing), drawing.p_landmarks[members]
            self._add_hidden(step, "landmarks", make_points(p_L, every[members], members, size_m))

    def _add_clouds(self, clouds: tuple[Cloud, ...]) -> None:
        total = max(sum(len(cloud.p_G) for cloud in clouds), 1)
        limit = self._drawing.options.max_points
        ranges = colour_ranges(clouds)
        for number, cloud in enumerate(clouds):
            if cloud.faces is not None:
                continue
            step = 0 if cloud.vertex < 0 else int(self.timeline.vertex_step[cloud.vertex])
            p = cloud.p_G - self._drawing.origin_G
            rows = spread_rows(p, max(1, limit * len(p) // total))
            size = 0.9 * self._drawing.unit_m / np.sqrt(max(min(total, limit), 1_000))
            part = make_points(p[rows], cloud_colours(cloud, ranges)[rows], rows, size)
            self._add_hidden(step, f"cloud_{number}", part)

    def _make_heads(self) -> dict[int, list[Any]]:
        """Make the camera, or a dot, that travels along each mission."""
        drawing = self._drawing
        heads: dict[int, list[Any]] = {}
        for mission in np.flatnonzero(self._plays).tolist():
            colour = drawing.mission_colours[mission]
            name = f"/play/head/{drawing.mission_ids[mission]}"
            lines = [
                se3.transform(
                    camera.T_I_C, cameras.frustum_points(camera.camera, 0.06 * drawing.unit_m)
                )[cameras.FRUSTUM_EDGES]
                for camera in cameras.mission_cameras(drawing.vi_map, mission)
            ]
            if lines:
                ends = np.concatenate(lines)
                part = make_segments(ends[:, 0], ends[:, 1], colour, np.arange(len(ends)), 2.5)
                heads[mission] = add_part(self._server, name, part)
                continue
            dot = make_points(np.zeros((1, 3)), colour, np.array([0]), 0.02 * drawing.unit_m)
            heads[mission] = add_part(self._server, name, dot)
        return heads

    def _place_heads(self, step: int) -> None:
        for mission, handles in self._heads.items():
            row = int(self.timeline.head[step, mission])
            for handle in handles:
                handle.visible = row >= 0
                if row >= 0:
                    handle.wxyz = self._drawing.vi_map.T_G_I[row, [3, 0, 1, 2]]
                    handle.position = self._drawing.p_vertices[row]

    def _show_recent(self, step: int) -> None:
        for handle in self._recent:
            handle.remove()
        rows, age = self.timeline.recent(self._drawing, step)
        keep = self._plays[self._drawing.landmark_mission[rows]]
        keep &= self._drawing.vi_map.landmarks.quality[rows] != 1
        rows, age = rows[keep], age[keep]
        base = np.broadcast_to(colours.REFERENCE, (len(rows), 3))
        glow = age[:, None] * base + (1.0 - age[:, None]) * colours.PICKED
        part = make_points(
            self._drawing.p_landmarks[rows],
            glow.astype(np.uint8),
            rows,
            1.6 * landmarks.point_size(self._drawing),
        )
        self._recent = add_part(self._server, "/play/recent", part)
