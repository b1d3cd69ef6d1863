"""Preparation of images: size, contrast, masks, and what is refused."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.vision.features.images import ImagePreparation
from maplab_py.vision.features.options import FeatureOptions
from tests.vision.tracking.rendered import HEIGHT, WIDTH, camera, image_at, pose


def test_pixels_of_a_resized_image_and_back() -> None:
    ready = ImagePreparation.of(camera(), 0, FeatureOptions(image_resize_factor=0.5))
    assert ready.size == (188, 120)
    uv = np.random.default_rng(0).uniform(0, 100, (9, 2))
    np.testing.assert_allclose(ready.to_prepared(ready.to_recorded(uv)), uv, atol=1e-12)
    # a square of two pixels becomes a pixel: its centre lies between theirs
    np.testing.assert_allclose(ready.to_recorded(np.array([[3.0, 5.0]])), [[6.5, 10.5]])
    blocks = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    blocks[10:12, 6:8] = 200
    assert ready.prepare(blocks)[5, 3] == 200


def test_the_image_of_a_driver_is_copied() -> None:
    image = image_at(pose()).copy()
    prepared = ImagePreparation.of(camera(), 0, FeatureOptions()).prepare(image)
    expected = image.copy()
    image[:] = 0
    assert np.array_equal(prepared, expected)


def test_contrast_is_equalised() -> None:
    dark = (image_at(pose()) // 8).astype(np.uint8)
    plain = ImagePreparation.of(camera(), 0, FeatureOptions()).prepare(dark)
    equal = ImagePreparation.of(camera(), 0, FeatureOptions(apply_clahe=True)).prepare(dark)
    assert equal.std() > 1.5 * plain.std()


def test_usable_pixels(tmp_path: Path) -> None:
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[:, :100] = 0
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    options = FeatureOptions(image_mask_path=str(tmp_path / "mask.png"))
    usable = ImagePreparation.of(camera(), 0, options).usable
    assert not usable[:, :100].any()
    assert not usable[:20].any()
    assert not usable[:, -20:].any()
    assert usable[20:-20, 100:-20].all()
    assert np.array_equal(ImagePreparation.of(camera(), 1, options).usable, usable)
    per_camera = dataclasses.replace(options, image_mask_path=f",{tmp_path / 'mask.png'}")
    assert ImagePreparation.of(camera(), 0, per_camera).usable[100, 50] == 255
    assert ImagePreparation.of(camera(), 1, per_camera).usable[100, 50] == 0
    half = dataclasses.replace(options, image_resize_factor=0.5)
    small = ImagePreparation.of(camera(), 0, half).usable
    assert not small[:, :50].any()
    assert small[12:-12, 50:-12].all()


def test_masks_that_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "empty.png").write_text("")
    assert cv2.imwrite(str(tmp_path / "small.png"), np.zeros((10, 10), dtype=np.uint8))
    for name, message in (
        ("none.png", "cannot be read"),
        ("text.png", "is no image"),
        ("empty.png", "is no image"),
        ("small.png", "has 10 x 10 pixels, the images of camera 0 have 376 x 240"),
    ):
        options = FeatureOptions(image_mask_path=str(tmp_path / name))
        with pytest.raises(UserError, match=message) as caught:
            ImagePreparation.of(camera(), 0, options)
        assert "--rovio_image_mask_path" in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((HEIGHT, WIDTH - 1), dtype=np.uint8),
        np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8),
        np.zeros((HEIGHT, WIDTH), dtype=np.uint16),
        np.zeros((0, 0), dtype=np.uint8),
    ],
    ids=["narrow", "colour", "16 bits", "empty"],
)
def test_images_that_are_refused(image: np.ndarray) -> None:
    with pytest.raises(MapError, match=r"camera 1: an image of .* wants 8-bit grey, 376 x 240"):
        ImagePreparation.of(camera(), 1, FeatureOptions()).prepare(image)


def test_freak_is_refused_in_a_line() -> None:
    with pytest.raises(FlagError, match="descriptor_type=freak: must be one of brisk, xfeat"):
        FeatureOptions(descriptor_type="freak")


@pytest.mark.parametrize(
    ("name", "value", "flag"),
    [
        ("descriptor_type", "orb", "--feature_tracking_descriptor_type=orb"),
        ("detector_type", "sift", "--feature_tracking_detector_type=sift"),
        ("detector_threshold", 0, "--feature_tracking_detector_threshold=0"),
        ("detector_nms_radius", float("nan"), "--feature_tracking_detector_nms_radius=nan"),
        ("gridded_detector_num_grid_rows", 0, "--feature_tracking_gridded_detector_num_grid_rows"),
        ("min_tracking_distance_to_image_border_px", -1, "--min_tracking_distance_to_image_"),
        ("image_resize_factor", 0.0, "--rovioli_image_resize_factor=0"),
        ("clahe_clip_limit", 0, "--rovioli_image_clahe_clip_limit=0"),
    ],
)
def test_wrong_options_name_their_flag(name: str, value: object, flag: str) -> None:
    with pytest.raises(FlagError) as caught:
        dataclasses.replace(FeatureOptions(), **{name: value})
    assert flag in str(caught.value)
