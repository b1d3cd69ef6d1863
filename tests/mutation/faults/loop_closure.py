"""Faults of loop closure: gates, consensus, merging, edges."""

from tests.mutation.fault import Fault

_GATES = ("tests/algorithms/loop_closure/test_gates.py",)
_PAIRS = ("tests/algorithms/loop_closure/test_mission_pairs.py",)
_EDGES = (
    "tests/algorithms/loop_closure/test_gates.py",
    "tests/algorithms/loop_closure/test_closing.py",
)
_RECORD = ("tests/algorithms/loop_closure/test_explanation.py",)
_ANCHORING = ("tests/algorithms/anchoring/test_anchoring.py",)

LOOP_CLOSURE = (
    Fault(
        "no_tilt_gate",
        "maplab_py/algorithms/loop_closure/gates.py",
        "c.tilt_deg, o.max_gravity_deviation_deg, ",
        "c.tilt_deg, np.inf, ",
        _GATES,
    ),
    Fault(
        "support_counts_the_query_itself",
        "maplab_py/algorithms/loop_closure/consensus.py",
        "between < _NEAR_M, query[i] != query[j]",
        "between < _NEAR_M, query[i] >= 0",
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
        "between_m=np.where(a == b, np.abs(way_m[query] - way_m[place]), np.nan),",
        "between_m=np.abs(way_m[query] - way_m[place]),",
        _ANCHORING,
    ),
    Fault(
        "look_alikes_not_resolved_by_odometry",
        "maplab_py/algorithms/loop_closure/gates.py",
        "v.accepted & v.is_related & ~j.is_usual",
        "v.accepted & v.is_related",
        _GATES,
    ),
    Fault(
        "edges_without_smallest_deviation",
        "maplab_py/algorithms/loop_closure/closure_table.py",
        " + np.diag(_FLOOR_STD**2)",
        "",
        _EDGES,
    ),
    Fault(
        "edges_twice",
        "maplab_py/algorithms/loop_closure/closure_table.py",
        "    rows = rows[np.sort(first)]",
        "    rows = rows[: len(first) + len(rows)]",
        _EDGES,
    ),
    Fault(
        "matches_of_one_query_vote_twice",
        "maplab_py/algorithms/loop_closure/merging.py",
        "    voters = distinct(pair * span + votes.query[open_])\n",
        "    voters = np.sort(pair * span + votes.query[open_])\n",
        _EDGES,
    ),
    Fault(
        "drift_of_one_mission_only",
        "maplab_py/algorithms/loop_closure/mission_alignment.py",
        " + np.abs(c.way_B_m[rows] - c.way_B_m[h])\n",
        "\n",
        _PAIRS,
    ),
    Fault(
        "lone_closure_that_others_contradict",
        "maplab_py/algorithms/loop_closure/consensus.py",
        "return support, smallest, (support == 0) & (against == 0.0)",
        "return support, smallest, support == 0",
        _GATES,
    ),
    Fault(
        "edge_covariance_without_lever_arm",
        "maplab_py/algorithms/loop_closure/closure_table.py",
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
        "    j.refuse(banned(vi_map, query, place), Verdict.REMOVED)\n",
        "",
        _RECORD,
    ),
)
