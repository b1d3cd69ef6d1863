"""A hash of all that a run estimates, to compare processes: `python -m tests.estimation.window.digest`."""

import hashlib

import numpy as np

from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from tests.estimation.window.recordings import scenario, simulated

_SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)


def digest_of_run() -> str:
    """Return the hash of states, covariances, prior and landmarks."""
    tracks = simulated(scenario(duration_s=2.5, keypoints=80))
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, WindowOptions())
    smoother.start(tracks.frames[0], tracks.start_state(_SIGMA))
    digest = hashlib.sha256()
    for frame in tracks.frames[1:]:
        update = smoother.add(frame)
        digest.update(update.state.T_M_I.tobytes() + update.covariance.tobytes())
    digest.update(smoother.prior.root.tobytes() + smoother.landmarks()[1].tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    print(digest_of_run())
