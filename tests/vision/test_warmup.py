import numpy as np

from maplab_py.vision import (
    epipolar_matching,
    kmeans,
    pose_kernels,
    projection,
    search_kernels,
    track_union,
)
from maplab_py.vision.features import detection
from maplab_py.vision.tracking import flow_kernels, motion, patch_kernels, stereo_kernels, tracker
from maplab_py.warmup import jobs
from tests.vision.tracking.rendered import pose, stereo


def compile_usual_kernels():
    jobs()["descriptor search"]()
    jobs()["absolute pose"]()


def test_warmup_compiles_every_kernel_that_place_recognition_calls():
    compile_usual_kernels()
    for kernel in (
        kmeans._nearest,
        projection._sum_table,
        search_kernels.differences_between,
        search_kernels.search_cells,
        track_union._unite,
        pose_kernels.search_poses,
    ):
        assert len(kernel.signatures) >= 1


def test_warmup_compiles_the_search_of_numbers():
    jobs()["descriptors of numbers"]()
    words = {str(signature[1]) for signature in search_kernels.search_cells.signatures}
    assert any("int8" in text for text in words)
    assert len(epipolar_matching._fill.signatures) >= 2


def test_a_search_on_a_map_compiles_nothing_more():
    from maplab_py.algorithms.loop_closure.workflow import close_loops
    from tests.algorithms.loop_closure.rooms import Walk, make_map

    compile_usual_kernels()
    kernels = (
        kmeans._nearest,
        projection._sum_table,
        search_kernels.differences_between,
        search_kernels.search_cells,
        track_union._unite,
        pose_kernels.search_poses,
    )
    before = [list(kernel.signatures) for kernel in kernels]
    vi_map, _ = make_map([Walk(room=1), Walk(room=1, start_s=60.0)])
    close_loops(vi_map)
    assert [list(kernel.signatures) for kernel in kernels] == before


def test_tracking_compiles_nothing_after_the_warmup():
    tracker.compile_kernels()
    kernels = (
        detection.corner_strengths,
        detection.occupy_all,
        detection.select_corners,
        flow_kernels.follow_on_level,
        patch_kernels.align_patches,
        patch_kernels.sample_patches,
        stereo_kernels.check_matches,
        stereo_kernels.expect_distances,
        motion.search_turn,
        motion.search_two_point,
    )
    before = [list(kernel.signatures) for kernel in kernels]
    assert all(before)
    rig = stereo()
    frame_tracker = tracker.FrameTracker(rig.cameras, rig.T_I_C)
    for time_ns, turn in enumerate((None, np.eye(3), None)):
        frame_tracker.track(time_ns, rig.images(pose(y=0.02 * time_ns)), turn)
    assert [list(kernel.signatures) for kernel in kernels] == before
