"""Selections of segments that the studies compare."""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.algorithms.self_calibration.segments.selection import Evaluation
from maplab_py.array_types import F64, I64
from studies.data_sets import OPTIONS

Loss = Callable[[F64], float]

WHOLE = "imu+camera+extrinsics"
FEW = 8
"""Number of segments in the comparisons, as in Schneider 2019."""
METHODS = (
    "informative",
    "batch",
    "two sessions",
    "8: A-optimality",
    "8: D-optimality",
    "8: E-optimality",
    "8: A-optimality by groups",
    "8: entropy by groups",
    "8: random",
    "8: least informative",
    "4: entropy",
    "4 each: entropy by groups",
    "8 each: entropy by groups",
)
JUDGED = ("informative", "batch", "8: A-optimality", "8: random", "8: least informative")
"""Their calibrations are also evaluated on another session."""


def rankings(evaluation: Evaluation, metric: str, groups: str) -> list[list[int]]:
    """Return all segments by table, the most informative first."""
    options = dataclasses.replace(OPTIONS, metric=metric, groups=groups)
    scores = [record.scores for record in evaluation.records(options, evaluation.sigma_ref())]
    return [
        np.argsort([record[table] for record in scores], kind="stable").tolist()
        for table in scores[0]
    ]


def random_choice(evaluation: Evaluation, seed: int, count: int) -> list[int]:
    """Return a number of random segments."""
    rng = np.random.default_rng(seed)
    return list(rng.choice(len(evaluation.segments), size=count, replace=False).tolist())


def chosen_segments(evaluation: Evaluation, method: str, number: int, per_group: int) -> list[I64]:
    """Return the segments (vertex rows) that a method of `METHODS` selects in a data set."""
    capacity, _, criterion = method.rpartition(": ")
    count = min(int(capacity.split()[0]) if capacity else FEW, len(evaluation.segments))
    if criterion == "random":
        best = random_choice(evaluation, number, count)
    elif criterion == "least informative":
        options = dataclasses.replace(OPTIONS, groups=WHOLE)
        records = evaluation.records(options, evaluation.sigma_ref())
        best = np.argsort([-record.scores[WHOLE] for record in records], kind="stable")[
            :count
        ].tolist()
    else:
        metric, groups = criterion.split(" by ")[0].replace("-", "_").lower(), WHOLE
        if criterion.endswith("by groups"):
            groups = OPTIONS.groups
        if criterion == "informative":
            metric, groups, count = OPTIONS.metric, OPTIONS.groups, per_group
        orders = rankings(evaluation, metric, groups)
        if criterion == "informative" or capacity.endswith("each"):
            best = [k for order in orders for k in order[:count]]
        else:  # the best of each table, the second best, and so on
            best = list(dict.fromkeys(k for rank in zip(*orders, strict=True) for k in rank))[
                :count
            ]
    return [evaluation.segments[k].rows for k in sorted(set(best))]


def joint_designs(evaluation: Evaluation, levels: F64) -> dict[str, list[int]]:
    """Select `FEW` segments greedily for the smallest loss of their joint covariance.

    Args:
        evaluation: Segments, evaluated at the true states.
        levels: Deviation (k,) of every parameter in table 6.1 of Schneider 2019.
    """
    names, prior = evaluation.parameters.names, np.diag(evaluation.parameters.prior_sigma**-2.0)
    information = [np.linalg.inv(segment.covariance) - prior for segment in evaluation.segments]
    scales = [name.startswith("accelerometer") and name.endswith("scale") for name in names]

    def trace(unit: F64) -> Loss:
        return lambda covariance: float(np.sum(np.diag(covariance) / unit**2))

    losses: dict[str, Loss] = {
        "thesis' deviations": trace(levels),
        "usual deviations": trace(evaluation.sigma_ref()),
        "determinant": lambda covariance: float(np.linalg.slogdet(covariance)[1]),
        "accelerometer scale": lambda covariance: float(covariance[np.ix_(scales, scales)].sum()),
    }
    return {f"8 together, {what}": _greedy(information, prior, f) for what, f in losses.items()}


def _greedy(information: list[F64], prior: F64, loss: Loss) -> list[int]:
    chosen: list[int] = []
    total = prior
    for _ in range(min(FEW, len(information))):
        losses = [
            np.inf
            if k in chosen
            else loss(np.asarray(np.linalg.inv(total + added), dtype=np.float64))
            for k, added in enumerate(information)
        ]
        chosen.append(int(np.argmin(losses)))
        total = total + information[chosen[-1]]
    return chosen
