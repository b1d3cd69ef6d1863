"""The network XFeat as a graph in the ONNX format, from the arrays of a checkpoint.

Source: G. Potje et al., XFeat: Accelerated Features for Lightweight Image Matching, CVPR 2024. A backbone
of small convolutions sees the image at 1/4 to 1/32 of its size; three of its scales are summed at 1/8
and give descriptors. Batch normalisation is part of the weights. The heads that find keypoints, to whole
pixels, are left out: corners are found more exactly (decision 35).
"""

import numpy as np

from maplab_py.vision.features.learned.checkpoint import Arrays
from maplab_py.vision.features.learned.graph import Graph

CELL_PX = 8
DIMENSIONS = 64
SIZE_STEP_PX = 32
"""Sides of the input are multiples of it: the coarsest scale is 1/32."""
_EPSILON = 1e-5
_STRIDES = {"block1": (1, 2, 1, 2), "block2": (1, 1), "block3": (2, 1, 1), "block4": (2, 1, 1)}
_STRIDES |= {"block5": (2, 1, 1, 1), "block_fusion": (1, 1)}


def xfeat_graph(arrays: Arrays, name: str) -> bytes:
    """Return the network: image (1, 1, H, W) to `descriptors` (1, H / 8, W / 8, 64).

    H and W are multiples of 32. Descriptors have unit length.

    Raises:
        UserError: Arrays are missing, or have another shape than this network's; onnx is not installed.
    """
    net = Graph(arrays, name, "XFeat")
    image = net.add("InstanceNormalization", "image", net.constant([1.0]), net.constant([0.0]),
                    epsilon=_EPSILON)  # fmt: skip
    quarter = net.add("AveragePool", image, kernel_shape=[4, 4], strides=[4, 4])
    skip = _convolution(net, quarter, "skip1.1", 1, 24)
    x = net.add("Add", _layers(net, image, "block1", (1, 4, 8, 8, 24)), skip)
    x = _layers(net, x, "block2", (24, 24, 24))
    eighth = _layers(net, x, "block3", (24, 64, 64, 64), last_size=1)
    sixteenth = _layers(net, eighth, "block4", (64, 64, 64, 64))
    coarsest = _layers(net, sixteenth, "block5", (64, 128, 128, 128, 64), last_size=1)
    x = net.add("Add", eighth, _enlarge(net, sixteenth, 2.0))
    x = _layers(net, net.add("Add", x, _enlarge(net, coarsest, 4.0)), "block_fusion", (64, 64, 64))
    x = _convolution(net, x, "block_fusion.2", 64, DIMENSIONS)
    unit = net.add("LpNormalization", x, axis=1, p=2)
    net.add("Transpose", unit, perm=[0, 2, 3, 1], output="descriptors")
    return net.content({"image": [1, 1, "H", "W"]}, {"descriptors": [1, "h", "w", DIMENSIONS]})


def _layers(net: Graph, x: str, block: str, widths: tuple[int, ...], *, last_size: int = 3) -> str:
    """Add the layers of a block, each a convolution without negative values, by their widths."""
    strides = _STRIDES[block]
    for row, stride in enumerate(strides):
        size = last_size if row == len(strides) - 1 else 3
        shape = widths[row + 1], widths[row], size, size
        x = _layer(net, x, f"{block}.{row}", shape, stride)
    return x


def _convolution(net: Graph, x: str, layer: str, width: int, outputs: int) -> str:
    """Add a convolution of 1 x 1 with its bias."""
    weight = net.array(f"{layer}.weight", (outputs, width, 1, 1))
    bias = net.array(f"{layer}.bias", (outputs,))
    return net.add("Conv", x, net.constant(weight), net.constant(bias), kernel_shape=[1, 1])


def _enlarge(net: Graph, x: str, factor: float) -> str:
    """Add a bilinear enlargement of an image."""
    scales = net.constant([1.0, 1.0, factor, factor])
    return net.add("Resize", x, "", scales, mode="linear")


def _layer(net: Graph, x: str, layer: str, shape: tuple[int, int, int, int], stride: int) -> str:
    weight = net.array(f"{layer}.layer.0.weight", shape).astype(np.float64)
    mean = net.array(f"{layer}.layer.1.running_mean", shape[:1]).astype(np.float64)
    variance = net.array(f"{layer}.layer.1.running_var", shape[:1]).astype(np.float64)
    scale = 1.0 / np.sqrt(variance + _EPSILON)
    folded = net.constant(weight * scale[:, None, None, None])
    size, margin = shape[2], shape[2] // 2
    x = net.add("Conv", x, folded, net.constant(-mean * scale), kernel_shape=[size, size],
                pads=[margin] * 4, strides=[stride, stride])  # fmt: skip
    return net.add("Relu", x)
