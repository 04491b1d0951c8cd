"""Photo files in and out: kinds, depths, what is refused, and how."""

from __future__ import annotations

import builtins
import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from make_photos import camera_exif, small_dng, tagged_jpeg, texture
from PIL import Image
from refusals import one_line

from rsundistort import Camera, rectify
from rsundistort.errors import FileError, FileKindWarning, InputError, MetadataWarning
from rsundistort.io import Metadata, list_photos, output_name, read_photo, write_image
from rsundistort.io.photos.images import unread_pictures
from rsundistort.model.orientation import orient_pixels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".TIFF"])
def test_lossless_kinds_come_back_exactly(tmp_path, suffix, channels, dtype):
    shape = (37, 53) if channels == 1 else (37, 53, channels)
    pixels = np.random.default_rng(3).integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)
    path = tmp_path / f"photo{suffix}"
    write_image(path, pixels)
    back = read_photo(path).pixels
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, pixels)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("shape", [(37, 53), (37, 53, 3)])
def test_float_tiff_comes_back_exactly(tmp_path, shape):
    pixels = np.random.default_rng(4).normal(size=shape).astype(np.float32)
    write_image(tmp_path / "photo.tif", pixels)
    back = read_photo(tmp_path / "photo.tif").pixels
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, pixels)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_lossy_kinds_come_close_and_quality_costs_bytes(tmp_path, suffix):
    pixels = cv2.merge([texture(96, 64, channels=1)] * 3)  # grey: WebP halves the colour
    sizes = []
    for quality in (60, 98):
        path = tmp_path / f"{quality}{suffix}"
        write_image(path, pixels, quality=quality)
        sizes.append(path.stat().st_size)
    assert sizes[0] < sizes[1]
    error = np.abs(read_photo(tmp_path / f"98{suffix}").pixels.astype(int) - pixels)
    assert error.mean() < 4


