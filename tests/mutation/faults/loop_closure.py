"""Faults of loop closure: gates, consensus, merging, edges."""

from __future__ import annotations

from tests.mutation.fault import Fault

_GATES = ("tests/algorithms/loop_closure/test_gates.py",)
_PAIRS = ("tests/algorithms/loop_closure/test_mission_pairs.py",)
_ALIKE = ("tests/algorithms/loop_closure/test_ambiguity.py",)
_EDGES = (
    "tests/algorithms/loop_closure/test_edges.py",
    "tests/algorithms/loop_closure/test_closing.py",
)
_RECORD = ("tests/algorithms/loop_closure/test_record.py",)
_ANCHORING = ("tests/algorithms/anchoring/test_anchoring.py",)

LOOP_CLOSURE = (
    Fault(
        "no_tilt_gate",
        "maplab_py/algorithms/loop_closure/gates.py",
        "    judgement.refuse(tilted, Verdict.TILTED)\n",
        "",
        _GATES,
    ),
    Fault(
        "support_counts_the_query_itself",
        "maplab_py/algorithms/loop_closure/consensus.py",
        "            other = query[i] != query[j]\n",
        "            other = query[i] >= 0\n",
        _GATES,
    ),
    Fault(
        "no_second_round_of_judging",
        "maplab_py/algorithms/loop_closure/consensus.py",
        "    for _ in range(2):\n",
        "    for _ in range(1):\n",
        _GATES,
    ),
    Fault(
        "drift_limits_closures_between_missions",
        "maplab_py/algorithms/loop_closure/gates.py",
        "    is_far_same_mission = same & (judgement.correction_m > drift)\n",
        "    is_far_same_mission = judgement.correction_m > drift\n",
        _ANCHORING,
    ),
    Fault(
        "look_alikes_not_resolved_by_odometry",
        "maplab_py/algorithms/loop_closure/gates.py",
        "    judgement.refuse(ambiguous & ~resolved, Verdict.AMBIGUOUS)\n",
        "    judgement.refuse(ambiguous, Verdict.AMBIGUOUS)\n",
        _ALIKE,
    ),
    Fault(
        "edges_without_smallest_deviation",
        "maplab_py/algorithms/loop_closure/edges.py",
        "    covariance += np.diag(_FLOOR_STD**2)\n",
        "",
        _EDGES,
    ),
    Fault(
        "edges_twice",
        "maplab_py/algorithms/loop_closure/edges.py",
        "    rows = rows[np.sort(first)]",
        "    rows = rows[: len(first) + len(rows)]",
        _EDGES,
    ),
    Fault(
        "matches_of_one_query_vote_twice",
        "maplab_py/algorithms/loop_closure/merging.py",
        "    voters = np.unique(pair.astype(np.int64) * span + query)\n",
        "    voters = np.sort(pair.astype(np.int64) * span + query)\n",
        _EDGES,
    ),
    Fault(
        "drift_of_one_mission_only",
        "maplab_py/algorithms/loop_closure/mission_alignment.py",
        "    between = np.abs(c.way_A_m - c.way_A_m[h]) + np.abs(c.way_B_m - c.way_B_m[h])\n",
        "    between = np.abs(c.way_A_m - c.way_A_m[h])\n",
        _PAIRS,
    ),
    Fault(
        "lone_closure_that_others_contradict",
        "maplab_py/algorithms/loop_closure/consensus.py",
        "    lone = (support == 0) & (against == 0) & (inliers >= rule.lone_inliers)\n",
        "    lone = (support == 0) & (inliers >= rule.lone_inliers)\n",
        _GATES,
    ),
    Fault(
        "edge_covariance_without_lever_arm",
        "maplab_py/algorithms/loop_closure/edges.py",
        "    J[:, :3, 3:] = so3.skew(T_A_B[:, 4:])\n",
        "",
        _EDGES,
    ),
    Fault(
        "neighbours_in_time_are_matched",
        "maplab_py/algorithms/loop_closure/detection.py",
        "    rule = MatchRule(round(options.min_image_time_seconds * 1e9))\n",
        "    rule = MatchRule(0)\n",
        _EDGES,
    ),
    Fault(
        "removed_closures_come_back",
        "maplab_py/algorithms/loop_closure/gates.py",
        "    judgement.refuse(banned(vi_map, query, place), Verdict.REMOVED)\n",
        "",
        _RECORD,
    ),
)
