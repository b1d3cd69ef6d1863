"""Pose graphs in g2o's text format: VERTEX_SE3:QUAT, EDGE_SE3:QUAT, VERTEX_SE2, EDGE_SE2 and FIX.

Files may be compressed with gzip. A file of edges alone starts from the poses along the odometry.
Information matrices are of Log(T_measured^-1 T_A_B), position before angle, as GTSAM and SE-Sync
read them.
"""

import dataclasses
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, U64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.input_files import TooLarge, decode_foreign, inflate, read_bytes
from maplab_py.interop.text_table import format_rows, is_number
from maplab_py.output_files import write_text


def chained_poses(id: U64, first: I64, second: I64, T_A_B: F64) -> F64:
    """Return poses T_G_V (V, 7) along a spanning forest of the edges, odometry before other edges.

    The first pose of every connected part is the identity.

    Args:
        id: Ids (V,), ascending; an edge between subsequent ids is odometry.
        first: Row of A (E,).
        second: Row of B (E,).
        T_A_B: Measured relative poses (E, 7).
    """
    parent, edge, is_forward = _spanning_forest(id, first, second)
    root = len(id)  # a further node above the first pose of every part
    step = se3.identity(root + 1)
    linked = np.flatnonzero(edge >= 0)
    measured = T_A_B[edge[linked]]
    forward = is_forward[linked, None]
    step[linked] = np.where(forward, measured, se3.inverse(measured))
    above = np.append(parent, root)
    while np.any(above != root):  # twice as far up in every round
        step = se3.compose(step[above], step)
        above = above[above]
    return np.asarray(step[:root])


def _spanning_forest(id: U64, first: I64, second: I64) -> tuple[I64, I64, np.ndarray]:
    """Return for every pose its parent, the edge that joins them (-1 = root), and its direction.

    A root's parent is V. Forward edges run from the parent to the pose.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import (
        breadth_first_order,
        connected_components,
        minimum_spanning_tree,
    )

    count = len(id)
    proper = np.flatnonzero(first != second)
    low = np.minimum(first[proper], second[proper])
    high = np.maximum(first[proper], second[proper])
    key, weight = low * count + high, np.where(id[high] - id[low] == 1, 1.0, 2.0)
    key, earliest = np.unique(key, return_index=True)
    edges, weight = proper[earliest], weight[earliest]
    ends = (key // count, key % count)
    graph = coo_array((weight, ends), shape=(count + 1, count + 1)).tocsr()
    _, part = connected_components(graph[:count, :count], directed=False)
    roots = np.unique(part, return_index=True)[1]
    tree = minimum_spanning_tree(graph).tocoo()
    rooted = coo_array(
        (
            np.ones(len(tree.data) + len(roots)),
            (np.append(tree.row, np.full(len(roots), count)), np.append(tree.col, roots)),
        ),
        shape=(count + 1, count + 1),
    ).tocsr()
    _, parent = breadth_first_order(rooted, count, directed=False)
    parent = parent[:count].astype(np.int64)
    rows = np.arange(count)
    wanted = np.minimum(rows, parent) * count + np.maximum(rows, parent)
    edge = np.full(count, -1, dtype=np.int64)
    linked = parent < count
    edge[linked] = edges[np.searchsorted(key, wanted[linked])]
    return parent, edge, np.asarray(second[edge] == rows)


_SMALLEST_RATIO = 1e-9
"""Smallest eigenvalue of a repaired matrix over the largest: the direction then tells almost nothing."""


def positive_definite(information: F64) -> tuple[F64, int]:
    """Raise the eigenvalues of matrices (N, 6, 6) that are not positive definite.

    Matrices that have a Cholesky factor are returned bit for bit. In the others eigenvalues below
    1e-9 of the largest are raised to that; a matrix without a positive eigenvalue, or with entries
    that are not finite, cannot be repaired and stays.

    Returns:
        The matrices, and how many of them were changed.
    """
    finite = np.isfinite(information).all(axis=(1, 2))
    suspects = np.flatnonzero(finite)
    value = np.linalg.eigvalsh(information[suspects])
    # what is safely positive needs no further look
    suspects = suspects[value[:, 0] <= _SMALLEST_RATIO * np.maximum(value[:, -1], 0.0)]
    rows = np.array([row for row in suspects.tolist() if not _has_factor(information[row])], int)
    value, vector = np.linalg.eigh(information[rows])
    can_repair = value[:, -1] > 0.0
    rows, value, vector = rows[can_repair], value[can_repair], vector[can_repair]
    value = np.maximum(value, _SMALLEST_RATIO * value[:, -1:])
    result = information.copy()
    result[rows] = (vector * value[:, None, :]) @ np.swapaxes(vector, 1, 2)
    result[rows] = 0.5 * (result[rows] + np.swapaxes(result[rows], 1, 2))
    return result, len(rows)


def _has_factor(matrix: F64) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


_POSE, _PLANAR_POSE = "VERTEX_SE3:QUAT", "VERTEX_SE2"
_EDGE, _PLANAR_EDGE = "EDGE_SE3:QUAT", "EDGE_SE2"
_FIX = "FIX"
_LAYOUT = {_POSE: (1, 8), _EDGE: (2, 30), _PLANAR_POSE: (1, 4), _PLANAR_EDGE: (2, 11), _FIX: (1, 1)}
"""Numbers of ids and of all words of each kind of line."""
_LARGEST_ID = (1 << 64) - 1
_MAX_BYTES = 500_000_000
_GZIP, _GZIP_WINDOW = b"\x1f\x8b", 31
_OUT_OF_PLANE = 1e4
"""Information of the height and tilt of planar edges, which they do not measure."""
_PLANAR = np.array([0, 1, 5])


_LARGEST = 1e100
"""Of poses and information: squares of larger values overflow."""


@dataclasses.dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses and measurements between them; planar files are read as graphs in the plane z = 0."""

    id: U64  # (V,) sorted
    T_G_V: F64  # (V, 7)
    first: I64  # (E,) rows of poses
    second: I64  # (E,)
    T_A_B: F64  # (E, 7)
    information: F64  # (E, 6, 6) position, orientation
    fixed: I64  # rows of fixed poses
    num_repaired: int = 0  # edges whose information in the file was not positive definite


