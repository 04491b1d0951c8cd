"""EXIF, XMP and ICC through every kind of file; ExifRead, Pillow and tifffile read and write them independently."""

from __future__ import annotations

import io
import struct
import warnings
import zlib

import cv2
import exifread
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from make_photos import MAKER_NOTE, THUMBNAIL, camera_exif, small_dng, tagged_jpeg, texture
from PIL import Image, ImageCms

from rsundistort.errors import MetadataWarning
from rsundistort.io import Metadata, read_photo, write_image
from rsundistort.io.photos.exif import corrected_exif, exif_of_tiff
from rsundistort.model.orientation import orient_pixels

SUFFIXES = (".jpg", ".png", ".webp", ".tif")
ICC = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
GREY_ICC = ICC[:16] + b"GRAY" + ICC[20:]
XMP = b"""<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
 <rdf:Description rdf:about="" xmlns:tiff="http://ns.adobe.com/tiff/1.0/" xmlns:exif="http://ns.adobe.com/exif/1.0/"
  xmlns:xmp="http://ns.adobe.com/xap/1.0/" xmlns:dji="http://www.dji.com/drone-dji/1.0/"
  xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/"
  tiff:Orientation="6" exif:PixelXDimension='4000' xmp:Rating="5" dji:GimbalYawDegree="-31.20" dji:DewarpData="2018;1"
  GDepth:Format="RangeInverse">
  <exif:PixelYDimension>3000</exif:PixelYDimension>
  <GDepth:Data>AAAA</GDepth:Data>
  <dc:title xmlns:dc="http://purl.org/dc/elements/1.1/"><rdf:Alt><rdf:li xml:lang="x-default">Tit\xc3\xa4l</rdf:li>
  </rdf:Alt></dc:title>
  <!-- somebody's comment -->
 </rdf:Description>
</rdf:RDF></x:xmpmeta>
                    <?xpacket end="w"?>"""


def tags(path, skipped=()):
    """Tags by ExifRead, an independent reader."""
    data = path.read_bytes()
    if path.suffix == ".webp":  # ExifRead looks for a head that the format does not have
        with Image.open(path) as image:
            data = tagged_jpeg(texture(8, 8), [(0xE1, b"Exif\0\0" + image.info["exif"].removeprefix(b"Exif\0\0"))])
    found = exifread.process_file(io.BytesIO(data), details=False)
    return {k: str(v) for k, v in found.items() if k.split()[0] in ("Image", "EXIF", "GPS") and k not in skipped}


def write(path, metadata, width=64, height=48, channels=3):
    write_image(path, texture(width, height, channels=channels), metadata)
    return read_photo(path)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_tags_are_kept_in_every_kind(tmp_path, suffix, order):
    exif = camera_exif(order)
    (tmp_path / "in.jpg").write_bytes(tagged_jpeg(texture(64, 48), [(0xE1, b"Exif\0\0" + exif)]))
    photo = read_photo(tmp_path / "in.jpg")
    assert photo.metadata.exif == exif
    out = tmp_path / f"out{suffix}"
    write_image(out, photo.pixels, photo.metadata)
    pointers = ("Image ExifOffset", "Image GPSInfo")
    before = tags(tmp_path / "in.jpg", pointers)
    assert len(before) > 15
    after = tags(out, pointers)
    assert before.items() <= after.items()
    if suffix != ".tif":
        assert after == before
    again = read_photo(out).metadata.exif
    # byte for byte, and where it was: its offsets count from the start of the block
    assert again.find(MAKER_NOTE) == exif.find(MAKER_NOTE) > 0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_opencv_and_pillow_follow_what_is_written(tmp_path, suffix):
    photo = write(tmp_path / f"a{suffix}", Metadata(camera_exif(">"), XMP, ICC))
    if suffix in (".jpg", ".png"):  # OpenCV 5 fails on any TIFF whose tag exchanges the sides, 4 knows none of WebP
        assert cv2.imread(str(tmp_path / f"a{suffix}"), cv2.IMREAD_COLOR).shape == (64, 48, 3)  # rotated by the tag
    with Image.open(tmp_path / f"a{suffix}") as image:
        exif = image.getexif()
        assert exif[0x0112] == 6
        assert exif.get_ifd(0x8769)[0x927C] == MAKER_NOTE
        assert image.info["icc_profile"] == ICC
        assert b"x-default" in image.info["xmp"]
        pixels = np.asarray(image)[..., ::-1]
        if suffix == ".tif":  # Pillow rotates a TIFF
            np.testing.assert_array_equal(pixels, orient_pixels(photo.pixels, 6))
        elif suffix != ".webp":  # no halved colour to be drawn by other means
            np.testing.assert_array_equal(pixels, photo.pixels)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_tiff_of_either_byte_order_is_exact(tmp_path, rng, channels, dtype, order):
    """Pixels follow the byte order of the EXIF block; tifffile reads them independently where it can inflate them."""
    shape = (37, 53) if channels == 1 else (37, 53, channels)
    pixels = (rng.random(shape) * 60000).astype(dtype)
    write_image(tmp_path / "a.tif", pixels, Metadata(camera_exif(order)))
    back = read_photo(tmp_path / "a.tif")
    assert back.pixels.dtype == dtype
    np.testing.assert_array_equal(back.pixels, pixels)
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        assert tiff.byteorder == order
        page = tiff.pages[0]
        assert page.shape == shape
        assert page.tags["ExifTag"].value["FocalLengthIn35mmFilm"] == 35
        assert (len(page.extrasamples), page.tags["Orientation"].value) == (int(channels == 4), 6)
        if dtype == np.float32:  # not packed
            expected = pixels if channels == 1 else pixels[..., [2, 1, 0, 3][:channels]]
            np.testing.assert_array_equal(page.asarray(), expected)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_sizes_and_thumbnail_become_true(tmp_path, suffix, order):
    photo = write(tmp_path / f"a{suffix}", Metadata(camera_exif(order, width=4000, height=3000)), 70, 50)
    found = tags(tmp_path / f"a{suffix}")
    assert (found["EXIF ExifImageWidth"], found["EXIF ExifImageLength"]) == ("70", "50")
    assert (found["Image ImageWidth"], found["Image ImageLength"]) == ("70", "50")
    assert THUMBNAIL not in (tmp_path / f"a{suffix}").read_bytes()
    assert found["Image Software"] == "their own software"
    assert photo.metadata.orientation == 6


