"""Poses of missions that a person gives."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.anchoring.reports import AnchoringReport
from maplab_py.algorithms.loop_closure.alignment_contest import AlignmentChoice
from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.geometry import yaw
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex


def place_mission(vi_map: VIMap, mission: int, T_G_M: F64) -> tuple[VIMap, AnchoringReport]:
    """Make the base frame of a mission known at a pose (4,): position and yaw.

    Raises:
        UserError: The base frame is known already.
    """
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    _require_unknown(vi_map, mission)
    row = vi_map.missions.baseframe[mission]
    poses, is_known = vi_map.baseframes.T_G_M.copy(), vi_map.baseframes.is_known.copy()
    poses[row], is_known[row] = yaw.to_pose(T_G_M), True
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    report = AnchoringReport(
        already_known=tuple(names[i] for i in np.flatnonzero(known)),
        anchored=(names[mission],),
        not_anchored={},
        alignments=(),
        notes=("the base frame was given and not compared with closures",),
    )
    frames = vi_map.baseframes.replace(T_G_M=poses, is_known=is_known)
    return vi_map.replace(baseframes=frames), report


def choice_near(vi_map: VIMap, mission: int, to: int, T_G_M: F64) -> AlignmentChoice:
    """Return the choice of the alignment of two missions that is near a pose (4,) of the first.

    Raises:
        UserError: The mission's base frame is known already, or that of the other is not.
    """
    _require_unknown(vi_map, mission)
    if not vi_map.baseframes.is_known[vi_map.missions.baseframe[to]]:
        name = to_hex(vi_map.missions.id[to])[:8]
        raise UserError(
            f"--to={name}: its base frame is unknown; name a mission of known base frame"
        )
    T_G_to = yaw.from_pose(vi_map.T_G_M)[to]
    T_to_M = yaw.compose(yaw.inverse(T_G_to), T_G_M)
    if mission < to:
        return AlignmentChoice(missions=(mission, to), T_B_A=T_to_M)
    return AlignmentChoice(missions=(to, mission), T_B_A=yaw.inverse(T_to_M))


def _require_unknown(vi_map: VIMap, mission: int) -> None:
    if vi_map.baseframes.is_known[vi_map.missions.baseframe[mission]]:
        name = to_hex(vi_map.missions.id[mission])[:8]
        raise UserError(
            f"the base frame of mission {name} is known already; make it unknown first "
            "(set_mission_baseframe_to_unknown)"
        )
