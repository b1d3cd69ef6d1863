"""The cameras of the viewer's pages."""

from collections import deque
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.layers.cameras import mission_cameras
from maplab_py.viewer.scene import Extent

FIELD_OF_VIEW_RAD = float(np.radians(45.0))
_ELEVATIONS_DEG = {"overview": 38.0, "top": 89.9, "side": 8.0}
VIEWS = tuple(_ELEVATIONS_DEG)
FREE, BEHIND, INSIDE = "free", "ride behind", "through the camera"
RIDES = (FREE, BEHIND, INSIDE)
"""Camera mode of a page for a mission that is played."""
_ASPECT = 1.35
"""Width by height that a view of everything is sure to fit."""
_MARGIN = 1.09
_FREE = 0.74
"""Part of a page's width that the panel leaves free."""
_FREE_HEIGHT = 0.58
"""Part of a phone's height that the sheet at its lower edge leaves free."""
_PANEL, _PHONE = 0.38, 0.65
"""Width of the panel by the height of a page; width by height up to which a page has a sheet instead.

Pages tell their size in pixels of the device, which differ; so only its form counts.
"""
Window = tuple[float, float, float]
"""Width by height of a page, and the parts of both that are free."""
View = tuple[F64, F64]
"""Position (3,) and target (3,) of a camera."""
_WIDE: Window = (_ASPECT, _FREE, 1.0)
_GIVEN = 64
"""Views of late that pages were given."""
_LEAST_FAR_M = 100.0
"""Distance up to which pages show a map that has just begun: they may be moved before it grows."""
_LEAST_SHARE, _ROOM = 0.65, 1.1
"""Share of the picture below which a map is moved closer to; room that a map gets to grow."""


def view_of(
    extent: Extent,
    view: str = "overview",
    *,
    beside_panel: bool = False,
    room: float = 1.0,
    window: Window = _WIDE,
) -> View:
    """Return camera position (3,) and target (3,) that just show the whole outline; z is up.

    The overview and the view from the side look across the longest direction of the map.

    Args:
        view: One of `VIEWS`.
        beside_panel: Leave the part of the page free that the panel covers.
        room: Width of the picture by that of the outline.
        window: Form of the page.
    """
    azimuth = _across(extent.outline)
    if view == "overview":
        azimuth -= np.radians(22.0)
    elevation = np.radians(_ELEVATIONS_DEG[view])
    back = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    p = (extent.outline - extent.centre) @ axes.T
    half = np.tan(0.5 * FIELD_OF_VIEW_RAD) * np.array([window[0], 1.0])
    free = np.array(window[1:]) if beside_panel else np.ones(2)
    tangent = half * free / (_MARGIN * room)
    middle = 0.5 * (p[:, :2].min(axis=0) + p[:, :2].max(axis=0))
    for _ in range(3):  # near points need more room: centre what is seen, not what is there
        distance = _distance(p, middle, tangent)
        seen = (p[:, :2] - middle) / (distance - p[:, 2:])
        middle = middle + 0.5 * distance * (seen.min(axis=0) + seen.max(axis=0))
    distance = max(_distance(p, middle, tangent), 0.2 * extent.radius_m)
    middle = middle + distance * (1.0 - free) * half * [1.0, -1.0]
    target = extent.centre + middle @ axes[:2]
    return target + distance * back, target


def _distance(p: F64, middle: F64, tangent: F64) -> float:
    """Return from how far points (N, 3), right, up and back, fit into the opening (2,)."""
    return max(float((np.abs(p[:, :2] - middle) / tangent + p[:, 2:]).max()), 0.01)


