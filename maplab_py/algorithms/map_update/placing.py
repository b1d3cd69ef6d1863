"""Place of a session in a map: by its localised vertices, and the landmarks that both have in common.

Localisation also works in thinned maps, where too few landmarks are left for the closures of loops. Its poses
must agree on one alignment of the session's trajectory.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.evidence import with_inherited
from maplab_py.algorithms.localization.database import database_of_map
from maplab_py.algorithms.localization.localization import queries, query_vertices
from maplab_py.algorithms.localization.localizer import Localizer, Outcome
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.map_update.visibility import main_feature_type
from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, yaw
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, edits, observer_counts

_AGREE_M, _AGREE_RAD = 1.0, np.deg2rad(10.0)
"""Differences of localised poses from the aligned trajectory: the odometry of the session drifts."""
_MIN_AGREEING = 4
_MIN_VOTES = 2
"""Keypoints that must match a landmark of the session with one of the map; all, if it has fewer."""


@dataclasses.dataclass(frozen=True, eq=False)
class Placed:
    """Alignments of missions (N,) of a session, and matches of their keypoints (rows of the session)."""

    missions: I64
    T_G_M: F64  # (N, 7)
    keypoint: I64  # (O,)
    landmark: I64  # (O,) rows of the map
    localized: float  # share of the vertices


def place(vi_map: VIMap, session: VIMap, progress: Progress = SILENT) -> Placed:
    """Localise the vertices of a session in a map; missions whose poses do not agree are left out.

    Raises:
        EstimationError: One of them has no descriptors, or the map no good landmark.
    """
    known = np.flatnonzero(vi_map.baseframes.is_known[vi_map.missions.baseframe])
    database = database_of_map(vi_map, missions=known, feature_type=main_feature_type(vi_map))
    if database.landmark is None:
        raise EstimationError("the landmarks of the map are not known")
    source = query_vertices(session, np.arange(len(session.missions)), database.projection)
    localizer = Localizer(database, LocalizationOptions())
    vertex, poses, matches = [], [], []
    for number, (query, row) in enumerate(
        zip(queries(source), source.vertex.tolist(), strict=True)
    ):
        progress.step(number, len(source.vertex), "vertices of the session")
        answer = localizer.localize(query)
        if answer.outcome is Outcome.LOCALIZED:
            vertex.append(row)
            poses.append(answer.T_G_I)
            keypoint = source.features.keypoint[source.start[row] + answer.keypoint]
            matches.append((keypoint, database.landmark[answer.landmark]))
    rows = np.array(vertex, dtype=np.int64)
    T_G_I = np.array(poses).reshape(-1, 7)
    mission = session.vertices.mission[rows]
    missions, aligned, kept = [], [], np.zeros(len(rows), dtype=np.bool_)
    for number in range(len(session.missions)):
        mine = np.flatnonzero(mission == number)
        T_G_M, agreeing = _alignment(T_G_I[mine], session.vertices.T_M_I[rows[mine]])
        if np.count_nonzero(agreeing) >= max(_MIN_AGREEING, len(mine) // 2):
            missions.append(number)
            aligned.append(T_G_M)
            kept[mine[agreeing]] = True
    empty = np.zeros(0, dtype=np.int64)
    columns = zip(*(m for m, k in zip(matches, kept, strict=True) if k), strict=True)
    joined = [np.concatenate([empty, *column]) for column in columns] or [empty, empty]
    return Placed(
        np.array(missions, dtype=np.int64),
        np.array(aligned).reshape(-1, 7),
        joined[0],
        joined[1],
        len(rows) / max(len(source.vertex), 1),
    )


def _alignment(T_G_I: F64, T_M_I: F64) -> tuple[F64, Mask]:
    """Return the alignment T_G_M (7,) that most pairs of poses (N, 7) agree with, and which do."""
    if len(T_G_I) == 0:
        return se3.identity(), np.zeros(0, dtype=np.bool_)
    turn = yaw.yaw_of(se3.compose(T_G_I, se3.inverse(T_M_I))[:, :4])
    p = T_G_I[:, 4:] - yaw.rotate(turn, T_M_I[:, 4:])
    # of alignment i at pose j
    apart_m = np.linalg.norm(
        yaw.rotate(turn[:, None], T_M_I[None, :, 4:]) + p[:, None] - T_G_I[None, :, 4:], axis=2
    )
    apart_rad = np.abs(yaw.wrap(turn[:, None] - turn[None]))
    agree = (apart_m < _AGREE_M) & (apart_rad < _AGREE_RAD)
    best = int(np.argmax(agree.sum(axis=1)))
    return se3.make(yaw.quaternion(turn[best]), p[best]), np.asarray(agree[best])


def with_matches(vi_map: VIMap, keypoint: I64, landmark: I64) -> tuple[VIMap, int]:
    """Return the map in which keypoints (N,) observe landmarks (N,), and the landmarks merged.

    Keypoints that observe another landmark vote for merging it into the matched one.
    """
    seen = vi_map.keypoints.landmark[keypoint].astype(np.int64)
    vi_map = _with_observations(vi_map, keypoint[seen < 0], landmark[seen < 0])
    voting = (seen >= 0) & (seen != landmark)
    pairs, votes = np.unique(np.stack([seen[voting], landmark[voting]]), axis=1, return_counts=True)
    order = np.lexsort((pairs[1], -votes, pairs[0]))
    pairs, votes = pairs[:, order], votes[order]
    _, first = np.unique(pairs[0], return_index=True)
    enough = votes[first] >= np.minimum(observer_counts(vi_map)[pairs[0, first]], _MIN_VOTES)
    source, target = pairs[:, first[enough]]
    survivor = edits.survivors(source, target, len(vi_map.landmarks))
    absorbed = np.flatnonzero(survivor != np.arange(len(survivor)))
    inherited = with_inherited(vi_map, absorbed, survivor[absorbed])
    return edits.merge_landmarks(inherited, source, target), len(absorbed)


def _with_observations(vi_map: VIMap, keypoint: I64, landmark: I64) -> VIMap:
    """Return the map in which free keypoints (N,) observe landmarks that their images do not see."""
    count = len(vi_map.landmarks)
    observed = vi_map.observations
    key = vi_map.keypoint_frame[observed].astype(np.int64) * count
    key += vi_map.keypoints.landmark[observed]
    wanted = vi_map.keypoint_frame[keypoint].astype(np.int64) * count + landmark
    _, first = np.unique(wanted, return_index=True)
    first = first[~np.isin(wanted[first], key)]
    keypoints = vi_map.keypoints.put(keypoint[first], landmark=landmark[first])
    return vi_map.replace(keypoints=keypoints)
