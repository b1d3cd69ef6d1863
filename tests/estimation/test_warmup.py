from __future__ import annotations

from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.warmup import optimizer_jobs
from maplab_py.sensors.camera import CAMERA_MODELS, is_known_to_maplab

RESIDUALS = [
    name
    for name, value in vars(sources).items()
    if not name.startswith("_") and getattr(value, "__module__", "") == sources.__name__
    if not isinstance(value, type)
]


def test_every_residual_is_compiled_by_its_name() -> None:
    jobs = optimizer_jobs()
    assert len(RESIDUALS) >= 7
    assert set(RESIDUALS) <= set(jobs)
    for name in RESIDUALS:
        jobs[name]()
        kernel = residual_kernel(name, getattr(sources, name))
        assert kernel.evaluate.signatures


def test_every_camera_model_has_its_jobs() -> None:
    jobs = optimizer_jobs()
    for projection, distortion in filter(lambda m: is_known_to_maplab(*m), CAMERA_MODELS):
        model = f"{projection.name} {distortion.name}"
        assert {f"reprojection {model}", f"camera calibration {model}"} <= set(jobs)