def test_orientation_is_carried_and_not_applied(tmp_path):
    write_image(tmp_path / "turned.jpg", texture(64, 48), Metadata(camera_exif("<", 6)))
    photo = read_photo(tmp_path / "turned.jpg")
    assert photo.metadata.orientation == 6
    assert photo.pixels.shape == (48, 64, 3)
    turned = cv2.imread(str(tmp_path / "turned.jpg"), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(turned, orient_pixels(photo.pixels, 6))  # the tag is really there: OpenCV follows it


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_tiff_is_read_in_the_stored_frame(tmp_path, dtype, orientation):
    """OpenCV rotates a TIFF by its tag, whatever flags it gets."""
    pixels = texture(64, 48).astype(dtype)
    write_image(tmp_path / "a.tif", pixels, Metadata(camera_exif(">", orientation)))
    photo = read_photo(tmp_path / "a.tif")
    np.testing.assert_array_equal(photo.pixels, pixels)
    assert photo.metadata.orientation == orientation


@pytest.mark.parametrize("part", [0.02, 0.5, 0.98])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_truncated_photo_is_refused_by_name(tmp_path, suffix, part):
    data = bytes(cv2.imencode(suffix, texture(160, 120))[1])
    (tmp_path / f"cut{suffix}").write_bytes(data[: int(part * len(data))])
    with pytest.raises(FileError) as error:
        read_photo(tmp_path / f"cut{suffix}")
    assert f"cut{suffix}" in one_line(error)


def test_jpeg_cut_after_its_thumbnail_is_refused(tmp_path):
    data = tagged_jpeg(
        texture(160, 120), [(0xE1, b"Exif\0\0" + camera_exif("<"))]
    )  # the thumbnail has an end of its own
    assert data.count(b"\xff\xd9") >= 2
    (tmp_path / "whole.jpg").write_bytes(data)
    assert read_photo(tmp_path / "whole.jpg").pixels.shape == (120, 160, 3)
    (tmp_path / "cut.jpg").write_bytes(data[: len(data) * 3 // 4])
    with pytest.raises(FileError, match=r"cut\.jpg"):
        read_photo(tmp_path / "cut.jpg")


@pytest.mark.parametrize("name", ["empty.jpg", "text.jpg", "missing.jpg", "folder.png", "text.dng", "empty.nef"])
def test_what_is_no_photo_is_refused_by_name(tmp_path, name):
    if name.startswith("empty"):
        (tmp_path / name).write_bytes(b"")
    elif name.startswith("text"):
        (tmp_path / name).write_text("this is no photo\n" * 100)
    elif name.startswith("folder"):
        (tmp_path / name).mkdir()
    with pytest.raises(FileError) as error:
        read_photo(tmp_path / name)
    assert name in one_line(error)


def test_write_image_refuses_what_cannot_be_stored(tmp_path):
    with pytest.raises(InputError) as error:
        write_image(tmp_path / "photo.xyz", texture(8, 8))
    assert ".xyz" in one_line(error)
    with pytest.raises(FileError) as missing:
        write_image(tmp_path / "no" / "photo.png", texture(8, 8))
    assert "photo.png" in one_line(missing)
    assert not list(tmp_path.iterdir())


def test_write_image_replaces_a_file(tmp_path):
    write_image(tmp_path / "a.png", texture(8, 8, 1))
    write_image(tmp_path / "a.png", texture(8, 8, 2))
    np.testing.assert_array_equal(read_photo(tmp_path / "a.png").pixels, texture(8, 8, 2))


def test_pictures_that_are_not_read_are_known(tmp_path):
    for name in ("a.png", "b.bmp", "c.JP2", ".d.gif", "e.txt", "f.GPR", "g.mpo"):
        (tmp_path / name).touch()
    assert unread_pictures(tmp_path) == ["b.bmp", "c.JP2", "f.GPR", "g.mpo"]
    assert list_photos(tmp_path) == ["a.png"]
    (tmp_path / "a.png").unlink()
    with pytest.raises(FileError, match=r"no photos in .* \(b\.bmp is of no such kind; convert it to PNG or TIFF"):
        list_photos(tmp_path)


@pytest.mark.parametrize("suffix", [".jpe", ".JFIF", ".jif", ".jfi", ".pjpeg", ".pjp"])
def test_a_jpeg_under_another_ending_is_read_and_written(tmp_path, suffix):
    pixels = texture(64, 48)
    write_image(tmp_path / f"a{suffix}", pixels, Metadata(camera_exif("<", 6)), quality=97)
    write_image(tmp_path / "b.jpg", pixels, Metadata(camera_exif("<", 6)), quality=97)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / "b.jpg").read_bytes()
    assert list_photos(tmp_path) == [f"a{suffix}", "b.jpg"]
    assert output_name(f"a{suffix}") == f"a{suffix}"
    photo = read_photo(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(photo.pixels, read_photo(tmp_path / "b.jpg").pixels)
    assert photo.metadata.orientation == 6


@pytest.mark.parametrize("suffix", [".nrw", ".NRW", ".rwl", ".3fr", ".fff"])
def test_raw_of_other_makers_is_developed(tmp_path, suffix):
    """A DNG under their endings: LibRaw goes by the content."""
    (tmp_path / f"a{suffix}").write_bytes(small_dng(6))
    assert list_photos(tmp_path) == [f"a{suffix}"]
    assert output_name(f"a{suffix}") == "a.tif"
    photo = read_photo(tmp_path / f"a{suffix}")
    assert photo.pixels.dtype == np.uint16
    assert photo.metadata.orientation == 6


def test_list_photos_sorts_and_passes_over_other_files(tmp_path):
    for name in ("b.JPG", "a.png", "c.tiff", "d.NEF", ".hidden.jpg", "notes.txt", "camera.json", "e.webp"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder.jpg").mkdir()
    assert list_photos(tmp_path) == ["a.png", "b.JPG", "c.tiff", "d.NEF", "e.webp"]
    (tmp_path / "f.jpg").symlink_to("nowhere.jpg")  # reading it says that it leads nowhere
    assert list_photos(tmp_path)[-1] == "f.jpg"
    for name in ("f10.jpg", "f9.jpg", "f09.jpg"):
        (tmp_path / name).write_bytes(b"")
    # names without leading zeros are in the order of capture, too
    assert list_photos(tmp_path)[5:8] == ["f09.jpg", "f9.jpg", "f10.jpg"]


@pytest.mark.parametrize("kind", ["empty", "missing", "file", "others"])
def test_list_photos_refuses(tmp_path, kind):
    folder = tmp_path / kind
    if kind == "file":
        folder.write_text("x")
    elif kind != "missing":
        folder.mkdir()
    if kind == "others":
        (folder / ".a.jpg").write_bytes(b"x")
        (folder / "a.txt").write_bytes(b"x")
    with pytest.raises(FileError) as error:
        list_photos(folder)
    assert str(folder) in one_line(error)


def test_output_name_turns_raw_and_heic_into_tiff_or_what_is_asked():
    names = ["a.jpg", "b.DNG", "c.x.nef", "d.TIF", "e.HEIC"]
    assert [output_name(n) for n in names] == ["a.jpg", "b.tif", "c.x.tif", "d.TIF", "e.tif"]
    assert [output_name(n, "png") for n in names] == ["a.jpg", "b.png", "c.x.png", "d.TIF", "e.png"]


def test_two_photos_of_one_output_are_refused(tmp_path):
    for name in ("a.jpg", "a.dng"):
        (tmp_path / name).write_bytes(b"x")
    assert list_photos(tmp_path) == ["a.dng", "a.jpg"]
    with pytest.raises(InputError, match=r"a\.dng and a\.jpg would both be rectified to a\.jpg"):
        list_photos(tmp_path, raw_as="jpg")


# ---------------------------------------------------------------- pixels through the identity


@pytest.mark.parametrize("interpolation", ["nearest", "linear", "cubic", "lanczos"])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_identity_motion_is_exact(tmp_path, rng, dtype, channels, interpolation):
    """From file to file: depth, channels and every bit, the border included."""
    width, height = 143, 101
    camera = Camera(width, height, [[123.4, 0, 70.3], [0, 119.9, 51.7], [0, 0, 1]])
    shape = (height, width) if channels == 1 else (height, width, channels)
    if dtype == np.float32:
        pixels = rng.normal(size=shape).astype(np.float32) * 1e4
    else:
        pixels = rng.integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)
    for suffix in [".tif"] if dtype == np.float32 else [".tif", ".png"]:
        write_image(tmp_path / f"in{suffix}", pixels)
        rectified, mask = rectify(read_photo(tmp_path / f"in{suffix}").pixels, camera, interpolation=interpolation)
        write_image(tmp_path / f"out{suffix}", rectified)
        out = read_photo(tmp_path / f"out{suffix}").pixels
        assert out.dtype == dtype
        assert (mask == 255).all()
        np.testing.assert_array_equal(out, pixels)


def test_16_bits_become_8_where_a_kind_holds_no_more(tmp_path):
    pixels = texture(64, 48, channels=1).astype(np.uint16) * 257
    write_image(tmp_path / "a.jpg", pixels, quality=100)
    back = read_photo(tmp_path / "a.jpg").pixels
    assert back.dtype == np.uint8
    assert np.abs(back.astype(int) - texture(64, 48, channels=1)).max() <= 2


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_floats_are_not_forced_into_whole_numbers(tmp_path, suffix):
    with pytest.raises(InputError, match="float32"):
        write_image(tmp_path / f"a{suffix}", texture(8, 8).astype(np.float32))
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- RAW and HEIC


def test_raw_is_developed_in_the_sensors_rows(tmp_path):
    photos = {}
    for o in (1, 3, 6, 8):
        (tmp_path / f"{o}.dng").write_bytes(small_dng(o))
        photos[o] = read_photo(tmp_path / f"{o}.dng")
        assert photos[o].metadata.orientation == o
        np.testing.assert_array_equal(photos[o].pixels, photos[1].pixels)
    pixels = photos[1].pixels
    assert pixels.shape == (48, 64, 3)
    assert pixels.dtype == np.uint16
    # it rises to the right and down, as the sensor's signal does
    assert pixels[24, 50, 1] > pixels[24, 10, 1]
    assert pixels[40, 30, 1] > pixels[8, 30, 1]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_raw_cut_short_is_named(tmp_path, share):
    data = small_dng()
    (tmp_path / "a.dng").write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileError) as error:
        read_photo(tmp_path / "a.dng")
    assert "a.dng" in one_line(error)


def heic(pixels, orientation=1, bits=8, **kwargs):
    """By libheif, which writes irot and imir for the orientation in the EXIF."""
    heif = pytest.importorskip("pillow_heif")
    out = io.BytesIO()
    mode = "RGB" if bits == 8 else "RGB;16"
    image = heif.from_bytes(mode, (pixels.shape[1], pixels.shape[0]), np.ascontiguousarray(pixels[..., ::-1]).tobytes())
    image.save(out, quality=-1, chroma=444, exif=b"Exif\0\0" + camera_exif(">", orientation, 96, 64), **kwargs)
    return out.getvalue()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_heic_is_read_in_the_stored_frame(tmp_path, orientation):
    """libheif rotates it; the rotation becomes the tag again."""
    stored = cv2.resize(texture(12, 8), (96, 64), interpolation=cv2.INTER_CUBIC)
    (tmp_path / "a.heic").write_bytes(heic(stored, orientation))
    photo = read_photo(tmp_path / "a.heic")
    assert photo.metadata.orientation == orientation
    assert photo.pixels.dtype == np.uint16
    # the picture that was given is the stored one; colours went through YCbCr
    assert np.abs(photo.pixels / 257 - stored).max() <= 4
    assert photo.metadata.exif[8:] != b""
    write_image(tmp_path / output_name("a.heic"), photo.pixels, photo.metadata)
    np.testing.assert_array_equal(read_photo(tmp_path / "a.tif").pixels, photo.pixels)
    assert read_photo(tmp_path / "a.tif").metadata.orientation == orientation


def test_heic_follows_its_own_rotation_rather_than_the_exif(tmp_path):
    """In HEIF irot and imir count; the EXIF may say anything."""
    stored = cv2.resize(texture(12, 8), (96, 64), interpolation=cv2.INTER_CUBIC)
    data = heic(stored, 6)
    (tmp_path / "a.heic").write_bytes(data.replace(camera_exif(">", 6, 96, 64), camera_exif(">", 1, 96, 64)))
    photo = read_photo(tmp_path / "a.heic")
    assert photo.metadata.orientation == 6
    assert np.abs(photo.pixels / 257 - stored).max() <= 4


def test_heic_of_10_bits_keeps_them(tmp_path):
    ramp = np.repeat(np.linspace(0, 65535, 96).astype(np.uint16)[None, :, None], 64, 0).repeat(3, 2)
    (tmp_path / "a.heic").write_bytes(heic(ramp, bits=16))
    pixels = read_photo(tmp_path / "a.heic").pixels
    assert len(np.unique(pixels[..., 1])) > 80
    assert np.abs(pixels[..., 1].astype(int) - ramp[..., 1]).max() < 400


def test_heic_without_its_extra_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(60))
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pillow_heif":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(FileError) as error:
        read_photo(tmp_path / "a.heic")
    assert 'pip install "rsundistort[heif]"' in one_line(error)
    assert "cannot be decoded" not in one_line(error)


@pytest.mark.parametrize("share", [0.01, 0.2, 0.6, 0.95])
def test_heic_cut_short_is_named(tmp_path, share):
    data = heic(texture(96, 64))
    (tmp_path / "a.heic").write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileError) as error:
        read_photo(tmp_path / "a.heic")
    assert "a.heic" in one_line(error)


