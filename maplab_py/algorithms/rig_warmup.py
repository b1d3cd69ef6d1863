"""What an optimisation of images and IMUs compiles for the cameras of a map, as jobs by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Self

import numpy as np

from maplab_py.algorithms.vi_optimization.calibration_states import rig_cameras
from maplab_py.compilation import is_missing_on_disk
from maplab_py.estimation.codegen.kernels import (
    residual_kernel,
    visual_kernels,
)
from maplab_py.estimation.codegen.modules import is_generated
from maplab_py.estimation.imu import preintegration
from maplab_py.estimation.kernels import imu
from maplab_py.estimation.linear import block_cholesky, supernodal
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.terms import factor, visual
from maplab_py.sensors import Distortion, Projection
from maplab_py.vimap import VIMap

REPROJECTION, INERTIAL = "reprojection", "inertial"
_MOVING = "moving"
_SHARED: dict[str, tuple[Callable[[], None], Callable[..., Any]]] = {
    "block Cholesky": (block_cholesky.compile_kernels, supernodal.factorise),
    "preintegration": (preintegration.compile_kernels, imu.preintegrate),
    "losses and normal equations": (factor.compile_kernels, factor.normal_equations),
}
"""What all rigs need: how to compile it, and a kernel that is on the disk once that is done."""


@dataclasses.dataclass(frozen=True)
class RigKernels:
    """The kernels for some camera models, with the models in the order of `rig_cameras`."""

    models: tuple[tuple[Projection, Distortion], ...]
    moving: bool  # images have a delay, or rows are read one after the other

    @classmethod
    def of_map(cls, vi_map: VIMap) -> Self:
        """Return the kernels that an optimisation of a map with all its missions needs.

        Raises:
            MapError: A mission's rig or IMU is not in sensors.yaml.
        """
        rig = rig_cameras(vi_map, np.arange(len(vi_map.missions), dtype=np.int64))
        return cls(rig.models, rig.is_moving)

    @classmethod
    def from_words(cls, words: list[str]) -> Self:
        """Return what `words` described."""
        pairs = [word.split("-") for word in words if word != _MOVING]
        models = tuple((Projection[p], Distortion[d]) for p, d in pairs)
        return cls(models, _MOVING in words)

    @property
    def words(self) -> list[str]:
        """The description as words, for the arguments of another process."""
        return [f"{p.name}-{d.name}" for p, d in self.models] + [_MOVING] * self.moving

    def jobs(self) -> dict[str, Callable[[], None]]:
        """Return by name what compiles the kernels, in the order in which it is started."""
        reprojection = partial(visual.compile_kernels)
        return {
            REPROJECTION: reprojection,
            INERTIAL: lambda: residual_kernel(INERTIAL, sources.inertial).compile_kernel(),
            **{name: compile_shared for name, (compile_shared, _) in _SHARED.items()},
        }

    def missing(self) -> tuple[str, ...]:
        """Return the names of the jobs whose kernels the disk does not have."""
        if not self.models:
            return ()
        missing = {name for name, (_, kernel) in _SHARED.items() if is_missing_on_disk(kernel)}
        if not is_generated("visual"):
            missing.add(REPROJECTION)
        else:
            kernels = visual_kernels()
            wanted = [kernels.evaluate, *([kernels.pixel_motion] if self.moving else [])]
            if any(is_missing_on_disk(kernel) for kernel in wanted):
                missing.add(REPROJECTION)
        if not is_generated(INERTIAL) or is_missing_on_disk(
            residual_kernel(INERTIAL, sources.inertial).evaluate
        ):
            missing.add(INERTIAL)
        return tuple(name for name in self.jobs() if name in missing)
