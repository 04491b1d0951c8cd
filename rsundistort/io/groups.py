"""Which photos one camera took in one mode, and which of them were turned after readout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..model import READOUTS
from .exif_facts import ExifFacts

__all__ = ["CameraGroup", "group_of", "group_photos", "guess_readouts"]


def group_of(facts: ExifFacts, width: int, height: int) -> str:
    """A label of the physical camera and its mode: alike for two photos that can share their intrinsics.

    Examples
    --------
    >>> facts = ExifFacts(make="Apple", model="iPhone 6", focal_mm=4.15)
    >>> group_of(facts, 3264, 2448)
    'apple-iphone-6-4.15mm-3264x2448'
    >>> group_of(ExifFacts(), 3264, 2448)
    'camera-3264x2448'
    """
    return f"{_body(facts)}-{width}x{height}"


def _body(facts: ExifFacts) -> str:
    """The label without the size."""
    make, model = facts.make or "", facts.model or ""
    if model.lower().startswith(make.lower()):  # "Canon", "Canon EOS 5D"
        make = ""
    # a phone's lens names the phone again, and one lens has several such names
    lens = "" if facts.lens is None or (model and model.lower() in facts.lens.lower()) else facts.lens
    words = [make, model, lens, facts.serial or ""]
    if not any(words[:2]):
        words[0] = "camera"
    if facts.focal_mm or facts.focal_35mm:
        words.append(f"{facts.focal_mm:.4g}mm" if facts.focal_mm else f"{facts.focal_35mm:.4g}mm-of-35")
    if facts.digital_zoom and facts.digital_zoom > 1:
        words.append(f"zoom-{facts.digital_zoom:.3g}")
    text = "".join(c if c.isalnum() or c == "." else " " for c in " ".join(words).lower())
    return "-".join(text.split())


@dataclass(frozen=True)
class CameraGroup:
    """Photos of one physical camera in one mode.

    Attributes
    ----------
    label : str
        As `group_of` gives it.
    facts : ExifFacts
        Of the first photo.
    width, height : int
        Size of its photos in pixels.
    names : tuple of str
        The photos.
    upright : bool
        Whether no photo has a tag that turns it.
    """

    label: str
    facts: ExifFacts
    width: int
    height: int
    names: tuple[str, ...]
    upright: bool


def group_photos(photos: Iterable[tuple[str, ExifFacts, int, int]]) -> dict[str, CameraGroup]:
    """Groups by label, in the order of their first photos.

    Parameters
    ----------
    photos : iterable of (name, facts, width, height)
        The size is that of the stored pixels, not the one that EXIF claims.
    """
    members: dict[str, list[tuple[str, ExifFacts, int, int]]] = {}
    for photo in photos:
        members.setdefault(group_of(*photo[1:]), []).append(photo)
    return {
        label: CameraGroup(
            label,
            *group[0][1:],
            names=tuple(photo[0] for photo in group),
            upright=all(photo[1].orientation in (None, 1) for photo in group),
        )
        for label, group in members.items()
    }


def guess_readouts(groups: Mapping[str, CameraGroup], readout: str = "top-to-bottom") -> tuple[dict[str, str], str]:
    """Readout direction of each group of a mixed folder, and what to say of it.

    Sensors lie on their long side. A camera that gave photos of W x H and of H x W, without an orientation tag, turned
    the pixels of the portrait ones after readout: theirs runs along the other axis. Which way round it runs cannot be
    seen, and does not matter: to reverse the readout is to negate the motion.

    Parameters
    ----------
    groups : mapping of label to CameraGroup
        As `group_photos` gives them.
    readout : str
        Of photos that were not turned.

    Returns
    -------
    readouts : dict of label to direction
        For every group.
    sentence : str
        What was guessed, for people; empty if nothing was.
    """
    across = "left-to-right" if READOUTS[readout][0] == 1 else "top-to-bottom"
    frames = {(_body(group.facts), group.width, group.height) for group in groups.values()}
    readouts = {}
    turned = 0
    for label, group in groups.items():
        is_turned = (
            group.height > group.width and group.upright and (_body(group.facts), group.height, group.width) in frames
        )
        readouts[label] = across if is_turned else readout
        turned += is_turned * len(group.names)
    if not turned:
        return readouts, ""
    photos, were, are = ("photo", "was", "is") if turned == 1 else ("photos", "were", "are")
    return readouts, (
        f"{turned} portrait {photos} of a camera that took landscape ones too {were} turned after readout, to go by "
        f"the missing orientation tag: {are} taken as read out {across}, the others {readout}"
    )
