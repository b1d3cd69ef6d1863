"""Checkpoints of PyTorch, read without it: a zip archive of raw arrays and a pickle that names them.

A pickle is a program. This reader follows three names only, those of a dictionary, of an array and of the
types of its numbers, and refuses the file at any other one before anything is called.
"""

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError

_MAX_BYTES = 1 << 28
_TYPES: dict[str, np.dtype[Any]] = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
}
_DAMAGED = (
    zipfile.BadZipFile, pickle.UnpicklingError, KeyError, ValueError, EOFError, IndexError,
    TypeError, AttributeError, OverflowError, MemoryError, NotImplementedError, RuntimeError,
)  # fmt: skip
"""Errors of `zipfile` and `pickle` at content that is no checkpoint."""

Arrays = dict[str, NDArray[Any]]
"""Arrays of a network by their names."""


class _Refused(Exception):
    """The pickle names something else than arrays."""


def read_checkpoint(content: bytes, name: str) -> Arrays:
    """Return the arrays of a checkpoint by name; nothing of it is executed.

    Raises:
        UserError: It is damaged, or its pickle names anything but arrays.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MAX_BYTES:
                raise UserError(
                    f"{name}: unpacks to more than {_MAX_BYTES >> 20} MB: not of this net"
                )
            inside = [each for each in archive.namelist() if each.endswith("/data.pkl")]
            if len(inside) != 1:
                raise UserError(f"{name}: is no checkpoint of PyTorch, which holds one data.pkl")
            folder = inside[0].removesuffix("data.pkl")
            reader = _Reader(
                archive.read(inside[0]), lambda key: archive.read(f"{folder}data/{key}")
            )
            state = reader.load()
    except _Refused as error:
        raise UserError(
            f"{name}: its pickle asks for {error}, which is no array: nothing was executed; take a file "
            "that holds weights only"
        ) from None
    except _DAMAGED as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{name}: the checkpoint is damaged ({reason}): download it again"
        ) from None
    if not isinstance(state, dict) or not all(
        isinstance(key, str) and isinstance(value, np.ndarray) for key, value in state.items()
    ):
        raise UserError(f"{name}: holds something else than arrays by name: not of this net")
    return dict(state)


class _Reader(pickle.Unpickler):
    """Unpickler that knows no names but those of arrays."""

    def __init__(self, content: bytes, storage: Callable[[str], bytes]) -> None:
        super().__init__(io.BytesIO(content))
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        """Return what the pickle may call or name.

        Raises:
            _Refused: It may not.
        """
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _array
        if module == "torch" and name in _TYPES:
            return _TYPES[name]
        raise _Refused(f"{module}.{name}")

    def persistent_load(self, pid: Any) -> NDArray[Any]:
        """Return the numbers (N,) that a storage id stands for."""
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, np.dtype) or not str(key).isdigit():
            raise pickle.UnpicklingError("a storage has another form")
        numbers = np.frombuffer(self._storage(key), dtype=dtype)
        if len(numbers) != count:
            raise pickle.UnpicklingError(f"storage {key} has {len(numbers)} numbers, not {count}")
        return numbers


def _array(storage: Any, offset: int, size: Any, stride: Any, *_: object) -> NDArray[Any]:
    """Return the contiguous array that a pickle describes."""
    shape = tuple(int(length) for length in size)
    steps, count = [], 1
    for length in reversed(shape):
        steps.append(count)
        count *= length
    is_contiguous = all(
        length <= 1 or int(given) == step
        for length, given, step in zip(shape, stride, reversed(steps), strict=True)
    )
    if not isinstance(storage, np.ndarray) or not is_contiguous or min(shape, default=1) < 0:
        raise pickle.UnpicklingError("an array is not stored row by row")
    if offset < 0 or offset + count > len(storage):
        raise pickle.UnpicklingError("an array is larger than its storage")
    return np.asarray(storage[offset : offset + count].reshape(shape))
