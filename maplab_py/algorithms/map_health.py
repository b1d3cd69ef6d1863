"""Health of a map: lights with figures, causes before effects, and the remedy of each fault.

Thresholds lie between the figures of real maps with small errors against ground truth and those of
maps made with wrong calibrations. Maps are not changed.
"""

import dataclasses
import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.landmarks import quality, sightings
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.loop_closure import closure_record, listing
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.reports import Verdict as ClosureVerdict
from maplab_py.algorithms.recording_check.doctor import map_findings
from maplab_py.algorithms.recording_check.findings import Check, Finding, Verdict, cause, remedies
from maplab_py.algorithms.scale_check import mission_scales
from maplab_py.array_types import F64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report, counted, view
from maplab_py.vimap import LandmarkQuality, VIMap, consistency, queries

_LIGHTS = {
    Verdict.OK: "green",
    Verdict.UNKNOWN: "grey",
    Verdict.NOTE: "yellow",
    Verdict.WRONG: "red",
    Verdict.HOPELESS: "red",
}
_COLOURS = {"green": "#1a7f37", "yellow": "#9a6700", "red": "#cf222e", "grey": "#6e7781"}
_SCALE_ERROR = 0.1
_ERROR_PX = (1.0, 2.0)
_FEW_LANDMARKS = 10
"""Good landmarks of a vertex below which images hardly fix its pose."""
_UNSEEN_SHARE = (0.05, 0.2)
_BAD_SHARE = (0.5, 0.8)
_ACCEL_BIAS_MPS2, _GYRO_BIAS_RADPS = (0.5, 1.5), (0.15, 0.4)
_BIAS_CHANGE = (5.0, 20.0)
"""Changes of biases as multiples of their random walk."""
_DRIFT = (0.01, 0.03)
_GAP_M = (0.2, 1.0)
_AMBIGUOUS_SHARE = (0.3, 0.7)
_LEAST_PATH_M = 5.0
"""Shorter loops measure noise instead of drift."""


@dataclasses.dataclass(frozen=True)
class Light:
    """One line of the page."""

    light: str  # green, yellow, red, or grey where the map does not show it
    check: str
    observed: str
    expected: str


class MapHealth(Report):
    """Findings on a map, causes before effects."""

    map_key: str
    findings: tuple[Finding, ...]

    @property
    def failure(self) -> str:
        """Return the violated rule of a map that is inconsistent; empty otherwise."""
        first = cause(self.findings)
        return first.line if first is not None and first.verdict is Verdict.HOPELESS else ""

    @property
    def advice(self) -> str:
        """Return the fault to repair first."""
        first = cause(self.findings)
        return f"{first.check}: {first.remedy}" if first is not None and first.remedy else ""

    @property
    def lights(self) -> tuple[Light, ...]:
        """The findings as lights."""
        return tuple(
            Light(_LIGHTS[f.verdict], f.check, f.observed, f.expected) for f in self.findings
        )

    def display(self) -> Any:
        """Return the lights, with the remedies below them."""
        return view(lights=self.lights, remedies=remedies(self.findings))

    def as_html(self) -> str:
        """Return the page as HTML that needs no network."""
        rows = "".join(
            f'<tr><td style="color:{_COLOURS[_LIGHTS[f.verdict]]}">&#9679; {_LIGHTS[f.verdict]}</td>'
            + "".join(
                f"<td>{html.escape(text)}</td>"
                for text in (f.check, f.observed, f.expected, f.remedy)
            )
            + "</tr>\n"
            for f in self.findings
        )
        head = "".join(f"<th>{name}</th>" for name in ("", "check", "observed", "expected", "next"))
        title = f"Health of map {html.escape(self.map_key)}"
        return (
            '<!doctype html><html lang="en"><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width"><style>body{font:16px sans-serif;'
            "margin:2em}td,th{padding:.3em .8em .3em 0;text-align:left;vertical-align:top}</style>\n"
            f"<title>{title}</title><h1>{title}</h1>\n<table><tr>{head}</tr>\n{rows}</table></html>\n"
        )


def map_health(
    vi_map: VIMap, map_key: str = "", folder: Path | None = None, progress: Progress = SILENT
) -> MapHealth:
    """Judge a map.

    Args:
        map_key: Its name, for the report.
        folder: Where it is on disk, for the space that it takes; None = it is not saved.
    """
    findings = list(_consistency(vi_map))
    if findings[0].verdict is not Verdict.HOPELESS:
        progress.step(1, 4, "calibration")
        findings += _calibration(vi_map)
        progress.step(2, 4, "scale and biases")
        findings += [*_scale(vi_map), *_biases(vi_map)]
        progress.step(3, 4, "landmarks")
        findings += [*_landmarks(vi_map, progress), *_closures(vi_map), *_base_frames(vi_map)]
    findings += _disk(vi_map, folder)
    return MapHealth(map_key, tuple(findings))


