"""Boxes of ISO base media files (HEIC, CR3): the properties of the primary picture."""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["boxes", "primary_properties"]


def boxes(data: bytes, start: int = 0, end: int | None = None) -> Iterator[tuple[bytes, int, int]]:
    """Name, start and end of the content of each box; stops where they are damaged."""
    at, end = start, len(data) if end is None else end
    while at + 8 <= end:
        size, head = int.from_bytes(data[at : at + 4], "big"), 8
        if size == 1:
            size, head = int.from_bytes(data[at + 8 : at + 16], "big"), 16
        elif size == 0:  # to the end
            size = end - at
        if size < head or at + size > end:
            return
        yield data[at + 4 : at + 8], at + head, at + size
        at += size


def _find(data: bytes, path: tuple[bytes, ...], start: int = 0, end: int | None = None) -> tuple[int, int] | None:
    for name, first, last in boxes(data, start, end):
        if name == path[0]:
            return (first, last) if len(path) == 1 else _find(data, path[1:], first, last)
    return None


def primary_properties(data: bytes) -> list[tuple[bytes, bytes]]:
    """Name and content of the primary picture's properties, in the order in which they apply; empty when damaged."""
    meta = _find(data, (b"meta",))
    if meta is None:
        return []
    inside = (meta[0] + 4, meta[1])  # after version and flags
    primary, store, links = (
        _find(data, path, *inside) for path in ((b"pitm",), (b"iprp", b"ipco"), (b"iprp", b"ipma"))
    )
    if primary is None or store is None or links is None:
        return []
    properties = [(name, data[first:last]) for name, first, last in boxes(data, *store)]
    length = 2 if data[primary[0]] == 0 else 4
    item = int.from_bytes(data[primary[0] + 4 : primary[0] + 4 + length], "big")
    return [properties[k - 1] for k in _links(data[links[0] : links[1]], item) if 0 < k <= len(properties)]


def _links(content: bytes, wanted: int) -> list[int]:
    """Numbers of the properties that an `ipma` box gives to an item."""
    id_bytes = 2 if content[:1] == b"\0" else 4
    wide = bool(content[3:4] and content[3] & 1)
    at = 8
    for _ in range(int.from_bytes(content[4:8], "big")):
        if at >= len(content):
            break
        item, at = int.from_bytes(content[at : at + id_bytes], "big"), at + id_bytes
        count, at = int.from_bytes(content[at : at + 1], "big"), at + 1
        step = 2 if wide else 1
        if at + count * step > len(content):
            return []
        # the top bit says whether a reader must understand the property
        numbers = [int.from_bytes(content[at + k * step : at + (k + 1) * step], "big") for k in range(count)]
        at += count * step
        if item == wanted:
            return [number & (0x7FFF if wide else 0x7F) for number in numbers]
    return []