# ---------------------------------------------------------------- files that are not what they say


def of_kind(kind):
    pixels = texture(64, 48)
    if kind == "HEIC":
        return heic(pixels)
    return small_dng() if kind == "RAW" else bytes(cv2.imencode(f".{kind.lower()}", pixels)[1])


@pytest.mark.parametrize("named", ["jpg", "png", "tif", "webp", "heic"])
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WebP", "HEIC", "RAW"])
def test_a_file_is_read_by_its_content(tmp_path, kind, named):
    path = tmp_path / f"a.{named}"
    path.write_bytes(of_kind(kind))
    if {"jpg": "JPEG", "tif": "TIFF", "webp": "WebP"}.get(named, named.upper()) == kind:
        assert read_photo(path).pixels.shape == (48, 64, 3)
        return
    with pytest.warns(FileKindWarning, match=rf"^a\.{named} is {kind} by its content"):
        photo = read_photo(path)
    assert photo.pixels.shape == (48, 64, 3)
    out = tmp_path / output_name(f"b.{named}")
    write_image(out, photo.pixels, photo.metadata)
    assert read_photo(out).pixels.shape == (48, 64, 3)  # of the kind that its name says


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WebP", "HEIC"])
def test_a_picture_is_no_raw_file(tmp_path, kind):
    """Whoever developed it may have rotated or cropped it."""
    (tmp_path / "a.nef").write_bytes(of_kind(kind))
    with pytest.raises(FileError, match=rf"a\.nef is {kind} by its content, not RAW"):
        read_photo(tmp_path / "a.nef")


