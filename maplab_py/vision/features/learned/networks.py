"""Networks that the user has installed, opened once, by onnxruntime."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from maplab_py.errors import UserError
from maplab_py.input_files import read_bytes
from maplab_py.output_files import write_bytes

_MAX_BYTES = 1 << 28
_THREADS = 2
_lock = threading.Lock()
_opened: dict[Path, Any] = {}
_T = TypeVar("_T")


def network_file(name: str) -> Path:
    """Return the file of an installed network ($XDG_DATA_HOME/maplab/networks/NAME.onnx)."""
    base = os.environ.get("XDG_DATA_HOME", "")
    folder = Path(base) if base else Path.home() / ".local" / "share"
    return folder / "maplab" / "networks" / f"{name}.onnx"


def install(name: str, network: bytes) -> Path:
    """Write a network into the user's data folder, and return its file; the next use opens it."""
    file = network_file(name.lower())
    with _lock:
        write_bytes(file, [network], overwrite=True)
        _opened.pop(file, None)
    return file


def installed(name: str, open_: Callable[[bytes, str], _T]) -> _T:
    """Return an installed network, opened from its content and name once.

    Raises:
        UserError: It is not installed or damaged, or onnxruntime is missing.
    """
    file = network_file(name.lower())
    with _lock:
        if file not in _opened:
            try:
                network = read_bytes(file, _MAX_BYTES, remedy="run install_features xfeat again")
            except OSError:
                raise UserError(
                    f"{name} is not installed on this computer: run install_features xfeat"
                ) from None
            _opened[file] = open_(network, str(file))
        opened: _T = _opened[file]
        return opened


def open_network(network: bytes, name: str) -> Any:
    """Return a session of onnxruntime on two threads.

    Raises:
        UserError: It cannot open the network, or is not installed.
    """
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as errors
    except ImportError:
        raise UserError("onnxruntime is not installed: pip install 'maplab-py[learned]'") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = _THREADS, 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    refusals = (errors.Fail, errors.InvalidArgument, errors.InvalidGraph, errors.InvalidProtobuf,
                errors.NotImplemented, errors.RuntimeException)  # fmt: skip
    try:
        return onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"])
    except refusals:
        raise UserError(f"{name}: is no network: run install_features again") from None
