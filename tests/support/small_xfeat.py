"""Random weights of the network XFeat, and checkpoints as PyTorch writes them, without it."""

import io
import itertools
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from typing import Any
from unittest import mock

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.vision.features.learned.checkpoint import Arrays
from maplab_py.vision.features.learned.xfeat import XFeat, installed_xfeat

_WIDTHS = {
    "block1": (1, 4, 8, 8, 24),
    "block2": (24, 24, 24),
    "block3": (24, 64, 64, 64),
    "block4": (64, 64, 64, 64),
    "block5": (64, 128, 128, 128, 64),
    "block_fusion": (64, 64, 64),
}
_LAST = {"skip1.1": (24, 1), "block_fusion.2": (64, 64)}


def xfeat_or_skip() -> XFeat:
    """Return the installed network; the test is skipped where there is none."""
    try:
        return installed_xfeat()
    except UserError as error:
        pytest.skip(f"needs the weights: {error}")


def random_arrays(seed: int = 0) -> Arrays:
    """Return weights of every layer."""
    rng = np.random.default_rng(seed)
    arrays: dict[str, Any] = {}
    for block, widths in _WIDTHS.items():
        for row, (before, after) in enumerate(itertools.pairwise(widths)):
            is_last = block in ("block3", "block5") and row == len(widths) - 2
            size = 1 if is_last else 3
            name = f"{block}.{row}.layer"
            deviation = np.sqrt(2.0 / (before * size * size))
            arrays[f"{name}.0.weight"] = rng.normal(0, deviation, (after, before, size, size))
            arrays[f"{name}.1.running_mean"] = rng.normal(0.0, 0.2, after)
            arrays[f"{name}.1.running_var"] = rng.uniform(0.5, 2.0, after)
    for name, shape in _LAST.items():
        arrays[f"{name}.weight"] = rng.normal(0.0, 0.2, (*shape, 1, 1))
        arrays[f"{name}.bias"] = rng.normal(0.0, 0.2, shape[0])
    return {key: np.asarray(value, dtype=np.float32) for key, value in arrays.items()}


def random_matcher_arrays(seed: int = 0) -> Arrays:
    """Return weights of LighterGlue."""
    rng = np.random.default_rng(seed)
    shapes: dict[str, tuple[int, int]] = {"input_proj": (96, 64), "posenc.Wr": (48, 2)}
    for row in range(6):
        name = f"transformers.{row}"
        shapes[f"{name}.self_attn.Wqkv"] = 288, 96
        for part in (
            "self_attn.out_proj",
            "cross_attn.to_qk",
            "cross_attn.to_v",
            "cross_attn.to_out",
        ):
            shapes[f"{name}.{part}"] = 96, 96
        for part in ("self_attn", "cross_attn"):
            shapes[f"{name}.{part}.ffn.0"], shapes[f"{name}.{part}.ffn.3"] = (192, 192), (96, 192)
    shapes["log_assignment.5.final_proj"], shapes["log_assignment.5.matchability"] = (
        (96, 96),
        (1, 96),
    )
    arrays: dict[str, Any] = {}
    for key, shape in shapes.items():
        arrays[f"{key}.weight"] = rng.normal(0.0, shape[1] ** -0.5, shape)
        arrays[f"{key}.bias"] = rng.normal(0.0, 0.2, shape[0])
        if key.endswith("ffn.0"):
            norm = key.replace("ffn.0", "ffn.1")
            arrays[f"{norm}.weight"] = rng.uniform(0.5, 1.5, shape[0])
            arrays[f"{norm}.bias"] = rng.normal(0.0, 0.2, shape[0])
    return {f"matcher.{key}": np.asarray(value, dtype=np.float32) for key, value in arrays.items()}


def checkpoint(arrays: Arrays, *, other: Any = None) -> bytes:
    """Return the content of a checkpoint, with one more value where `other` is given."""
    storage = type("FloatStorage", (), {"__module__": "torch"})
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")

    def _rebuild_tensor_v2() -> None:
        raise AssertionError("a name, never called")

    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = (
        utils.__name__,
        "_rebuild_tensor_v2",
    )
    torch.__dict__["FloatStorage"], utils.__dict__["_rebuild_tensor_v2"] = (
        storage,
        _rebuild_tensor_v2,
    )
    keys: dict[int, tuple[str, Any]] = {}

    class Storage:
        def __init__(self, values: Any) -> None:
            self.values = values

    class Tensor:
        def __init__(self, values: Any) -> None:
            self.values = values

        def __reduce__(self) -> Any:
            steps = tuple(step // 4 for step in self.values.strides)
            state = (Storage(self.values), 0, self.values.shape, steps, False, OrderedDict())
            return _rebuild_tensor_v2, state

    class Writer(pickle.Pickler):
        def persistent_id(self, value: Any) -> Any:
            if not isinstance(value, Storage):
                return None
            key, _ = keys.setdefault(id(value.values), (str(len(keys)), value.values))
            return "storage", storage, key, "cpu", value.values.size

    state = OrderedDict((key, Tensor(value)) for key, value in arrays.items())
    if other is not None:
        state["other"] = other
    text, archive = io.BytesIO(), io.BytesIO()
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}):
        Writer(text, protocol=2).dump(state)
    with zipfile.ZipFile(archive, "w") as target:
        target.writestr("archive/data.pkl", text.getvalue())
        for key, values in keys.values():
            target.writestr(f"archive/data/{key}", np.ascontiguousarray(values).tobytes())
    return archive.getvalue()