def test_cmyk_is_converted_and_its_profile_left_out(tmp_path):
    rgb = Image.fromarray(np.full((48, 64, 3), (200, 120, 40), np.uint8))
    profile = bytes(16) + b"CMYK" + bytes(200)
    rgb.convert("CMYK").save(tmp_path / "a.jpg", quality=95, icc_profile=profile)
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.pixels.shape == (48, 64, 3)
    assert np.abs(photo.pixels[24, 32].astype(int) - [40, 120, 200]).max() <= 6
    with pytest.warns(MetadataWarning, match=r"b\.jpg: the ICC profile \(CMYK\) is not of these colours"):
        write_image(tmp_path / "b.jpg", photo.pixels, photo.metadata)
    assert read_photo(tmp_path / "b.jpg").metadata.icc == b""


# ---------------------------------------------------------------- too large


def claimed(suffix, width, height):
    """A small file whose header claims a size."""
    if suffix == ".heic":
        data = heic(texture(96, 64))
        return data.replace(struct.pack(">II", 96, 64), struct.pack(">II", width, height))
    data = bytes(cv2.imencode(suffix, texture(64, 48), [cv2.IMWRITE_WEBP_QUALITY, 80])[1])
    if suffix == ".jpg":
        at = data.index(b"\xff\xc0")
        return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]
    if suffix == ".png":
        header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    if suffix == ".webp":
        at = data.index(b"\x9d\x01\x2a") + 3
        return data[:at] + struct.pack("<HH", width, height) + data[at + 4 :]
    write = struct.pack("<HHIHH", 0x0100, 3, 1, 64, 0), struct.pack("<HHIHH", 0x0101, 3, 1, 48, 0)
    for old, tag, value in zip(write, (0x0100, 0x0101), (width, height), strict=True):
        assert old in data
        data = data.replace(old, struct.pack("<HHII", tag, 4, 1, value))
    return data


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".heic"])
def test_a_decompression_bomb_is_refused_unopened(tmp_path, suffix, monkeypatch):
    (tmp_path / f"a{suffix}").write_bytes(claimed(suffix, 16000, 16000))

    def never(*args, **kwargs):
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", never)
    with pytest.raises(FileError) as error:
        read_photo(tmp_path / f"a{suffix}")
    assert f"a{suffix} has 16000x16000 pixels, more than the limit of 250 million" in one_line(error)
    assert "--max-pixels" in str(error.value)


