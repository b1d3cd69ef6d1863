"""Ceres on the visual benchmark problems, through pycolmap's bundle adjuster (C++ cost functions)."""

from typing import Any

import numpy as np

from benchmarks import problems
from benchmarks.solution import Effort, Solution, StoppingRule, effort

NUM_THREADS = 2
_CAMERA = 1


def solve_visual(problem: problems.VisualProblem, rule: StoppingRule) -> tuple[Solution, Effort]:
    """Minimise the reprojection errors by Schur elimination, sparse as COLMAP does or iterative.

    Filling pycolmap's reconstruction does not count as effort: it is the form of the input.
    """
    import pycolmap

    reconstruction = _reconstruction(problem)
    config = pycolmap.BundleAdjustmentConfig()
    for keyframe in range(len(problem.T_G_I)):
        config.add_image(keyframe + 1)
    config.set_constant_cam_intrinsics(_CAMERA)
    for keyframe in range(problems.NUM_KNOWN_POSES):
        config.set_constant_rig_from_world_pose(keyframe + 1)
    options = _options(rule)
    with effort() as spent:
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
        summary = adjuster.solve().ceres_summary
    T_G_I, p_G = _states(reconstruction, problem)
    iterations = summary.num_successful_steps + summary.num_unsuccessful_steps - 1
    return Solution(T_G_I, p_G, summary.final_cost, iterations), spent


def _options(rule: StoppingRule) -> Any:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = False
    options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.ceres.auto_select_solver_type = False
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    solver = options.ceres.solver_options
    solver.linear_solver_type = type(solver.linear_solver_type).SPARSE_SCHUR
    if rule.forcing:
        solver.linear_solver_type = type(solver.linear_solver_type).ITERATIVE_SCHUR
        solver.preconditioner_type = type(solver.preconditioner_type).SCHUR_JACOBI
        solver.eta = rule.forcing
    solver.num_threads = NUM_THREADS
    solver.max_num_iterations = rule.max_iterations
    solver.initial_trust_region_radius = 1.0 / rule.initial_damping
    solver.function_tolerance = rule.function_tolerance
    solver.gradient_tolerance = 0.0
    solver.parameter_tolerance = 0.0
    return options


def _reconstruction(problem: problems.VisualProblem) -> Any:
    """Fill pycolmap's own data structure, element by element as its interface asks for."""
    import pycolmap

    result = pycolmap.Reconstruction()
    width, height = problems.IMAGE_PX.astype(int)
    parameters = [problems.FOCAL_PX, problems.FOCAL_PX, *problems.CENTRE_PX]
    camera = pycolmap.Camera(
        camera_id=_CAMERA, model="PINHOLE", width=width, height=height, params=parameters
    )
    result.add_camera_with_trivial_rig(camera)
    order = np.argsort(problem.keyframe, kind="stable")
    begin = np.searchsorted(problem.keyframe[order], np.arange(len(problem.T_G_I) + 1))
    point_in_image = np.empty(len(order), dtype=np.int64)
    point_in_image[order] = np.arange(len(order)) - begin[problem.keyframe[order]]
    for keyframe, T_G_C in enumerate(problem.initial_T_G_I):
        seen = order[begin[keyframe] : begin[keyframe + 1]]
        image = pycolmap.Image(
            name=str(keyframe), keypoints=problem.uv_px[seen], camera_id=_CAMERA,
            image_id=keyframe + 1,
        )  # fmt: skip
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(T_G_C[:4]), T_G_C[4:]).inverse()
        result.add_image_with_trivial_frame(image, pose)
    start = problem.start.tolist()
    pairs = list(zip((problem.keyframe + 1).tolist(), point_in_image.tolist(), strict=True))
    for landmark, p_G in enumerate(problem.initial_p_G):
        elements = pairs[start[landmark] : start[landmark + 1]]
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
        result.add_point3D(p_G, track)
    return result


def _states(
    reconstruction: Any, problem: problems.VisualProblem
) -> tuple[problems.F64, problems.F64]:
    T_G_I = np.empty_like(problem.T_G_I)
    for keyframe in range(len(T_G_I)):
        T_G_C = reconstruction.image(keyframe + 1).cam_from_world().inverse()
        T_G_I[keyframe, :4], T_G_I[keyframe, 4:] = T_G_C.rotation.quat, T_G_C.translation
    points = reconstruction.points3D
    p_G = np.array([points[point].xyz for point in sorted(points)])
    return T_G_I, p_G
