"""A service that returns what it is asked, ends with a status, or takes its time."""

import sys
import time
from typing import Any

from maplab_py.child_processes import serve


def answer(request: Any) -> Any:
    if isinstance(request, int):
        sys.exit(request)
    if isinstance(request, float):
        time.sleep(request)
    return request


if __name__ == "__main__":
    serve(answer)
