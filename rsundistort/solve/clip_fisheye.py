"""A video by a lens that nobody described: as a pinhole's, or as a fisheye's, whichever explains its frames."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from ..errors import InputError, ReconstructionError
from ..input.fisheyes import cameras_as_fisheyes, cameras_as_pinholes
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos
from ..input.photo_cameras import PhotoCameras
from ..io.kept import Kept
from .clip_pan import rotates_by
from .outcome import Solved
from .solutions import leaves_less, leaves_no_more

__all__ = ["by_likeliest_lens"]


def by_likeliest_lens(
    solve: Callable[..., Solved],
    clip: Clip,
    keys: LoadedPhotos,
    said: list[warnings.WarningMessage],
    kept: Kept | None = None,
) -> tuple[Solved, list[str]]:
    """The result of a video by its cameras, or as of a fisheye, if it may be one and that explains the frames better.

    Parameters
    ----------
    solve : callable
        From key frames and what is kept of them to a result; with `rotates` as in `solve_clip`.
    said : list of warnings.WarningMessage
        Warnings of these calls. Those of the result that is taken are left.

    Returns
    -------
    solved : Solved
    notes : list of str
        Which camera is a fisheye, for people.

    Raises
    ------
    ReconstructionError
        That of the cameras as they are, if no fisheye can be trusted.
    """

    def tried(cameras: PhotoCameras, *, rotates: bool = False) -> Solved | None:
        said.clear()
        with suppress(ReconstructionError, InputError):
            return solve(replace(keys, cameras=cameras), rotates=rotates)
        return None

    found, failed = None, None
    try:
        found = solve(keys, kept=kept)
    except ReconstructionError as error:
        failed = error
    of_found = [*said]
    for cameras, notes, rotates in _as_fisheyes(clip, keys.cameras, found):
        other = tried(cameras, rotates=rotates)
        if other is None or not _fits_better(other, found):
            continue
        of_other = [*said]
        travelled = tried(cameras) if rotates else None  # what travels a little looks as if it only rotated
        if travelled is not None:
            other, of_other = travelled, [*said]
        pinholes = cameras_as_pinholes(cameras, other.shared.cameras)
        as_pinhole = None if pinholes is None else tried(pinholes)
        if as_pinhole is not None:
            return as_pinhole, []
        said[:] = of_other
        return other, notes
    said[:] = of_found
    if found is None:
        assert failed is not None
        raise failed
    return found, []


def _as_fisheyes(
    clip: Clip, cameras: PhotoCameras, found: Solved | None
) -> Iterator[tuple[PhotoCameras, list[str], bool]]:
    """The camera of a video as a fisheye, where it may be one; what to say, and whether it is to rotate only.

    A video shows what little a lens leaves, and its path absorbs some: each wide view is tried. Of that, rotations say
    little, and an error nothing; nor does a scene, if rotations of a fisheye explain it.
    """
    wide_view = partial(cameras_as_fisheyes, cameras, doubted=True)
    if found is None:
        any_view = wide_view(cameras.cameras, is_unexplained=True)
        if any_view is not None:
            yield *any_view, False
        return
    if found.evidence.get("stands"):  # any lens explains it
        return
    any_view = wide_view(found.shared.cameras, is_unexplained=True) if cameras.without_focal else None
    if any_view is not None and (_only_rotates(found) or rotates_by(clip, any_view[0].of(0))):
        yield *any_view, True
    as_found = wide_view(found.shared.cameras, is_unexplained=False)
    if as_found is not None:
        yield *as_found, False


def _fits_better(other: Solved, before: Solved | None) -> bool:
    """Whether a path through as many frames leaves less, by more than noise may, or no more without any travel.

    Whether it can be trusted, if there is none before it.
    """
    if before is None:
        return other.verdict is not None and other.verdict.shape == "trusted"
    assert other.whole is not None
    assert before.whole is not None
    results = other.result, before.result
    no_travel = _only_rotates(other) and not _only_rotates(before)
    fits = leaves_less(*results) or (no_travel and leaves_no_more(*results))
    return fits and other.whole.num_images >= before.whole.num_images


def _only_rotates(solved: Solved) -> bool:
    """Whether the frames of a video have directions only."""
    return not np.ptp(solved.shared.center_w, axis=0).any()
