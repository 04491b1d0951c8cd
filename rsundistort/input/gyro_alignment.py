"""Axes and clock of a gyroscope relative to the camera, from the video alone.

Between two frames a time dt apart the world rotates in the camera frame by `rotation` (`Exp(rotation) R_cw` is the
second orientation): the camera's mean rate about its own axes is `-rotation / dt`. A gyroscope that is fixed to the
camera measures `omega` about its axes, with a zero-rate offset (bias), on a clock of its own:

    -rotation / dt = s R (mean of omega over the same time, moved by the offset of the clocks - bias) + noise

R takes the gyroscope's axes to the camera's. s is 1 for the true focal length; rotations from a wrong one are too large
or too small by its error. The offset is searched for by the correlation that the best R at each offset reaches (a
Procrustes problem, in closed form); all unknowns are then refined together, with a loss that excludes wrong rotations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..io.gyro import GyroLog
from ..model.array_types import Array, Index
from ..model.checks import check_array, check_finite

__all__ = ["GyroAlignment", "NoAlignment", "align_gyro", "check_pairs"]

# Smallest number of rotations of an alignment, and the share of them that the log must cover.
_FEWEST, _COVERED = 20, 0.6
# Below, the log is of another clip: white rates reach 0.5 at the best of a thousand offsets, with a hundred rotations.
_LEAST_CORRELATION = 0.7
# Another offset, or a mirror image, with residuals of less than this many times the variance counts as good as the
# best.
_AS_GOOD, _BETTER = 1.3, 0.7
# rad/s rms of the rates about their mean. Below it, the rates are noise and wind.
_STILL = 0.02
# Relative error of a rate because of the focal length and the lens.
_SHARE = 0.05
# rad. Deviation of a sensor from the axes of its camera, if it is meant to be aligned with them; 15 degrees is another
# orientation.
_TILT, _OBLIQUE = np.radians(5.0), np.radians(15.0)
# Twice the log-likelihood by which one orientation must be better than another to exclude it. Twelve is 0.002 at one in
# twenty-four; the residuals of neighbours are not independent.
_EXCLUDES = 20.0
# Offsets that are computed together.
_AT_ONCE = 64


@dataclass(frozen=True)
class GyroAlignment:
    """Alignment of a gyroscope's log with a video.

    Attributes
    ----------
    offset_s, offset_sigma_s : float
        Time on the log's clock when the camera's shows zero, as `motions_from_gyro` takes it, and its standard
        deviation.
    camera_from_gyro : (3, 3) array
        Rotation that takes the log's rates to the camera's axes: right, down, ahead. About axes that the motion does
        not determine it is that of `axes`.
    axes : str or None
        The nearest signed permutation of the log's axes, as `parse_axes` takes it; None if the gyroscope deviates by
        more than 15 degrees from all of them. "XYZ" (the log's own axes) if the motion does not exclude it.
    also : tuple of str
        Other permutations that the motion does not exclude; empty if the camera rotated about two axes.
    axes_sigma_deg : (3,) array
        Standard deviation of `camera_from_gyro` about the camera's axes.
    bias : (3,) array
        Zero-rate offset in rad/s, about the log's axes.
    ratio, ratio_sigma : float
        Rotations of the video over those of the gyroscope: 1 if the focal length is right.
    correlation : float
        Of the rates of both, without their means, over all axes.
    axis_correlations : (3,) array
        The same about each axis of the camera; small for an axis about which it hardly rotated.
    rms : float
        Residual, rad/s per component, without wrong rotations.
    num_inliers, num_rotations : int
        Rotations that fit, of those that the log covers.
    """

    offset_s: float
    offset_sigma_s: float
    camera_from_gyro: Array
    axes: str | None
    also: tuple[str, ...]
    axes_sigma_deg: Array
    bias: Array
    ratio: float
    ratio_sigma: float
    correlation: float
    axis_correlations: Array
    rms: float
    num_inliers: int
    num_rotations: int

    def in_camera(self, log: GyroLog) -> GyroLog:
        """The log about the camera's axes, without its bias, by its own clock."""
        return GyroLog(log.time_s, (log.omega_c - self.bias) @ self.camera_from_gyro.T, log.readout_s)

    def __str__(self) -> str:
        way = self.axes or "oblique"
        return (
            f"gyroscope found: axes {way}, offset {self.offset_s:.4f} s +- {1e3 * self.offset_sigma_s:.1f} ms, "
            f"correlation {self.correlation:.3f}"
        )


@dataclass(frozen=True)
class NoAlignment:
    """Why a log could not be aligned: one line in `reason`, and the best correlation that was found (NaN if none)."""

    reason: str
    correlation: float = float("nan")

    def __str__(self) -> str:
        return self.reason


def align_gyro(
    log: GyroLog,
    frame_time_s: ArrayLike,
    pairs: ArrayLike,
    rotations: ArrayLike,
    *,
    largest_s: float = 10.0,
    around_s: float = 0.0,
) -> GyroAlignment | NoAlignment:
    """The offset of a log's clock and the axes of its sensor, from rotations between frames.

    Parameters
    ----------
    log : GyroLog
        In any axes; those of a camera's log are as its maker says.
    frame_time_s : (m,) array
        Times at which the middle lines of the frames were read, on the camera's clock.
    pairs : (n, 2) array of int
        Frames of each rotation, the earlier first. Neighbours are best: motion between distant frames is averaged.
    rotations : (n, 3) array
        Rotation vectors in radians, about the camera's axes: `Exp(rotation)` takes directions in the first frame to
        those in the second. False ones, and NaN, are left out.
    largest_s, around_s : float
        Offsets that differ from `around_s` by up to `largest_s` either way are tried.

    Returns
    -------
    GyroAlignment or NoAlignment
        The latter with its reason: too few rotations, a log that does not cover the frames, a camera that stood still
        or rotated too uniformly, a log of another clip, several offsets that fit, a mirror image.
    """
    start, end, seen = _rates(frame_time_s, pairs, rotations)
    if len(seen) < _FEWEST:
        return NoAlignment(f"{len(seen)} rotations between frames are too few to find a gyroscope by ({_FEWEST})")

    interval = float(np.median(end - start))
    coarse = _Coarse(log, start, end, _without_jumps(seen, start, log, interval))
    if not min(np.ptp(coarse.seen), np.ptp(log.omega_c)) > 0:
        return NoAlignment("the camera, or its gyroscope, did not move at all")
    found = coarse.search(largest_s, around_s)
    if found is None:
        within = f"within {largest_s:g} s of {around_s:g} s" if around_s else f"up to {largest_s:g} s"
        return NoAlignment(
            f"no offset {within} lets the gyroscope's log, from {log.time_s[0]:.2f} to "
            f"{log.time_s[-1]:.2f} s, cover the frames"
        )
    offset, proper, mirrored, rival = found
    measured = log.mean(start + offset, end + offset)
    spread = [float(np.sqrt(np.nanmean(np.nanvar(x, axis=0)))) for x in (coarse.seen, measured)]
    ways = _ways(coarse, offset, seen, mirrored=mirrored > proper and 1 - mirrored**2 < _BETTER * (1 - proper**2))
    fit = _refine(log, start, end, seen, offset, ways[0], coarse.ratio(offset))
    if fit is None:
        # a log that hardly fits anywhere fits best where it ends
        covers = (
            "the gyroscope's log does not cover the frames" if proper >= _LEAST_CORRELATION else _other_clip(proper)
        )
        return NoAlignment(covers, proper)
    against = _why_not(fit, ways[0], max(spread), interval)
    if against is None and 1 - rival**2 < _AS_GOOD * (1 - proper**2):
        against = "the camera's rotations repeat: several offsets of the gyroscope's clock fit them"
    if against is not None:
        return NoAlignment(against, proper)
    tilt = np.arccos(np.clip((np.trace(fit.camera_from_gyro @ ways[0].T) - 1) / 2, -1, 1))
    if tilt <= _OBLIQUE:
        return replace(fit, axes=_letters(ways[0]), also=tuple(_letters(way) for way in ways[1:]))
    return fit


def check_pairs(pairs: ArrayLike, rotations: ArrayLike) -> tuple[Index, Array]:
    """Pairs of frames (n, 2) and the rotations (n, 3) between them; other shapes and types are refused."""
    between = np.asarray(pairs)
    if between.ndim != 2 or between.shape[1] != 2 or not np.issubdtype(between.dtype, np.integer):
        raise InputError(f"pairs.shape={between.shape} of {between.dtype}, expected (n, 2) of int")
    return between, check_array(rotations, (len(between), 3), "rotations")


def _rates(frame_time_s: ArrayLike, pairs: ArrayLike, rotations: ArrayLike) -> tuple[Array, Array, Array]:
    """Start and end (n,) of intervals between frames, and the rates (n, 3) in them; without false ones."""
    times = check_finite(frame_time_s, (None,), "frame_time_s")
    between, vectors = check_pairs(pairs, rotations)
    if len(between) and (between.min() < 0 or between.max() >= len(times)):
        raise InputError(f"pairs connect frames {between.min()} to {between.max()} of {len(times)}")
    start, end = times[between[:, 0]], times[between[:, 1]]
    good = np.isfinite(vectors).all(axis=1) & (end > start)
    return start[good], end[good], -vectors[good] / (end - start)[good, None]


def _why_not(fit: GyroAlignment, way: Array, spread: float, interval_s: float) -> str | None:
    """Reason against an alignment by the nearest signed permutation, where rates change by `spread`."""
    if fit.correlation < _LEAST_CORRELATION and spread < _STILL:
        return (
            f"the camera stood still or rotated uniformly (its rate changes by {spread:.3f} rad/s): no gyroscope can "
            "be found by that"
        )
    if fit.correlation < _LEAST_CORRELATION:
        return _other_clip(fit.correlation)
    if np.linalg.det(way) < 0:
        return (
            f"the gyroscope's axes are a mirror image of the camera's, as {_letters(way)} takes them, which no sensor "
            "is: the sign of an axis is wrong, or two axes are exchanged"
        )
    if not fit.offset_sigma_s < interval_s / 2:
        return "the camera rotated too uniformly to determine the offset of the gyroscope's clock"
    return None


def _other_clip(correlation: float) -> str:
    return (
        f"the gyroscope's log does not show the camera's rotations (correlation {correlation:.2f}): it is of another "
        "clip, or the video is stabilised"
    )


def _without_jumps(seen: Array, at_s: Array, log: GyroLog, interval_s: float) -> Array:
    """Rates in which one that is unlike both its neighbours in time is their median, and none is beyond the log's."""
    order = np.argsort(at_s, kind="stable")
    padded = np.pad(seen[order], ((1, 1), (0, 0)), mode="edge")
    smooth = np.empty_like(seen)
    smooth[order] = np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)
    at = np.arange(log.time_s[0], log.time_s[-1] - interval_s, interval_s / 2)
    rates = np.linalg.norm(log.mean(at, at + interval_s), axis=1)
    limit = 2 * np.nanmax(rates) if np.isfinite(rates).any() else np.inf
    size = np.maximum(np.linalg.norm(smooth, axis=1), 1e-300)
    return smooth * np.minimum(1.0, limit / size)[:, None]


