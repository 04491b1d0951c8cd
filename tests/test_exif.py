"""What EXIF says of cameras: blocks built byte by byte, whole and damaged; groups and readouts from it."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import fields, replace
from pathlib import Path

import cv2
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_photos import texture

from rsundistort.io import (
    ExifFacts,
    camera_from_exif,
    facts_of_exif,
    focal_from_exif,
    group_of,
    groups_of,
    guess_readouts,
    read_exif,
)

SCENES = Path(__file__).parent.parent / "sample_scenes"
PHOTOS = Path(__file__).parent.parent.parent / "shared" / "photos"

MAKE, MODEL, ORIENTATION, EXIF_IFD = 0x010F, 0x0110, 0x0112, 0x8769
FOCAL, WIDTH, HEIGHT, FOCAL_35, ZOOM = 0x920A, 0xA002, 0xA003, 0xA405, 0xA404
PLANE_X, PLANE_UNIT, SERIAL, LENS = 0xA20E, 0xA210, 0xA431, 0xA434


def ascii_(text, pad=1):
    data = text if isinstance(text, bytes) else text.encode()
    return 2, len(data) + pad, data + b"\0" * pad


def short(value, order="<"):
    return 3, 1, struct.pack(order + "H", value)


def long(value, order="<"):
    return 4, 1, struct.pack(order + "I", value)


def rational(numerator, denominator, order="<"):
    return 5, 1, struct.pack(order + "II", numerator, denominator)


def exif_block(main, sub, order="<"):
    """A TIFF structure of two directories; entries are tag -> (type, count, bytes)."""

    def directory(entries, at, order):
        head = struct.pack(order + "H", len(entries))
        behind, data = at + 2 + 12 * len(entries) + 4, b""
        for tag, (kind, count, value) in sorted(entries.items()):
            field = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack(order + "I", behind + len(data))
            data += value + b"\0" * (len(value) % 2) if len(value) > 4 else b""
            head += struct.pack(order + "HHI", tag, kind, count) + field
        return head + bytes(4) + data

    start = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "I", 8)
    main = {**main, EXIF_IFD: long(0, order)}
    sub_at = 8 + len(directory(main, 8, order))
    main[EXIF_IFD] = long(sub_at, order)
    return start + directory(main, 8, order) + directory(sub, sub_at, order)


def jpeg(block, width=64, height=48):
    pixels = bytes(cv2.imencode(".jpg", texture(width, height))[1])
    segment = b"Exif\0\0" + block
    return pixels[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + pixels[2:]


def png(block):
    pixels = bytes(cv2.imencode(".png", texture(64, 48))[1])
    chunk = b"eXIf" + block
    return pixels[:33] + struct.pack(">I", len(block)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + pixels[33:]


def webp(block):
    plain = bytes(cv2.imencode(".webp", texture(64, 48))[1])[12:]
    size = struct.pack("<I", 63)[:3] + struct.pack("<I", 47)[:3]
    chunks = b"WEBPVP8X" + struct.pack("<IB3x", 10, 8) + size + plain
    chunks += b"EXIF" + struct.pack("<I", len(block)) + block + b"\0" * (len(block) % 2)
    return b"RIFF" + struct.pack("<I", len(chunks)) + chunks


def phone(order="<", **changes):
    """The block of a phone, as (main, sub), with entries put in place of others."""
    main = {MAKE: ascii_("Apple"), MODEL: ascii_("iPhone 6"), ORIENTATION: short(6, order)}
    sub = {
        FOCAL: rational(83, 20, order),
        FOCAL_35: short(29, order),
        WIDTH: long(3264, order),
        HEIGHT: long(2448, order),
        LENS: ascii_("iPhone 6 back camera 4.15mm f/2.2"),
    }
    main.update(changes.get("main", {}))
    sub.update(changes.get("sub", {}))
    return exif_block(main, sub, order)


PHONE = ExifFacts(
    make="Apple",
    model="iPhone 6",
    lens="iPhone 6 back camera 4.15mm f/2.2",
    focal_mm=4.15,
    focal_35mm=29.0,
    orientation=6,
    width=3264,
    height=2448,
)


def facts_of(tmp_path, block):
    (tmp_path / "a.jpg").write_bytes(jpeg(block))
    return read_exif(tmp_path / "a.jpg")


# ---------------------------------------------------------------- reading


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("wrap", [jpeg, png, webp, bytes], ids=["jpeg", "png", "webp", "tiff"])
def test_facts_of_every_kind_of_file(tmp_path, wrap, order):
    path = tmp_path / "Größe 1.bin"
    path.write_bytes(wrap(phone(order)))
    assert read_exif(path) == PHONE


def test_facts_of_a_block():
    assert facts_of_exif(phone()) == facts_of_exif(b"Exif\0\0" + phone(">")) == PHONE
    assert facts_of_exif(b"") == facts_of_exif(b"Exif\0\0") == facts_of_exif(b"noise") == ExifFacts()


def test_other_segments_before_the_exif(tmp_path):
    data = jpeg(phone())
    xmp = b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x='adobe:ns:meta/'/>"
    (tmp_path / "a.jpg").write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp + data[2:])
    assert read_exif(tmp_path / "a.jpg") == PHONE


def test_heic(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.from_bytes("BGR", (64, 48), texture(64, 48).tobytes()).save(tmp_path / "a.heic", exif=phone())
    assert read_exif(tmp_path / "a.heic") == PHONE


def test_a_body_with_its_lens(tmp_path):
    sub = {
        LENS: ascii_("EF24-105mm f/4L IS USM"),
        SERIAL: ascii_("0320502347"),
        ZOOM: rational(3, 2),
        PLANE_X: rational(5616000, 1459),
        PLANE_UNIT: short(2),
        WIDTH: short(5616),
        HEIGHT: short(3744),
        FOCAL: rational(24, 1),
        FOCAL_35: short(0),
    }
    facts = facts_of(tmp_path, phone(sub=sub))
    assert (facts.lens, facts.serial, facts.digital_zoom) == ("EF24-105mm f/4L IS USM", "0320502347", 1.5)
    assert facts.focal_35mm is None
    assert facts.sensor_width_mm == pytest.approx(1.459 * 25.4, abs=1e-9)


@pytest.mark.parametrize(("unit", "per_unit"), [(2, 16320 * 25.4), (3, 16320 * 10), (4, 16320), (5, 16320 / 1000)])
def test_units_of_the_focal_plane(tmp_path, unit, per_unit):
    sub = {PLANE_X: rational(round(per_unit * 1000), 24 * 1000), PLANE_UNIT: short(unit), FOCAL_35: short(0)}
    # 3264 pixels, 680 a mm
    assert facts_of(tmp_path, phone(sub=sub)).sensor_width_mm == pytest.approx(4.8, rel=1e-4)


def test_a_focal_plane_that_belies_the_35_mm_equivalent(tmp_path):
    """An editor that scaled the photo corrected its width, not the resolution of the focal plane."""
    plane = {PLANE_X: rational(680, 1), PLANE_UNIT: short(4)}
    assert facts_of(tmp_path, phone(sub=plane)).sensor_width_mm == pytest.approx(4.8)
    assert facts_of(tmp_path, phone(sub={**plane, WIDTH: long(1632), HEIGHT: long(1224)})).sensor_width_mm is None


# ---------------------------------------------------------------- when and where

TAKEN, SUB_SECOND, GPS_IFD = 0x9003, 0x9291, 0x8825


def rationals(*numbers, order="<"):
    return 5, len(numbers), b"".join(struct.pack(order + "II", *number) for number in numbers)


@pytest.mark.parametrize(
    ("date", "fraction", "taken_s"),
    [
        ("1970:01:02 00:00:01", None, 86401.0),
        ("2026:11:21 16:08:42", "25", 1795277322.25),
        ("2026:11:21 16:08:42", "007 ", 1795277322.007),
        ("2026:11:21 16:08:42", "a", 1795277322.0),
        ("0000:00:00 00:00:00", None, None),
        ("2026:13:21 16:08:42", None, None),
        ("    :  :     :  :  ", "1", None),
    ],
)
def test_time_of_capture(date, fraction, taken_s):
    sub = {TAKEN: ascii_(date), **({} if fraction is None else {SUB_SECOND: ascii_(fraction)})}
    assert facts_of_exif(phone(sub=sub)).taken_s == pytest.approx(taken_s)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("gps", "place_deg"),
    [
        (
            (b"N", [(55, 1), (42, 1), (36, 1)], b"E", [(13, 1), (11, 1), (2550, 100)]),
            (55.71, 13 + 11 / 60 + 25.5 / 3600),
        ),
        ((b"S", [(5571, 100), (0, 1), (0, 1)], b"W", [(1319, 100)]), (-55.71, -13.19)),
        ((b"N", [(0, 1)] * 3, b"E", [(0, 1)] * 3), None),
        ((b"N", [(0, 0)] * 3, b"E", [(13, 1)] * 3), None),
        ((b"N", [(91, 1)] * 3, b"E", [(13, 1)] * 3), None),
        ((b"?", [(51, 1)] * 3, b"E", [(13, 1)] * 3), None),
        ((b"N", [], b"E", [(13, 1)] * 3), None),
    ],
)
def test_place_by_gps(order, gps, place_deg):
    north, latitude, east, longitude = gps
    entries = {
        1: (2, 2, north + b"\0"), 2: rationals(*latitude, order=order),
        3: (2, 2, east + b"\0"), 4: rationals(*longitude, order=order),
    }  # fmt: skip
    place = facts_of_exif(with_gps(entries, order)).place_deg
    assert place == (None if place_deg is None else pytest.approx(place_deg, abs=1e-9))


def with_gps(entries, order):
    """A block whose second directory is that of GPS."""
    block = bytearray(exif_block({}, entries, order))
    struct.pack_into(order + "H", block, 10, GPS_IFD)
    return bytes(block)


# ---------------------------------------------------------------- damaged


@pytest.mark.parametrize(
    ("stored", "read"),
    [
        (ascii_("Apple", pad=27), "Apple"),
        (ascii_("Apple", pad=0), "Apple"),
        (ascii_("  Apple   Inc. \n\0\0\0garbage"), "Apple Inc."),
        (ascii_("", pad=32), None),
        (ascii_("        "), None),
        (ascii_("----"), None),
        (ascii_("Unknown"), None),
        (ascii_("小米"), "小米"),
        (ascii_("Größe".encode("latin-1")), "Größe"),
        (ascii_(b"\x01\x02\x7fA\x1b[2J"), "A[2J"),
        (ascii_("x" * 5000), "x" * 100),
        (short(7), None),
        (rational(1, 0), None),
        ((7, 5, b"Apple"), "Apple"),
        ((99, 5, b"Apple"), None),
    ],
    ids=lambda value: None if isinstance(value, str) else repr(value)[:40],
)
def test_texts(tmp_path, stored, read):
    facts = facts_of(tmp_path, phone(main={MAKE: stored}))
    assert facts == replace(PHONE, make=read)


def test_a_text_longer_than_the_file(tmp_path):
    """Pillow 10 gives up there, Pillow 13 goes on."""
    facts = facts_of(tmp_path, phone(main={MAKE: (2, 0xFFFFFFFF, b"Apple")}))
    assert facts.make is None
    assert facts.focal_mm in (None, 4.15)


@pytest.mark.parametrize(
    ("field", "part", "tag", "stored", "read"),
    [
        ("orientation", "main", ORIENTATION, short(0), None),
        ("orientation", "main", ORIENTATION, short(9), None),
        ("orientation", "main", ORIENTATION, long(3), 3),
        ("orientation", "main", ORIENTATION, ascii_("6"), None),
        ("orientation", "main", ORIENTATION, rational(13, 2), None),
        ("orientation", "main", ORIENTATION, (3, 2, struct.pack("<HH", 8, 1)), 8),
        ("orientation", "main", ORIENTATION, (3, 0, b""), None),
        ("focal_mm", "sub", FOCAL, rational(0, 1), None),
        ("focal_mm", "sub", FOCAL, rational(0, 0), None),
        ("focal_mm", "sub", FOCAL, rational(415, 0), None),
        ("focal_mm", "sub", FOCAL, rational(0xFFFFFFFF, 1), None),
        ("focal_mm", "sub", FOCAL, (10, 1, struct.pack("<ii", -83, 20)), None),
        ("focal_mm", "sub", FOCAL, (12, 1, struct.pack("<d", float("nan"))), None),
        ("focal_mm", "sub", FOCAL, (12, 1, struct.pack("<d", 4.25)), 4.25),
        ("focal_mm", "sub", FOCAL, ascii_("4.15 mm"), None),
        ("focal_35mm", "sub", FOCAL_35, short(0), None),
        ("focal_35mm", "sub", FOCAL_35, short(65535), None),
        ("width", "sub", WIDTH, long(0), None),
        ("width", "sub", WIDTH, long(0xFFFFFFFF), None),
        ("width", "sub", WIDTH, short(640), 640),
        ("digital_zoom", "sub", ZOOM, rational(0, 1), None),
        ("digital_zoom", "sub", ZOOM, rational(0, 0), None),
        ("digital_zoom", "sub", ZOOM, rational(1, 1), 1.0),
        ("sensor_width_mm", "sub", PLANE_X, rational(0, 1), None),
        ("sensor_width_mm", "sub", PLANE_X, rational(1, 0), None),
        ("sensor_width_mm", "sub", PLANE_X, rational(1, 1000), None),
    ],
)
def test_numbers(tmp_path, field, part, tag, stored, read):
    assert facts_of(tmp_path, phone(**{part: {tag: stored}})) == replace(PHONE, **{field: read})


def test_an_exif_directory_that_is_elsewhere(tmp_path):
    for at in (0, 8, 1, 60_000, 0xFFFFFFFF):
        block = bytearray(phone())
        place = block.index(struct.pack("<HHI", EXIF_IFD, 4, 1)) + 8
        block[place : place + 4] = struct.pack("<I", at)
        facts = facts_of(tmp_path, bytes(block))
        assert (facts.make, facts.model, facts.orientation) == ("Apple", "iPhone 6", 6)
        assert facts.focal_mm is None


def credible(facts):
    """Each fact is missing or believable."""
    bounds = {
        "focal_mm": (0.5, 3000),
        "focal_35mm": (4, 5000),
        "sensor_width_mm": (1, 100),
        "digital_zoom": (1, 100),
        "orientation": (1, 8),
        "width": (1, 10**6),
        "height": (1, 10**6),
    }
    for each in fields(facts):
        value = getattr(facts, each.name)
        if value is None:
            continue
        if each.name in bounds:
            assert bounds[each.name][0] <= value <= bounds[each.name][1]
        else:
            assert value == value.strip() != ""
            assert value.isprintable()
    label = group_of(facts, 64, 48)
    assert label.endswith("-64x48")
    assert not set(label) & set(' /\\:*?"<>|\0\n')
    assert focal_from_exif(facts, 64, 48) is None or 12 < focal_from_exif(facts, 64, 48) < 1300
    return True


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("wrap", [jpeg, bytes], ids=["jpeg", "tiff"])
def test_blocks_cut_short(tmp_path, wrap, order):
    block = phone(order)
    path = tmp_path / "a.jpg"
    for end in range(0, len(block), 3):
        path.write_bytes(wrap(block[:end]))
        facts = read_exif(path)
        for each in fields(facts):
            # a text may lose its end
            value = getattr(facts, each.name)
            assert value is None or isinstance(value, str) or value == getattr(PHONE, each.name)


@given(st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=4)), max_size=8), st.sampled_from("<>"))
def test_damaged_blocks_never_raise(tmp_path_factory, damages, order):
    block = bytearray(phone(order, sub={PLANE_X: rational(680, 1, order), PLANE_UNIT: short(4, order)}))
    for at, put in damages:
        at = at % len(block)
        block[at : at + len(put)] = put
    path = tmp_path_factory.getbasetemp() / "damaged.jpg"
    for wrap in (jpeg, bytes):
        path.write_bytes(wrap(bytes(block)))
        assert credible(read_exif(path))


@given(
    st.binary(max_size=300), st.sampled_from([b"", b"\xff\xd8\xff\xe1", b"II*\0", b"RIFF", b"\x89PNG", b"0000ftypheic"])
)
def test_files_of_noise_never_raise(tmp_path_factory, noise, start):
    path = tmp_path_factory.getbasetemp() / "noise.jpg"
    path.write_bytes(start + noise)
    assert credible(read_exif(path))


def test_what_is_no_file_has_no_facts(tmp_path):
    assert read_exif(tmp_path) == read_exif(tmp_path / "none.jpg") == ExifFacts()
    (tmp_path / "empty.jpg").write_bytes(b"")
    assert read_exif(tmp_path / "empty.jpg") == ExifFacts()


def test_a_photo_of_more_pixels_than_fit_into_memory(tmp_path):
    """Its EXIF is read all the same: whether it may be opened is not decided here."""
    data = jpeg(phone())
    at = data.index(b"\xff\xc0")
    data = data[: at + 5] + struct.pack(">HH", 60_000, 60_000) + data[at + 9 :]
    (tmp_path / "a.jpg").write_bytes(data)
    assert read_exif(tmp_path / "a.jpg") == PHONE


# ---------------------------------------------------------------- focal lengths


def test_the_focal_length_is_that_of_pycolmap(tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg(phone(), 640, 480))
    theirs = pycolmap.infer_camera_from_image(tmp_path / "a.jpg")
    ours = camera_from_exif(tmp_path / "a.jpg", 640, 480, "left-to-right")
    assert ours.K[0, 0] == ours.K[1, 1] == pytest.approx(theirs.mean_focal_length(), rel=2e-4)
    assert (ours.readout, *ours.K[:2, 2]) == ("left-to-right", 319.5, 239.5)


def test_the_focal_length_from_the_sensor():
    facts = ExifFacts(focal_mm=4.15, sensor_width_mm=4.8)
    assert focal_from_exif(facts, 3264, 2448) == pytest.approx(4.15 / 4.8 * 3264)
    assert focal_from_exif(facts, 2448, 3264) == pytest.approx(4.15 / 4.8 * 3264)
    # seen before the 35-mm equivalent, which is rounded to whole mm
    assert focal_from_exif(replace(facts, focal_35mm=29), 3264, 2448) == pytest.approx(4.15 / 4.8 * 3264)
    assert focal_from_exif(replace(facts, digital_zoom=2), 3264, 2448) == pytest.approx(2 * 4.15 / 4.8 * 3264)
    assert focal_from_exif(replace(facts, sensor_width_mm=90), 3264, 2448) is None
    assert focal_from_exif(ExifFacts(focal_mm=4.15), 3264, 2448) is None


def test_the_focal_length_of_a_model_that_pycolmap_knows(tmp_path):
    block = phone(sub={FOCAL_35: short(0)}, main={MAKE: ascii_("Canon"), MODEL: ascii_("Canon PowerShot A80")})
    (tmp_path / "a.jpg").write_bytes(jpeg(block, 640, 480))
    theirs = pycolmap.infer_camera_from_image(tmp_path / "a.jpg")
    assert theirs.has_prior_focal_length
    ours = camera_from_exif(tmp_path / "a.jpg", 640, 480)
    assert ours.K[0, 0] == pytest.approx(theirs.mean_focal_length())


@pytest.mark.parametrize("change", [{}, {MAKE: ascii_("", 8), MODEL: ascii_("", 8)}])
def test_no_focal_length_no_camera(tmp_path, change):
    block = phone(
        main={MAKE: ascii_("No one"), MODEL: ascii_("Nothing"), **change},
        sub={FOCAL: rational(0, 0), FOCAL_35: short(0)},
    )
    (tmp_path / "a.jpg").write_bytes(jpeg(block))
    assert camera_from_exif(tmp_path / "a.jpg", 64, 48) is None
    (tmp_path / "a.jpg").write_bytes(b"no photo")
    assert camera_from_exif(tmp_path / "a.jpg", 64, 48) is None


@pytest.mark.parametrize(
    ("folder", "num", "label"),
    [
        ("lund", 29, "camera-4.3mm-1024x768"),
        ("iphone6", 10, "apple-iphone-6-4.15mm-1024x768"),
    ],
)
def test_real_photos_are_one_group(folder, num, label):
    if not (PHOTOS / folder).is_dir():
        pytest.skip("needs the photos beside the project")
    names = [path for path in (PHOTOS / folder).iterdir() if path.suffix.lower() == ".jpg"]
    assert len(names) == num
    assert {group_of(read_exif(path), 1024, 768) for path in names} == {label}


# ---------------------------------------------------------------- groups


@pytest.mark.parametrize(
    ("facts", "label"),
    [
        (PHONE, "apple-iphone-6-4.15mm-640x480"),
        (ExifFacts(), "camera-640x480"),
        (ExifFacts(focal_35mm=28), "camera-28mm-of-35-640x480"),
        (ExifFacts(make="Canon", model="Canon EOS 5D", lens="EF24-105mm f/4L", focal_mm=24, serial="0 32"),
         "canon-eos-5d-ef24-105mm-f-4l-0-32-24mm-640x480"),
        (ExifFacts(make="小米", model="Größe: 12/S"), "小米-größe-12-s-640x480"),
        (replace(PHONE, digital_zoom=1.5), "apple-iphone-6-4.15mm-zoom-1.5-640x480"),
        (replace(PHONE, digital_zoom=1.0, orientation=1, width=8, height=9), "apple-iphone-6-4.15mm-640x480"),
    ],
)  # fmt: skip
def test_labels(facts, label):
    assert group_of(facts, 640, 480) == label


def test_a_zoom_that_only_the_35_mm_equivalent_tells_is_another_group():
    """Photos without one, or with one that is rounded otherwise, are of the shortest."""
    of_35 = [26, 39, 27, None, 52, 39]
    facts = [replace(PHONE, focal_35mm=each) for each in of_35]
    usual = "apple-iphone-6-4.15mm-640x480"
    zoomed = ["apple-iphone-6-4.15mm-39mm-of-35-640x480", "apple-iphone-6-4.15mm-52mm-of-35-640x480"]
    assert groups_of(facts, [(640, 480)] * 6) == [usual, zoomed[0], usual, usual, zoomed[1], zoomed[0]]


# ---------------------------------------------------------------- readouts

UPRIGHT = replace(PHONE, orientation=1)


def guess(*photos, readout="top-to-bottom"):
    facts, sizes = [photo[0] for photo in photos], [photo[1:] for photo in photos]
    groups = [group_of(*photo) for photo in photos]
    readouts, notes = guess_readouts(facts, sizes, groups, readout)
    assert readouts.keys() == set(groups)
    assert all("\n" not in note for note in notes)
    directions = [readouts[group] for group in groups]
    assert bool(notes) == any(direction != readout for direction in directions)
    return directions, notes


@pytest.mark.parametrize("facts", [UPRIGHT, ExifFacts(), replace(PHONE, orientation=None)])
def test_portraits_among_landscapes_were_rotated(facts):
    directions, notes = guess((facts, 640, 480), (facts, 480, 640), (facts, 480, 640))
    assert directions == ["top-to-bottom", "left-to-right", "left-to-right"]
    assert "2 portrait photos" in notes[0]
    # many or few
    assert guess((facts, 480, 640), (facts, 480, 640), (facts, 640, 480))[0][0] == "left-to-right"
    columns, _ = guess((facts, 640, 480), (facts, 480, 640), readout="right-to-left")
    assert columns == ["right-to-left", "top-to-bottom"]


@pytest.mark.parametrize(
    "photos",
    [
        # the tag rotates them, the pixels lie as they were read
        [(UPRIGHT, 640, 480), (PHONE, 480, 640)],
        [(UPRIGHT, 640, 480), (PHONE, 640, 480)],
        # nothing to compare with
        [(UPRIGHT, 480, 640), (UPRIGHT, 480, 640)],
        [(UPRIGHT, 640, 480)],
        [],
        # another size, another camera, another lens
        [(UPRIGHT, 640, 480), (UPRIGHT, 480, 600)],
        [(UPRIGHT, 640, 480), (replace(UPRIGHT, model="iPhone 7"), 480, 640)],
        [(UPRIGHT, 640, 480), (replace(UPRIGHT, focal_mm=2.65), 480, 640)],
        [(UPRIGHT, 480, 480), (UPRIGHT, 480, 480)],
    ],
)
def test_readouts_that_cannot_be_guessed_stay(photos):
    assert guess(*photos)[0] == ["top-to-bottom"] * len(photos)


def test_axes_of_the_handheld_scene():
    """Every photo's axis is found; the way along it does not matter."""
    value = json.loads((SCENES / "handheld" / "cameras.json").read_text())
    names = sorted(value["images"])
    truth = [value["cameras"][value["images"][name]] for name in names]
    facts = [read_exif(SCENES / "handheld" / "photos" / name) for name in names]
    directions, _ = guess(*[(fact, each["width"], each["height"]) for fact, each in zip(facts, truth, strict=True)])
    rows = {"top-to-bottom", "bottom-to-top"}
    assert [each in rows for each in directions] == [each["readout"] in rows for each in truth]
