"""The camera of a rectified photo: how much to keep, how much to crop, how large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..model import Camera, RowMotion
from ..model.array_types import Array
from ..model.checks import check_fields, check_number, check_size
from ..model.projection import motion_of, unproject_points
from .photo import MAX_SIDE

__all__ = ["ViewOptions", "optimal_new_camera", "rectified_roi", "rectified_view", "steadiest_pinhole"]

# Beyond it a photo of a pixel fits into no file.
_MOST_SCALE = 1e4
# Points on each side of a frame by which a pinhole camera is fitted; steps from it to the one with the camera's own K.
_SAMPLES, _SHARES = 33, 65
# Pixels that an empty border may be wide: the edge of a pixel lies so far from its centre.
_EMPTY_PX = 0.5


@dataclass(frozen=True)
class ViewOptions:
    """View and size of rectified photos.

    Parameters
    ----------
    alpha : float or "keep", optional
        0: no empty pixel in any photo of a camera; 1: every pixel of all of them; between: between, as in
        `optimal_new_camera`. "keep": K and size of the raw photos. None: as the solution has it, "keep" for a new one.
    scale : float, optional
        Size of the rectified photos in that of the raw ones. None: as the solution has it, 1 for a new view.
    max_size : int, optional
        Longest side, in pixels; smaller photos stay.
    """

    alpha: float | str | None = None
    scale: float | None = None
    max_size: int | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if isinstance(self.alpha, str):
            if self.alpha != "keep":
                raise InputError(f"alpha={self.alpha!r}, expected 'keep' or a number from 0 to 1")
        elif self.alpha is not None and not 0.0 <= self.alpha <= 1.0:
            raise InputError(f"alpha={self.alpha}, expected 'keep' or a number from 0 to 1")
        if self.scale is not None and not 0.0 < self.scale <= _MOST_SCALE:
            raise InputError(f"scale={self.scale}, expected a positive number up to {_MOST_SCALE:g}")
        if self.max_size is not None and self.max_size < 2:
            raise InputError(f"max_size={self.max_size}, expected at least 2 pixels")

    def scale_for(self, width: int, height: int, raw_side: int = 0) -> tuple[float, int, int]:
        """Scale, width and height of the rectified photos by a view of such a size; refused where OpenCV takes none.

        The view is of raw photos whose longer side has `raw_side` pixels; by default, of their size.
        """
        longest = max(width, height)
        scale = 1.0 if self.scale is None else self.scale * (raw_side or longest) / longest
        said = f"scale={1.0 if self.scale is None else self.scale:g}"
        if self.max_size is not None and self.max_size / longest < scale:
            scale, said = self.max_size / longest, f"max_size={self.max_size}"
        # cut off, so that no pixel's centre lies beyond the last of the old ones
        across, down = (int(scale * side + 1e-9) for side in (width, height))
        if min(across, down) < 2:
            raise InputError(f"{said} leaves {across}x{down} pixels of {width}x{height}")
        if max(across, down) > MAX_SIDE:
            raise InputError(
                f"{said} makes {across}x{down} pixels of {width}x{height}, and OpenCV fills sides up to {MAX_SIDE}"
            )
        return scale, across, down


def rectified_view(
    camera: Camera, motions: Sequence[RowMotion], shutter_model: str, view: ViewOptions, as_it_was: Camera
) -> Camera:
    """The camera of the rectified photos of one physical camera.

    Parameters
    ----------
    camera : Camera
        Of the raw photos.
    motions : sequence of RowMotion
        Of all of them: one camera has to do for all.
    shutter_model : str
        As in `init_rectify_map`.
    as_it_was : Camera
        The rectified camera where `view.alpha` is None.
    """
    old = as_it_was if view.alpha is None else camera.pinhole()
    scale, width, height = view.scale_for(old.width, old.height, max(camera.width, camera.height))
    if view.alpha is None or view.alpha == "keep" or not motions:
        if (width, height) == (old.width, old.height):
            return old
        K = np.array(old.K)
        K[:2, 2] += 0.5  # the corner of the photo stays, not the centre of its first pixel
        K[:2] *= scale
        K[:2, 2] -= 0.5
        return Camera(width, height, K, readout=old.readout)
    return optimal_new_camera(camera, motions, shutter_model, float(view.alpha), (width, height))[0]


def steadiest_pinhole(camera: Camera, before: Camera) -> Camera:
    """The pinhole camera whose picture moves least when a lens that was taken for another one is found.

    Rectified by the camera as it was `before`, photos keep its K. What is found of a lens beside its distortion, or
    against it, need not zoom them: one factor of the focal lengths and the principal point follow, so that pixels stay
    where they were in the mean square over the frame, as far as that leaves no borders empty.

    Parameters
    ----------
    camera : Camera
        As it was found.
    before : Camera
        As it was given, or guessed.
    """
    plain = camera.pinhole()
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, _SAMPLES), np.linspace(0, camera.height - 1, _SAMPLES))
    xy = np.column_stack([x.ravel(), y.ravel()])
    (found, seen), (old, seen_before) = (unproject_points(xy, each, RowMotion(), "global") for each in (camera, before))
    f, f_before = (np.diag(each.K)[:2] for each in (camera, before))
    target = f_before * old + before.K[:2, 2]
    # what the picture shows: a fisheye's border lies far beyond it
    shown = seen & seen_before & ((target >= 0) & (target <= [camera.width - 1, camera.height - 1])).all(1)
    if not shown.any():
        return plain
    rays, target = f * found[shown], target[shown]
    middle, middle_before = rays.mean(0), target.mean(0)
    factor = float(((rays - middle) * (target - middle_before)).sum() / ((rays - middle) ** 2).sum())
    centre = middle_before - factor * middle
    outline = _outline(camera, None, "global")
    K = plain.K.copy()
    for share in np.linspace(1.0, 0.0, _SHARES):
        zoom = 1.0 + share * (factor - 1.0)
        K[[0, 1], [0, 1]], K[:2, 2] = zoom * f, plain.K[:2, 2] + share * (centre - plain.K[:2, 2])
        if outline is None or _empty(outline, K, camera) <= max(_EMPTY_PX, _empty(outline, plain.K, camera)):
            break
    return replace(plain, K=K)


def _empty(outline: _Outline, K: Array, camera: Camera) -> float:
    """How wide the widest empty border of a rectified photo is, in pixels."""
    f, c, last = np.diag(K)[:2], K[:2, 2], np.array([camera.width - 1, camera.height - 1])
    return float(max((f * outline.inner_lo + c).max(), (last - f * outline.inner_hi - c).max()))


@dataclass(frozen=True)
class _Outline:
    """The border of a photo in ideal normalised coordinates: the rectangle within it, and that around it."""

    inner_lo: Array
    inner_hi: Array
    outer_lo: Array
    outer_hi: Array

    def roi(self, new_camera: Camera) -> tuple[int, int, int, int] | None:
        """The pixels (x, y, width, height) of a rectified photo within the inner rectangle."""
        f, c = np.diag(new_camera.K)[:2], new_camera.K[:2, 2]
        last = np.array([new_camera.width - 1, new_camera.height - 1])
        # a border that was put on a pixel is on it, whatever the rounding
        lo = np.maximum(np.ceil(f * self.inner_lo + c - 1e-6), 0)
        hi = np.minimum(np.floor(f * self.inner_hi + c + 1e-6), last)
        if not (hi >= lo).all():
            return None
        x, y, right, bottom = (int(v) for v in (*lo, *hi))
        return x, y, right - x + 1, bottom - y + 1


def _outline(camera: Camera, motion: RowMotion | None, shutter_model: str) -> _Outline | None:
    """The outline of a photo, every pixel of its border walked; None where some have no place in a pinhole photo."""
    left, right, top, bottom = (unproject_points(b, camera, motion, shutter_model)[0] for b in _border(camera))
    edges = np.vstack([left, right, top, bottom])
    if not np.isfinite(edges).all():
        return None
    return _Outline(
        np.array([left[:, 0].max(), top[:, 1].max()]),
        np.array([right[:, 0].min(), bottom[:, 1].min()]),
        edges.min(0),
        edges.max(0),
    )


def _border(camera: Camera) -> list[Array]:
    """Pixels of the left, right, top and bottom border of the raw photo."""
    w, h = camera.width - 1.0, camera.height - 1.0
    u, v = np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
    return [
        np.column_stack([np.zeros_like(v), v]),
        np.column_stack([np.full_like(v, w), v]),
        np.column_stack([u, np.zeros_like(u)]),
        np.column_stack([u, np.full_like(u, h)]),
    ]


def rectified_roi(
    camera: Camera, motion: RowMotion | None, shutter_model: str, new_camera: Camera
) -> tuple[int, int, int, int] | None:
    """Rectangle (x, y, width, height) of a rectified photo without empty pixels: within its border's innermost points.

    None where there is no such rectangle, or the border has no place in a pinhole photo.
    """
    outline = _outline(camera, motion, shutter_model)
    return None if outline is None else outline.roi(new_camera)


def optimal_new_camera(
    camera: Camera,
    motion: RowMotion | Sequence[RowMotion] | None = None,
    shutter_model: str = "rotation",
    alpha: float = 0.0,
    size: tuple[int, int] | None = None,
) -> tuple[Camera, tuple[int, int, int, int]]:
    """Pinhole camera of the rectified photo, in the manner of `cv2.getOptimalNewCameraMatrix`.

    The borders of the raw photo are walked pixel by pixel, so that the answer is exact also with strong motion. Pixels
    keep the shape (fx : fy) that they have in the raw photo. The wider a fisheye, the less this is what one wants: the
    middle shrinks as the border is stretched, and a border 90 degrees from the axis is refused.

    Parameters
    ----------
    camera, motion, shutter_model
        As in `init_rectify_map`; or the motions of several photos, for all of which the new camera has to do.
    alpha : float
        0: no empty pixel in any of them; 1: every pixel of all of them is kept; between: between.
    size : (width, height), optional
        Size of the rectified photo; the camera's own when left out.

    Returns
    -------
    new_camera : Camera
        Without distortion.
    roi : (x, y, width, height)
        Rectangle without empty pixels in any of the rectified photos.
    """
    alpha = check_number(alpha, "alpha", 0.0, 1.0)
    if isinstance(motion, Sequence) and not motion:
        raise InputError("motion holds none; give those of the photos, or None for a camera that stood still")
    motions = [motion_of(camera, each) for each in (motion if isinstance(motion, Sequence) else [motion])]
    width, height = check_size((camera.width, camera.height) if size is None else size, least=2)
    outlines = [_outline(camera, each, shutter_model) for each in motions]
    found = [each for each in outlines if each is not None]
    if not found or len(found) < len(outlines):
        if camera.lens == "fisheye":
            raise InputError(
                "the photo's border has no place in a pinhole photo: it lies 90 degrees or more from the axis, or the "
                "lens folds before; check dist, or make a camera of your own, as camera.pinhole() does with the same K"
            )
        raise InputError("the photo's border has no place without lens and shutter; check dist and phi")
    inner_lo, inner_hi = np.max([o.inner_lo for o in found], 0), np.min([o.inner_hi for o in found], 0)
    outer_lo, outer_hi = np.min([o.outer_lo for o in found], 0), np.max([o.outer_hi for o in found], 0)
    if (inner_hi <= inner_lo).any():
        raise InputError("no rectangle without empty pixels exists; check dist and phi")
    span = np.array([width - 1.0, height - 1.0])
    shape = np.array([camera.K[0, 0], camera.K[1, 1]]) / camera.K[0, 0]
    # one zoom for both axes: the tighter one for the inner rectangle, the wider one for the outer
    zoom_inner = (span / (inner_hi - inner_lo) / shape).max()
    zoom_outer = (span / (outer_hi - outer_lo) / shape).min()
    zoom = zoom_inner ** (1.0 - alpha) * zoom_outer**alpha
    middle = (1.0 - alpha) * (inner_lo + inner_hi) / 2 + alpha * (outer_lo + outer_hi) / 2
    f = zoom * shape
    c = span / 2 - f * middle
    new = Camera(width, height, np.array([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1]]), readout=camera.readout)
    roi = _Outline(inner_lo, inner_hi, outer_lo, outer_hi).roi(new)
    if roi is None:
        raise InputError("no rectangle without empty pixels exists; check dist and phi")
    return new, roi
