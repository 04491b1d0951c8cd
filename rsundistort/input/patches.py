"""Cut-outs of photos, for the alignment of tracks at full size."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..batch.workers import Workers
from ..errors import FileError
from ..io import read_mask, read_photo
from ..model.array_types import Mask
from ..sfm import PatchPlaces, PatchSource, allowed_patches, cut_patches, grey_8_bit
from .load import LoadedPhotos

__all__ = ["patch_source"]

# Bytes per pixel of a photo while it is read and made grey, with its halvings.
_BYTES_PER_PIXEL = 16


@dataclass(frozen=True)
class _PatchJob:
    """All that cutting patches out of one photo takes."""

    frame: int
    source: Path
    mask: Path | None
    max_megapixels: float
    places: PatchPlaces


def _cut(job: _PatchJob) -> tuple[NDArray[np.uint8], Mask] | None:
    """Patches, and which of them the mask allows; None if the photo can no longer be read."""
    try:
        pixels = read_photo(job.source, job.max_megapixels).pixels
    except FileError:
        return None
    height, width = pixels.shape[:2]
    mask = None if job.mask is None else read_mask(job.mask, width, height)
    return cut_patches(grey_8_bit(pixels), job.places), allowed_patches(mask, job.places)


def patch_source(
    photos: LoadedPhotos, names: Sequence[str], workers: Workers, tell: Callable[[int], None]
) -> PatchSource:
    """Function that cuts patches out of these photos; `tell` gets the number of photos read."""
    most = max(camera.width * camera.height for camera in photos.cameras.cameras)
    fitting = workers.fitting("alignment", _BYTES_PER_PIXEL * most)

    def patches_of(places: Mapping[int, PatchPlaces]) -> Iterator[tuple[int, NDArray[np.uint8], Mask]]:
        jobs = [
            _PatchJob(
                frame, photos.folder / names[frame], photos.mask_of.get(names[frame]), photos.max_megapixels, each
            )
            for frame, each in places.items()
        ]
        with closing(fitting.map(_cut, jobs, lambda job, why: None)) as results:
            for done, (job, result) in enumerate(zip(jobs, results, strict=True), 1):
                tell(done)
                if result is not None:
                    yield job.frame, *result

    return patches_of