def _graded(
    check: str, value: float, bounds: tuple[float, float], observed: str, expected: str, remedy: str
) -> Finding:
    """Return a finding: well below the first bound, wrong above the second."""
    of_value = Check(check, expected)
    if value <= bounds[0]:
        return of_value.ok(observed)
    return (of_value.note if value <= bounds[1] else of_value.wrong)(observed, remedy)


def _consistency(vi_map: VIMap) -> Iterator[Finding]:
    report = consistency.check_consistency(vi_map)
    rules, check = counted(len(report.errors), "violated rule"), Check("consistency", "none")
    if report.errors:
        first = report.errors[0].rule
        yield check.hopeless(f"{rules}, first: {first}", "check_map_consistency lists them")
    else:
        yield check.ok(rules)


def _calibration(vi_map: VIMap) -> Iterator[Finding]:
    """Yield what tracks and samples show of the calibration, and the first reason for what they do not."""
    findings = map_findings(vi_map)
    yield from (f for f in findings if f.verdict is not Verdict.UNKNOWN)
    reason = next((f.observed for f in findings if f.verdict is Verdict.UNKNOWN), "")
    if reason or not findings:
        check = Check("rest of the calibration", "agrees with tracks and samples")
        yield check.unknown(reason or "no tracks and IMU samples to compare")


def _scale(vi_map: VIMap) -> Iterator[Finding]:
    scales = mission_scales(vi_map)
    labels = queries.mission_labels(vi_map)
    for scale in scales:
        check = Check(f"metric scale of {labels[scale.mission]}", "0.9 to 1.1")
        observed = f"{scale.scale:.3f} of the IMU's lengths"
        if scale.doubt:
            yield check.wrong(observed, scale.doubt)
        elif abs(scale.scale - 1.0) > _SCALE_ERROR:
            yield check.note(observed, "optvi, then self_calibrate")
        else:
            yield check.ok(observed)
    if len(scales) < len(vi_map.missions):
        missing = counted(len(vi_map.missions) - len(scales), "mission")
        check = Check("metric scale", "0.1 m/s^2")
        yield check.unknown(f"{missing} without enough acceleration")


def _biases(vi_map: VIMap) -> Iterator[Finding]:
    edges, vertices = vi_map.imu_edges, vi_map.vertices
    if not len(edges):
        return
    for name, bias, bounds, unit in (
        ("accelerometer", vertices.accel_bias, _ACCEL_BIAS_MPS2, "m/s^2"),
        ("gyroscope", vertices.gyro_bias, _GYRO_BIAS_RADPS, "rad/s"),
    ):
        largest = float(np.linalg.norm(bias, axis=1).max(initial=0.0))
        yield _graded(
            f"bias of the {name}", largest, bounds, f"at most {largest:.3g} {unit}",
            f"{bounds[0]:g} {unit}", "check_recording of the recording, or self_calibrate",
        )  # fmt: skip
    change = _bias_changes(vi_map)
    if len(change):
        typical = float(np.median(np.abs(change)))  # a start from zero biases is no fault
        yield _graded(
            "change of the biases", typical, _BIAS_CHANGE, f"{typical:.2g} times their random walk",
            f"{_BIAS_CHANGE[0]:g}", "larger bias_random_walk_noise_density in sensors.yaml, then optvi",
        )  # fmt: skip


def _bias_changes(vi_map: VIMap) -> F64:
    """Return the changes of biases over IMU edges as multiples of their random walk."""
    data = InertialData.of_map(vi_map)
    vertices = vi_map.vertices
    first, second = vi_map.imu_edges.from_vertex, vi_map.imu_edges.to_vertex
    density = np.sqrt(data.walk_variance_density[data.imu_of_edge])  # gyroscope, accelerometer
    walk = np.sqrt(data.duration_s)[:, None] * np.repeat(density, 3, axis=1)
    bias = np.hstack([vertices.gyro_bias, vertices.accel_bias])
    return np.asarray((bias[second] - bias[first])[walk > 0.0] / walk[walk > 0.0])