def test_a_width_beyond_a_short_gets_room():
    block, problems = corrected_exif(camera_exif(">"), 70000, 48)
    assert not problems
    found = exifread.process_file(io.BytesIO(tagged_jpeg(texture(8, 8), [(0xE1, b"Exif\0\0" + block)])))
    assert str(found["EXIF ExifImageWidth"]) == "70000"


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_put_or_added(orientation, order):
    assert Metadata(camera_exif(order)).with_orientation(orientation).orientation == orientation
    bare = Metadata().with_orientation(orientation)
    assert bare.orientation == orientation
    assert bool(bare.exif) == (orientation != 1)
    head = b"II*\0" if order == "<" else b"MM\0*"
    other = head + struct.pack(order + "IHHHIHHI", 8, 1, 0x0128, 3, 1, 2, 0, 0)  # has none
    block = Metadata(other).with_orientation(orientation)
    assert block.orientation == orientation
    assert block.exif.startswith(head)


def test_xmp_is_corrected_in_its_text(tmp_path):
    photo = write(tmp_path / "a.jpg", Metadata(xmp=XMP).with_orientation(1))
    xmp = photo.metadata.xmp
    assert b'tiff:Orientation="1"' in xmp
    assert b'exif:PixelXDimension="64"' in xmp
    assert b"<exif:PixelYDimension>48</exif:PixelYDimension>" in xmp
    assert b"GDepth:Format" not in xmp
    assert b"AAAA" not in xmp
    for kept in (b'xmp:Rating="5"', "Titäl".encode(), b"GimbalYawDegree", b"somebody's comment", b"dji:DewarpData"):
        assert kept in xmp


@pytest.mark.parametrize("xmp", [b"", XMP, b"garbage", b"<x>", b"<rdf:RDF/>", b"\xff\xfe<\0x\0"], ids=range(6))
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.filterwarnings("ignore::rsundistort.errors.MetadataWarning")
def test_a_rectified_photo_carries_its_mark(tmp_path, suffix, xmp):
    assert Metadata(xmp=xmp).rectified_by is None
    marked = Metadata(camera_exif("<"), xmp, ICC).marked("1.2.3")
    photo = write(tmp_path / f"a{suffix}", marked)
    assert photo.metadata.rectified_by == "1.2.3"
    assert photo.metadata.marked("1.3").rectified_by == "1.3"
    assert photo.metadata.marked("1.3").xmp.count(b"RectifiedBy") == 1
    assert tags(tmp_path / f"a{suffix}")["Image Software"] == "their own software"
    if xmp == XMP:
        assert b'xmp:Rating="5"' in photo.metadata.xmp
        assert b"DewarpData" not in photo.metadata.xmp  # of a lens that is taken out


