"""TIFF files of every layout: read rightly at their full depth, or refused in a line."""

from __future__ import annotations

import itertools
import warnings

import cv2
import numpy as np
import pytest
import tifffile
from make_photos import camera_exif, texture
from PIL import Image
from refusals import one_line
from tiff_files import tiff_file

from rsundistort.errors import FileError, SkippedPhotoWarning
from rsundistort.io import Metadata, read_photo, write_image
from rsundistort.io.masks import read_mask

MIN_IS_WHITE, MIN_IS_BLACK, RGB, PALETTE, CMYK, LAB = 0, 1, 2, 3, 5, 8
WIDTH, HEIGHT = 53, 37
# photometric, samples, extra samples
KINDS = {
    "grey": (MIN_IS_BLACK, 1, ()),
    "grey+alpha": (MIN_IS_BLACK, 2, (2,)),
    "grey+other": (MIN_IS_BLACK, 2, (0,)),
    "three bands": (MIN_IS_BLACK, 3, (0, 0)),  # as GDAL writes colours of 16 bits
    "RGB": (RGB, 3, ()),
    "RGBA": (RGB, 4, (2,)),
}
STORED = [
    {},
    {"order": ">", "method": "deflate"},
    {"method": "lzw", "predictor": 2, "tile": 16},
    {"order": ">", "method": "deflate", "predictor": 2, "rows_per_strip": 5},
    {"method": "lzw", "tile": 32, "order": ">"},
]


def numbers(dtype, samples, seed=0):
    """Every bit counts; signed ones are not negative, floats beyond 1 and below 0."""
    rng, dtype = np.random.default_rng(seed), np.dtype(dtype)
    shape = (HEIGHT, WIDTH, samples)
    if dtype.kind == "f":
        return rng.normal(0.5, 1, shape).astype(dtype)
    return rng.integers(0, int(np.iinfo(dtype).max) + 1, shape, dtype=dtype)


