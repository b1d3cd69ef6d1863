"""Graphs in the ONNX format, built node by node from the arrays of a checkpoint."""

from typing import Any

import numpy as np

from maplab_py.array_types import F32
from maplab_py.errors import UserError
from maplab_py.vision.features.learned.checkpoint import Arrays

_OPSET, _IR_VERSION = 17, 9
Shape = list[str | int]


class Graph:
    """Nodes and constants of a graph that grows."""

    def __init__(self, arrays: Arrays, name: str, network: str) -> None:
        self._arrays, self._name, self._network = arrays, name, network
        self._nodes: list[tuple[tuple[str, list[str], list[str]], dict[str, Any]]] = []
        self._constants: dict[str, F32] = {}

    def add(self, operation: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """Add a node, and return the name of its output."""
        output = output or f"value_{len(self._nodes)}"
        self._nodes.append(((operation, list(inputs), [output]), attributes))
        return output

    def constant(self, value: Any, dtype: type[np.float32 | np.int64] = np.float32) -> str:
        """Add a constant, and return its name."""
        name = f"constant_{len(self._constants)}"
        self._constants[name] = np.array(value, dtype=dtype, order="C")
        return name

    def array(self, key: str, shape: tuple[int, ...]) -> F32:
        """Return an array of the checkpoint.

        Raises:
            UserError: It is missing, or not what this network has.
        """
        value = self._arrays.get(key)
        if value is None or value.shape != shape or value.dtype != np.float32:
            there = "missing" if value is None else f"{value.dtype} {value.shape}"
            raise UserError(
                f"{self._name}: is no checkpoint of {self._network}: {key} is {there}, not float32 {shape}"
            )
        if not np.isfinite(value).all():
            raise UserError(
                f"{self._name}: {key} has numbers that are not finite: take another file"
            )
        return value

    def content(self, inputs: dict[str, Shape], outputs: dict[str, Shape]) -> bytes:
        """Return the file, given names and shapes of inputs and outputs.

        Raises:
            UserError: onnx is not installed.
        """
        try:
            from onnx import TensorProto, checker, helper, numpy_helper
        except ImportError:
            raise UserError(
                "onnx is not installed, which writes the network: pip install 'maplab-py[learned]'"
            ) from None

        def ends(shapes: dict[str, Shape]) -> list[Any]:
            return [
                helper.make_tensor_value_info(key, TensorProto.FLOAT, shape)
                for key, shape in shapes.items()
            ]

        graph = helper.make_graph(
            [helper.make_node(*words, **values) for words, values in self._nodes],
            self._network,
            ends(inputs),
            ends(outputs),
            [numpy_helper.from_array(value, key) for key, value in self._constants.items()],
        )
        opset = [helper.make_opsetid("", _OPSET)]
        model = helper.make_model(graph, opset_imports=opset, ir_version=_IR_VERSION)
        checker.check_model(model)
        return bytes(model.SerializeToString(deterministic=True))