def test_the_mark_survives_another_program_that_writes_elements():
    """As ExifTool writes XMP."""
    marked = Metadata(xmp=XMP).marked("1.2").xmp
    element = b">\n <rsundistort:RectifiedBy>1.2</rsundistort:RectifiedBy>\n</rdf:Description>"
    assert Metadata(xmp=marked.replace(b' rsundistort:RectifiedBy="1.2"/>', element)).rectified_by == "1.2"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_profile_of_other_colours_is_left_out(tmp_path, suffix):
    with pytest.warns(MetadataWarning, match=rf"a\{suffix}: the ICC profile \(GRAY\)"):
        write_image(tmp_path / f"a{suffix}", texture(64, 48), Metadata(icc=GREY_ICC))
    assert read_photo(tmp_path / f"a{suffix}").metadata == Metadata()
    if suffix != ".webp":  # knows no grey
        assert write(tmp_path / f"b{suffix}", Metadata(icc=GREY_ICC), channels=1).metadata.icc == GREY_ICC


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_profile_of_many_segments_is_kept(tmp_path, suffix):
    large = ICC + bytes(range(256)) * 600
    assert write(tmp_path / f"a{suffix}", Metadata(icc=large)).metadata.icc == large
    with Image.open(tmp_path / f"a{suffix}") as image:
        assert image.info["icc_profile"] == large


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_pillow_wrote_is_read(tmp_path, suffix):
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 8, "Pillow"
    exif.get_ifd(0x8769)[0xA405] = 28
    if suffix == ".tif":
        exif[0x02BC] = XMP
    Image.fromarray(texture(64, 48)).save(tmp_path / f"a{suffix}", exif=exif, icc_profile=ICC, xmp=XMP)
    if suffix == ".png":  # Pillow keeps XMP of PNG in its info only
        data = (tmp_path / "a.png").read_bytes()
        text = b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(XMP)
        chunk = struct.pack(">I", len(text)) + b"iTXt" + text + struct.pack(">I", zlib.crc32(b"iTXt" + text))
        (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])
    metadata = read_photo(tmp_path / f"a{suffix}").metadata
    assert metadata.orientation == 8
    assert (metadata.xmp, metadata.icc) == (XMP, ICC)
    write_image(tmp_path / "b.jpg", texture(64, 48), metadata)
    found = tags(tmp_path / "b.jpg")
    assert found["Image Make"] == "Pillow"
    if suffix != ".tif":  # where Pillow writes IFD0 only
        assert found["EXIF FocalLengthIn35mmFilm"] == "28"


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("quality", [90, 101])
def test_webp_keeps_alpha_beside_metadata(tmp_path, alpha, quality):
    pixels = texture(64, 48, channels=4 if alpha else 3)
    write_image(tmp_path / "plain.webp", pixels, quality=quality)
    write_image(tmp_path / "full.webp", pixels, Metadata(camera_exif("<"), XMP, ICC), quality)
    plain, full = read_photo(tmp_path / "plain.webp"), read_photo(tmp_path / "full.webp")
    np.testing.assert_array_equal(full.pixels, plain.pixels)
    assert full.pixels.shape[2] == 3 + alpha
    with Image.open(tmp_path / "full.webp") as image:
        assert image.mode == ("RGBA" if alpha else "RGB")


def test_what_belongs_to_pictures_left_behind_is_not_carried(tmp_path):
    """Multi-picture segments and extended XMP (depth maps)."""
    xmp = XMP.replace(
        b"GDepth:Format", b'xmlns:n="http://ns.adobe.com/xmp/note/" n:HasExtendedXMP="0123" GDepth:Format'
    )
    segments = [
        (0xE1, b"Exif\0\0" + camera_exif("<")),
        (0xE1, b"http://ns.adobe.com/xap/1.0/\0" + xmp),
        (0xE1, b"http://ns.adobe.com/xmp/extension/\0" + bytes(40) + b"depth"),
        (0xE2, b"MPF\0" + bytes(30)),
    ]
    (tmp_path / "in.jpg").write_bytes(tagged_jpeg(texture(64, 48), segments) + tagged_jpeg(texture(16, 12), []))
    photo = read_photo(tmp_path / "in.jpg")
    assert photo.pixels.shape == (48, 64, 3)
    write_image(tmp_path / "out.jpg", photo.pixels, photo.metadata)
    data = (tmp_path / "out.jpg").read_bytes()
    for gone in (b"MPF\0", b"extension", b"HasExtendedXMP", b"GDepth:Format"):
        assert gone not in data
    assert b'xmp:Rating="5"' in data


