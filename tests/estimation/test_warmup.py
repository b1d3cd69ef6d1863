from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.warmup import optimizer_jobs

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


def test_all_cameras_have_one_job() -> None:
    assert "reprojection" in optimizer_jobs()
