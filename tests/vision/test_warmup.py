from __future__ import annotations

from maplab_py.vision import kmeans, pose_kernels, projection, search_kernels, track_union
from maplab_py.vision.warmup import compile_poses, compile_search


def test_warmup_compiles_every_kernel_that_place_recognition_calls():
    compile_search()
    compile_poses()
    for kernel in (
        kmeans._nearest,
        projection._sum_table,
        search_kernels.bits_between,
        search_kernels.search_all,
        search_kernels.search_cells,
        track_union._unite,
        pose_kernels.search_poses,
    ):
        assert len(kernel.signatures) >= 1


def test_a_search_on_a_map_compiles_nothing_more():
    from maplab_py.algorithms.loop_closure.closing import close_loops
    from tests.algorithms.loop_closure.rooms import Walk, make_map

    compile_search()
    compile_poses()
    kernels = (
        kmeans._nearest,
        projection._sum_table,
        search_kernels.bits_between,
        search_kernels.search_cells,
        track_union._unite,
        pose_kernels.search_poses,
    )
    before = [list(kernel.signatures) for kernel in kernels]
    vi_map, _ = make_map([Walk(room=1), Walk(room=1, start_s=60.0)])
    close_loops(vi_map)
    assert [list(kernel.signatures) for kernel in kernels] == before
