"""The faults by area, as data."""

from tests.mutation.fault import Fault
from tests.mutation.faults.algorithms import ALGORITHMS
from tests.mutation.faults.console import CONSOLE
from tests.mutation.faults.loop_closure import LOOP_CLOSURE
from tests.mutation.faults.self_calibration import SELF_CALIBRATION
from tests.mutation.faults.storage import STORAGE

AREAS: dict[str, tuple[Fault, ...]] = {
    "storage": STORAGE,
    "loop_closure": LOOP_CLOSURE,
    "self_calibration": SELF_CALIBRATION,
    "console": CONSOLE,
    "algorithms": ALGORITHMS,
}
