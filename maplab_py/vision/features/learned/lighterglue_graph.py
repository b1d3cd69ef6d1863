"""The matcher LighterGlue as a graph in the ONNX format, from the arrays of a checkpoint.

Sources: P. Lindenberger et al., LightGlue: Local Feature Matching at Light Speed, ICCV 2023; the smaller one
for XFeat is by its authors. Six layers of attention, within an image and across to the other one, change the
descriptors of both images until the same point has the same one. All keypoints take part in all layers.
Linear maps that follow each other are folded into one.
"""

import numpy as np

from maplab_py.array_types import F64
from maplab_py.vision.features.learned.checkpoint import Arrays
from maplab_py.vision.features.learned.graph import Graph

DIMENSIONS = 64
_WIDTH, _LAYERS = 96, 6
_BOTH: list[str | int] = [2, "pairs", "keypoints"]
_ROTATE = np.kron(np.eye(_WIDTH // 2), [[0.0, -1.0], [1.0, 0.0]])
"""Turns each pair of numbers by 90 degrees."""


def lighterglue_graph(arrays: Arrays, name: str) -> bytes:
    """Return the network that matches P pairs of images of N keypoints.

    Inputs are `places` (2, P, N, 2) of keypoints from the middle of their image, relative to half its larger
    side, `descriptors` (2, P, N, 64), and `absence` (2, P, 1, N), zero or, where an image has fewer
    keypoints, a very negative number. Output is `scores` (P, N, N), logarithms of probabilities.

    Raises:
        UserError: Arrays are missing, or have another shape than this network's; onnx is not installed.
    """
    net = Graph(arrays, name, "LighterGlue")
    x = _linear(net, "descriptors", *_maps(net, "matcher.input_proj", _WIDTH, DIMENSIONS))
    frequencies = np.repeat(net.array("matcher.posenc.Wr.weight", (_WIDTH // 2, 2)), 2, axis=0)
    angle = net.add("MatMul", "places", net.constant(frequencies.T))
    turn = net.add("Cos", angle), net.add("Sin", angle)
    swap = net.constant([1, 0], np.int64)
    absent = net.add("Gather", "absence", swap, axis=0)
    for row in range(_LAYERS):
        x = _within(net, x, f"matcher.transformers.{row}.self_attn", turn)
        x = _across(net, x, f"matcher.transformers.{row}.cross_attn", swap, absent)
    _assign(net, x, f"matcher.log_assignment.{_LAYERS - 1}")
    return net.content(
        {
            "places": [*_BOTH, 2],
            "descriptors": [*_BOTH, DIMENSIONS],
            "absence": [2, "pairs", 1, "keypoints"],
        },
        {"scores": ["pairs", "keypoints", "keypoints"]},
    )


def _maps(net: Graph, key: str, outputs: int, inputs: int = _WIDTH) -> tuple[F64, F64]:
    """Return weight (outputs, inputs) and bias (outputs,) of a linear map."""
    weight = net.array(f"{key}.weight", (outputs, inputs))
    return weight.astype(np.float64), net.array(f"{key}.bias", (outputs,)).astype(np.float64)


def _linear(net: Graph, x: str, weight: F64, bias: F64) -> str:
    return net.add("Add", net.add("MatMul", x, net.constant(weight.T)), net.constant(bias))


def _within(net: Graph, x: str, key: str, turn: tuple[str, str]) -> str:
    """Add attention within an image; queries and keys are turned by angles that depend on the place."""
    weight, bias = _maps(net, f"{key}.Wqkv", 3 * _WIDTH)
    (query, key_, value), biases = (
        weight.reshape(_WIDTH, 3, -1).swapaxes(0, 1),
        bias.reshape(-1, 3).T,
    )
    scale = _WIDTH**-0.5
    rows = [scale * query, scale * _ROTATE @ query, key_, _ROTATE @ key_, value]
    shifts = [
        scale * biases[0],
        scale * _ROTATE @ biases[0],
        biases[1],
        _ROTATE @ biases[1],
        biases[2],
    ]
    q, q_turned, k, k_turned, v = (_linear(net, x, w, b) for w, b in zip(rows, shifts, strict=True))
    cosine, sine = turn
    q, k = (
        net.add("Add", net.add("Mul", straight, cosine), net.add("Mul", turned, sine))
        for straight, turned in ((q, q_turned), (k, k_turned))
    )
    return _update(net, x, _attend(net, q, k, v, "absence"), key, f"{key}.out_proj")


def _across(net: Graph, x: str, key: str, swap: str, absent: str) -> str:
    """Add attention to the other image."""
    weight, bias = _maps(net, f"{key}.to_qk", _WIDTH)
    scale = _WIDTH**-0.25
    q = _linear(net, x, scale * weight, scale * bias)
    v = _linear(net, x, *_maps(net, f"{key}.to_v", _WIDTH))
    k, v = (net.add("Gather", each, swap, axis=0) for each in (q, v))
    return _update(net, x, _attend(net, q, k, v, absent), key, f"{key}.to_out")


def _attend(net: Graph, query: str, key: str, value: str, absent: str) -> str:
    product = net.add("MatMul", query, net.add("Transpose", key, perm=[0, 1, 3, 2]))
    return net.add("MatMul", net.add("Softmax", net.add("Add", product, absent), axis=-1), value)


def _update(net: Graph, x: str, context: str, key: str, output: str) -> str:
    """Add what attention has found to the descriptors, through a layer of twice their width."""
    wide = 2 * _WIDTH
    first, first_bias = _maps(net, f"{key}.ffn.0", wide, wide)
    message, message_bias = _maps(net, output, _WIDTH)
    of_x, of_message = first[:, :_WIDTH], first[:, _WIDTH:]
    both = np.concatenate([of_x, of_message @ message], axis=1)
    hidden = _linear(net, net.add("Concat", x, context, axis=-1), both,
                     first_bias + of_message @ message_bias)  # fmt: skip
    scale, shift = (net.array(f"{key}.ffn.1.{name}", (wide,)) for name in ("weight", "bias"))
    hidden = net.add("LayerNormalization", hidden, net.constant(scale), net.constant(shift),
                     axis=-1, epsilon=1e-5)  # fmt: skip
    error = net.add("Erf", net.add("Div", hidden, net.constant(np.sqrt(2.0))))
    gelu = net.add("Mul", hidden, net.add("Add", error, net.constant(1.0)))
    weight, bias = _maps(net, f"{key}.ffn.3", _WIDTH, wide)
    return net.add("Add", x, _linear(net, gelu, 0.5 * weight, bias))


def _assign(net: Graph, x: str, key: str) -> None:
    """Add the scores: the share of a pair among those of either keypoint, if both are seen twice."""
    weight, bias = _maps(net, f"{key}.final_proj", _WIDTH)
    scale = _WIDTH**-0.25
    vectors = _linear(net, x, scale * weight, scale * bias)
    seen = _linear(net, x, *_maps(net, f"{key}.matchability", 1))
    # log sigmoid(z) = -softplus(-z)
    seen = net.add("Neg", net.add("Softplus", net.add("Neg", seen)))
    sides = [net.constant(side, np.int64) for side in (0, 1)]
    first, second = (net.add("Gather", vectors, side, axis=0) for side in sides)
    product = net.add("MatMul", first, net.add("Transpose", second, perm=[0, 2, 1]))
    absent_first, absent_second = (net.add("Gather", "absence", side, axis=0) for side in sides)
    absent_first = net.add("Transpose", absent_first, perm=[0, 2, 1])
    by_row = net.add("LogSoftmax", net.add("Add", product, absent_second), axis=2)
    by_column = net.add("LogSoftmax", net.add("Add", product, absent_first), axis=1)
    seen_first, seen_second = (net.add("Gather", seen, side, axis=0) for side in sides)
    seen_both = net.add("Add", seen_first, net.add("Transpose", seen_second, perm=[0, 2, 1]))
    net.add("Add", net.add("Add", by_row, by_column), seen_both, output="scores")
