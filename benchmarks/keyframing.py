"""Time of keyframing ten minutes at 10 Hz, and how exactly its inertial edges are merged.

python -m benchmarks.keyframing
"""

import time

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from tests.algorithms.keyframing.test_keyframing import largest_difference, ten_minutes
from tests.support.machine import slowness

REPEATS = 5


def main() -> None:
    """Print processor times, the machine's factor, and the largest difference of predictions."""
    before = ten_minutes()
    options = KeyframingOptions(min_shared_landmarks_obs=5)
    for _ in range(REPEATS):
        factor = slowness()
        begin = time.process_time()
        after, report = keyframe(before, options)
        seconds = time.process_time() - begin
        factor = 0.5 * (factor + slowness())
        print(
            f"{report.vertices_before} -> {report.vertices_after} vertices, "
            f"{len(before.imu_samples)} samples: {seconds:.2f} s processor, machine {factor:.2f} "
            f"times slower than ordinary: {seconds / factor:.2f} s"
        )
    position, rotation = largest_difference(before, after)
    print(f"predictions differ by at most {position:.1e} m or m/s and {rotation:.1e} rad")


if __name__ == "__main__":
    main()
