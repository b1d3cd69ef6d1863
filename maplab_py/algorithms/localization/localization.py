"""Localise all vertices of some missions in a map, and compare with a reference."""

import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.localization import options as localization_options
from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.algorithms.localization.localizer import Localization, Localizer, Outcome, Query
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import UserError
from maplab_py.geometry import alignment, interpolation, se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, descriptors, starts_of_counts, to_hex_list
from maplab_py.vision.projection import DescriptorProjection

_ROUNDS = 15
_TRUSTED = 3.0
"""Pairs with a distance above this multiple of the median are excluded from an alignment."""


@dataclasses.dataclass(frozen=True, eq=False)
class Localizations:
    """Results of all queries, one row each."""

    vertex: I64  # (Q,) vertex rows of the query map
    T_G_I: F64  # (Q, 7), in G of the searched map
    is_localized: Mask  # (Q,)
    answers: tuple[Localization, ...]
    seconds: float


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """Reference poses of the queries, in a reference frame R."""

    name: str
    T_R_I: F64  # (Q, 7)
    is_known: Mask  # (Q,)


def localize_missions(
    database: LocalizationMap,
    vi_map: VIMap,
    options: localization_options.LocalizationOptions,
    *,
    missions: I64 | None = None,
    sequence_length: int = 1,
    progress: Progress = SILENT,
) -> Localizations:
    """Localise every vertex of some missions (None = all) sequentially.

    Args:
        database: Where to localise; it is not changed.
        vi_map: The map whose vertices are the queries; it is not changed.
        missions: Mission rows of the queries.
        sequence_length: Vertices whose images make up one query.

    Raises:
        EstimationError: The query has no descriptors, or of another length than the map's.
    """
    begin = time.perf_counter()
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    source = query_vertices(vi_map, rows, database.projection)
    localizer = Localizer(database, options)
    answers = []
    for number, query in enumerate(queries(source, sequence_length)):
        progress.step(number, len(source.vertex), "queries")
        answers.append(localizer.localize(query))
    return Localizations(
        vertex=source.vertex,
        T_G_I=np.array([answer.T_G_I for answer in answers]).reshape(-1, 7),
        is_localized=np.array([a.outcome is Outcome.LOCALIZED for a in answers], dtype=np.bool_),
        answers=tuple(answers),
        seconds=time.perf_counter() - begin,
    )


def align_robustly(p_R: F64, p_G: F64, *, level: bool) -> F64:
    """Return T_R_G (7,) that aligns points of G with those of R, robust against wrong pairs.

    Pairs with a distance far above the median are removed and the remaining pairs aligned again.

    Args:
        p_R: Points (N, 3).
        p_G: Points (N, 3).
        level: Both frames are gravity-aligned: rotate about the vertical only.
    """
    kept = np.ones(len(p_R), dtype=np.bool_)
    T_R_G = se3.identity()
    for _ in range(_ROUNDS):
        if level:
            T_R_G = alignment.align_yaw_position(p_R[kept], p_G[kept])
        else:
            T_R_G, _ = alignment.umeyama(p_R[kept], p_G[kept])
        error = np.linalg.norm(p_R - se3.transform(T_R_G, p_G), axis=1)
        now = error <= max(_TRUSTED * float(np.median(error)), 1e-6)
        if np.array_equal(now, kept) or now.sum() < 3:
            break
        kept = now
    return T_R_G


