"""All kernels compiled at once, for a wheel, for tests, and for `maplab warmup`.

A job calls kernels that are needed together with small arguments of the types that commands use.
"""

import gc
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, wait
from multiprocessing.process import BaseProcess

import numpy as np

from maplab_py.algorithms.dense import grid_kernels, reconstruction, triangle_tree
from maplab_py.algorithms.localization import guided
from maplab_py.algorithms.relaxation.graph_files import map_of_graph
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.array_types import F64
from maplab_py.cancellation import cleaned_up
from maplab_py.compilation import TARGET
from maplab_py.estimation.warmup import optimizer_jobs
from maplab_py.estimation.window.warmup import window_jobs
from maplab_py.frontend import gyroscope
from maplab_py.frontend.initialization import gyro_bias
from maplab_py.geometry import se3
from maplab_py.interop.g2o import PoseGraph
from maplab_py.kernel_cache import cache_folder
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.simulation.imaging import Brightness, Imager
from maplab_py.simulation.ray_caster import painted_boxes
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.scene import make_scene
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf.scan import estimate
from maplab_py.vimap.descriptors import FeatureType
from maplab_py.vision import (
    absolute_pose,
    descriptors,
    epipolar_matching,
    index,
    point_covariance,
    rays_and_points,
    track_union,
)
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.tracking import tracker


def jobs() -> dict[str, Callable[[], None]]:
    """Return by name what compiles kernels that are needed together."""
    return {
        **optimizer_jobs(),
        **window_jobs(),
        "descriptor search": _compile_search,
        "feature tracking": tracker.compile_kernels,
        "descriptors of numbers": _compile_numbers,
        "absolute pose": absolute_pose.compile_kernels,
        "relaxation": _relax_circle,
        "message scan": _scan_message,
        "dense maps": _compile_dense,
        "guided matching": guided.compile_kernels,
        "image rendering": _render_room,
        "start of the odometry": gyro_bias.compile_kernels,
        "gyroscope": gyroscope.compile_kernels,
    }


def compile_kernels(progress: Progress) -> tuple[list[str], float, str]:
    """Compile all kernels; return their names, the time it took [s], and the cache folder.

    Several processes compile at a time; they share what they make through the cache folder.
    """
    start = time.perf_counter()
    names = list(jobs())
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    workers = min(len(names), os.cpu_count() or 1)
    folder = cache_folder(TARGET)  # a temporary one must be known before processes inherit it
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start_process)
    with cleaned_up(lambda: _end(pool, others)):
        pending = {pool.submit(_compile, name) for name in reversed(names)}
        while pending:
            progress.step(len(names) - len(pending), len(names), "compile kernels")
            done, pending = wait(pending, timeout=0.2)
            for future in done:
                future.result()
    progress.step(len(names), len(names), "compile kernels")
    return [name.lower() for name in names], time.perf_counter() - start, str(folder.parent)


def _compile(name: str) -> None:
    jobs()[name]()


def _end(pool: ProcessPoolExecutor, others: set[BaseProcess]) -> None:
    """End the processes of a pool, whatever they do."""
    pool.shutdown(wait=False, cancel_futures=True)
    for process in set(multiprocessing.active_children()) - others:
        process.kill()


def _start_process() -> None:
    """Leave Ctrl-C, which the terminal sends to all processes, to the console; collect garbage seldom.

    The compiler makes many small objects that live until its end: collections are a tenth of the time.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)


def _compile_numbers() -> None:
    """Compile the search of descriptors that are not binary, and the tracks of extracted features."""
    index.compile_kernels(DescriptorKind(8, FeatureType.SIFT))
    descriptors.compile_kernels(np.int8)
    epipolar_matching.compile_kernels()


def _compile_search() -> None:
    """Compile the descriptor indices, and what merging landmarks needs."""
    for module in (index, descriptors, track_union, point_covariance, rays_and_points):
        module.compile_kernels()


def _compile_dense() -> None:
    """Compile the kernels of stereo, fusion and distances."""
    for module in (reconstruction, grid_kernels, triangle_tree):
        module.compile_kernels()


def _scan_message() -> None:
    """Compile the walk over the fields of a message and the reading of ids."""
    from maplab_py.storage.protobuf import id_fields_kernel

    message = pb.VIMapMetadata()
    message.files.add(file_type=0, path="missions")
    begin = np.zeros(1, dtype=np.int64)
    data = np.frombuffer(bytes(1), dtype=np.uint8)
    id_fields_kernel.parts_of_field(data, 1)
    id_fields_kernel.read_ids(data, begin[:0], begin[:0], 1, 0)
    id_fields_kernel.landmark_columns(data, begin[:0], begin[:0])
    estimate(message.SerializeToString(), pb.VIMapMetadata.DESCRIPTOR)  # type: ignore[arg-type]


def _relax_circle(poses: int = 12) -> None:
    """Relax a map of a circle of poses whose ends meet."""
    T_G_V = se3.identity(poses)
    T_G_V[:, 4] = np.sin(2.0 * np.pi * np.arange(poses) / poses)
    T_G_V[:, 5] = np.cos(2.0 * np.pi * np.arange(poses) / poses)
    first = np.append(np.arange(poses - 1), [0, 1])
    second = np.append(np.arange(1, poses), [poses - 1, poses - 2])
    T_A_B = se3.compose(se3.inverse(T_G_V[first]), T_G_V[second])
    T_A_B[-1, 4] += 0.01
    graph = PoseGraph(
        id=np.arange(poses, dtype=np.uint64),
        T_G_V=T_G_V,
        first=first,
        second=second,
        T_A_B=T_A_B,
        information=np.tile(1e4 * np.eye(6), (len(first), 1, 1)),
        fixed=np.zeros(1, dtype=np.int64),
    )
    relax(map_of_graph(graph), RelaxationOptions())


def _render_room() -> None:
    """Render a tiny image, which compiles the ray caster and the formation of images."""
    options, rng = ImageOptions(texel_m=0.1), np.random.default_rng(0)
    room = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    scene = make_scene(room, 0.1 * room[None] + 0.5, options, rng)
    pinhole = Projection.PINHOLE
    camera = Camera("0" * 32, pinhole, Distortion.NONE, np.full(4, 8.0), np.zeros(0), 16, 16)

    def at_time(time_s: F64) -> F64:
        return se3.identity(len(time_s))

    imager = Imager.of(painted_boxes(scene), camera, options, 0.0, at_time, Brightness())
    imager.image(0.0, rng)


if __name__ == "__main__":
    compile_kernels(SILENT)
