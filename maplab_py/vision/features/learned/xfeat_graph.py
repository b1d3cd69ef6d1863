"""The network XFeat as a graph in the ONNX format, from the arrays of a checkpoint.

Source: G. Potje et al., XFeat: Accelerated Features for Lightweight Image Matching, CVPR 2024. A backbone
of small convolutions sees the image at 1/4 to 1/32 of its size; three of its scales are summed at 1/8
and give descriptors. Batch normalisation is part of the weights. The heads that find keypoints, to whole
pixels, are left out: corners are found more exactly (decision 35).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maplab_py.array_types import F32
from maplab_py.errors import UserError
from maplab_py.vision.features.learned.checkpoint import Arrays

CELL_PX = 8
DIMENSIONS = 64
SIZE_STEP_PX = 32
"""Sides of the input are multiples of it: the coarsest scale is 1/32."""
_EPSILON = 1e-5
_OPSET, _IR_VERSION = 17, 9
_STRIDES = {"block1": (1, 2, 1, 2), "block2": (1, 1), "block3": (2, 1, 1), "block4": (2, 1, 1)}
_STRIDES |= {"block5": (2, 1, 1, 1), "block_fusion": (1, 1)}


def xfeat_graph(arrays: Arrays, name: str) -> bytes:
    """Return the network: image (1, 1, H, W) to `descriptors` (1, H / 8, W / 8, 64).

    H and W are multiples of 32. Descriptors have unit length.

    Args:
        arrays: Arrays of a checkpoint.
        name: Its name, for messages.

    Raises:
        UserError: Arrays are missing, or have another shape than this network's; onnx is not installed.
    """
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise UserError(
            "onnx is not installed, which writes the network: pip install 'maplab-py[learned]'"
        ) from None
    net = _Network(arrays, name)
    image = net.add("InstanceNormalization", "image", net.constant([1.0]), net.constant([0.0]),
                    epsilon=_EPSILON)  # fmt: skip
    quarter = net.add("AveragePool", image, kernel_shape=[4, 4], strides=[4, 4])
    skip = net.convolution(quarter, "skip1.1", 1, 24)
    x = net.add("Add", net.layers(image, "block1", (1, 4, 8, 8, 24)), skip)
    x = net.layers(x, "block2", (24, 24, 24))
    eighth = net.layers(x, "block3", (24, 64, 64, 64), last_size=1)
    sixteenth = net.layers(eighth, "block4", (64, 64, 64, 64))
    coarsest = net.layers(sixteenth, "block5", (64, 128, 128, 128, 64), last_size=1)
    x = net.add("Add", eighth, net.enlarge(sixteenth, 2.0))
    x = net.layers(net.add("Add", x, net.enlarge(coarsest, 4.0)), "block_fusion", (64, 64, 64))
    x = net.convolution(x, "block_fusion.2", 64, DIMENSIONS)
    unit = net.add("LpNormalization", x, axis=1, p=2)
    net.add("Transpose", unit, perm=[0, 2, 3, 1], output="descriptors")
    shape: list[str | int] = [1, "h", "w", DIMENSIONS]
    graph = helper.make_graph(
        [helper.make_node(*words, **values) for words, values in net.nodes],
        "XFeat",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, "H", "W"])],
        [helper.make_tensor_value_info("descriptors", TensorProto.FLOAT, shape)],
        [numpy_helper.from_array(value, key) for key, value in net.constants.items()],
    )
    opset = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=_IR_VERSION)
    checker.check_model(model)
    return bytes(model.SerializeToString(deterministic=True))


class _Network:
    """Nodes and constants of a graph that grows."""

    def __init__(self, arrays: Arrays, name: str) -> None:
        self._arrays, self._name = arrays, name
        self.nodes: list[tuple[tuple[str, list[str], list[str]], dict[str, Any]]] = []
        self.constants: dict[str, F32] = {}

    def add(self, operation: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """Add a node, and return the name of its output."""
        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(((operation, list(inputs), [output]), attributes))
        return output

    def constant(self, value: Any) -> str:
        """Add a constant, and return its name."""
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.ascontiguousarray(value, dtype=np.float32)
        return name

    def layers(self, x: str, block: str, widths: tuple[int, ...], *, last_size: int = 3) -> str:
        """Add the layers of a block, each a convolution without negative values, by their widths."""
        strides = _STRIDES[block]
        for row, stride in enumerate(strides):
            size = last_size if row == len(strides) - 1 else 3
            x = self._layer(x, f"{block}.{row}", (widths[row + 1], widths[row], size, size), stride)
        return x

    def convolution(self, x: str, layer: str, width: int, outputs: int) -> str:
        """Add a convolution of 1 x 1 with its bias."""
        weight = self._array(f"{layer}.weight", (outputs, width, 1, 1))
        bias = self._array(f"{layer}.bias", (outputs,))
        return self.add("Conv", x, self.constant(weight), self.constant(bias), kernel_shape=[1, 1])

    def enlarge(self, x: str, factor: float) -> str:
        """Add a bilinear enlargement of an image."""
        scales = self.constant([1.0, 1.0, factor, factor])
        return self.add("Resize", x, "", scales, mode="linear")

    def _layer(self, x: str, layer: str, shape: tuple[int, int, int, int], stride: int) -> str:
        weight = self._array(f"{layer}.layer.0.weight", shape).astype(np.float64)
        mean = self._array(f"{layer}.layer.1.running_mean", shape[:1]).astype(np.float64)
        variance = self._array(f"{layer}.layer.1.running_var", shape[:1]).astype(np.float64)
        scale = 1.0 / np.sqrt(variance + _EPSILON)
        folded = self.constant(weight * scale[:, None, None, None])
        size, margin = shape[2], shape[2] // 2
        x = self.add("Conv", x, folded, self.constant(-mean * scale), kernel_shape=[size, size],
                     pads=[margin] * 4, strides=[stride, stride])  # fmt: skip
        return self.add("Relu", x)

    def _array(self, key: str, shape: tuple[int, ...]) -> F32:
        value = self._arrays.get(key)
        if value is None or value.shape != shape or value.dtype != np.float32:
            there = "missing" if value is None else f"{value.dtype} {value.shape}"
            raise UserError(
                f"{self._name}: is no checkpoint of XFeat: {key} is {there}, not float32 {shape}"
            )
        if not np.isfinite(value).all():
            raise UserError(
                f"{self._name}: {key} has numbers that are not finite: take another file"
            )
        return value
