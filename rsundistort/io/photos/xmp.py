"""XMP packets: what became untrue is corrected in the text itself, so that all else stays byte for byte.

XMP is RDF in XML; a property of a namespace is an attribute or an element of the prefix that the packet declares.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from xml.parsers import expat

__all__ = ["corrected_xmp", "marked_xmp", "rectified_by", "xmp_values"]

_TIFF, _EXIF = "http://ns.adobe.com/tiff/1.0/", "http://ns.adobe.com/exif/1.0/"
_OURS = "urn:rsundistort:1.0/"
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"

# What describes other pictures that came in the same file: depth maps, gain maps, motion photos, thumbnails.
_COMPANIONS = (
    "http://ns.google.com/photos/1.0/panorama/",
    "http://ns.google.com/photos/1.0/depthmap/",
    "http://ns.google.com/photos/1.0/image/",
    "http://ns.google.com/photos/1.0/audio/",
    "http://ns.google.com/photos/1.0/camera/",
    "http://ns.google.com/photos/1.0/container/",
    "http://ns.google.com/photos/1.0/container/item/",
    "http://ns.google.com/photos/dd/1.0/device/",
    "http://ns.adobe.com/hdr-gain-map/1.0/",
    "http://ns.apple.com/HDRGainMap/1.0/",
    "http://ns.apple.com/pixeldatainfo/1.0/",
    "http://ns.adobe.com/xmp/note/",
)
# What describes the lens and the shutter of a photo that is rectified: both are gone.
_CORRECTED = {
    "http://pix4d.com/camera/1.0": "PerspectiveDistortion|Fisheye(?:Polynomial|Affine\\w+)|RollingShutterReadoutTime",
    "http://www.dji.com/drone-dji/1.0/": "DewarpData",
}


# More declarations than any program writes; each is a name to look for in the whole packet.
_MOST_PREFIXES = 1000


def _is_well_formed(packet: bytes) -> bool:
    """Whether a packet may be searched: tags that are never closed take the square of its length."""
    # nobody's packet declares entities, other than to do harm
    if b"<!DOCTYPE" in packet or b"<!ENTITY" in packet or packet.count(b"xmlns:") > _MOST_PREFIXES:
        return False
    try:
        # what stands before or behind the packet is padding
        expat.ParserCreate(namespace_separator=" ").Parse(packet.strip(b"\0 \t\r\n"), True)
    except expat.ExpatError:
        return False
    return True


def _prefixes(packet: bytes, namespace: str) -> list[bytes]:
    pattern = rb"xmlns:([\w.-]+)\s*=\s*[\"']" + re.escape(namespace.rstrip("/").encode()) + rb"/?[\"']"
    return sorted({re.escape(prefix) for prefix in re.findall(pattern, packet)})


def _attribute(prefix: bytes, name: bytes) -> re.Pattern[bytes]:
    return re.compile(rb"(\s" + prefix + rb":(?:" + name + rb")\s*=\s*)(\"[^\"<]*\"|'[^'<]*')")


def _element(prefix: bytes, name: bytes) -> re.Pattern[bytes]:
    tag = prefix + rb":(?P<name>" + name + rb")(?![\w.-])"
    return re.compile(rb"(<" + tag + rb"(?:\s[^<>]*)?(?<!/)>)(.*?)(</" + prefix + rb":(?P=name)\s*>)", re.DOTALL)


def _get(packet: bytes, namespace: str, name: str) -> str | None:
    for prefix in _prefixes(packet, namespace):
        found = _attribute(prefix, name.encode()).search(packet)
        if found:
            return found[2][1:-1].decode(errors="replace")
        found = _element(prefix, name.encode()).search(packet)
        if found:
            return found[3].decode(errors="replace").strip()
    return None


def _set(packet: bytes, namespace: str, name: str, value: str) -> bytes:
    """Replace a simple property wherever it stands."""
    for prefix in _prefixes(packet, namespace):
        packet = _attribute(prefix, name.encode()).sub(rb'\g<1>"' + value.encode() + rb'"', packet)
        packet = _element(prefix, name.encode()).sub(rb"\g<1>" + value.encode() + rb"\g<4>", packet)
    return packet


def _drop(packet: bytes, namespace: str, name: str = r"[\w.-]+") -> bytes:
    """Leave a property out, or all of a namespace."""
    for prefix in _prefixes(packet, namespace):
        packet = _element(prefix, name.encode()).sub(b"", packet)
        packet = re.sub(rb"<" + prefix + rb":(?:" + name.encode() + rb")(?:\s[^<>]*)?/>", b"", packet)
        packet = _attribute(prefix, name.encode()).sub(b"", packet)
    return packet


def corrected_xmp(
    packet: bytes, width: int | None = None, height: int | None = None, orientation: int | None = None
) -> tuple[bytes, list[str]]:
    """A packet whose size and orientation, where it names them, are true, without what describes pictures left behind.

    Returns
    -------
    packet : bytes
        Corrected; as it was when it is damaged.
    problems : list of str
        What is damaged.
    """
    if not packet:
        return packet, []
    if not _is_well_formed(packet):
        return packet, ["the XMP is no well-formed XML"]
    new = packet
    if width is not None and height is not None:
        for namespace, across, down in (
            (_EXIF, "PixelXDimension", "PixelYDimension"), (_TIFF, "ImageWidth", "ImageLength"),
        ):  # fmt: skip
            new = _set(_set(new, namespace, across, str(width)), namespace, down, str(height))
        for namespace in _COMPANIONS:
            new = _drop(new, namespace)
        new = _drop(new, "http://ns.adobe.com/xap/1.0/", "Thumbnails")
    if orientation is not None:
        new = _set(new, _TIFF, "Orientation", str(orientation))
    return (new, []) if _is_well_formed(new) else (packet, ["the XMP could not be corrected"])


def xmp_values(packet: bytes, wanted: Iterable[tuple[str, Sequence[str]]]) -> dict[str, str]:
    """Simple properties of a packet by name, of the first namespace that has each; none of one that is damaged."""
    if not packet or not _is_well_formed(packet):
        return {}
    found: dict[str, str] = {}
    for namespace, names in wanted:
        if namespace.rstrip("/").encode() in packet:
            for name in names:
                value = None if name in found else _get(packet, namespace, name)
                if value is not None:
                    found[name] = value
    return found


def rectified_by(packet: bytes) -> str | None:
    """The version of rsundistort that rectified a photo, by its packet; None when none did."""
    return _get(packet, _OURS, "RectifiedBy") if _OURS.encode() in packet and _is_well_formed(packet) else None


def marked_xmp(packet: bytes, version: str) -> bytes:
    """A packet that says that the photo is rectified, and no longer what lens and shutter did to it.

    A damaged packet gives way to a new one.
    """
    if not _is_well_formed(packet):
        packet = b""
    for namespace, names in _CORRECTED.items():
        packet = _drop(packet, namespace, names)
    if rectified_by(packet) is not None:
        return _set(packet, _OURS, "RectifiedBy", version)
    rdf = (_prefixes(packet, _RDF) or [b"rdf"])[0]
    about = re.search(rb"\s" + rdf + rb":about\s*=\s*\"([^\"<]*)\"", packet)
    end = packet.rfind(b"</" + rdf + b":RDF")
    if end >= 0:
        marked = packet[:end] + _mark(rdf, about[1] if about else b"", version) + packet[end:]
        if _is_well_formed(marked):
            return marked
    return (
        b'<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        b'<rdf:RDF xmlns:rdf="%s">%s</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
        % (_RDF.encode(), _mark(b"rdf", b"", version))
    )


def _mark(rdf: bytes, about: bytes, version: str) -> bytes:
    return b'<%s:Description %s:about="%s" xmlns:rsundistort="%s" rsundistort:RectifiedBy="%s"/>' % (
        rdf, rdf, about, _OURS.encode(), version.encode(),
    )  # fmt: skip
