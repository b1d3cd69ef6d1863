"""A network in the ONNX format that finds contrasts and describes them by a few fixed filters."""

from pathlib import Path

import numpy as np

FEATURES, NUMBERS = 150, 24


def write_network(
    path: Path, *, outputs: tuple[str, ...] = ("keypoints", "scores", "descriptors")
) -> None:
    """Write it; the best pixels of a Laplacian in every 8 x 8 cell become keypoints."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(0)
    laplacian = np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]], dtype=np.float32)[None, None]
    filters = rng.normal(size=(NUMBERS, 1, 9, 9)).astype(np.float32)
    filters -= filters.mean(axis=(2, 3), keepdims=True)
    constants = {
        "laplacian": laplacian,
        "filters": filters,
        "minus_one": np.array([-1], dtype=np.int64),
        "features": np.array([FEATURES], dtype=np.int64),
        "flat": np.array([NUMBERS, -1], dtype=np.int64),
        "last": np.array(3, dtype=np.int64),
    }
    node = helper.make_node
    nodes = [
        node("Conv", ["image", "laplacian"], ["curvature"], pads=[1, 1, 1, 1]),
        node("Abs", ["curvature"], ["strength"]),
        node("MaxPool", ["strength"], ["peak"], kernel_shape=[9, 9], pads=[4, 4, 4, 4]),
        node("Equal", ["strength", "peak"], ["is_peak"]),
        node("Cast", ["is_peak"], ["one_at_peaks"], to=TensorProto.FLOAT),
        node("Mul", ["strength", "one_at_peaks"], ["peaks"]),
        node("Reshape", ["peaks", "minus_one"], ["all_peaks"]),
        node("TopK", ["all_peaks", "features"], ["scores", "place"], axis=0),
        node("Shape", ["image"], ["shape"]),
        node("Gather", ["shape", "last"], ["width"], axis=0),
        node("Mod", ["place", "width"], ["x"]),
        node("Div", ["place", "width"], ["y"]),
        node("Unsqueeze", ["x", "minus_one"], ["x_column"]),
        node("Unsqueeze", ["y", "minus_one"], ["y_column"]),
        node("Concat", ["x_column", "y_column"], ["keypoints"], axis=1),
        node("Conv", ["image", "filters"], ["responses"], pads=[4, 4, 4, 4]),
        node("Reshape", ["responses", "flat"], ["by_filter"]),
        node("Gather", ["by_filter", "place"], ["chosen"], axis=1),
        node("Transpose", ["chosen"], ["descriptors"], perm=[1, 0]),
    ]
    types = {
        "keypoints": (TensorProto.INT64, [FEATURES, 2]),
        "scores": (TensorProto.FLOAT, [FEATURES]),
        "descriptors": (TensorProto.FLOAT, [FEATURES, NUMBERS]),
    }
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, "height", "width"])],
        [helper.make_tensor_value_info(name, *types[name]) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