def as_photo(values):
    """What is expected of (h, w, samples) numbers: OpenCV's channels, and a kind of number that photos have."""
    dtype = {"u": values.dtype, "i": f"u{values.itemsize}", "f": np.float32}[values.dtype.kind]
    order = {1: [0], 2: [0, 0, 0, 1], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[values.shape[2]]
    return np.squeeze(values[..., order].astype(dtype))


def read(tmp_path, data):
    (tmp_path / "a.tif").write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_photo(tmp_path / "a.tif")


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", ["u1", "u2", "i1", "i2", "f2", "f4", "f8"])
def test_every_depth_and_order_of_channels_is_read_and_written_exactly(tmp_path, dtype, kind, planar):
    photometric, samples, extra = KINDS[kind]
    values = numbers(dtype, samples)
    for how in STORED:
        pixels = read(tmp_path, tiff_file(values, photometric, extra, planar, **how)).pixels
        assert pixels.dtype == as_photo(values).dtype, how
        np.testing.assert_array_equal(pixels, as_photo(values), err_msg=str(how))
    write_image(tmp_path / "b.tif", pixels)
    np.testing.assert_array_equal(read_photo(tmp_path / "b.tif").pixels, pixels)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("kind", ["grey", "RGB", "RGBA"])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_floats_packed_by_differences_of_their_bytes(tmp_path, dtype, kind, planar):
    photometric, samples, extra = KINDS[kind]
    values = numbers(dtype, samples)
    for how in ({"method": "deflate"}, {"method": "lzw", "tile": 16}):
        photo = read(tmp_path, tiff_file(values, photometric, extra, planar, predictor=3, **how))
        np.testing.assert_array_equal(photo.pixels, as_photo(values))


def test_a_predictor_of_what_is_not_packed_means_nothing(tmp_path):
    values = numbers("u2", 2)
    sums = np.cumsum(values, axis=1, dtype=np.uint16)  # whose differences are the values
    photo = read(tmp_path, tiff_file(sums, MIN_IS_BLACK, (2,), predictor=2))
    np.testing.assert_array_equal(photo.pixels, as_photo(values))


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("kind", KINDS)
def test_numbers_of_10_to_14_bits_are_the_highest_of_16(tmp_path, kind, bits):
    photometric, samples, extra = KINDS[kind]
    values = numbers("u2", samples) >> (16 - bits)
    for planar, method in itertools.product((False, True), ("none", "lzw")):
        photo = read(tmp_path, tiff_file(values, photometric, extra, planar, bits=bits, method=method))
        np.testing.assert_array_equal(photo.pixels, as_photo(values << (16 - bits)))


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize(("dtype", "bits"), [("u1", 8), ("u2", 16), ("u2", 12), ("i2", 16)])
def test_where_0_is_white_it_is_black_afterwards(tmp_path, dtype, bits, samples):
    values = numbers(dtype, samples) >> (8 * np.dtype(dtype).itemsize - bits)
    most = 32767 if dtype == "i2" else (1 << bits) - 1
    expected = values.copy()
    expected[..., 0] = most - expected[..., 0]
    expected <<= 4 * (bits == 12)
    for how in STORED if bits % 8 == 0 else STORED[:2]:
        photo = read(tmp_path, tiff_file(values, MIN_IS_WHITE, (2,) * (samples - 1), bits=bits, **how))
        np.testing.assert_array_equal(photo.pixels, as_photo(expected))


def test_bigtiff_and_orientation_of_separate_channels(tmp_path):
    values = numbers("u2", 3)
    tifffile.imwrite(
        tmp_path / "a.tif", np.moveaxis(values, 2, 0), photometric="rgb", planarconfig="separate", bigtiff=True,
        compression="zlib", predictor=True, byteorder=">", extratags=[(274, 3, 1, 6, True)],
    )  # fmt: skip
    photo = read_photo(tmp_path / "a.tif")
    np.testing.assert_array_equal(photo.pixels, as_photo(values))
    assert photo.metadata.orientation == 6


def test_kinds_of_8_bits_that_libtiff_converts(tmp_path):
    rgb = Image.fromarray(texture(64, 48))
    for mode, far in (("P", 90), ("CMYK", 0), ("1", 255)):
        rgb.convert(mode).save(tmp_path / "a.tif")
        pixels = read_photo(tmp_path / "a.tif").pixels
        expected = np.asarray(rgb.convert(mode).convert("L" if mode == "1" else "RGB"))
        assert pixels.dtype == np.uint8
        np.testing.assert_array_equal(pixels, expected if mode == "1" else expected[..., ::-1])
        assert np.abs(np.asarray(rgb).astype(int) - np.atleast_3d(expected)).max() <= far


REFUSED = {
    "of 5 channels": tiff_file(numbers("u2", 5), RGB, (2, 0)),
    "of whole numbers of 32 bits": tiff_file(numbers("u4", 3), RGB),
    "of signed numbers of 32 bits": tiff_file(numbers("i4", 1), MIN_IS_BLACK),
    "of CMYK colours in whole numbers of 16 bits": tiff_file(numbers("u2", 4), CMYK),
    "of Lab colours in whole numbers of 16 bits": tiff_file(numbers("u2", 3), LAB),
    "of palette colours in whole numbers of 16 bits": tiff_file(numbers("u2", 1), PALETTE),
    "of whole numbers of 4 bits": tiff_file(numbers("u2", 1) >> 12, MIN_IS_BLACK, bits=4),
    "of 1 channels of floats of which 0 is white": tiff_file(numbers("f4", 1), MIN_IS_WHITE),
    "with negative numbers": tiff_file(numbers("i2", 3) - 5, RGB),
    "packed by Zstandard": tiff_file(numbers("u1", 3), RGB).replace(
        np.array([0x0103, 3, 1, 0, 1], "<u2").tobytes(), np.array([0x0103, 3, 1, 0, 50000], "<u2").tobytes()
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_would_be_misread_is_refused_in_a_line(tmp_path, what):
    with pytest.raises(FileError, match=rf"^a\.tif is a TIFF {what}") as error:
        read(tmp_path, REFUSED[what])
    assert "save it as" in one_line(error) or "pack it by LZW" in one_line(error)


def test_strips_that_are_missing_are_an_error(tmp_path):
    data = tiff_file(numbers("u2", 3), RGB, planar=True)
    cut = data.replace(np.array([0x0117, 4], "<u2").tobytes(), np.array([0x0099, 4], "<u2").tobytes())
    for damaged in (cut, data[:200] + data[6000:]):
        with pytest.raises(FileError, match=r"a\.tif (is|cannot be)"):
            read(tmp_path, damaged)


# ---------------------------------------------------------------- several pictures in a file


def save_pictures(path, *pictures):
    """Pictures one behind another: pixels, and the kind that each is marked as."""
    with tifffile.TiffWriter(path) as file:
        for pixels, kind in pictures:
            file.write(pixels, photometric="rgb" if pixels.ndim == 3 else "minisblack", subfiletype=kind)


def test_of_several_pictures_the_first_is_read_and_the_others_are_told(tmp_path):
    first = texture(64, 48, 1)
    save_pictures(tmp_path / "a.tif", (first[..., ::-1], 0), (texture(64, 48, 2), 0), (texture(64, 48, 3), 0))
    with pytest.warns(SkippedPhotoWarning, match=r"^a\.tif holds 3 pictures, of which only the first is read"):
        photo = read_photo(tmp_path / "a.tif")
    np.testing.assert_array_equal(photo.pixels, first)


def test_thumbnails_reductions_and_masks_are_no_further_pictures(tmp_path):
    first = texture(64, 48)
    mask = np.ones((48, 64), bool)
    save_pictures(tmp_path / "a.tif", (first[..., ::-1], 0), (texture(32, 24), 1), (texture(16, 12), 0), (mask, 4))
    np.testing.assert_array_equal(read(tmp_path, (tmp_path / "a.tif").read_bytes()).pixels, first)
    write_image(tmp_path / "b.tif", first, Metadata(camera_exif("<", 6)))
    np.testing.assert_array_equal(read(tmp_path, (tmp_path / "b.tif").read_bytes()).pixels, first)


@pytest.mark.parametrize("inside", [False, True])
def test_a_thumbnail_is_not_taken_for_its_picture(tmp_path, inside):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(texture(16, 12), photometric="rgb", subifds=1 if inside else None)
        file.write(texture(64, 48), photometric="rgb")
    with pytest.raises(FileError, match=r"a\.tif is a TIFF that begins with a picture of 16x12 pixels .* of 64x48"):
        read_photo(tmp_path / "a.tif")


# ---------------------------------------------------------------- masks


def test_a_mask_of_16_bits_in_which_0_is_white_is_refused(tmp_path):
    mask = np.where(np.eye(16), 0, 65535).astype(np.uint16)[..., None]
    (tmp_path / "a.tif").write_bytes(tiff_file(mask, MIN_IS_WHITE))
    with pytest.raises(FileError, match=r"mask .*a\.tif is a TIFF of 16 bits of which 0 is white"):
        read_mask(tmp_path / "a.tif", 16, 16)
    (tmp_path / "a.tif").write_bytes(tiff_file((mask >> 8).astype(np.uint8), MIN_IS_WHITE))
    assert (cv2.countNonZero(read_mask(tmp_path / "a.tif", 16, 16))) == 16