# ---------------------------------------------------------------- too long for a JPEG


def test_a_maker_note_too_long_for_a_jpeg_is_named(tmp_path):
    exif = camera_exif("<", thumbnail=False)
    at = exif.find(struct.pack("<HHI", 0x927C, 7, len(MAKER_NOTE)))
    long = exif[: at + 4] + struct.pack("<II", 70000, len(exif)) + exif[at + 12 :] + bytes(70000)
    with pytest.warns(MetadataWarning, match=r"a\.jpg: not kept: the maker note"):
        write_image(tmp_path / "a.jpg", texture(64, 48), Metadata(long))
    found = tags(tmp_path / "a.jpg")
    assert found["EXIF FocalLength"] == "43/10"
    assert found["GPS GPSLatitude"] == "[55, 41, 267/5]"
    write_image(tmp_path / "a.tif", texture(64, 48), Metadata(long))  # has room


def test_xmp_too_long_for_a_jpeg_is_named_and_the_mark_stays(tmp_path):
    long = XMP.replace(b"somebody's", b"x" * 70000)
    with pytest.warns(MetadataWarning, match=r"a\.jpg: not kept: the XMP"):
        photo = write(tmp_path / "a.jpg", Metadata(xmp=long).marked("9"))
    assert photo.metadata.rectified_by == "9"


# ---------------------------------------------------------------- built from TIFF structures


@pytest.mark.parametrize("order", "<>")
def test_a_block_built_of_a_block_says_the_same(order):
    exif = camera_exif(order)
    built = exif_of_tiff(exif)
    assert built.find(MAKER_NOTE) == exif.find(MAKER_NOTE)
    before, after = (
        {
            key: str(value)
            for key, value in exifread.process_file(
                io.BytesIO(tagged_jpeg(texture(8, 8), [(0xE1, b"Exif\0\0" + b)]))
            ).items()
            if key.split()[0] in ("Image", "EXIF", "GPS")
        }
        for b in (exif, built)
    )
    moved = {"Image ExifOffset", "Image GPSInfo", "Image ImageWidth", "Image ImageLength"}  # a size is the file's
    assert {k: v for k, v in after.items() if k not in moved} == {k: v for k, v in before.items() if k not in moved}


@pytest.mark.parametrize("byteorder", "<>")
def test_a_bigtiff_is_read_in_the_stored_frame(tmp_path, byteorder):
    pixels = texture(64, 48).astype(np.uint16) * 257
    extra = [(0x0112, "H", 1, 6, True), (0x010F, "s", 0, "A Maker", True)]
    tifffile.imwrite(
        tmp_path / "a.tif", pixels[..., ::-1], bigtiff=True, photometric="rgb", extratags=extra, byteorder=byteorder
    )
    photo = read_photo(tmp_path / "a.tif")
    np.testing.assert_array_equal(photo.pixels, pixels)
    assert photo.metadata.orientation == 6
    write_image(tmp_path / "b.tif", photo.pixels, photo.metadata)
    assert tags(tmp_path / "b.tif")["Image Make"] == "A Maker"
    np.testing.assert_array_equal(read_photo(tmp_path / "b.tif").pixels, pixels)


def test_raw_keeps_its_tags_and_its_maker_note_in_place(tmp_path):
    (tmp_path / "a.dng").write_bytes(small_dng(6))
    photo = read_photo(tmp_path / "a.dng")
    for suffix in (".tif", ".jpg", ".png"):
        write_image(tmp_path / f"a{suffix}", photo.pixels, photo.metadata)
        found = tags(tmp_path / f"a{suffix}")
        assert found["Image Make"].startswith("A Maker")
        assert found["Image Orientation"] == "Rotated 90 CW"
        assert found["EXIF FocalLength"] == "43/10"
        assert "EXIF ColorSpace" not in found  # that was of the camera's own JPEG
        assert not {"Image Tag 0xC612", "Image CFAPattern"} & found.keys()  # no DNG any more
        written = read_photo(tmp_path / f"a{suffix}").metadata.exif
        assert written.find(MAKER_NOTE) == small_dng(6).find(MAKER_NOTE)


# ---------------------------------------------------------------- damaged blocks


