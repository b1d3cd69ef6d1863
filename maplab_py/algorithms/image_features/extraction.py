"""Compute keypoints and descriptors from the images of a map."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.dense.resources import IMAGES, FrameResources, check_size
from maplab_py.algorithms.image_features import keypoint_edits
from maplab_py.algorithms.image_features.options import PLUGIN, ExtractionOptions, ExtractionReport
from maplab_py.array_types import I64, U8, Mask, mask_of
from maplab_py.child_processes import in_order
from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.memory import require_memory
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import ResourceOwner, VIMap, resources_of, to_hex, type_name
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.features.extension import ExtractedFeatures, checked, plugin_extractor
from maplab_py.vision.features.extractors import KINDS, extract

_BYTES_PER_KEYPOINT = 80
"""Memory of a keypoint without its descriptor [bytes]."""
_Extract = Callable[[U8], tuple[ExtractedFeatures, DescriptorKind]]


def extract_features(
    vi_map: VIMap,
    map_folder: Path,
    options: ExtractionOptions,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, ExtractionReport]:
    """Add the features of images to the frames that have them as resources.

    Frames that have descriptors of this kind stay as they are, unless they are to be replaced. The result
    does not depend on the number of threads.

    Args:
        map_folder: Its folder, where its resources are.

    Raises:
        UserError: The missions have no images, frames have keypoints that cannot be kept, or there is
            no such plugin.
        MapError: An image is missing or has another size than the camera's.
        MaplabError: A plugin's extractor gave something else than features.
    """
    extractor, kind, threads = _extractor(options)
    frames, resources = _frames_with_images(vi_map, missions)
    skipped = 0
    if kind is not None and not options.replace:
        new = ~keypoint_edits.has_kind(vi_map, kind)[frames]
        frames, resources, skipped = frames[new], resources[new], int(np.count_nonzero(~new))
    _check_kept(vi_map, frames, options)
    features, kind = _features_of_images(
        vi_map, map_folder, frames, resources, extractor, kind, threads, progress
    )
    features = [_strongest(part, options.max_features) for part in features]
    if KINDS.get(options.feature_type) is None and not options.replace and kind is not None:
        new = ~keypoint_edits.has_kind(vi_map, kind)[frames]
        skipped += int(np.count_nonzero(~new))
        features = [part for part, is_new in zip(features, new.tolist(), strict=True) if is_new]
        frames = frames[new]
    result = vi_map
    if options.replace and kind is not None:
        chosen = mask_of(len(vi_map.frames), frames)
        result = keypoint_edits.without_kind(vi_map, chosen, kind)
    removed = len(vi_map.keypoints) - len(result.keypoints)
    counts = np.array([len(part.scores) for part in features], dtype=np.int64)
    if kind is not None:
        require_memory(
            2.0 * counts.sum() * (_BYTES_PER_KEYPOINT + kind.size), "adding the features to the map"
        )
        result = keypoint_edits.with_features(
            result, frames.tolist(), features, kind, options.feature_sigma_px
        )
    return result, ExtractionReport(
        feature_type=type_name(kind.feature_type) if kind is not None else options.feature_type,
        descriptor_bytes=kind.size if kind is not None else 0,
        images=len(frames),
        keypoints=int(counts.sum()),
        median_per_image=float(np.median(counts)) if len(counts) else 0.0,
        frames_that_had_some=skipped,
        frames_without_image=int(np.count_nonzero(_choose(vi_map, missions)))
        - len(frames)
        - skipped,
        keypoints_removed=removed,
        landmarks_removed=len(vi_map.landmarks) - len(result.landmarks),
    )


def _extractor(options: ExtractionOptions) -> tuple[_Extract, DescriptorKind | None, int]:
    """Return the extractor, its kind if that is known before, and how many threads may call it."""
    name = options.feature_type
    if not name.startswith(PLUGIN):
        kind = KINDS[name]
        return (
            lambda image: (extract(name, image, options.max_features), kind),
            kind,
            1 if name == "xfeat" else os.cpu_count() or 1,  # the network has threads of its own
        )
    plugin = plugin_extractor(name.removeprefix(PLUGIN))
    model = Path(options.feature_model) if options.feature_model else None
    if model is not None and not model.is_file():
        raise UserError(f"--feature_model={model}: there is no such file")
    call = plugin.make(model)
    return lambda image: checked(call(image), plugin.feature_type, name), None, 1


def _choose(vi_map: VIMap, missions: I64 | None) -> Mask:
    """Return which frames (F,) belong to missions and are valid."""
    valid = vi_map.frames.is_valid & (vi_map.frames.id != 0).any(axis=1)
    if missions is None:
        return np.asarray(valid)
    return np.asarray(valid & np.isin(vi_map.vertices.mission[vi_map.frames.vertex], missions))


def _frames_with_images(vi_map: VIMap, missions: I64 | None) -> tuple[I64, I64]:
    """Return the frames of missions that have an image, and the resource of each."""
    chosen = resources_of(vi_map, IMAGES) & (vi_map.resources.owner_kind == ResourceOwner.FRAME)
    resources = np.flatnonzero(chosen)
    owner = vi_map.resources.owner[resources].astype(np.int64)
    inside = _choose(vi_map, missions)[owner]
    frames, first = np.unique(owner[inside], return_index=True)
    if not len(frames):
        raise UserError(
            "there are no images to extract features from: attach those of the recording with "
            "import_images, or of a bag with import_bag_resources"
        )
    return frames, resources[inside][first]


def _check_kept(vi_map: VIMap, frames: I64, options: ExtractionOptions) -> None:
    """Check that the keypoints of frames can stay beside new ones, which have descriptors.

    Raises:
        UserError: A frame has keypoints without descriptors.
    """
    bare = frames[keypoint_edits.is_undescribed(vi_map)[frames]]
    if len(bare) and not options.replace:
        raise UserError(
            f"frame {to_hex(vi_map.frames.id[bare[0]])} and {len(bare) - 1} others have keypoints without "
            "descriptors, which the map format cannot hold beside keypoints with some: --replace=true "
            "removes them"
        )


def _features_of_images(
    vi_map: VIMap,
    map_folder: Path,
    frames: I64,
    resources: I64,
    extractor: _Extract,
    kind: DescriptorKind | None,
    threads: int,
    progress: Progress,
) -> tuple[list[ExtractedFeatures], DescriptorKind | None]:
    """Return the features of each frame, and their kind, None where no image has any."""
    store = FrameResources(vi_map, map_folder)

    def of_frame(number: int) -> tuple[ExtractedFeatures, DescriptorKind]:
        frame = int(frames[number])
        return extractor(_grey(store, frame, int(resources[number])))

    features = []
    for number, (part, part_kind) in enumerate(in_order(of_frame, range(len(frames)), threads)):
        progress.step(number + 1, len(frames), "images")
        if kind is not None and part_kind != kind and len(part.scores):
            raise MaplabError(
                f"the extractor gave descriptors {part_kind.words} after some {kind.words}: all of a map's "
                "must be alike"
            )
        if kind is None and len(part.scores):
            kind = part_kind
        features.append(part)
    if kind is not None:
        empty = ExtractedFeatures(
            np.zeros((0, 2)), np.zeros(0), np.zeros((0, kind.size), dtype=np.uint8), np.zeros(0)
        )
        features = [part if len(part.scores) else empty for part in features]
    return features, kind


def _grey(store: FrameResources, frame: int, resource: int) -> U8:
    """Return the image of a frame as grey values (H, W).

    Raises:
        MapError: It is missing, no image of 8 bits, or of another size than its camera's.
    """
    import cv2

    image: Any = store.content(resource)
    name = f"image {to_hex(store.vi_map.resources.id[resource])}"
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise MapError(f"{name}: is no grey or colour image of 8 bits")
    check_size(name, image, store.camera(frame))
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(image, dtype=np.uint8)


def _strongest(features: ExtractedFeatures, most: int) -> ExtractedFeatures:
    """Return the features with the highest scores, the highest first."""
    order = np.argsort(-features.scores, kind="stable")[:most]
    diameters = features.diameters_px
    return ExtractedFeatures(
        features.keypoints_px[order],
        features.scores[order],
        features.descriptors[order],
        None if diameters is None else diameters[order],
    )
