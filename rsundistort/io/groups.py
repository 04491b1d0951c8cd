"""Which photos one camera took in one mode, and which of them were rotated after readout."""

from __future__ import annotations

from collections.abc import Sequence

from ..model import other_axis
from .photos.exif_facts import ExifFacts

__all__ = ["group_of", "groups_of", "guess_readouts"]

# 35-mm equivalents that differ by more than this share are of another zoom: EXIF has them in whole millimetres.
_ZOOMED = 0.05


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


def groups_of(facts: Sequence[ExifFacts], sizes: Sequence[tuple[int, int]]) -> list[str]:
    """The label of each photo of a folder.

    As `group_of` has it, but for photos that were zoomed digitally: some programs write that into the 35-mm equivalent
    alone, which then differs between photos of one focal length. The shortest has the usual label.
    """
    labels = [group_of(fact, *size) for fact, size in zip(facts, sizes, strict=True)]
    wide = dict[str, float]()
    for fact, label in zip(facts, labels, strict=True):
        if fact.focal_35mm:
            wide[label] = min(fact.focal_35mm, wide.get(label, fact.focal_35mm))
    return [
        f"{_body(fact)}-{fact.focal_35mm:.4g}mm-of-35-{size[0]}x{size[1]}"
        if fact.focal_35mm and fact.focal_35mm > (1 + _ZOOMED) * wide[label]
        else label
        for fact, size, label in zip(facts, sizes, labels, strict=True)
    ]


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


def guess_readouts(
    facts: Sequence[ExifFacts], sizes: Sequence[tuple[int, int]], groups: Sequence[str], readout: str = "top-to-bottom"
) -> tuple[dict[str, str], list[str]]:
    """Readout direction of each group of a mixed folder, and what to say of it.

    Sensors lie on their long side. A camera that gave photos of W x H and of H x W, without an orientation tag, rotated
    the pixels of the portrait ones after readout: theirs runs along the other axis. Which way round it runs cannot be
    seen, and does not matter: to reverse the readout is to negate the motion.

    Parameters
    ----------
    facts, sizes, groups : sequences of length m
        Of each photo what its EXIF says, the (width, height) of its stored pixels, and its label as of `group_of`.
    readout : str
        Of photos that were not rotated.

    Returns
    -------
    readouts : dict of label to direction
        For every group.
    notes : list of str
        What was guessed, for people; empty if nothing was.
    """
    across = other_axis(readout)
    frames = {(_body(fact), *size) for fact, size in zip(facts, sizes, strict=True)}
    # a tag that rotates the photo for people says that nobody has rotated its pixels
    tagged = {group for fact, group in zip(facts, groups, strict=True) if fact.orientation not in (None, 1)}
    readouts = {}
    for fact, (width, height), group in zip(facts, sizes, groups, strict=True):
        rotated = height > width and group not in tagged and (_body(fact), height, width) in frames
        readouts[group] = across if rotated else readout
    count = sum(readouts[group] == across for group in groups)
    if not count:
        return readouts, []
    photos, were, they = ("photo", "was", "it is") if count == 1 else ("photos", "were", "they are")
    return readouts, [
        f"{count} portrait {photos} of a camera that took landscape ones too {were} rotated after readout, to go by "
        f"the missing orientation tag; {they} taken as read out {across}, the others {readout}"
    ]