def read_g2o(path: Path) -> PoseGraph:
    """Read a pose graph, compressed with gzip or not.

    Information matrices that are not positive definite are repaired; `num_repaired` counts them.
    Without any pose in the file the poses are those along the edges.

    Raises:
        MapError: The file cannot be read or a line is wrong; names file and line.
    """
    sections = _split(_text(path).splitlines(), path)
    poses, edges = (
        [sections[k] for k in kinds] for kinds in ((_POSE, _PLANAR_POSE), (_EDGE, _PLANAR_EDGE))
    )
    ends = np.concatenate([edges[0][0], edges[1][0]])
    T_A_B = np.concatenate([_pose(edges[0][1][:, :7]), _planar_pose(edges[1][1][:, :3])])
    ids = np.concatenate([poses[0][0][:, 0], poses[1][0][:, 0]])
    T = np.concatenate([_pose(poses[0][1]), _planar_pose(poses[1][1])])
    if len(ids) == 0 and len(ends) == 0:
        raise MapError(f"{path}: there are no poses in the file")
    if len(ids) == 0:
        ids = np.unique(ends)
        a, b = np.searchsorted(ids, ends).T
        T = chained_poses(ids, a, b, T_A_B)
    order = np.argsort(ids, kind="stable")
    ids, T = ids[order], T[order]
    if np.any(ids[1:] == ids[:-1]):
        twice = ids[1:][ids[1:] == ids[:-1]][0]
        raise MapError(f"{path}: pose {twice} occurs twice")
    rows = np.minimum(np.searchsorted(ids, ends), len(ids) - 1)
    missing = np.flatnonzero(ids[rows] != ends)
    if len(missing):
        raise MapError(f"{path}: an edge names pose {ends.ravel()[missing[0]]}, which is not there")
    information, num_repaired = positive_definite(
        np.concatenate(
            [_symmetric(edges[0][1][:, 7:], 6), _lifted(_symmetric(edges[1][1][:, 3:], 3))]
        )
    )
    return PoseGraph(
        id=ids,
        T_G_V=T,
        first=rows[:, 0],
        second=rows[:, 1],
        T_A_B=T_A_B,
        information=information,
        fixed=np.flatnonzero(np.isin(ids, sections[_FIX][0])),
        num_repaired=num_repaired,
    )


def _text(path: Path) -> str:
    """Return the text of a file, unpacked if it is compressed."""
    remedy = "split it into parts"
    try:
        content = read_bytes(path, _MAX_BYTES, remedy=remedy, error=MapError)
        if content.startswith(_GZIP):
            content = bytes(inflate(content, _MAX_BYTES, wbits=_GZIP_WINDOW)[0])
        return decode_foreign(content)
    except TooLarge as error:
        raise MapError(f"{path}: unpacks to {error}; {remedy}") from error
    except (EOFError, zlib.error) as error:
        raise MapError(f"{path}: is damaged: wrong gzip data; copy it again") from error
    except OSError as error:
        raise MapError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise MapError(f"cannot read {path}: it is not text") from error