@pytest.mark.parametrize("stray", [b"\0\1", b"\xff", b"\xff\xd0", b"\xff\0", b"\x5a" * 70_000])
def test_a_bomb_behind_stray_bytes_is_found_as_the_decoder_finds_it(tmp_path, stray, monkeypatch):
    data = claimed(".jpg", 16000, 16000)
    end = 4 + int.from_bytes(data[4:6], "big")  # of the first segment
    (tmp_path / "a.jpg").write_bytes(data[:end] + stray + data[end:])
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(FileError, match="16000x16000"):
        read_photo(tmp_path / "a.jpg")


def test_a_photo_with_stray_bytes_is_read_as_ever(tmp_path):
    write_image(tmp_path / "a.jpg", texture(64, 48))
    data = (tmp_path / "a.jpg").read_bytes()
    end = 4 + int.from_bytes(data[4:6], "big")
    (tmp_path / "b.jpg").write_bytes(data[:end] + b"\0\1" + data[end:])
    np.testing.assert_array_equal(read_photo(tmp_path / "b.jpg").pixels, read_photo(tmp_path / "a.jpg").pixels)


@pytest.mark.parametrize(
    ("place", "put", "says"),
    [
        (slice(8, 12), struct.pack(">I", 0xFFFFFFF0), "is cut short"),  # a chunk of four gigabytes
        (slice(12, 16), b"tEXt", "does not say how large"),
    ],
)
def test_a_header_that_does_not_say_how_large_is_refused_unopened(tmp_path, monkeypatch, place, put, says):
    monkeypatch.setattr(cv2, "imdecode", None)
    write_image(tmp_path / "a.png", texture(64, 48))
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[place] = put
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(FileError, match=says):
        read_photo(tmp_path / "a.png")


