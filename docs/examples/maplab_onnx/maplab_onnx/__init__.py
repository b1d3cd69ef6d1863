"""A feature extractor that runs a network in the ONNX format, which the user names.

The network takes a grey image, float32 from 0 to 1, of shape (1, 1, H, W) with any H and W. Its outputs
are named `keypoints` (K, 2), x and y in pixels, `scores` (K,) and `descriptors` (K, D); each may have
a leading axis of length one. Exports of SuperPoint are of this form.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.plugin import ExtractedFeatures, UserError, feature_extractor

_OUTPUTS = ("keypoints", "scores", "descriptors")


@feature_extractor("onnx", feature_type="SuperPoint")
def onnx_features(model: Path | None) -> Callable[[np.ndarray], ExtractedFeatures]:
    """Open the network of --feature_model."""
    if model is None:
        raise UserError(
            "--feature_type=plugin:onnx needs a network: give --feature_model=FILE.onnx"
        )
    session = _session(model)
    name = session.get_inputs()[0].name

    def extract(image: np.ndarray) -> ExtractedFeatures:
        pixels = (image[None, None] / 255.0).astype(np.float32)
        keypoints, scores, descriptors = session.run(list(_OUTPUTS), {name: pixels})
        count = scores.size
        return ExtractedFeatures(
            keypoints.reshape(count, 2).astype(np.float64),
            scores.reshape(count).astype(np.float64),
            descriptors.reshape(count, -1).astype(np.float32),
        )

    return extract


def _session(model: Path) -> Any:
    """Return the network, on one thread of the processor: the same image gives the same features."""
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as errors
    except ImportError as error:
        raise UserError("onnxruntime is not installed: pip install 'maplab-py[learned]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(
            str(model), options, providers=["CPUExecutionProvider"]
        )
    except (
        errors.Fail,
        errors.InvalidArgument,
        errors.InvalidGraph,
        errors.InvalidProtobuf,
        errors.NotImplemented,
        errors.RuntimeException,
    ) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{model}: onnxruntime cannot open it as a network: {reason}") from None
    there = {output.name for output in session.get_outputs()}
    missing = [output for output in _OUTPUTS if output not in there]
    if missing:
        raise UserError(
            f"{model}: the network has no output {', '.join(missing)}; it has {', '.join(sorted(there))}"
        )
    return session