def write_g2o(graph: PoseGraph, path: Path, *, overwrite: bool = False) -> None:
    """Write a pose graph as SE(3) poses and edges, every number exact.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    to_file = [4, 5, 6, 0, 1, 2, 3]
    upper = graph.information[:, *np.triu_indices(6)]

    def chunks() -> Iterator[str]:
        pose_line = f"{_POSE} %d" + " %.17g" * 7
        yield from format_rows(pose_line, [graph.id, graph.T_G_V[:, to_file]])
        yield from (f"{_FIX} {number}\n" for number in graph.id[graph.fixed].tolist())
        ends = [graph.id[graph.first], graph.id[graph.second]]
        edge_line = f"{_EDGE} %d %d" + " %.17g" * 28
        yield from format_rows(edge_line, [*ends, graph.T_A_B[:, to_file], upper])

    write_text(path, chunks(), overwrite=overwrite)


def _split(lines: list[str], path: Path) -> dict[str, tuple[U64, F64]]:
    """Return ids (N, 1 or 2) and values of the lines of each kind; all numbers of FIX are ids."""
    rows: dict[str, list[tuple[int, list[int], list[float]]]] = {kind: [] for kind in _LAYOUT}
    for number, line in enumerate(lines, 1):
        kind, *words = line.split() or ["#"]
        if kind.startswith(("#", "PARAMS_")):  # which no edge that is read names
            continue
        if kind not in _LAYOUT:
            raise MapError(f"{path}:{number}: '{kind}' is not among {', '.join(_LAYOUT)}")
        ids, width = _LAYOUT[kind] if kind != _FIX else (len(words), len(words))
        if len(words) != width:
            raise MapError(f"{path}:{number}: {kind} has {len(words)} numbers, not {width}")
        try:
            rows[kind].append((number, [*map(int, words[:ids])], [*map(float, words[ids:])]))
        except ValueError:
            wrong = [word for word in words[:ids] if not word.isdecimal()]
            problem = "is not an id: wants 64 bits without sign" if wrong else "is not a number"
            wrong += [word for word in words[ids:] if not is_number(word)]
            raise MapError(f"{path}:{number}: '{wrong[0]}' {problem}") from None
    return {kind: _checked(kind, of_kind, path) for kind, of_kind in rows.items()}


def _checked(
    kind: str, rows: list[tuple[int, list[int], list[float]]], path: Path
) -> tuple[U64, F64]:
    ids, width = _LAYOUT[kind]
    for number, of_line, _ in rows:
        if not all(0 <= value <= _LARGEST_ID for value in of_line):
            wrong = next(value for value in of_line if not 0 <= value <= _LARGEST_ID)
            raise MapError(f"{path}:{number}: '{wrong}' is not an id: wants 64 bits without sign")
    numbers = [value for _, of_line, _ in rows for value in of_line]
    values = np.array([row[2] for row in rows], dtype=np.float64).reshape(len(rows), width - ids)
    size = np.abs(values)
    problems = [
        (~np.isfinite(values).all(axis=1), "a value is not a finite number"),
        ((size > _LARGEST).any(axis=1), f"a value is beyond {_LARGEST:g}"),
    ]
    if kind in (_POSE, _EDGE):
        is_zero = size[:, 3:7].max(axis=1, initial=0.0) < 1.0 / _LARGEST
        problems.append((is_zero, "the quaternion is zero"))
    for wrong_rows, problem in problems:
        if wrong_rows.any():
            raise MapError(f"{path}:{rows[int(np.argmax(wrong_rows))][0]}: {problem}")
    return np.array(numbers, dtype=np.uint64).reshape(-1, ids), values


def _pose(values: F64) -> F64:
    """Turn [p, q] (N, 7) into poses; quaternions are printed with few digits."""
    return se3.make(so3.normalize(values[:, 3:]), values[:, :3])


def _planar_pose(values: F64) -> F64:
    turn = np.zeros((len(values), 3))
    turn[:, 2] = values[:, 2]
    position = np.zeros((len(values), 3))
    position[:, :2] = values[:, :2]
    return se3.make(so3.exp(turn), position)


def _symmetric(upper: F64, size: int) -> F64:
    """Return matrices (N, size, size) of their upper triangles, row by row."""
    full = np.zeros((len(upper), size, size))
    full[:, *np.triu_indices(size)] = upper
    return full + np.triu(full, 1).transpose(0, 2, 1)


def _lifted(information: F64) -> F64:
    """Put planar information (N, 3, 3) of x, y, angle into (N, 6, 6)."""
    full = np.tile(np.eye(6) * _OUT_OF_PLANE, (len(information), 1, 1))
    full[:, _PLANAR[:, None], _PLANAR] = information
    return full