def _across(outline: F64) -> float:
    """Return the direction [rad] from which the outline (N, 3) is widest, on the side of -y."""
    flat = outline[:, :2] - outline[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(flat.T @ flat + 1e-12 * np.eye(2))
    normal = axes[:, 0] if axes[1, 0] <= 0.0 else -axes[:, 0]
    return float(np.arctan2(normal[1], normal[0]))


def share_of_picture(extent: Extent, position: F64, target: F64, window: Window = _WIDE) -> float:
    """Return the share of the free part of a page that the outline spans; infinite if it is not all seen."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    p = (extent.outline - position) @ np.stack([right, np.cross(back, right), back]).T
    if (p[:, 2] >= 0.0).any():
        return np.inf
    tangent = np.tan(0.5 * FIELD_OF_VIEW_RAD)
    aspect, *free = window
    seen = p[:, :2] / (-p[:, 2:] * tangent * np.array([aspect, 1.0]))
    seen = (seen + (1.0 - np.array(free)) * [1.0, -1.0]) / free
    if (np.abs(seen) > 1.0).any():
        return np.inf
    return float(0.5 * np.ptp(seen, axis=0).max())


class Cameras:
    """The cameras of open pages: those that nobody has moved keep the whole map in their picture."""

    def __init__(self, server: Any) -> None:
        """Start with a server that shows nothing yet."""
        self._server = server
        self._view: View = (np.array([0.0, -1.0, 1.0]), np.zeros(3))  # of new pages
        self._given: deque[View] = deque([self._view], _GIVEN)
        self._newest: dict[int, tuple[View, Window]] = {}  # that pages were given, by their id
        self._extent: Extent | None = None
        server.on_client_connect(self._open)

    def show_all(self, extent: Extent) -> None:
        """Let all pages, and those that will be opened, see everything."""
        self._extent = extent
        self._set_view(extent, room=1.0)
        for client in self._server.get_clients().values():
            self._fit(client, extent, room=1.0)

    def keep_in_view(self, extent: Extent) -> None:
        """Move cameras, unless the user has, when the map outgrows their picture or is small in it."""
        self._extent = extent
        if not _is_well_seen(extent, self._view, _WIDE):
            self._set_view(extent, room=_ROOM)
        clients = self._server.get_clients()
        self._newest = {key: each for key, each in self._newest.items() if key in clients}
        for key, client in clients.items():
            if key in self._newest and _is_well_seen(extent, *self._newest[key]):
                continue
            _set_planes(client.camera, extent)
            if self._is_unmoved(client):
                self._fit(client, extent, room=_ROOM)

    def aim_new_pages(self, extent: Extent) -> None:
        """Let pages that will be opened look as those do that nobody has moved."""
        aim_initially(self._server.initial_camera, extent, self._view)

    def _is_unmoved(self, client: Any) -> bool:
        """Tell whether a page looks from where it was put, or was put before: slow pages tell it late."""
        position = np.asarray(client.camera.position)
        newest, _ = self._newest.get(client.client_id, (self._view, _WIDE))
        return any(
            np.linalg.norm(position - given) < 0.01 * np.linalg.norm(given - target)
            for given, target in (newest, *self._given)
        )

    def _set_view(self, extent: Extent, room: float) -> None:
        self._view = view_of(extent, beside_panel=True, room=room)
        self._given.append(self._view)
        self.aim_new_pages(extent)

    def _open(self, client: Any) -> None:
        """Fit the map into a page, and again when its form changes."""
        form = [_WIDE]

        def fit_again(camera: Any) -> None:
            window = window_of(camera)
            if abs(window[0] - form[0][0]) > 0.01 and self._is_unmoved(client):
                form[0] = window
                if self._extent is not None:
                    self._fit(client, self._extent, room=1.0)

        fit_again(client.camera)
        client.camera.on_update(fit_again)

    def _fit(self, client: Any, extent: Extent, room: float) -> None:
        """Let a page see everything beside its panel."""
        window = window_of(client.camera)
        view = view_of(extent, beside_panel=True, room=room, window=window)
        with client.atomic():
            _look(client.camera, extent, view)
        self._given.append(view)
        self._newest[client.client_id] = view, window


def _is_well_seen(extent: Extent, view: View, window: Window) -> bool:
    return _LEAST_SHARE <= share_of_picture(extent, *view, window) <= 1.0


def window_of(camera: Any) -> Window:
    """Return the form of a page."""
    aspect = float(camera.aspect)
    if not aspect > 0.0:
        return _WIDE  # a page that is folded away tells no form
    if aspect <= _PHONE:
        return aspect, 1.0, _FREE_HEIGHT
    return aspect, 1.0 - _PANEL / aspect, 1.0


def aim(camera: Any, extent: Extent, view: str = "overview", *, beside_panel: bool = True) -> None:
    """Point the camera of a page."""
    window = window_of(camera) if beside_panel else _WIDE
    _look(camera, extent, view_of(extent, view, beside_panel=beside_panel, window=window))


def _look(camera: Any, extent: Extent, view: View) -> None:
    position, target = view
    camera.up_direction = (0.0, 0.0, 1.0)
    camera.position = position
    camera.look_at = target
    camera.fov = FIELD_OF_VIEW_RAD
    _set_planes(camera, extent)


def approach(camera: Any, p: F64, distance_m: float) -> None:
    """Look at a point (3,) of the scene from a distance, in the direction of the present view."""
    back = np.asarray(camera.position) - np.asarray(camera.look_at)
    length = float(np.linalg.norm(back))
    back = back / length if length > 1e-9 else np.array([0.0, -0.8, 0.6])
    camera.position = p + distance_m * back
    camera.look_at = p


def ride(camera: Any, drawing: Drawing, vertex: int, how: str) -> None:
    """Move the camera of a page along with a vertex (row), behind it or where its camera is.

    It looks where the first camera of the mission looks; without cameras where the path leads.
    """
    centre, forward = _line_of_sight(drawing, vertex)
    length = 0.3 * drawing.unit_m
    if how == BEHIND:
        level = np.array([forward[0], forward[1], 0.0])
        norm = float(np.linalg.norm(level))
        back = level / norm if norm > 1e-6 else np.array([0.0, 1.0, 0.0])
        camera.position = centre + length * (np.array([0.0, 0.0, 0.6]) - back)
        camera.look_at = centre + 0.2 * length * back
    else:
        camera.position = centre
        camera.look_at = centre + 0.1 * length * forward


def _line_of_sight(drawing: Drawing, vertex: int) -> tuple[F64, F64]:
    """Return from where (3,) and in which direction (3,) the camera of a vertex looks."""
    vi_map = drawing.vi_map
    p = drawing.p_vertices[vertex]
    mission = int(vi_map.vertices.mission[vertex])
    cameras = mission_cameras(vi_map, mission)
    if cameras:
        T_G_C = se3.compose(vi_map.T_G_I[vertex], cameras[0].T_I_C)
        offset = T_G_C[4:] - vi_map.T_G_I[vertex, 4:]
        return p + offset, so3.rotate(T_G_C[:4], np.array([0.0, 0.0, 1.0]))
    start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
    step = (
        drawing.p_vertices[min(vertex + 1, stop - 1)] - drawing.p_vertices[max(vertex - 1, start)]
    )
    length = float(np.linalg.norm(step))
    return p, step / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])


def aim_initially(camera: Any, extent: Extent, view: View) -> None:
    """Set what new pages begin with (its field for the up direction has another name)."""
    position, target = view
    camera.position = tuple(position.tolist())
    camera.look_at = tuple(target.tolist())
    camera.up = (0.0, 0.0, 1.0)
    camera.fov = FIELD_OF_VIEW_RAD
    _set_planes(camera, extent)


def _set_planes(camera: Any, extent: Extent) -> None:
    camera.near = max(1e-3, 2e-4 * extent.radius_m)
    camera.far = max(_LEAST_FAR_M, 100.0 * extent.radius_m)
