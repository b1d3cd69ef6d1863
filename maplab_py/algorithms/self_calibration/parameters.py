"""The calibration parameters of a problem, one by one: where they are, their names and priors."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.vi_optimization.rig_states import RigCameras, parameter_count
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.camera_terms import EXTRINSICS, INTRINSICS, TIME_OFFSET
from maplab_py.estimation.imu_calibration_terms import ACCEL, GYRO, ROTATION
from maplab_py.estimation.states import States
from maplab_py.sensors import Distortion, Projection

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_PLACES = ("x scale", "y scale", "z scale", "xy misalignment", "xz misalignment", "yz misalignment")
_AXES = ("x", "y", "z")
_DISTORTION = {
    Distortion.NONE: (),
    Distortion.RADTAN: ("k1", "k2", "p1", "p2"),
    Distortion.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    Distortion.FOV: ("w",),
}


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number of the calibration."""

    name: str  # in words, e.g. "gyroscope z scale"
    unit: str
    group: str  # imu, camera or extrinsics
    block: str
    row: int  # of the block
    column: int  # of the block's tangent vector
    prior_sigma: float


@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """The k calibration parameters that are estimated, in the order of every covariance."""

    each: tuple[Parameter, ...]

    def __len__(self) -> int:
        return len(self.each)

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k,)."""
        return tuple(one.name for one in self.each)

    @property
    def prior_sigma(self) -> F64:
        """Prior standard deviations (k,)."""
        return np.array([one.prior_sigma for one in self.each])

    def of_groups(self, groups: tuple[str, ...]) -> I64:
        """Return the rows of the parameters of some groups."""
        return np.array([k for k, one in enumerate(self.each) if one.group in groups], dtype=int)

    def nodes(self, states: States) -> tuple[I64, I64]:
        """Return the node and the direction within it (0 .. 2) of every parameter."""
        node = [states.nodes(one.block)[one.row, one.column // 3] for one in self.each]
        return np.array(node, dtype=np.int64), np.array([one.column % 3 for one in self.each])

    def difference(self, blocks: ParameterBlocks, reference: ParameterBlocks) -> F64:
        """Return the tangent vector (k,) that leads from a reference to the values."""
        change = {block.name: block.difference(reference[block.name].values) for block in blocks}
        return np.array([change[one.block][one.row, one.column] for one in self.each])


def parameters_of(
    rig: RigCameras | None, imus: int, states: States, options: SelfCalibrationOptions
) -> Parameters:
    """Return the parameters that the options ask for and the states have.

    Args:
        rig: The cameras.
        imus: Number of IMUs.
        states: States with the blocks of the calibration.
        options: What to estimate, and how well it is known beforehand.
    """
    wanted, found = options.estimated(), list[Parameter]()
    if "imu" in wanted and GYRO in states.blocks:
        found += _imu(imus, options)
    if rig is not None and INTRINSICS in states.blocks:
        if "intrinsics" in wanted:
            found += _intrinsics(rig, options)
        found += _extrinsics(len(rig.owner), wanted, options)
    return Parameters(tuple(found))


def _numbered(what: str, row: int, count: int) -> str:
    return what if count == 1 else f"{what} {row}"


def _imu(count: int, options: SelfCalibrationOptions) -> list[Parameter]:
    found = []
    sigma = [options.prior_imu_scale] * 3 + [options.prior_imu_misalignment] * 3
    for row in range(count):
        for block, what in ((GYRO, "gyroscope"), (ACCEL, "accelerometer")):
            name = _numbered(what, row, count)
            found += [
                Parameter(f"{name} {place}", "", "imu", block, row, k, sigma[k])
                for k, place in enumerate(_PLACES)
            ]
        name = _numbered("accelerometer", row, count)
        turn = float(np.deg2rad(options.prior_imu_rotation_deg))
        found += [
            Parameter(f"{name} rotation about {axis}", "rad", "imu", ROTATION, row, k, turn)
            for k, axis in enumerate(_AXES)
        ]
    return found


def _intrinsics(rig: RigCameras, options: SelfCalibrationOptions) -> list[Parameter]:
    found, counts = [], parameter_count(rig)
    for row in range(len(rig.owner)):
        values = rig.cameras.parameters[row]
        projection, distortion = rig.models[int(values[0])]
        names = ["focal length u", "focal length v", "centre u", "centre v"]
        focal = options.prior_focal_relative * float(values[1])
        units, sigmas = ["px"] * 4, [focal, focal, *[options.prior_centre_px] * 2]
        if projection is Projection.UNIFIED:
            focal = options.prior_focal_relative * float(values[2])
            names, units = ["mirror xi", *names], ["", *units]
            sigmas = [0.2, focal, focal, *[options.prior_centre_px] * 2]
        more = _DISTORTION[distortion]
        names += [f"distortion {name}" for name in more]
        units += [""] * len(more)
        sigmas += [options.prior_distortion] * len(more)
        camera = _numbered("camera", row, len(rig.owner))
        found += [
            Parameter(f"{camera} {names[k]}", units[k], "camera", INTRINSICS, row, k, sigmas[k])
            for k in range(int(counts[row]))
        ]
    return found


def _extrinsics(
    count: int, wanted: frozenset[str], options: SelfCalibrationOptions
) -> list[Parameter]:
    found = []
    turn = float(np.deg2rad(options.prior_rotation_deg))
    for row in range(count):
        camera = _numbered("camera", row, count)
        for k, axis in enumerate(_AXES):
            if "extrinsics_translation" in wanted:
                sigma = options.prior_position_m
                name = f"{camera} position {axis}"
                found.append(Parameter(name, "m", "extrinsics", EXTRINSICS, row, k, sigma))
        for k, axis in enumerate(_AXES):
            if "extrinsics_rotation" in wanted:
                name = f"{camera} rotation about {axis}"
                found.append(Parameter(name, "rad", "extrinsics", EXTRINSICS, row, k + 3, turn))
        if "time_offset" in wanted:
            sigma = options.prior_time_offset_s
            name = f"{camera} image delay"
            found.append(Parameter(name, "s", "extrinsics", TIME_OFFSET, row, 0, sigma))
    return found
