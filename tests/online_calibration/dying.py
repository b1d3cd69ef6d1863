"""The process beside an odometry, killed before or after it does something.

`dying SOCKET MODULE.FUNCTION before|after`, as `child_processes.Service` starts it.
"""

import os
import signal
import sys

from maplab_py.algorithms.self_calibration import checks
from maplab_py.algorithms.self_calibration.segments import selection
from maplab_py.child_processes import serve
from maplab_py.online_calibration import process
from maplab_py.online_calibration.child import Answerer


def _die_at(function: str, when: str) -> None:
    module, name = function.split(".")
    of_module = {"selection": selection, "checks": checks, "process": process}[module]
    plain = getattr(of_module, name)

    def dying(*arguments: object, **options: object) -> None:
        if when == "after":
            plain(*arguments, **options)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(of_module, name, dying)


if __name__ == "__main__":
    _die_at(*sys.argv[2:])
    serve(Answerer())