def damage(kind):
    exif = bytearray(camera_exif("<"))
    if kind == "cut short":
        return bytes(exif[:300])
    if kind == "IFD0 beyond the end":
        exif[4:8] = struct.pack("<I", 1 << 30)
    elif kind == "IFD1 is IFD0":
        count = struct.unpack_from("<H", exif, 8)[0]
        exif[10 + 12 * count :][:4]
        exif[10 + 12 * count : 14 + 12 * count] = struct.pack("<I", 8)
    elif kind == "Exif IFD is IFD0":
        at = exif.find(struct.pack("<HHI", 0x8769, 4, 1))
        exif[at + 8 : at + 12] = struct.pack("<I", 8)
    elif kind == "huge count":
        at = exif.find(struct.pack("<HH", 0x9003, 2))
        exif[at + 4 : at + 8] = struct.pack("<I", 0xFFFFFFFF)
    elif kind == "unknown type":
        at = exif.find(struct.pack("<HH", 0x920A, 5))
        exif[at + 2 : at + 4] = struct.pack("<H", 99)
    elif kind == "many entries":
        exif[8:10] = struct.pack("<H", 0xFFFF)
    elif kind == "no header":
        exif[:4] = b"XXXX"
    return bytes(exif)


@pytest.mark.parametrize(
    "kind",
    ["cut short", "IFD0 beyond the end", "IFD1 is IFD0", "Exif IFD is IFD0", "huge count", "unknown type",
     "many entries", "no header"],
)  # fmt: skip
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_exif_is_carried_and_reported_once(tmp_path, suffix, kind):
    exif = damage(kind)
    (tmp_path / "in.jpg").write_bytes(tagged_jpeg(texture(64, 48), [(0xE1, b"Exif\0\0" + exif)]))
    photo = read_photo(tmp_path / "in.jpg")
    assert photo.pixels.shape == (48, 64, 3)
    assert 1 <= photo.metadata.orientation <= 8
    with pytest.warns(MetadataWarning, match=rf"^out\{suffix}: the EXIF is damaged") as caught:
        write_image(tmp_path / f"out{suffix}", photo.pixels, photo.metadata)
    assert len(caught) == 1
    again = read_photo(tmp_path / f"out{suffix}")
    assert again.pixels.shape == (48, 64, 3)
    if suffix != ".tif":
        assert len(again.metadata.exif) in (len(exif), len(exif) - len(THUMBNAIL))


@pytest.mark.parametrize("orientation", [0, 9, 65535])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_orientation_that_means_nothing_is_carried(tmp_path, suffix, orientation):
    photo = write(tmp_path / f"a{suffix}", Metadata(camera_exif(">", orientation)))
    assert photo.metadata.orientation == 1
    assert tags(tmp_path / f"a{suffix}")["Image Orientation"] == str(orientation)
    assert photo.metadata.with_orientation(1).orientation == 1
    np.testing.assert_array_equal(photo.pixels.shape, (48, 64, 3))


@given(st.data())
def test_no_damage_raises(data):
    """Random bytes changed anywhere in a block, and cut anywhere."""
    exif = bytearray(camera_exif(data.draw(st.sampled_from("<>"))))
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(exif) - 1), st.integers(0, 255)), max_size=12)):
        exif[at] = value
    metadata = Metadata(bytes(exif[: data.draw(st.integers(0, len(exif)))]))
    assert 1 <= metadata.orientation <= 8
    fitted, _ = metadata.with_orientation(3).fitted(30, 20, 3)
    assert fitted.fitted(30, 20, 3)[0].exif == fitted.exif


@given(st.binary(max_size=60), st.integers(0, len(XMP)), st.integers(0, 40))
def test_no_damage_of_xmp_raises(content, at, gone):
    metadata = Metadata(xmp=XMP[:at] + content + XMP[at + gone :])
    assert metadata.fitted(30, 20, 3)[0].marked("2").rectified_by == "2"
    assert metadata.marked("2").with_orientation(3).rectified_by == "2"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_files_are_refused_or_read_but_never_raise_anything_else(tmp_path, suffix, rng):
    from rsundistort.errors import FileError

    write_image(tmp_path / f"a{suffix}", texture(48, 32), Metadata(camera_exif("<"), XMP, ICC))
    data = np.frombuffer((tmp_path / f"a{suffix}").read_bytes(), np.uint8)
    head = min(len(data), 6000)
    for _ in range(60):
        broken = data.copy()
        broken[rng.integers(0, head, 8)] = rng.integers(0, 256, 8)
        (tmp_path / f"b{suffix}").write_bytes(broken.tobytes())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                photo = read_photo(tmp_path / f"b{suffix}")
                write_image(tmp_path / f"c{suffix}", photo.pixels, photo.metadata)
            except FileError:
                pass
