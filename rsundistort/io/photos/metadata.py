"""A photo's EXIF, XMP and ICC: carried as they are, but for what became untrue."""

from __future__ import annotations

from dataclasses import dataclass, replace

from .exif import EXPOSURE_TAGS, Damaged, corrected_exif, exif_of_tiff, read_orientation
from .xmp import corrected_xmp, marked_xmp, rectified_by

__all__ = ["Metadata"]


@dataclass(frozen=True)
class Metadata:
    """Blocks of a photo; empty where it has none.

    Attributes
    ----------
    exif : bytes
        TIFF structure, without the head that it has in a JPEG.
    """

    exif: bytes = b""
    xmp: bytes = b""
    icc: bytes = b""

    @property
    def orientation(self) -> int:
        """The EXIF orientation, 1 to 8; 1 where there is none or one that means nothing."""
        stored = read_orientation(self.exif)
        return stored if 1 <= stored <= 8 else 1

    @property
    def rectified_by(self) -> str | None:
        """The version of rsundistort that rectified the photo; None when none did."""
        return rectified_by(self.xmp)

    def with_orientation(self, orientation: int) -> Metadata:
        """Metadata with another orientation."""
        exif, _ = corrected_exif(self.exif, orientation=orientation)
        xmp, _ = corrected_xmp(self.xmp, orientation=orientation)
        return replace(self, exif=exif, xmp=xmp)

    def without_exposure(self) -> Metadata:
        """Metadata without the time of the exposure: the lines of a simulated photo are exposed for none."""
        try:
            return replace(self, exif=exif_of_tiff(self.exif, without=EXPOSURE_TAGS))
        except Damaged:
            return self

    def marked(self, version: str) -> Metadata:
        """Metadata of the photo after that version of rsundistort rectified it."""
        return replace(self, xmp=marked_xmp(self.xmp, version))

    def fitted(self, width: int, height: int, channels: int) -> tuple[Metadata, list[str]]:
        """What is true of pixels of that size and number of channels, and what is damaged or left out."""
        exif, problems = corrected_exif(self.exif, width, height)
        xmp, more = corrected_xmp(self.xmp, width, height)
        icc = self.icc
        space = {b"GRAY": (1,), b"RGB ": (3, 4)}.get(icc[16:20], ())
        if icc and channels not in space:
            which = icc[16:20].decode("ascii", "replace").strip() or "damaged"
            more = [*more, f"the ICC profile ({which}) is not of these colours and is left out"]
            icc = b""
        described = [f"the EXIF is damaged ({'; '.join(problems)})"] if problems else []
        return Metadata(exif, xmp, icc), described + more
