"""A service that returns what it is asked, ends with a status, takes its time, or hangs up."""

import os
import sys
import time
from typing import Any

from maplab_py.child_processes import serve


def answer(request: Any) -> Any:
    if isinstance(request, int):
        sys.exit(request)
    if isinstance(request, float):
        time.sleep(request)
    if request == "hang up":
        os.close(int(sys.argv[1]))
        time.sleep(60.0)
    return request


if __name__ == "__main__":
    serve(answer)