def align_level(T_R_I: F64, T_G_I: F64) -> F64:
    """Return T_R_G (7,) between two frames with the same vertical by poses (N, 7), some of them wrong.

    Each pair tells the yaw between the frames. Positions tell it better where they are spread, and
    nothing where they lie close together: their answer counts if the orientations permit it.
    """
    q = so3.multiply(T_R_I[:, :4], so3.inverse(T_G_I[:, :4]))
    yaw = 2.0 * np.arctan2(q[:, 2], q[:, 3])
    tried = yaw[:: -(-len(yaw) // _MOST_TRIED)]
    spread = np.median(np.abs(_turn(yaw[:, None] - tried)), axis=0)
    turn = _turn(yaw - tried[spread.argmin()])
    best = tried[spread.argmin()] + np.median(turn)
    T_R_G = se3.make(so3.exp([0.0, 0.0, best]), np.zeros(3))
    T_R_G[4:] = np.median(T_R_I[:, 4:] - se3.transform(T_R_G, T_G_I[:, 4:]), axis=0)
    by_positions = align_robustly(T_R_I[:, 4:], T_G_I[:, 4:], level=True)
    away = _turn(2.0 * np.arctan2(by_positions[2], by_positions[3]) - best)
    return by_positions if abs(away) <= 3.0 * float(spread.min()) else T_R_G


def _turn(angle: F64) -> F64:
    """Return angles [rad] between -pi and pi."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def pose_errors(localizations: Localizations, reference: Reference, T_R_G: F64) -> tuple[F64, F64]:
    """Return position [m] and orientation errors [deg] (Q,), NaN where a query was not localised."""
    step = se3.local(reference.T_R_I, se3.compose(T_R_G, localizations.T_G_I))
    valid = localizations.is_localized & reference.is_known
    position = np.where(valid, np.linalg.norm(step[:, :3], axis=1), np.nan)
    orientation = np.where(valid, np.degrees(np.linalg.norm(step[:, 3:], axis=1)), np.nan)
    return position, orientation


def describe(
    database: LocalizationMap,
    localizations: Localizations,
    *,
    reference: Reference | None = None,
    T_R_G: F64 | None = None,
    success_error_m: float = 0.5,
) -> localization_options.LocalizationReport:
    """Summarise the results, and their errors if there is a reference."""
    outcomes = [answer.outcome for answer in localizations.answers]
    refused = {
        outcome.value: outcomes.count(outcome)
        for outcome in Outcome
        if outcome is not Outcome.LOCALIZED and outcome in outcomes
    }
    position = orientation = np.full(len(outcomes), np.nan)
    known = np.zeros(len(outcomes), dtype=np.bool_)
    if reference is not None and T_R_G is not None:
        position, orientation = pose_errors(localizations, reference, T_R_G)
        known = reference.is_known
    success = int(np.count_nonzero(position < success_error_m))
    localized = int(localizations.is_localized.sum())
    answered = [answer for answer in localizations.answers if answer.outcome is Outcome.LOCALIZED]
    name = "full" if database.has_descriptors else "summary"
    kind = database.projection.kind
    return localization_options.LocalizationReport(
        map_kind=name if kind.is_binary else f"{name}, {descriptors.type_name(kind.feature_type)}",
        map_landmarks=len(database.p_G),
        map_observations=len(database.descriptors),
        queries=len(outcomes),
        localized=localized,
        localized_share=localized / max(len(outcomes), 1),
        refused=refused,
        reference=reference.name if reference is not None else "",
        queries_with_reference=int(known.sum()),
        success=success,
        success_share=success / max(int(known.sum()), 1),
        wrong=int(np.count_nonzero(position >= success_error_m)),
        success_error_m=success_error_m,
        position_error_m=_distribution(position),
        orientation_error_deg=_distribution(orientation),
        inliers=_distribution(np.array([a.inliers for a in answered], dtype=np.float64)),
        matching_ms=_distribution(1e3 * np.array([a.matching_s for a in localizations.answers])),
        ransac_ms=_distribution(1e3 * np.array([a.ransac_s for a in localizations.answers])),
        seconds=localizations.seconds,
    )


def _distribution(values: F64) -> localization_options.Distribution | None:
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    return localization_options.Distribution(
        median=float(np.median(values)),
        mean=float(values.mean()),
        percentile_95=float(np.percentile(values, 95.0)),
        largest=float(values.max()),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class QueryVertices:
    """Features of the vertices to be localised, grouped by vertex."""

    vi_map: VIMap
    features: MapFeatures
    start: I64  # (V + 1,) features of each vertex of the map
    vertex: I64  # (Q,) vertices to be localised


def query_vertices(vi_map: VIMap, missions: I64, projection: DescriptorProjection) -> QueryVertices:
    """Collect the features of all vertices of some missions.

    Raises:
        EstimationError: The map has no descriptors, or others than the projection takes.
    """
    kind = projection.kind
    has_kind = descriptors.sizes_of_type(vi_map.frames, kind.feature_type, kind.depth) == kind.size
    features, _ = map_features(
        vi_map,
        missions,
        projection=projection,
        feature_type=kind.feature_type,
        sizes=(kind.size,) if has_kind.any() else (),
    )
    counts = np.bincount(features.vertex, minlength=len(vi_map.vertices))
    chosen = np.isin(vi_map.vertices.mission, missions)
    return QueryVertices(vi_map, features, starts_of_counts(counts), np.flatnonzero(chosen))


def queries(source: QueryVertices, sequence_length: int = 1) -> Iterator[Query]:
    """Yield one query per vertex.

    With a sequence length of n, the images of the n - 1 preceding vertices of the same mission are
    treated as those of one rig whose extrinsics are the relative poses of the map.
    """
    vi_map = source.vi_map
    first_of_mission = vi_map.vertex_start[vi_map.vertices.mission]
    size = source.features.kind.size
    for vertex in source.vertex.tolist():
        first = max(vertex - sequence_length + 1, int(first_of_mission[vertex]))
        rows = np.arange(source.start[first], source.start[vertex + 1])
        features = source.features
        T_V_I = se3.relative(
            vi_map.vertices.T_M_I[vertex], vi_map.vertices.T_M_I[features.vertex[rows]]
        )
        yield Query(
            key=vertex,
            descriptors=vi_map.keypoints.descriptor[features.keypoint[rows], :size],
            origin_I=se3.transform(T_V_I, features.origin_I[rows]),
            ray_I=so3.rotate(T_V_I[:, :4], features.ray_I[rows]),
            rad_per_px=features.rad_per_px[rows],
            q_M_I=vi_map.vertices.T_M_I[vertex, :4],
        )


_MIN_PAIRS = 10
_MOST_TRIED = 500  # pairs whose yaw is compared with those of all


def trajectory_of_queries(
    vi_map: VIMap, localizations: Localizations
) -> tuple[Reference, F64 | None]:
    """Use the poses of the query map; return T_R_G too, None when too few queries were localised.

    If the base frames of the queries' missions are known, both maps are assumed to share G. Else
    the trajectory is first aligned with the localised poses by yaw and position.
    """
    T_G_I = vi_map.T_G_I[localizations.vertex]
    known = np.ones(len(localizations.vertex), dtype=np.bool_)
    missions = np.unique(vi_map.vertices.mission[localizations.vertex])
    if vi_map.baseframes.is_known[vi_map.missions.baseframe[missions]].all():
        return Reference(f"{localization_options.QUERY_PATH} in G", T_G_I, known), se3.identity()
    reference = Reference(
        f"{localization_options.QUERY_PATH}, aligned with the localised poses", T_G_I, known
    )
    return reference, _from_answers(reference, localizations, level=True)


def ground_truth(
    name: str,
    times_ns: I64,
    T_R_I: F64,
    query: VIMap,
    localizations: Localizations,
    searched: VIMap | None,
) -> tuple[Reference, F64 | None]:
    """Use a ground-truth trajectory; also return T_R_G, None if it cannot be determined.

    A full map is aligned with the ground truth by its vertices, so that errors of the map count.
    A summary map has no times: the localised poses are aligned with the truth robustly.

    Args:
        name: Name of the reference.
        times_ns: Times (N,) of the truth.
        T_R_I: Poses (N, 7) of the truth.
        query: The map of the queries.
        localizations: The localised poses.
        searched: The map that was searched, None for a summary map.

    Raises:
        UserError: No query lies in the truth's time span.
    """
    poses, known = interpolation.interpolate_poses(
        times_ns, T_R_I, query.vertices.timestamp_ns[localizations.vertex]
    )
    if not known.any():
        raise UserError(f"{name}: none of the queries lies in its time span")
    reference = Reference(name, poses, known)
    if searched is not None:
        where, inside = interpolation.interpolate_poses(
            times_ns, T_R_I, searched.vertices.timestamp_ns
        )
        if inside.sum() >= _MIN_PAIRS:
            T_R_G, _ = alignment.umeyama(where[inside, 4:], searched.T_G_I[inside, 4:])
            return reference, T_R_G
    return reference, _from_answers(reference, localizations, level=False)


def _from_answers(reference: Reference, localizations: Localizations, *, level: bool) -> F64 | None:
    both = reference.is_known & localizations.is_localized
    if both.sum() < _MIN_PAIRS:
        return None
    T_R_I, T_G_I = reference.T_R_I[both], localizations.T_G_I[both]
    return (
        align_level(T_R_I, T_G_I)
        if level
        else align_robustly(T_R_I[:, 4:], T_G_I[:, 4:], level=False)
    )


_HEADER = (
    "vertex,timestamp_ns,outcome,keypoints,matches,inliers,"
    "q_x,q_y,q_z,q_w,p_x,p_y,p_z,position_error_m,orientation_error_deg,matching_ms,ransac_ms\n"
)


def csv_lines(
    query: VIMap, localizations: Localizations, reference: Reference, T_R_G: F64 | None
) -> list[str]:
    """Return a header and one line per query; errors are empty where T_R_G (7,) is not known."""
    nan = np.full(len(localizations.vertex), np.nan)
    position, orientation = (
        (nan, nan) if T_R_G is None else pose_errors(localizations, reference, T_R_G)
    )
    lines = [_HEADER]
    names = to_hex_list(query.vertices.id[localizations.vertex])
    times = query.vertices.timestamp_ns[localizations.vertex].tolist()
    for row, answer in enumerate(localizations.answers):
        pose = (
            ",".join(f"{value:.9g}" for value in answer.T_G_I)
            if localizations.is_localized[row]
            else ",,,,,,"
        )
        errors = f"{position[row]:.6g},{orientation[row]:.6g}" if position[row] >= 0.0 else ","
        spent = f"{1e3 * answer.matching_s:.3f},{1e3 * answer.ransac_s:.3f}"
        counts = f"{answer.keypoints},{answer.matches},{answer.inliers}"
        lines.append(
            f"{names[row]},{times[row]},{answer.outcome.value},{counts},{pose},{errors},{spent}\n"
        )
    return lines