@pytest.mark.parametrize("quality", [80, 101])
@pytest.mark.parametrize("alpha", [False, True])
def test_sizes_in_webp_headers(tmp_path, quality, alpha):
    """Lossy, lossless and extended files keep it in different places."""
    write_image(tmp_path / "a.webp", texture(67, 45, channels=4 if alpha else 3), quality=quality)
    with pytest.raises(FileError, match="67x45"):
        read_photo(tmp_path / "a.webp", max_megapixels=0.001)


def test_the_limit_can_be_set(tmp_path):
    write_image(tmp_path / "a.png", texture(100, 100))
    assert read_photo(tmp_path / "a.png", max_megapixels=0.01).pixels.shape == (100, 100, 3)
    with pytest.raises(FileError, match=r"100x100"):
        read_photo(tmp_path / "a.png", max_megapixels=0.0099)
    (tmp_path / "a.dng").write_bytes(small_dng())
    with pytest.raises(FileError, match="64x48"):
        read_photo(tmp_path / "a.dng", max_megapixels=0.001)


@pytest.mark.parametrize("shape", [(2, 32767), (32767, 2)])
def test_sides_that_opencv_cannot_remap_are_refused_before(tmp_path, shape):
    pixels = np.zeros(shape, np.uint8)
    write_image(tmp_path / "a.png", pixels)
    with pytest.raises(FileError, match="sides above 32766"):
        read_photo(tmp_path / "a.png")
    height, width = shape
    with pytest.raises(InputError, match="32766") as error:
        rectify(pixels, Camera(width, height, [[100, 0, 1], [0, 100, 1], [0, 0, 1]]))
    one_line(error)
    smaller = pixels[: height - 1] if height > width else pixels[:, : width - 1]
    write_image(tmp_path / "b.png", smaller)
    read = read_photo(tmp_path / "b.png").pixels
    height, width = read.shape
    camera = Camera(width, height, [[1e4, 0, width / 2], [0, 1e4, height / 2], [0, 0, 1]])
    np.testing.assert_array_equal(rectify(read, camera)[0], smaller)


@pytest.mark.parametrize("name", ["with space.png", "Жук 虫 ä.jpg", "a.b.c.webp"])
def test_any_name_is_read_and_written(tmp_path, name):
    write_image(tmp_path / name, texture(16, 12), Metadata(camera_exif("<")))
    photo = read_photo(tmp_path / name)
    assert photo.pixels.shape == (12, 16, 3)
    assert photo.metadata.orientation == 6
