"""Photos for the tests: textures, EXIF, and the courtyard at half its size."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

COURTYARD = Path(__file__).parent.parent / "sample_scenes" / "courtyard"
COURTYARD_NAMES = [f"{k:04}.png" for k in range(1, 7)]


# noise hardly shrinks, however long the encoder tries
_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def texture(width: int, height: int, seed: int = 0, channels: int = 3) -> np.ndarray:
    """Smooth noise, 8 bit: (h, w) for one channel, else (h, w, channels)."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    stretched = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)
    return stretched[..., 0] if channels == 1 and stretched.ndim == 3 else stretched


def save_png(path: Path, pixels: np.ndarray) -> None:
    path.write_bytes(bytes(cv2.imencode(".png", pixels, _FAST)[1]))


def save_textures(folder: Path, names: list[str], width: int = 320, height: int = 240) -> Path:
    """A folder of photos that have nothing in common."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        (folder / name).write_bytes(bytes(cv2.imencode(Path(name).suffix, texture(width, height, seed), _FAST)[1]))
    return folder


def exif_block(orientation: int, focal_35mm: int | None = None) -> np.ndarray:
    """A little-endian TIFF header with the orientation, and the focal length of a 35 mm equivalent."""
    short = 3
    if focal_35mm is None:
        ifd = struct.pack("<HHHIHHI", 1, 0x0112, short, 1, orientation, 0, 0)
        return np.frombuffer(b"II*\0" + struct.pack("<I", 8) + ifd, np.uint8)
    exif_at = 8 + 2 + 2 * 12 + 4
    ifd = struct.pack("<H", 2)
    ifd += struct.pack("<HHIHH", 0x0112, short, 1, orientation, 0)
    ifd += struct.pack("<HHII", 0x8769, 4, 1, exif_at) + struct.pack("<I", 0)
    sub = struct.pack("<HHHIHHI", 1, 0xA405, short, 1, focal_35mm, 0, 0)
    return np.frombuffer(b"II*\0" + struct.pack("<I", 8) + ifd + sub, np.uint8)


def half_camera(camera: dict) -> dict:
    """The camera of photos shrunk to half their size; pixel centres are whole numbers."""
    K = np.array(camera["K"])
    K[:2, 2] = (K[:2, 2] + 0.5) / 2 - 0.5
    K[[0, 1], [0, 1]] /= 2
    return {**camera, "width": camera["width"] // 2, "height": camera["height"] // 2, "K": K.tolist()}


def half_courtyard(folder: Path, names: list[str] | None = None) -> Path:
    """Photos (PNG), camera and truth of the courtyard at half its size; returns the photos' folder."""
    names = COURTYARD_NAMES if names is None else names
    photos = folder / "photos"
    photos.mkdir(parents=True)
    for name in names:
        full = cv2.imread(str(COURTYARD / "photos" / name.replace(".png", ".jpg")), cv2.IMREAD_COLOR)
        height, width = full.shape[:2]
        save_png(photos / name, cv2.resize(full, (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    camera = half_camera(json.loads((COURTYARD / "camera.json").read_text()))
    (folder / "camera.json").write_text(json.dumps(camera))
    # phi is per unit of the clock, which does not know the size
    truth = json.loads((COURTYARD / "ground_truth.json").read_text())
    truth["cameras"] = {key: half_camera(value) for key, value in truth["cameras"].items()}
    truth["rectified_cameras"] = {key: half_camera(v) for key, v in truth["rectified_cameras"].items()}
    for image in truth["images"]:
        image["name"] = image["name"].replace(".jpg", ".png")
    truth["images"] = [image for image in truth["images"] if image["name"] in names]
    (folder / "ground_truth.json").write_text(json.dumps(truth))
    return photos


# What a camera's EXIF says beside its sizes: IFD0, the Exif IFD and the GPS IFD, as (tag, type, values).
_ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED = 2, 3, 4, 5, 7
MAKER_NOTE = b"Maker\0\1" + bytes(range(120)) + b"END"
THUMBNAIL = bytes(cv2.imencode(".jpg", np.full((12, 16, 3), 90, np.uint8))[1])


def camera_exif(order: str, orientation: int = 6, width: int = 64, height: int = 48, thumbnail: bool = True) -> bytes:
    """A block as a camera writes it: strings, rationals, maker note, GPS, a thumbnail; in a byte order, < or >."""
    ifd0 = [
        (0x0100, _LONG, [width]),
        (0x0101, _SHORT, [height]),
        (0x010F, _ASCII, b"A Maker\0\0\0"),  # NULs behind the string, as some pad
        (0x0110, _ASCII, b"Model 7\0"),
        (0x0112, _SHORT, [orientation]),
        (0x011A, _RATIONAL, [72, 1]),
        (0x0131, _ASCII, b"their own software\0"),
        (0x8769, _LONG, "exif"),
        (0x8825, _LONG, "gps"),
    ]
    exif = [
        (0x829A, _RATIONAL, [1, 250]),
        (0x9003, _ASCII, b"2024:05:06 07:08:09\0"),
        (0x920A, _RATIONAL, [43, 10]),
        (0x927C, _UNDEFINED, MAKER_NOTE),
        (0x9286, _UNDEFINED, b"ASCII\0\0\0a comment"),
        (0xA001, _SHORT, [1]),
        (0xA002, _SHORT, [width]),
        (0xA003, _LONG, [height]),
        (0xA405, _SHORT, [35]),
    ]
    gps = [
        (0x0000, 1, bytes([2, 3, 0, 0])),
        (0x0001, _ASCII, b"N\0"),
        (0x0002, _RATIONAL, [55, 1, 41, 1, 267, 5]),
    ]
    ifd1 = [(0x0103, _SHORT, [6]), (0x0201, _LONG, "thumbnail"), (0x0202, _LONG, [len(THUMBNAIL)])]
    blocks = {"ifd0": ifd0, "exif": exif, "gps": gps, **({"ifd1": ifd1} if thumbnail else {})}
    forms = {_SHORT: "H", _LONG: "I", _RATIONAL: "I"}

    def size(entries):
        # at most 4 bytes fit into an entry
        values = [
            len(v) if isinstance(v, bytes) else 4 * (t != _SHORT) * len(v)
            for _, t, v in entries
            if not isinstance(v, str)
        ]
        return 2 + 12 * len(entries) + 4 + sum(n + n % 2 for n in values if n > 4)

    starts, at = {}, 8
    for name, entries in blocks.items():
        starts[name] = at
        at += size(entries)
    starts["thumbnail"] = at
    out = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    for name, entries in blocks.items():
        head, tail = struct.pack(order + "H", len(entries)), b""
        behind = starts[name] + 2 + 12 * len(entries) + 4
        for tag, kind, values in entries:
            if isinstance(values, str):
                values = [starts[values]]
            raw = values if isinstance(values, bytes) else struct.pack(f"{order}{len(values)}{forms[kind]}", *values)
            count = len(values) // 2 if kind == _RATIONAL else len(values)
            field = raw.ljust(4, b"\0") if len(raw) <= 4 else struct.pack(order + "I", behind + len(tail))
            tail += b"" if len(raw) <= 4 else raw + bytes(len(raw) % 2)
            head += struct.pack(order + "HHI", tag, kind, count) + field
        following = starts["ifd1"] if name == "ifd0" and thumbnail else 0
        out += head + struct.pack(order + "I", following) + tail
    return out + (THUMBNAIL if thumbnail else b"")


def tagged_jpeg(pixels: np.ndarray, segments: list[tuple[int, bytes]], quality: int = 95) -> bytes:
    """A JPEG with segments (marker, content) behind its start."""
    data = bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
    block = b"".join(struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content for marker, content in segments)
    return data[:2] + block + data[2:]


def small_dng(orientation: int = 1, width: int = 64, height: int = 48) -> bytes:
    """A Bayer DNG of a smooth slope, with a maker note and an Exif IFD."""
    base = camera_exif("<", orientation, width, height, thumbnail=False)
    y, x = np.mgrid[:height, :width]
    mosaic = (20000 + 200 * x + 300 * y).astype("<u2").tobytes()
    strip_at = len(base) + len(base) % 2
    ifd_at = strip_at + len(mosaic)
    count = struct.unpack_from("<H", base, 8)[0]
    kept = [struct.unpack_from("<HHI4s", base, 10 + 12 * k) for k in range(count)]
    wide = b"".join(struct.pack("<ii", int(v), 1) for v in np.eye(3).ravel())
    neutral = struct.pack("<6I", *[1, 1] * 3)
    tail_at = ifd_at + 2 + 12 * (len(kept) + 15) + 4
    shorts = {0x0102: 16, 0x0103: 1, 0x0106: 32803, 0x0115: 1, 0xC65A: 21}
    entries = kept + [(tag, 3, 1, struct.pack("<HH", value, 0)) for tag, value in shorts.items()]
    longs = {0x00FE: 0, 0x0111: strip_at, 0x0116: height, 0x0117: len(mosaic), 0xC61D: 65535}
    entries += [(tag, 4, 1, struct.pack("<I", value)) for tag, value in longs.items()]
    entries += [(0x828D, 3, 2, struct.pack("<HH", 2, 2)), (0x828E, 1, 4, bytes([0, 1, 1, 2]))]
    entries += [(0xC612, 1, 4, bytes([1, 4, 0, 0])), (0xC621, 10, 9, struct.pack("<I", tail_at))]
    entries += [(0xC628, 5, 3, struct.pack("<I", tail_at + len(wide)))]
    ifd = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHI4s", *e) for e in sorted(entries))
    data = base[:4] + struct.pack("<I", ifd_at) + base[8:]
    return data.ljust(strip_at, b"\0") + mosaic + ifd + bytes(4) + wide + neutral
