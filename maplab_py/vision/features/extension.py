"""Feature extractors of plugins: from an image to keypoints, scores and descriptors.

Example, with a network that the user names::

    @feature_extractor("tiny", feature_type="SuperPoint")
    def tiny(model):
        network = load(model)

        def extract(image):
            keypoints_px, scores, descriptors = network(image)
            return ExtractedFeatures(keypoints_px, scores, descriptors)

        return extract

`extract_features --feature_type=plugin:tiny --feature_model=tiny.onnx` then uses it.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, U8
from maplab_py.errors import MaplabError, UserError
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType, type_of_name
from maplab_py.vision.descriptors import DescriptorKind

_MAX_NUMBERS = 4096


@dataclasses.dataclass(frozen=True, eq=False)
class ExtractedFeatures:
    """K features of one image."""

    keypoints_px: F64  # (K, 2) x to the right, y down; the middle of the first pixel is (0, 0)
    scores: F64  # (K,) larger = better; the best --max_features are kept
    descriptors: NDArray[np.generic]  # (K, D) uint8 or float32
    diameters_px: F64 | None = None  # (K,) of what the descriptors see; None = 0


Extractor = Callable[[U8], ExtractedFeatures]
"""From a grey image (H, W), uint8, to its features."""
ExtractorFactory = Callable[[Path | None], Extractor]
"""Makes an extractor from the file of --feature_model, None where it is not given."""


@dataclasses.dataclass(frozen=True)
class PluginExtractor:
    """A feature extractor of a plugin."""

    name: str
    feature_type: int
    make: ExtractorFactory


REGISTERED: dict[str, PluginExtractor] = {}
"""The extractors of all plugins that were imported."""


def feature_extractor(
    name: str, *, feature_type: str
) -> Callable[[ExtractorFactory], ExtractorFactory]:
    """Make a feature extractor of a function; a decorator, the function stays as it is.

    The function gets the file of --feature_model, or None, and returns what extracts the features
    of a grey image. That is called for one image after the other, from one thread; the same image
    must give the same features.

    Args:
        name: What comes after `plugin:` in --feature_type; letters, digits and underscores.
        feature_type: Type of the descriptors: Binary, SuperPoint, R2D2, SIFT, LIDARSuperPoint or
            the number of another one. Only Binary ones, uint8, are compared by bits.

    Raises:
        ValueError: The name has other characters.
        FlagError: There is no such feature type.
    """
    if not name.isidentifier():
        raise ValueError(
            f"feature extractor '{name}': letters, digits and underscores are expected"
        )
    number = type_of_name(feature_type)

    def decorate(make: ExtractorFactory) -> ExtractorFactory:
        REGISTERED[name] = PluginExtractor(name, number, make)
        return make

    return decorate


def plugin_extractor(name: str) -> PluginExtractor:
    """Return the extractor of a plugin by its name.

    Raises:
        UserError: No plugin has it.
    """
    if name not in REGISTERED:
        there = ", ".join(sorted(REGISTERED)) or "none"
        raise UserError(
            f"--feature_type=plugin:{name}: no plugin has a feature extractor '{name}'; there are: {there}"
        )
    return REGISTERED[name]


def checked(
    features: Any, feature_type: int, what: str
) -> tuple[ExtractedFeatures, DescriptorKind]:
    """Return features of a plugin with their types, and the kind of their descriptors.

    Raises:
        MaplabError: Shapes or types are wrong, or a position is not a number.
    """
    if not isinstance(features, ExtractedFeatures):
        raise MaplabError(f"{what}: gave {type(features).__name__}, not ExtractedFeatures")
    keypoints = np.asarray(features.keypoints_px, dtype=np.float64)
    scores = np.asarray(features.scores, dtype=np.float64)
    descriptors = np.asarray(features.descriptors)
    count = len(keypoints)
    if keypoints.shape != (count, 2) or scores.shape != (count,):
        raise MaplabError(
            f"{what}: keypoints are {keypoints.shape} and scores {scores.shape}, not (K, 2) and (K,)"
        )
    if descriptors.ndim != 2 or len(descriptors) != count:
        raise MaplabError(f"{what}: descriptors are {descriptors.shape}, not ({count}, D)")
    if not 0 < descriptors.shape[1] <= _MAX_NUMBERS:
        raise MaplabError(f"{what}: descriptors have {descriptors.shape[1]} numbers, not 1 to 4096")
    if descriptors.dtype not in (np.uint8, np.float32):
        raise MaplabError(f"{what}: descriptors are {descriptors.dtype}, not uint8 or float32")
    is_bytes = descriptors.dtype == np.uint8
    if feature_type == FeatureType.BINARY and not is_bytes:
        raise MaplabError(f"{what}: Binary descriptors must be uint8, not {descriptors.dtype}")
    diameters = features.diameters_px
    diameters = np.zeros(count) if diameters is None else np.asarray(diameters, dtype=np.float64)
    if diameters.shape != (count,):
        raise MaplabError(f"{what}: diameters are {diameters.shape}, not ({count},)")
    for words, values in (("keypoint", keypoints), ("score", scores), ("descriptor", descriptors)):
        if not np.isfinite(values).all():
            raise MaplabError(f"{what}: a {words} is not a number")
    depth = DescriptorDepth.UINT8 if is_bytes else DescriptorDepth.FLOAT32
    size = descriptors.shape[1] * (1 if is_bytes else 4)
    return (
        ExtractedFeatures(keypoints, scores, descriptors, diameters),
        DescriptorKind(size, feature_type, depth),
    )
