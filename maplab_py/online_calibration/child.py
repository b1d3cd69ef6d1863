"""A process of low priority that answers the requests of one odometry.

`python -m maplab_py.online_calibration.child SOCKET`, as `child_processes.Service` starts it.
"""

import contextlib
import os

from maplab_py.child_processes import serve
from maplab_py.errors import MaplabError
from maplab_py.online_calibration import process

_NICENESS = 10


class Answerer:
    """Answers requests; the first of them opens the database."""

    def __init__(self) -> None:
        self._calibration: process.DeviceCalibration | None = None

    def __call__(self, request: process.Opening | process.Piece | process.Finish) -> process.Status:
        """Return the status after a request."""
        try:
            if isinstance(request, process.Opening):
                self._calibration = process.DeviceCalibration(request)
                return self._calibration.status()
            assert self._calibration is not None
            return self._calibration.answer(request)
        except MaplabError as error:
            return process.Status(problem=str(error))


if __name__ == "__main__":
    with contextlib.suppress(OSError):
        os.nice(_NICENESS)
    serve(Answerer())
