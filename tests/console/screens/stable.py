"""Screens without what differs between machines: times, sizes of files, folders, estimates."""

import os
import re
from pathlib import Path

from maplab_py.kernel_cache import cache_root

_FRACTION = re.compile(r"-?\d+(?:\.\d+(?:e[+-]\d+)?|e[+-]\d+)|\bnan\b")
_NUMBER = re.compile(r"(?<![\w.#-])-?\d+(?:\.\d+)?(?:e[+-]\d+)?(?![\w.#])")
_ID = re.compile(r"\b[0-9a-f]{8}\b")
_MEASURED = re.compile(r"\btime\b|\[ms\]|\[MB\]|\[GB\]|\[MB/s\]|^fingerprint$")
"""Headings of values that depend on the machine or on the version of a compressor."""
_REPLACED = (
    (re.compile(r"127\.0\.0\.1:\d+"), "127.0.0.1:8080"),
    (re.compile(r"[\d,]+ bytes"), "# bytes"),
    (re.compile(r"\b\d+\.\d+\.\d+\b"), "#.#.#"),  # versions
    (re.compile(r"\d+\.\d MB"), "#.# MB"),
)

ESTIMATES = {
    "anchor_all_missions",
    "anchor_mission",
    "assign_edge_uncertainties",
    "assign_switch_variable_uncertainties_for_loop-closure_edges",
    "assign_switch_variable_values_for_loop-closure_edges",
    "collect_segments",
    "convert_all_depth_maps_to_point_clouds",
    "create_esdf_from_depth_resource",
    "create_localization_summary_map",
    "create_mesh_from_tsdf_grid",
    "create_tsdf_from_depth_resource",
    "demo",
    "evaluate_segment_information",
    "extract_features",
    "judge_closures",
    "landmark_sparsify",
    "localize",
    "lc_report_accepted",
    "lc_report_refused",
    "loopclosure_all_missions",
    "loopclosure_one_mission",
    "mission_coobservability_stats_of_joined",
    "optimize_visual",
    "optimize_visual_inertial",
    "prune_segments",
    "register_point_clouds",
    "relax",
    "relax_external",
    "relax_missions_independently",
    "remove_invalid_observations",
    "remove_loopclosure",
    "rovioli",
    "segment_database_stats",
    "self_calibrate",
    "simulate_robots",
    "stereo_dense_reconstruction",
    "suggest_motion",
    "timing",
    "track_features",
    "train_projection_matrix",
    "visualize_esdf",
    "visualize_loop_closures",
    "visualize_mesh",
    "why_closure",
    "why_pair",
}
"""Commands whose numbers come from iterations, images or clocks: only their layout is compared."""


class Stable:
    """Replaces what differs between machines in the texts of one command."""

    def __init__(self, command: str) -> None:
        """Look up the command and the folders of this machine.

        Args:
            command: Its name.
        """
        self._is_estimate = command in ESTIMATES
        folders = {
            str(Path.cwd()): "/work",
            str(cache_root()): "/cache",
            os.environ.get("XDG_STATE_HOME", ""): "/state",
            os.environ.get("XDG_CONFIG_HOME", ""): "/config",
        }
        self._folders = {folder: name for folder, name in folders.items() if folder}

    def text(self, text: str) -> str:
        """Replace folders and addresses, and in estimates all numbers."""
        for folder, name in self._folders.items():
            text = text.replace(folder, name)
        for pattern, replacement in _REPLACED:
            text = pattern.sub(replacement, text)
        if self._is_estimate:
            text = _ID.sub("########", text)
            text = _NUMBER.sub(_masked, text)
        return text

    def value(self, heading: str, text: str) -> str:
        """Replace also the numbers of a value that is measured."""
        return _NUMBER.sub(_masked, text) if _MEASURED.search(heading) else self.text(text)


def _masked(match: re.Match[str]) -> str:
    return "#.##" if _FRACTION.fullmatch(match[0]) else "#"
