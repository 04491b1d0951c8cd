"""Photos whose numbers use a part of what their files could hold: features as of 8 bits, outputs on their own scale."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from make_photos import COURTYARD, texture

from rsundistort import Camera, RowMotion, Solution, SolvedImage, rectify_folder, write_solution
from rsundistort.batch.one_photo import _colors
from rsundistort.io import Photo, read_photo, write_image
from rsundistort.model.brightness import white_level
from rsundistort.report.pictures import _as_bytes
from rsundistort.sfm import detect_features, grey_8_bit


@pytest.fixture(scope="module")
def photo():
    """A photo of 8 bits, (240, 320, 3), that reaches white."""
    full = cv2.imread(str(COURTYARD / "photos" / "0001.jpg"), cv2.IMREAD_COLOR)
    small = cv2.resize(full, (320, 240), interpolation=cv2.INTER_AREA)
    return cv2.normalize(small, None, 0, 255, cv2.NORM_MINMAX)


def with_bits(photo, bits):
    """The photo in a file of 16 bits as a sensor of so many bits saw it: with noise in the bits that 8 do not hold."""
    low = np.random.default_rng(1).integers(0, 1 << (bits - 8), photo.shape, dtype=np.uint16)
    return (photo.astype(np.uint16) << (bits - 8)) | low


def same_features(first, second, share=0.9):
    """Whether nearly all of the features of either are where the other has one.

    Of photos that differ by rounding 0.93 to 0.96 are the same: the others are as weak as the threshold.
    """
    gap = np.linalg.norm(first.xy_raw[:, None] - second.xy_raw[None], axis=2)
    return min((gap.min(1) < 0.5).mean(), (gap.min(0) < 0.5).mean()) >= share


# ---------------------------------------------------------------- features


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_photos_of_few_bits_show_the_features_of_their_8_bit_twins(photo, bits):
    assert len(detect_features(photo).xy_raw) > 300
    assert same_features(detect_features(with_bits(photo, bits)), detect_features(photo))
    alpha = cv2.merge([with_bits(photo, bits), np.full(photo.shape[:2], 65535, np.uint16)])
    assert np.array_equal(detect_features(alpha).xy_raw, detect_features(with_bits(photo, bits)).xy_raw)


@pytest.mark.parametrize("white", [255.0, 4095.0, 65535.0, 1.0])
def test_floats_show_them_on_every_scale(photo, white):
    found = detect_features((photo * (white / 255)).astype(np.float32))
    assert same_features(found, detect_features(photo))


def test_photos_of_the_whole_range_are_seen_as_ever(photo, rng):
    whole = with_bits(photo, 16)
    seen = cv2.cvtColor(whole, cv2.COLOR_BGR2GRAY)
    assert np.array_equal(grey_8_bit(whole), seen >> 8)
    bright = rng.random((60, 80), np.float32)
    assert np.array_equal(grey_8_bit(bright), (bright * 255).astype(np.uint8))
    bright[:4, :10] = 30.0  # lights, less than a hundredth
    assert white_level(bright) == 1.0
    assert np.array_equal(grey_8_bit(photo), cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_a_defective_pixel_does_not_make_a_photo_dark(photo, dtype):
    noisy = with_bits(photo, 12).astype(dtype)
    noisy[50, 50] = 65535
    assert white_level(noisy) == 4095
    assert grey_8_bit(noisy)[50, 50] == 255


@pytest.mark.parametrize(
    ("values", "white"),
    [
        (np.zeros((4, 4), np.uint8), 255),
        (np.zeros((4, 4), np.uint16), 255),
        (np.full((4, 4), 256, np.uint16), 1023),
        (np.full((4, 4), 16384, np.uint16), 65535),
        (np.zeros((4, 4), np.float32), 1 / 256),
        (np.full((4, 4), np.nan, np.float32), 1),
        (np.full((4, 4), 1.04, np.float32), 1),
        (np.full((4, 4), 7.0, np.float32), 7),  # of scenes brighter than white
        (np.full((4, 4), 256.0, np.float32), 255),  # sharpened
        (np.full((4, 4), 1e6, np.float32), 1e6),
    ],
)
def test_white(values, white):
    assert white_level(values) == pytest.approx(white)


# ---------------------------------------------------------------- outputs


def test_rectified_photos_keep_their_own_numbers(tmp_path, photo):
    camera = Camera(320, 240, [[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
    (tmp_path / "in").mkdir()
    write_image(tmp_path / "in" / "a.png", with_bits(photo, 12))
    write_image(tmp_path / "in" / "b.tif", photo.astype(np.float32))
    images = tuple(SolvedImage(name, "1", motion=RowMotion([0, 0, 0.0])) for name in ("a.png", "b.tif"))
    write_solution(tmp_path / "s.json", Solution("rotation", {"1": camera}, {"1": camera}, images))
    rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "out")
    for name in ("a.png", "b.tif"):
        before, after = (read_photo(tmp_path / folder / name).pixels for folder in ("in", "out/images"))
        np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_the_report_and_points_show_their_colours(photo, dtype):
    seen = with_bits(photo, 12).astype(dtype)
    assert np.abs(_as_bytes(seen).astype(int) - photo).max() <= 1
    xy = np.array([[5, 6], [100, 200]])
    np.testing.assert_allclose(_colors(Photo(seen), xy), photo[xy[:, 1], xy[:, 0], ::-1], atol=1.0)
    whole = texture(64, 48).astype(np.uint16) * 257
    assert np.array_equal(_as_bytes(whole), texture(64, 48))


def test_a_photo_of_low_contrast_is_searched_as_if_it_filled_the_range():
    photo = texture(320, 240, 3, 1)
    flat = (100 + 12 * (photo / 255.0)).round().astype(np.uint8)
    found = detect_features(flat)
    assert len(found.xy_raw) > 0.3 * len(detect_features(photo).xy_raw)
    # where there is nothing but noise of the last bit, there are hardly any features
    noise = np.random.default_rng(0).integers(100, 102, (240, 320)).astype(np.uint8)
    assert len(detect_features(noise).xy_raw) < 0.1 * len(found.xy_raw)
    assert len(detect_features(np.full((240, 320), 100, np.uint8)).xy_raw) == 0
