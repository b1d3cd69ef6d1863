"""Faults of the estimator, anchoring, relaxation, sparsification, keyframing and the viewer."""

from tests.mutation.fault import Fault

_ESTIMATION = (
    "tests/estimation",
    "tests/algorithms/vi_optimization",
)
_ANCHORING = ("tests/algorithms/anchoring",)
_RELAXATION = ("tests/algorithms/relaxation",)
_SPARSIFICATION = ("tests/algorithms/sparsification",)
_KEYFRAMING = ("tests/algorithms/keyframing",)
_VIEWER = ("tests/viewer",)

ALGORITHMS = (
    Fault(
        "uphill_steps_are_kept",
        "maplab_py/estimation/problem/solver.py",
        "    run.return_to_best()\n",
        "",
        _ESTIMATION,
    ),
    Fault(
        "cycles_not_checked",
        "maplab_py/algorithms/anchoring/anchoring.py",
        "known, consistent(pairs, options, names), options)",
        "known, pairs, options)",
        _ANCHORING,
    ),
    Fault(
        "tree_not_checked",
        "maplab_py/algorithms/anchoring/anchoring.py",
        "    checked = [_against_tree(p, T_G_M, reached, options) for p in pairs]\n",
        "    checked = list(pairs)\n",
        _ANCHORING,
    ),
    Fault(
        "weakest_spanning_tree",
        "maplab_py/algorithms/anchoring/anchoring.py",
        "key=lambda p: -p.weight)",
        "key=lambda p: p.weight)",
        _ANCHORING,
    ),
    Fault(
        "core_not_judged_again",
        "maplab_py/algorithms/relaxation/robust.py",
        "            if np.any(kept & ~core):",
        "            if np.any(kept & ~kept):",
        _RELAXATION,
    ),
    Fault(
        "one_start_only",
        "maplab_py/algorithms/relaxation/robust.py",
        "_STARTS = (1.0, 0.5)\n",
        "_STARTS = (1.0,)\n",
        _RELAXATION,
    ),
    Fault(
        "weights_ignored",
        "maplab_py/algorithms/sparsification/sparsify.py",
        "    if options.weighted:\n",
        "    if options.weighted is None:\n",
        _SPARSIFICATION,
    ),
    Fault(
        "wanted_more_than_can_be",
        "maplab_py/algorithms/sparsification/sparsify.py",
        "        wanted=np.minimum(available, wanted),\n",
        "        wanted=np.full(len(vertices), wanted),\n",
        _SPARSIFICATION,
    ),
    Fault(
        "coverage_wants_more_than_was",
        "maplab_py/algorithms/sparsification/sparsify.py",
        "    wanted = np.minimum(before, options.min_keypoints_per_keyframe)\n",
        "    wanted = np.full(size, options.min_keypoints_per_keyframe)\n",
        _SPARSIFICATION,
    ),
    Fault(
        "keyframe_at_the_distance",
        "maplab_py/algorithms/keyframing/heuristic.py",
        "> o.distance_threshold_m",
        ">= o.distance_threshold_m",
        _KEYFRAMING,
    ),
    Fault(
        "keyframe_at_the_rotation",
        "maplab_py/algorithms/keyframing/heuristic.py",
        "> o.rotation_threshold_deg",
        ">= o.rotation_threshold_deg",
        _KEYFRAMING,
    ),
    Fault(
        "keyframe_after_the_nth",
        "maplab_py/algorithms/keyframing/heuristic.py",
        ">= o.every_nth_vertex",
        "> o.every_nth_vertex",
        _KEYFRAMING,
    ),
    Fault(
        "keyframe_with_enough_landmarks",
        "maplab_py/algorithms/keyframing/heuristic.py",
        "shared < o.min_shared_landmarks_obs",
        "shared <= o.min_shared_landmarks_obs",
        _KEYFRAMING,
    ),
    Fault(
        "title_not_escaped",
        "maplab_py/viewer/display/panel.py",
        "{escape(scene.title)}",
        "{scene.title}",
        _VIEWER,
    ),
)