@dataclass(frozen=True)
class _Coarse:
    """Rates of the camera without jumps, against the log at any offset."""

    log: GyroLog
    start: Array
    end: Array
    seen: Array

    def products(self, offset_s: float | Array) -> tuple[Array, Array]:
        """(..., 3, 3) of the rates of both without their means, over the root of their squares, and (...) their ratio.

        NaN if the log covers too little.
        """
        offsets = np.asarray(offset_s)[..., None]
        measured = self.log.mean(self.start + offsets, self.end + offsets)
        there = np.isfinite(measured[..., :1])
        count = there.sum(axis=-2, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            a, b = (np.where(there, x, 0.0) for x in (self.seen, measured))
            a, b = (np.where(there, x - x.sum(axis=-2, keepdims=True) / count, 0.0) for x in (a, b))
            norms = (np.sqrt(np.sum(x * x, axis=(-2, -1))) for x in (a, b))
            of_a, of_b = (np.where(n > 0, n, np.nan) for n in norms)
            enough = count[..., 0, 0] >= max(_FEWEST, _COVERED * len(self.seen))
            scale = np.where(enough, of_a * of_b, np.nan)
            return a.swapaxes(-1, -2) @ b / scale[..., None, None], of_a / of_b

    def correlations(self, offset_s: Array) -> Array:
        """(k, 2) what the best rotation, and the best mirror image, reach; -inf where the log covers too little."""
        found = np.full((len(offset_s), 2), -np.inf)
        for first in range(0, len(offset_s), _AT_ONCE):
            products, _ = self.products(offset_s[first : first + _AT_ONCE])
            covered = np.isfinite(products).all(axis=(1, 2))
            U, s, Vt = np.linalg.svd(products[covered])
            last = s[:, 2] * np.sign(np.linalg.det(U) * np.linalg.det(Vt))
            rows = first + np.flatnonzero(covered)
            found[rows] = np.stack([s[:, 0] + s[:, 1] + last, s[:, 0] + s[:, 1] - last], axis=1)
        return found

    def ratio(self, offset_s: float) -> float:
        """Rates of the camera over those of the log."""
        products, ratio = self.products(offset_s)
        return float(np.clip(ratio * np.linalg.svd(products)[1].sum(), 0.5, 2.0))

    def search(self, largest_s: float, around_s: float) -> tuple[float, float, float, float] | None:
        """The best offset, what rotation and mirror image reach there, and the best elsewhere; None if none covers."""
        interval = float(np.median(self.end - self.start))
        step = interval / 2
        # only where the log covers anything
        first = max(around_s - largest_s, self.log.time_s[0] - self.end.max())
        last = min(around_s + largest_s, self.log.time_s[-1] - self.start.min())
        offsets = np.arange(np.ceil(first / step), np.floor(last / step) + 1) * step
        either = self.correlations(offsets).max(axis=1)
        if not len(either) or not np.isfinite(either.max()):
            return None
        top = int(np.argmax(either))
        # the residual doubles on both sides of the maximum; where it is as small again lies another maximum
        left = 1 - np.maximum(either, 0) ** 2
        apart = left > 2 * left[top]
        before, after = np.flatnonzero(apart[:top]), np.flatnonzero(apart[top:])
        beyond = [*either[: before[-1] if len(before) else 0], *either[top + after[0] if len(after) else len(either) :]]
        rival = float(max(beyond, default=0.0))
        fine = offsets[top] + step * np.arange(-8, 9) / 8
        scores = self.correlations(fine)
        best = int(np.argmax(scores.max(axis=1)))
        proper, mirrored = map(float, scores[best])
        return float(fine[best]), proper, mirrored, max(rival, 0.0)


# ---------------------------------------------------------------- which way it lies


def _signed_permutations(*, mirrored: bool) -> list[Array]:
    """24 orientations of a sensor along the camera's axes, or their mirror images; the identity comes first."""
    ways = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        way = np.zeros((3, 3))
        way[range(3), order] = signs
        if (np.linalg.det(way) < 0) == mirrored:
            ways.append(way)
    return ways


def _ways(coarse: _Coarse, offset_s: float, seen: Array, *, mirrored: bool) -> list[Array]:
    """Orientations that the motion does not exclude: first the log's own axes if they are one, else the best."""
    measured = coarse.log.mean(coarse.start + offset_s, coarse.end + offset_s)
    there = np.isfinite(measured[:, 0])
    measured, seen = measured[there], seen[there]
    ratio = coarse.ratio(offset_s)
    ways = _signed_permutations(mirrored=mirrored)
    left = [seen - ratio * measured @ way.T for way in ways]
    left = [each - np.median(each, axis=0) for each in left]
    sizes = np.array([np.linalg.norm(each, axis=1) for each in left])
    noise = _scale(sizes[np.argmin(np.median(sizes, axis=1) + 1e-3 * sizes.mean(axis=1))], measured)
    costs = np.log1p((sizes / noise) ** 2).sum(axis=1) * 2
    allowed = np.flatnonzero(costs < costs.min() + _EXCLUDES)
    return [ways[i] for i in sorted(allowed, key=lambda i: (i != 0 or mirrored, costs[i]))]


def _letters(way: Array) -> str:
    """The axes in the form that `parse_axes` reads."""
    columns = np.argmax(np.abs(way), axis=1)
    return "".join("XYZ"[k] if way[row, k] > 0 else "xyz"[k] for row, k in enumerate(columns))


def _scale(sizes: Array, measured: Array, share: float = _SHARE) -> Array:
    """(n,) standard deviation of a rate per component, rad/s: the median residual, and a share of the rate."""
    noise = np.median(sizes) / 1.538  # median of the length of three normal numbers
    return np.hypot(max(noise, 1e-9), share * np.linalg.norm(measured - np.median(measured, axis=0), axis=1))


# ---------------------------------------------------------------- all unknowns together

_ROTATION, _SHIFT, _RATIO, _OFFSET = slice(0, 3), slice(3, 6), 6, 7


def _refine(
    log: GyroLog, start: Array, end: Array, seen: Array, offset_s: float, way: Array, ratio: float
) -> GyroAlignment | None:
    """Gauss-Newton on rotation, bias, ratio and offset, with Cauchy's loss; the axes are not named.

    The rotation has a prior about `way`, which only matters where the motion does not determine it.
    """
    rotation, shift = way.copy(), np.zeros(3)
    interval = float(np.median(end - start))
    eye = np.eye(3)
    for iteration in range(30):
        covered = np.isfinite(log.mean(start + offset_s, end + offset_s)[:, 0])
        covered &= np.isfinite(log.mean(start + offset_s - interval, end + offset_s + interval)[:, 0])
        if covered.sum() < max(_FEWEST, _COVERED * len(covered)):
            return None
        a, b, y = start[covered] + offset_s, end[covered] + offset_s, seen[covered]
        measured = log.mean(a, b)
        h = interval / 8
        slope = (log.mean(a + h, b + h) - log.mean(a - h, b - h)) / (2 * h)
        rotated = measured @ rotation.T
        if iteration == 0:
            shift = np.median(y - ratio * rotated, axis=0)
        residuals = y - ratio * rotated - shift
        sizes = np.linalg.norm(residuals, axis=1)
        # the error of the start grows with the rate, and must not be taken for wrong rotations
        noise = _scale(sizes, ratio * measured, max(_SHARE, 0.4 * 0.6**iteration))
        # the share only detects wrong rotations: fast rotations determine axes, ratio and offset best
        inlier = 1 / (1 + (sizes / (3 * noise)) ** 2)
        weights = inlier / np.min(noise) ** 2
        J = np.empty((len(y), 3, 8))
        J[:, :, _ROTATION] = -ratio * np.cross(rotated[:, None, :], eye).transpose(0, 2, 1)
        J[:, :, _SHIFT] = eye
        J[:, :, _RATIO] = rotated
        J[:, :, _OFFSET] = ratio * slope @ rotation.T
        H = np.einsum("n,nij,nik->jk", weights, J, J)
        g = np.einsum("n,nij,ni->j", weights, J, residuals)
        prior = np.diag([1 / _TILT**2] * 3 + [0.0] * 3 + [1.0, 1e-4 / interval**2])
        # both may be mirror images
        tilt = Rotation.from_matrix(rotation @ way.T).as_rotvec()
        off = np.concatenate([-tilt, np.zeros(3), [1 - ratio, 0.0]])
        step = np.linalg.solve(H + prior, g + prior @ off)
        pulls = np.einsum("n,nij,ni->nj", weights, J, residuals)
        meat = pulls.T @ pulls + prior
        rotation = Rotation.from_rotvec(step[_ROTATION]).as_matrix() @ rotation
        shift = shift + step[_SHIFT]
        ratio = float(np.clip(ratio + step[_RATIO], 0.1, 10.0))
        offset_s += float(np.clip(step[_OFFSET], -interval, interval))
        if iteration > 5 and np.abs(step[_OFFSET]) < 1e-7 and np.abs(step).max() < 1e-6:
            break
    inverse = np.linalg.inv(H + prior)
    # the variance of the gradients, not the noise: rates are not equally exact, and the focal length is wrong for all
    sigma = np.sqrt(np.diag(inverse @ meat @ inverse))
    fits = sizes < 4 * noise
    A, B = (x - np.average(x, axis=0, weights=inlier) for x in (y, rotated))
    with np.errstate(invalid="ignore", divide="ignore"):
        products, squares = inlier @ (A * B), (inlier @ A**2, inlier @ B**2)
        axis_correlations = products / np.sqrt(squares[0] * squares[1])
        correlation = products.sum() / np.sqrt(squares[0].sum() * squares[1].sum())
    rms = float(np.sqrt(np.mean(residuals[fits] ** 2))) if fits.any() else float("inf")
    return GyroAlignment(
        offset_s=offset_s,
        offset_sigma_s=float(sigma[_OFFSET]),
        camera_from_gyro=rotation,
        axes=None,
        also=(),
        axes_sigma_deg=np.degrees(sigma[_ROTATION]),
        bias=-rotation.T @ shift / ratio,
        ratio=ratio,
        ratio_sigma=float(sigma[_RATIO]),
        correlation=float(np.nan_to_num(correlation)),
        axis_correlations=np.nan_to_num(axis_correlations),
        rms=rms,
        num_inliers=int(fits.sum()),
        num_rotations=len(y),
    )