def _landmarks(vi_map: VIMap, progress: Progress) -> Iterator[Finding]:
    if not len(vi_map.landmarks):
        yield Check("landmarks", "landmarks").unknown("the map has none")
        return
    judged, report = quality.evaluate_quality(vi_map, LandmarkQualityOptions(), progress=progress)
    share = report.bad / max(report.landmarks, 1)
    yield _graded(
        "bad landmarks", share, _BAD_SHARE,
        f"{100.0 * share:.0f} %, most {quality.causes_in_words(vars(report))[0]}" if report.bad else "none",
        f"{100.0 * _BAD_SHARE[0]:.0f} %", "remove_bad_landmarks; why LANDMARK explains one",
    )  # fmt: skip
    keypoints = judged.observations
    landmark = judged.keypoints.landmark[keypoints]
    is_good = judged.landmarks.quality[landmark] == LandmarkQuality.GOOD
    keypoints, landmark = keypoints[is_good], landmark[is_good]
    if len(keypoints):
        error = sightings.residuals(judged, keypoints, judged.p_G[landmark]).error_px
        median = float(np.median(error))
        yield _graded(
            "reprojection error", median, _ERROR_PX, f"{median:.2f} px at the median",
            f"{_ERROR_PX[0]:g} px", "optvi",
        )  # fmt: skip
    with_frames = np.unique(judged.frames.vertex)
    seen = np.bincount(judged.keypoint_vertex[keypoints], minlength=len(judged.vertices))
    unseen = float(np.mean(seen[with_frames] < _FEW_LANDMARKS)) if len(with_frames) else 0.0
    yield _graded(
        "coverage", unseen, _UNSEEN_SHARE,
        f"{100.0 * unseen:.0f} % of the vertices see fewer than {_FEW_LANDMARKS} good landmarks",
        f"{100.0 * _UNSEEN_SHARE[0]:.0f} %", "init_track_landmarks, or record with more texture",
    )  # fmt: skip


def _closures(vi_map: VIMap) -> Iterator[Finding]:
    c = closure_record.read_record(vi_map).closures
    if not len(c):
        yield Finding(
            "loop closures", "none are recorded", "some where places are seen again", Verdict.UNKNOWN,
            "relax, then lc",
        )  # fmt: skip
        return
    is_accepted = c.verdict == VERDICTS.index(ClosureVerdict.ACCEPTED)
    is_loop = is_accepted & (c.between_m > _LEAST_PATH_M)
    if is_loop.any():
        drift = float(np.median(c.correction_m[is_loop] / c.between_m[is_loop]))
        yield _graded(
            "drift before closure", drift, _DRIFT,
            f"{100.0 * drift:.2f} % of the path at the median of {counted(int(is_loop.sum()), 'loop')}",
            f"{100.0 * _DRIFT[0]:g} %", "self_calibrate, or check_recording of the recording",
        )  # fmt: skip
    gap_m = listing.list_closures(vi_map).largest_gap_m
    yield _graded(
        "gaps at closures", gap_m, _GAP_M, f"at most {gap_m:.2f} m are left", f"{_GAP_M[0]:g} m",
        "relax, then lc (lc_report --sort_by=gap lists them)",
    )  # fmt: skip
    ambiguous = int(np.count_nonzero(c.verdict == VERDICTS.index(ClosureVerdict.AMBIGUOUS)))
    share = ambiguous / len(c)
    yield _graded(
        "ambiguous places", share, _AMBIGUOUS_SHARE,
        f"{100.0 * share:.0f} % of the candidates look the same as another place",
        f"{100.0 * _AMBIGUOUS_SHARE[0]:.0f} %", 'lc_report --reason="another place"',
    )  # fmt: skip


def _base_frames(vi_map: VIMap) -> Iterator[Finding]:
    if len(vi_map.missions) < 2:
        return
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    check = Check("base frames", "all")
    observed = f"{int(known.sum())} of {len(known)} missions are anchored"
    if known.all():
        yield check.ok(observed)
    else:
        remedy = (
            "" if known.any() else "set_mission_baseframe_to_known, then "
        ) + "anchor_all_missions"
        yield check.note(observed, remedy)


def _disk(vi_map: VIMap, folder: Path | None) -> Iterator[Finding]:
    import shutil

    needed_gb = 1e-9 * vi_map.nbytes()
    if folder is None or not folder.is_dir():
        yield Check("disk", "room for two copies").unknown("the map is not saved")
        return
    free_gb = 1e-9 * shutil.disk_usage(folder).free
    size_gb = 1e-9 * sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    path_m = float(queries.mission_distances_m(vi_map).sum())
    rate = f", {1e3 * size_gb / path_m:.2g} MB per metre" if path_m > 1.0 else ""
    yield _graded(
        "disk", 2.0 * max(size_gb, needed_gb), (free_gb, free_gb),
        f"{1e3 * size_gb:.1f} MB{rate}, {free_gb:.0f} GB free", "room for two copies",
        "clean_up_resource_folders, or save elsewhere",
    )  # fmt: skip
