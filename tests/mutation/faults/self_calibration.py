"""Faults of self-calibration: segments, their scores and tests, export."""

from tests.mutation.fault import Fault

_SINGLE = ("tests/algorithms/self_calibration/test_uncertainty.py",)
_SEGMENTS = ("tests/algorithms/self_calibration/test_segments.py",)
_ESTIMATION = ("tests/algorithms/self_calibration/test_estimation.py",)
_CHECKS = ("tests/algorithms/self_calibration/test_calibration.py",)

SELF_CALIBRATION = (
    Fault(
        "covariance_follows_the_residuals_down",
        "maplab_py/algorithms/self_calibration/pruning.py",
        "max(fit, 1.0)",
        "fit",
        _SINGLE,
    ),
    Fault(
        "covariance_ignores_the_residuals",
        "maplab_py/algorithms/self_calibration/pruning.py",
        "uncertainty.covariance(formal_scale=max(fit, 1.0))",
        "uncertainty.covariance()",
        _SINGLE,
    ),
    Fault(
        "variance_not_shrunk_by_the_prior",
        "maplab_py/algorithms/self_calibration/pruning.py",
        "root = np.sqrt(1.0 - eigen.prior_share[determined])",
        "root = np.ones(int(determined.sum()))",
        _SINGLE,
    ),
    Fault(
        "half_against_half_is_decided",
        "maplab_py/algorithms/self_calibration/pruning.py",
        "    if 2 * against >= len(tests):\n",
        "    if 2 * against > len(tests):\n",
        _SINGLE,
    ),
    Fault(
        "segments_do_not_share_their_boundary",
        "maplab_py/algorithms/self_calibration/segments/splitting.py",
        "max(keyframes - 1, 1)",
        "keyframes",
        _SEGMENTS,
    ),
    Fault(
        "gaps_between_missions_are_bridged",
        "maplab_py/algorithms/self_calibration/estimation/problem.py",
        "(run[1:] != run[:-1]) & (mission[1:] == mission[:-1])",
        "run[1:] != run[:-1]",
        _SINGLE,
    ),
    Fault(
        "uninformative_segments_look_certain",
        "maplab_py/algorithms/self_calibration/segments/selection.py",
        "    prior = np.diag(parameters.prior_sigma**2)\n",
        "    prior = np.diag(1e-4 * parameters.prior_sigma**2)\n",
        _SINGLE,
    ),
    Fault(
        "scores_at_another_calibration",
        "maplab_py/algorithms/self_calibration/segments/selection.py",
        "        source = device.with_device_of(source, database.vi_map)\n",
        "        source = source.replace()\n",
        _SINGLE,
    ),
    Fault(
        "least_informative_takes_the_best",
        "maplab_py/algorithms/self_calibration/segments/database.py",
        '    sign = -1.0 if self.selection == "least_informative" else 1.0\n',
        "    sign = 1.0\n",
        _SINGLE,
    ),
    Fault(
        "noise_biased_by_the_cut",
        "maplab_py/algorithms/self_calibration/estimation/solution.py",
        "freedom[kept] + 2.0",
        "freedom[kept]",
        _ESTIMATION,
    ),
    Fault(
        "remainders_of_tracks_are_trusted",
        "maplab_py/algorithms/self_calibration/estimation/solution.py",
        "    whole = alive[left[alive] >= _MIN_SHARE_LEFT * np.diff(data.start)[alive]]\n",
        "    whole = alive\n",
        _ESTIMATION,
    ),
    Fault(
        "short_path_alone_is_lost_scale",
        "maplab_py/algorithms/self_calibration/calibration.py",
        "    has_shrunk = np.all(after_m < _MIN_RATIO * before_m, axis=0)\n",
        "    has_shrunk = np.any(after_m < _MIN_RATIO * before_m, axis=0)\n",
        _ESTIMATION,
    ),
    Fault(
        "spread_of_parts_not_of_their_mean",
        "maplab_py/algorithms/self_calibration/checks.py",
        "    spread = np.std(changes, axis=0, ddof=1) / np.sqrt(len(changes))\n",
        "    spread = np.std(changes, axis=0, ddof=1)\n",
        _CHECKS,
    ),
)
