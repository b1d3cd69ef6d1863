"""Changes of a world between sessions: furniture moves, posters are replaced, rooms refurbished.

A world that changes holds every point and box that ever exists, with masks of the sessions in which they
do: a piece of furniture that moves leaves its points and gets new ones of the same appearance elsewhere.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import UserError
from maplab_py.simulation.scenario import ChangeOptions, WorldOptions
from maplab_py.simulation.surfaces import box_surfaces, scatter
from maplab_py.simulation.world import World

_ON_BOX_M = 1e-4
_POSTER_RADIUS_M = 0.5
_PLACES_TRIED = 30
_GAP_M = 0.05
"""Least distance of two pieces of furniture."""


def with_changes(
    world: World,
    options: WorldOptions,
    changes: ChangeOptions,
    sessions: int,
    rng: np.random.Generator,
) -> World:
    """Return the world with everything that exists in any of some sessions.

    Raises:
        UserError: The world has no rooms with furniture, or objects that move all the time.
    """
    if options.layout != "rooms" or options.corridor_rooms or options.furniture_per_room == 0:
        raise UserError("changes: only worlds of rooms with furniture change")
    if options.moving_objects:
        raise UserError("changes: give moving_objects: 0, objects that move cannot be replaced")
    builder = _Builder(world, options, changes, sessions, rng)
    for session in range(1, sessions):
        builder.move_furniture(session, changes.moved_share)
        builder.replace_posters(session, changes.replaced_posters)
        if session == changes.refurbished_session:
            builder.move_furniture(session, changes.refurbished_share, is_new=True)
            builder.replace_posters(session, changes.refurbished_posters)
    return builder.world()


class _Builder:
    """Points and boxes so far; rows are appended, and `until` ends those that are replaced."""

    def __init__(
        self,
        world: World,
        options: WorldOptions,
        changes: ChangeOptions,
        sessions: int,
        rng: np.random.Generator,
    ) -> None:
        self._options, self._rng, self._sessions, self._base = options, rng, sessions, world
        self._pieces = options.rooms * options.furniture_per_room
        self._p, self._n, self._look = world.p_G, world.normal_G, world.look
        self._boxes = world.boxes
        self._since, self._until = _spans(len(world.p_G), sessions)
        self._box_since, self._box_until = _spans(len(world.boxes), sessions)
        self._piece = np.full(len(world.p_G), -1, dtype=np.int64)  # box that carries a point
        for box in range(self._pieces):
            low, high = world.boxes[box]
            inside = np.all((world.p_G > low - _ON_BOX_M) & (world.p_G < high + _ON_BOX_M), axis=1)
            self._piece[inside] = box
        share = 0.5 * changes.single_light_share
        draw = rng.uniform(size=int(world.look.max()) + 1)
        self._light_of_look = np.where(draw < share, 0, np.where(draw < 2.0 * share, 1, -1))

    def move_furniture(self, session: int, share: float, *, is_new: bool = False) -> None:
        """Move a share of the pieces to other places of their rooms, or replace them by new ones there."""
        for box in self._standing(session):
            place = self._free_place(box, session) if self._rng.uniform() < share else None
            if place is None:
                continue
            shift_x, mirror = place
            points = np.flatnonzero((self._piece == box) & (self._until > session))
            flip = np.array([1.0, -1.0 if mirror else 1.0, 1.0])
            p, n = self._p[points] * flip + [shift_x, 0.0, 0.0], self._n[points] * flip
            moved = np.sort(self._boxes[box] * flip + [shift_x, 0.0, 0.0], axis=0)
            if is_new:
                surfaces = box_surfaces(moved[0], moved[1], inwards=False)
                p, n = scatter(surfaces, self._options, max(len(points), 1), self._rng)
            look = self._new_looks(len(p)) if is_new else self._look[points]
            self._replace(session, points, p, n, look, moved, box)

    def replace_posters(self, session: int, count: int) -> None:
        """Replace what hangs on round patches of the walls, `count` of them per room."""
        walls = np.flatnonzero((self._piece < 0) & (np.abs(self._n[:, 2]) < 0.5))
        for _ in range(count * self._options.rooms):
            here = walls[(self._since[walls] < session) & (self._until[walls] > session)]
            centre = self._rng.choice(here)
            near = np.linalg.norm(self._p[here] - self._p[centre], axis=1) < _POSTER_RADIUS_M
            points = here[near & (self._n[here] @ self._n[centre] > 0.9)]
            offset = self._rng.normal(0.0, 0.1, (len(points), 3))
            offset -= np.sum(offset * self._n[points], axis=1)[:, None] * self._n[points]
            p = self._p[points] + offset
            self._replace(session, points, p, self._n[points], self._new_looks(len(points)))

    def world(self) -> World:
        """Return the world, with its masks by session."""
        session = np.arange(self._sessions)[:, None]
        return dataclasses.replace(
            self._base,
            p_G=self._p,
            normal_G=self._n,
            look=self._look,
            boxes=self._boxes,
            moving=np.full(len(self._p), -1, dtype=np.int64),
            exists=(session >= self._since) & (session < self._until),
            has_box=(session >= self._box_since) & (session < self._box_until),
            light=self._light_of_look[self._look],
        )

    def _standing(self, session: int) -> list[int]:
        """Return the pieces of furniture (rows of boxes) that stand before a session."""
        wall_boxes = np.arange(self._pieces, len(self._base.boxes))
        here = np.flatnonzero((self._box_until > session) & (self._box_since < session))
        return np.setdiff1d(here, wall_boxes).tolist()  # type: ignore[no-any-return]

    def _free_place(self, box: int, session: int) -> tuple[float, bool] | None:
        """Return a shift along the wall and whether to the opposite wall; None if nothing is free."""
        low, high = self._boxes[box]
        length = self._options.room_size_m[0]
        room = np.floor(0.5 * (low[0] + high[0]) / length + 0.5)
        start, width = (room - 0.5) * length, high[0] - low[0]
        others = np.setdiff1d(np.flatnonzero(self._box_until > session), [box])
        for _ in range(_PLACES_TRIED):
            x = start + self._rng.uniform(0.1, 0.9) * (length - width)
            mirror = bool(self._rng.uniform() < 0.5)
            y = np.sort(-self._boxes[box, :, 1]) if mirror else self._boxes[box, :, 1]
            b = self._boxes[others]
            apart = (b[:, 0, 0] > x + width + _GAP_M) | (b[:, 1, 0] < x - _GAP_M)
            apart |= (b[:, 0, 1] > y[1] + _GAP_M) | (b[:, 1, 1] < y[0] - _GAP_M)
            if abs(x - low[0]) + mirror * length > width and apart.all():
                return float(x - low[0]), mirror
        return None

    def _new_looks(self, count: int) -> I64:
        first = max(len(self._light_of_look), int(self._look.max()) + 1)
        lights = self._rng.choice(self._light_of_look, count)  # as frequent as before
        self._light_of_look = np.append(self._light_of_look, lights)
        return first + np.arange(count)

    def _replace(
        self,
        session: int,
        points: I64,
        p: F64,
        normal: F64,
        look: I64,
        box: F64 | None = None,
        old_box: int = -1,
    ) -> None:
        """End points (and their box) at a session and add others."""
        self._until[points] = session
        piece = -1
        if box is not None:
            self._box_until[old_box] = session
            piece = len(self._boxes)
            self._boxes = np.concatenate([self._boxes, box[None]])
            self._box_since = np.append(self._box_since, session)
            self._box_until = np.append(self._box_until, self._sessions)
        self._p, self._n = np.concatenate([self._p, p]), np.concatenate([self._n, normal])
        self._look = np.concatenate([self._look, look])
        self._piece = np.append(self._piece, np.full(len(p), piece))
        self._since = np.append(self._since, np.full(len(p), session))
        self._until = np.append(self._until, np.full(len(p), self._sessions))


def _spans(count: int, sessions: int) -> tuple[I64, I64]:
    """Return first and end session (N,) of what exists in all of them."""
    return np.zeros(count, dtype=np.int64), np.full(count, sessions, dtype=np.int64)


def visible_in_light(world: World, light: int) -> Mask:
    """Return which points (L,) can be seen in one of two conditions of light."""
    if world.light is None:
        return np.ones(len(world.p_G), dtype=np.bool_)
    return np.asarray((world.light < 0) | (world.light == light))
