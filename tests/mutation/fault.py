"""What a planted fault is."""

import ast
import dataclasses
from pathlib import Path


class FaultError(Exception):
    """A fault that cannot be planted or judged."""


@dataclasses.dataclass(frozen=True)
class Fault:
    """One deliberate fault.

    Attributes:
        name: Short name, unique among all faults.
        file: File below the root of the repository.
        text: Text that occurs exactly once in the file.
        replacement: What it is replaced by.
        tests: Test files or folders that should notice; those of a file before those of a folder.
        marker: Which tests of these run (`pytest -m`).
    """

    name: str
    file: str
    text: str
    replacement: str
    tests: tuple[str, ...]
    marker: str = "not slow and not browser"

    @property
    def selection(self) -> tuple[str, ...]:
        """The words that choose the tests on pytest's command line."""
        return (*self.tests, "-m", self.marker)


def planted(fault: Fault, source: str) -> str:
    """Return the source of a file with the fault in it.

    Raises:
        FaultError: The text does not occur exactly once, or the result is not Python.
    """
    count = source.count(fault.text)
    if count != 1:
        raise FaultError(f"its text occurs {count} times in {fault.file}")
    faulty = source.replace(fault.text, fault.replacement)
    if faulty == source:
        raise FaultError("its replacement changes nothing")
    if Path(fault.file).suffix == ".py":
        try:
            ast.parse(faulty)
        except SyntaxError as error:
            raise FaultError(f"its replacement is not Python ({error.msg})") from None
    return faulty
