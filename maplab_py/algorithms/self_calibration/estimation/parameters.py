"""The calibration parameters of a problem: place among the states, name, unit and prior."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.vi_optimization.calibration_states import RigCameras, parameter_count
from maplab_py.array_types import F64, I64
from maplab_py.estimation.blocks import Manifold, ParameterBlocks
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS, TIMING
from maplab_py.estimation.terms.inertial_calibration import ACCEL, GYRO, ROTATION
from maplab_py.sensors.camera import DISTORTION_SIZE, MIRROR_NAMES, parameter_names
from maplab_py.sensors.imu import TRIANGLE_NAMES

_PRIOR_MIRROR = 0.2
"""Prior deviation of the mirror parameter of unified projection."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A scalar of the calibration."""

    name: str  # e.g. "gyroscope z scale"
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
        return tuple(parameter.name for parameter in self.each)

    @property
    def prior_sigma(self) -> F64:
        """Prior standard deviations (k,)."""
        return np.array([parameter.prior_sigma for parameter in self.each])

    def of_groups(self, groups: tuple[str, ...]) -> I64:
        """Return the rows of the parameters of some groups."""
        return np.array([k for k, p in enumerate(self.each) if p.group in groups], dtype=int)

    def nodes(self, states: States) -> tuple[I64, I64]:
        """Return the node and the direction within it (0 .. 2) of every parameter."""
        node = [states.nodes(p.block)[p.row, p.column // 3] for p in self.each]
        return np.array(node, dtype=np.int64), np.array([p.column % 3 for p in self.each])

    def difference(self, blocks: ParameterBlocks, reference: ParameterBlocks) -> F64:
        """Return the tangent vector (k,) from a reference to the values."""
        change = {block.name: block.difference(reference[block.name].values) for block in blocks}
        return np.array([change[p.block][p.row, p.column] for p in self.each])

    def values(self, blocks: ParameterBlocks) -> F64:
        """Return the values (k,); zero for poses and rotations, which are reported as changes."""
        values = np.zeros(len(self))
        for k, parameter in enumerate(self.each):
            block = blocks[parameter.block]
            if block.manifold is Manifold.VECTOR:
                values[k] = block.values[parameter.row, parameter.column]
        return values


def parameters_of(
    rig: RigCameras | None, imus: int, states: States, options: SelfCalibrationOptions
) -> Parameters:
    """Return the parameters that the options ask for and the states have.

    Args:
        rig: The cameras.
        imus: Number of IMUs.
        states: States with the blocks of the calibration.
    """
    names, parameters = options.estimated(), list[Parameter]()
    if "imu" in names and GYRO in states.blocks:
        for row, number in _numbered(imus):
            parameters += _imu(row, number, options)
    if rig is not None and INTRINSICS in states.blocks:
        if "intrinsics" in names:
            for row, number in _numbered(len(rig.owner)):
                parameters += _intrinsics(rig, row, number, options)
        for row, number in _numbered(len(rig.owner)):
            parameters += _extrinsics(row, number, names, options)
    return Parameters(tuple(parameters))


def _numbered(count: int) -> Iterator[tuple[int, str]]:
    """Yield the rows of some sensors and what follows their kind in names."""
    for row in range(count):
        yield row, "" if count == 1 else f" {row}"


def _imu(row: int, number: str, options: SelfCalibrationOptions) -> list[Parameter]:
    sigma = [options.prior_imu_scale] * 3 + [options.prior_imu_misalignment] * 3
    turn = float(np.deg2rad(options.prior_imu_rotation_deg))
    matrices = [
        Parameter(f"{sensor}{number} {name}", "", "imu", block, row, k, sigma[k])
        for block, sensor in ((GYRO, "gyroscope"), (ACCEL, "accelerometer"))
        for k, name in enumerate(TRIANGLE_NAMES)
    ]
    name = f"accelerometer{number} rotation about"
    rotation = [
        Parameter(f"{name} {axis}", "rad", "imu", ROTATION, row, k, turn)
        for k, axis in enumerate("xyz")
    ]
    return [*matrices, *rotation]


def _intrinsics(
    rig: RigCameras, row: int, number: str, options: SelfCalibrationOptions
) -> list[Parameter]:
    projection, distortion = rig.models[row]
    mirrors = len(MIRROR_NAMES[projection])
    focal = options.prior_focal_relative * float(rig.cameras.parameters[row, 1 + mirrors])
    sigma = [_PRIOR_MIRROR] * mirrors + [focal] * 2 + [options.prior_centre_px] * 2
    sigma += [options.prior_distortion] * DISTORTION_SIZE[distortion]
    names = parameter_names(projection, distortion)
    return [
        Parameter(f"camera{number} {name}", unit, "camera", INTRINSICS, row, k, sigma[k])
        for k, (name, unit) in enumerate(names[: int(parameter_count(rig)[row])])
    ]


def _extrinsics(
    row: int, number: str, names: frozenset[str], options: SelfCalibrationOptions
) -> list[Parameter]:
    turn = float(np.deg2rad(options.prior_rotation_deg))
    camera, group, parameters = f"camera{number}", "extrinsics", list[Parameter]()

    def add(name: str, unit: str, block: str, column: int, sigma: float) -> None:
        parameters.append(Parameter(f"{camera} {name}", unit, group, block, row, column, sigma))

    if "extrinsics_translation" in names:
        for k, axis in enumerate("xyz"):
            add(f"position {axis}", "m", EXTRINSICS, k, options.prior_position_m)
    if "extrinsics_rotation" in names:
        for k, axis in enumerate("xyz"):
            add(f"rotation about {axis}", "rad", EXTRINSICS, k + 3, turn)
    if "time_offset" in names:
        add("image delay", "s", TIMING, 0, options.prior_time_offset_s)
    if "line_delay" in names:
        add("line delay", "s", TIMING, 1, 1e-6 * options.prior_line_delay_us)
    return parameters
