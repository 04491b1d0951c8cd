"""EXIF blocks: small TIFF structures, read with suspicion and corrected in place.

A maker note holds offsets from the start of its block that only its maker knows. So a block is never serialised anew
when it can be patched, and one that has to be built (of a TIFF or RAW file) leaves the maker note where it was.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

__all__ = [
    "COLOR_SPACE",
    "EXIF_IFD",
    "EXPOSURE_TAGS",
    "GPS_IFD",
    "MAKER_NOTE",
    "ORIENTATION",
    "Damaged",
    "Entry",
    "TiffStructure",
    "corrected_exif",
    "described_entries",
    "exif_of_tiff",
    "exif_structure",
    "pack_ifd",
    "read_orientation",
]

ORIENTATION = 0x0112
EXIF_IFD, GPS_IFD, INTEROP_IFD = 0x8769, 0x8825, 0xA005
MAKER_NOTE, COLOR_SPACE = 0x927C, 0xA001
_WIDTH, _LENGTH, _PIXELS_X, _PIXELS_Y = 0x0100, 0x0101, 0xA002, 0xA003
_THUMBNAIL_AT, _THUMBNAIL_LENGTH = 0x0201, 0x0202

#: Tags of IFD0 that describe the photo rather than the layout of the file that it came in.
_DESCRIBING = frozenset(
    [
        *(0x000B, 0x010D, 0x010E, 0x010F, 0x0110, ORIENTATION, 0x011A, 0x011B, 0x0128, 0x0131, 0x0132, 0x013B, 0x013C),
        *(0x4746, 0x4749, 0x8298, 0x83BB, EXIF_IFD, GPS_IFD, 0x9003, 0x9004, 0x9C9B, 0x9C9C, 0x9C9D, 0x9C9E, 0x9C9F),
        *(0xC614, 0xC62F, 0xC630),  # model, serial number and lens of a DNG
    ]
)

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_ASCII, _SHORT, _LONG, _UNDEFINED, _LAST_CLASSIC = 2, 3, 4, 7, 13
_FORMS = {1: "B", 3: "H", 4: "I", 5: "II", 6: "b", 8: "h", 9: "i", 10: "ii", 11: "f", 12: "d", 13: "I", 16: "Q"}
# a block fits into one JPEG segment
_MOST_IN_JPEG = 65000


class Damaged(ValueError):
    """A structure is not what it should be."""


@dataclass(frozen=True)
class Entry:
    """A tag of an IFD: its type, how many values, where it stands and where its values are."""

    tag: int
    kind: int
    count: int
    at: int
    value_at: int
    size: int


class TiffStructure:
    """What a TIFF-structured file or EXIF block says of itself; nothing outside it is ever read.

    Attributes
    ----------
    order : str
        "<" or ">".
    first : int
        Where IFD0 is.
    problems : list of str
        What was found damaged on the way; the rest was read.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.problems: list[str] = []
        self.order = {b"II": "<", b"MM": ">"}.get(bytes(data[:2]), "")
        if not self.order or len(data) < 8:
            raise Damaged("no TIFF header")
        # BigTIFF has longer offsets; RAW files have magic numbers of their own
        self.is_big = self._unpack("H", 2) == 43
        self.first = self._unpack("Q", 8) if self.is_big else self._unpack("I", 4)
        self.reach = 0  # end of the farthest byte that an entry read so far uses
        self._seen: set[int] = set()

    def _unpack(self, form: str, at: int) -> int:
        try:
            return int(struct.unpack_from(self.order + form, self.data, at)[0])
        except struct.error:
            raise Damaged("an offset points beyond the end") from None

    def ifd(self, at: int, name: str) -> tuple[list[Entry], int, int]:
        """Whole entries of the IFD at an offset; where its link to the next stands and leads, 0 for nowhere."""
        if at in self._seen:
            self.problems.append(f"{name} is part of a circle")
            return [], 0, 0
        self._seen.add(at)
        head, step, inline, form = (8, 20, 8, "Q") if self.is_big else (2, 12, 4, "I")
        try:
            count = self._unpack("Q" if self.is_big else "H", at)
        except Damaged:
            self.problems.append(f"{name} lies beyond the end")
            return [], 0, 0
        entries: list[Entry] = []
        whole = min(count, max(0, len(self.data) - at - head) // step)
        for k in range(whole):
            place = at + head + k * step
            tag, kind = self._unpack("H", place), self._unpack("H", place + 2)
            number = self._unpack(form, place + 4)
            size = _SIZES.get(kind, 0) * number
            value_at = place + step - inline
            if size > inline:
                value_at = self._unpack(form, value_at)
            if kind not in _SIZES or value_at + size > len(self.data):
                self.problems.append(f"tag 0x{tag:04X} of {name} is damaged")
                continue
            entries.append(Entry(tag, kind, number, place, value_at, size))
            self.reach = max(self.reach, place + step, value_at + size)
        link = at + head + count * step
        if whole < count or link + inline > len(self.data):
            # many writers forget the link after the last IFD
            if whole < count:
                self.problems.append(f"{name} is cut short")
            return entries, 0, 0
        return entries, link, self._unpack(form, link)

    def value(self, entry: Entry) -> bytes:
        """The bytes of an entry's values, in the file's byte order."""
        return bytes(self.data[entry.value_at : entry.value_at + entry.size])

    def first_value(self, entry: Entry) -> bytes | float | None:
        """A text whole, of numbers and fractions the first; None of other types and of fractions over nothing."""
        if entry.kind in (_ASCII, _UNDEFINED):
            return self.value(entry)
        form = _FORMS.get(entry.kind)
        if form is None or entry.count < 1:
            return None
        number = struct.unpack_from(self.order + form, self.data, entry.value_at)
        if len(number) == 1:
            return float(number[0])
        return number[0] / number[1] if number[1] else None

    def number(self, entry: Entry) -> int | None:
        """The first value of an entry of whole numbers."""
        form = {1: "B", _SHORT: "H", _LONG: "I", 13: "I", 16: "Q", 18: "Q"}.get(entry.kind)
        return None if form is None or entry.count < 1 else self._unpack(form, entry.value_at)

    def numbers(self, entry: Entry) -> tuple[int, ...]:
        """All values of an entry of whole numbers."""
        form = {1: "B", _SHORT: "H", _LONG: "I", 16: "Q"}[entry.kind]
        return struct.unpack_from(f"{self.order}{entry.count}{form}", self.data, entry.value_at)

    def fractions(self, entry: Entry) -> tuple[float, ...]:
        """All values of an entry of fractions; none if it is of another type, or if one is over nothing."""
        if entry.kind not in (5, 10):
            return ()
        numbers = struct.unpack_from(f"{self.order}{_FORMS[entry.kind] * entry.count}", self.data, entry.value_at)
        pairs = list(zip(numbers[::2], numbers[1::2], strict=True))
        return tuple(a / b for a, b in pairs) if all(b for _, b in pairs) else ()

    def main(self) -> tuple[dict[int, Entry], int, int]:
        """The entries of IFD0 by tag; its link to the next IFD and where that leads."""
        entries, link, following = self.ifd(self.first, "IFD0")
        return {entry.tag: entry for entry in reversed(entries)}, link, following

    def sub(self, entries: dict[int, Entry], pointer: int, name: str) -> dict[int, Entry]:
        """The entries by tag of the IFD that a tag points to; none where there is none."""
        at = self.number(entries[pointer]) if pointer in entries else None
        return {} if not at else {entry.tag: entry for entry in reversed(self.ifd(at, name)[0])}


def exif_structure(block: bytes) -> TiffStructure:
    """An EXIF block, which has the short offsets of a classic TIFF."""
    structure = TiffStructure(block)
    if structure.is_big:
        raise Damaged("its header is that of a BigTIFF")
    return structure


def read_orientation(block: bytes) -> int:
    """The EXIF orientation of a block as it stands there, 1 without one; may be none of 1 to 8."""
    try:
        structure = TiffStructure(block)
        entry = structure.main()[0].get(ORIENTATION)
    except Damaged:
        return 1
    value = None if entry is None else structure.number(entry)
    return 1 if value is None else value


def pack_ifd(order: str, entries: Sequence[tuple[int, int, int, bytes | int]], at: int, following: int = 0) -> bytes:
    """An IFD to be put at an offset, with the values that do not fit into its entries behind it.

    Parameters
    ----------
    order : str
        "<" or ">".
    entries : sequence of (tag, type, count, value)
        A value is bytes in that byte order, or the offset where they are in the file already.
    at, following : int
        Where the IFD will stand (even), and where the next one is.
    """
    behind = at + 2 + 12 * len(entries) + 4
    head, tail = struct.pack(order + "H", len(entries)), b""
    for tag, kind, count, value in sorted(entries, key=lambda entry: entry[0]):
        if isinstance(value, int):
            field = struct.pack(order + "I", value)
        elif len(value) <= 4:
            field = value.ljust(4, b"\0")
        else:
            field = struct.pack(order + "I", behind + len(tail))
            tail += value + b"\0" * (len(value) % 2)
        head += struct.pack(order + "HHI", tag, kind, count) + field
    return head + struct.pack(order + "I", following) + tail


def described_entries(structure: TiffStructure) -> Iterator[tuple[int, int, int, bytes | int]]:
    """Those entries of IFD0 that describe the photo, as `pack_ifd` takes them for the same file."""
    for tag, entry in structure.main()[0].items():
        if tag in _DESCRIBING:
            yield tag, entry.kind, entry.count, structure.value(entry) if entry.size <= 4 else entry.value_at


def corrected_exif(
    block: bytes, width: int | None = None, height: int | None = None, orientation: int | None = None
) -> tuple[bytes, list[str]]:
    """A block whose size and orientation are true, without the thumbnail; all else stays byte for byte where it was.

    Parameters
    ----------
    block : bytes
        A TIFF structure; empty for none.
    width, height : int, optional
        Size of the pixels: replaces what the block says of it, if it does. The thumbnail is cut off with it.
    orientation : int, optional
        Put in place of the block's; added if it has none, unless it is 1.

    Returns
    -------
    block : bytes
        As far as it could be corrected.
    problems : list of str
        What is damaged.
    """
    if not block:
        if orientation in (None, 1):
            return b"", []
        block = b"II*\0\x08\0\0\0" + bytes(6)
    data = bytearray(block)
    try:
        structure = exif_structure(block)
        order = structure.order
        entries, link, following = structure.main()

        def put(entry: Entry, value: int) -> None:
            if entry.count != 1 or structure.number(entry) != value:
                kind, form, values = (_SHORT, "HH", (value, 0)) if value < 65536 else (_LONG, "I", (value,))
                struct.pack_into(f"{order}HHI{form}", data, entry.at, entry.tag, kind, 1, *values)

        if width is not None and height is not None:
            exif = structure.sub(entries, EXIF_IFD, "the Exif IFD")
            for ifd, tag, value in (
                (entries, _WIDTH, width), (entries, _LENGTH, height),
                (exif, _PIXELS_X, width), (exif, _PIXELS_Y, height),
            ):  # fmt: skip
                if tag in ifd:
                    put(ifd[tag], value)
            structure.sub(exif, INTEROP_IFD, "the interoperability IFD")
            structure.sub(entries, GPS_IFD, "the GPS IFD")
            if following:
                _cut_thumbnail(data, structure, link, following)
        if orientation is not None and ORIENTATION in entries:
            put(entries[ORIENTATION], orientation)
        elif orientation not in (None, 1):
            _add_orientation(data, structure, entries, link, orientation)
        return bytes(data), structure.problems
    except Damaged as error:
        return bytes(data), [str(error)]


def _add_orientation(
    data: bytearray, structure: TiffStructure, entries: dict[int, Entry], link: int, orientation: int
) -> None:
    """Put a longer IFD0 at the end of the block; the values of its entries stay where they are."""
    order = structure.order
    data += bytes(len(data) % 2)
    every: list[tuple[int, int, int, bytes | int]] = [
        (e.tag, e.kind, e.count, e.value_at if e.size > 4 else structure.value(e)) for e in entries.values()
    ]
    every.append((ORIENTATION, _SHORT, 1, struct.pack(order + "H", orientation)))
    following = struct.unpack_from(order + "I", data, link)[0] if link else 0
    struct.pack_into(order + "I", data, 4, len(data))
    data += pack_ifd(order, every, len(data), following)


def _cut_thumbnail(data: bytearray, structure: TiffStructure, link: int, thumbnail_ifd: int) -> None:
    """Unlink IFD1, and take off the end of the block what only the thumbnail needed."""
    data[link : link + 4] = bytes(4)
    others = structure.reach
    entries = {entry.tag: entry for entry in structure.ifd(thumbnail_ifd, "IFD1")[0]}
    if _THUMBNAIL_AT in entries and _THUMBNAIL_LENGTH in entries:
        at, length = structure.number(entries[_THUMBNAIL_AT]), structure.number(entries[_THUMBNAIL_LENGTH])
        # some cameras pad the block behind it
        if at and length and at >= others and data[at : at + 2] == b"\xff\xd8" and not any(data[at + length :]):
            del data[at:]


#: How long the shutter was open, twice.
EXPOSURE_TAGS = frozenset((0x829A, 0x9201))


def exif_of_tiff(data: bytes, without: frozenset[int] = frozenset()) -> bytes:
    """An EXIF block of what a TIFF-structured file (TIFF, DNG, most RAW, an EXIF block) says of the photo.

    Parameters
    ----------
    without : frozenset of int
        Tags of the Exif IFD to leave out.

    Returns
    -------
    bytes
        Describing tags of IFD0, the Exif, GPS and interoperability IFDs; the maker note at its old offset where that
        lies in the first 64 kB. Empty when there is nothing to say.

    Raises
    ------
    Damaged
        When the file is not TIFF-structured.
    """
    structure = TiffStructure(data)
    entries, _, _ = structure.main()
    exif = structure.sub(entries, EXIF_IFD, "the Exif IFD")
    gps = structure.sub(entries, GPS_IFD, "the GPS IFD")
    interop = structure.sub(exif, INTEROP_IFD, "the interoperability IFD")
    left_out = {EXIF_IFD, GPS_IFD, INTEROP_IFD, *without}
    note = None if MAKER_NOTE in without else exif.get(MAKER_NOTE)

    def values(ifd: dict[int, Entry]) -> list[tuple[int, int, int, bytes | int]]:
        return [
            (entry.tag, entry.kind, entry.count, structure.value(entry))
            for entry in ifd.values()
            if entry.tag not in left_out and entry is not note and entry.kind <= _LAST_CLASSIC
        ]

    main = [entry for entry in values(entries) if entry[0] in _DESCRIBING]
    if not (main or exif or gps):
        return b""
    order = structure.order
    block = bytearray((b"II*\0" if order == "<" else b"MM\0*") + bytes(4))
    note_at = 0
    if note is not None and note.size > 4 and len(block) <= note.value_at <= _MOST_IN_JPEG - note.size:
        note_at = note.value_at

    def append(piece_of: Sequence[tuple[int, int, int, bytes | int]]) -> int:
        size = len(pack_ifd(order, piece_of, 0))
        at = len(block)
        if note is not None and at < note_at + note.size and at + size > note_at > 0:
            # around the maker note, which stays
            at = note_at + note.size + (note_at + note.size) % 2
        block.extend(bytes(at - len(block)))
        block.extend(pack_ifd(order, piece_of, at))
        return at

    def pointer(tag: int, at: int) -> tuple[int, int, int, bytes | int]:
        return tag, _LONG, 1, struct.pack(order + "I", at)

    sub = values(exif)
    if interop:
        sub.append(pointer(INTEROP_IFD, append(values(interop))))
    if note is not None:
        sub.append((MAKER_NOTE, note.kind, note.count, note_at or structure.value(note)))
    if sub:
        main.append(pointer(EXIF_IFD, append(sub)))
    if gps:
        main.append(pointer(GPS_IFD, append(values(gps))))
    at = append(main)
    block[4:8] = struct.pack(order + "I", at)
    if note is not None and note_at:
        block.extend(bytes(max(0, note_at + note.size - len(block))))
        block[note_at : note_at + note.size] = structure.value(note)
    return bytes(block)
