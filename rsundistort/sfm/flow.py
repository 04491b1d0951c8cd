"""Optical flow between frames of a video: motion of the content, and points of key frames in the others."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..model.array_types import Array, Index, Mask
from .alignment import align_places

__all__ = ["FlowFrame", "FlowTracks", "KeyFlow", "KeyFrameChooser", "flow_between", "flow_size", "from_reduced"]

Grey = NDArray[np.uint8]
Places = NDArray[np.float32]

# Larger frames are reduced to this: a twentieth of a pixel there is a tenth in a 4K frame.
_FLOW_MEGAPIXELS = 2.1
_WINDOW = (21, 21)
# Levels of the pyramids above frames and above reduced ones, and the longer side of these.
_LEVELS, _COARSE_LEVELS, _COARSE = 4, 2, 160
# Pixels from sample to sample of the windows that are aligned last: 15 of them are as wide as that window. And how far
# off what was only shifted may be, pixels.
_SPACING, _MOST_OFF = _WINDOW[0] / 15, 1.0
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003)
# A point that returns elsewhere, followed there and back again, was lost: pixels.
_BACK_PX = 0.5
# Share of the points that have to return at the finest level, and times the median difference of windows from which on
# one of them may show another thing all the same.
_MOST_RETURN = 0.75
_UNLIKE = 3.0
# Side of the area whose mean brightness is divided out, pixels of a frame, and of a reduced one, where a smaller area
# would leave nothing of large things; the least mean, so that noise in the dark is no texture; and what it becomes.
_AREA, _COARSE_AREA, _DARK, _MEAN = 31, 63, 16.0, 100.0
# Corners that measure the motion of the content, cells of a side of the frame that share them, how good they are at
# least by the best, and how far they are apart at least, by the diagonal.
_CORNERS, _CELLS, _LEAST_CORNER, _CORNERS_APART = 300, 6, 1e-4, 0.02
# A key frame is due when the content has moved by this share of its diagonal, or when this few of the corners are still
# seen; the sharpest of the frames that moved by `_CANDIDATE` of that is taken.
_MOVED, _SEEN, _CANDIDATE = 0.06, 0.5, 0.6
# But no later than after this many frames: points that are followed from one key frame to the next connect all frames
# between.
_MOST_GAP = 12
# Corners that vanish from one frame to the next: another scene.
_CUT, _LEAST_CORNERS = 0.75, 20


def flow_size(width: int, height: int) -> tuple[int, int]:
    """Width and height at which frames of this size are followed."""
    shrink = max(1.0, math.sqrt(width * height / (1e6 * _FLOW_MEGAPIXELS)))
    return max(2, round(width / shrink)), max(2, round(height / shrink))


def from_reduced(step: Array) -> Array:
    """(3, 3) from pixels of a reduced frame to those of the frame, `step` (2,) times as large; centres are integers."""
    (a, b), (x, y) = step, 0.5 * step - 0.5
    return np.array([[a, 0.0, x], [0.0, b, y], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class FlowFrame:
    """A frame as it is followed.

    Attributes
    ----------
    grey : (h, w) uint8 array
        Over its mean brightness nearby. The flow takes a point to be as bright in all frames; under lamps that flicker
        a rolling shutter reads bands of different brightness, which run through the frames, and exposures follow the
        scene.
    coarse : (h', w') uint8 array
        Reduced, over its mean farther around. Fast pans move the content by a tenth of the frame, and of a frame over
        its mean nearby the upper levels of a pyramid, which show such motions, are empty.
    """

    grey: Grey
    coarse: Grey

    @classmethod
    def of(cls, grey: Grey) -> FlowFrame:
        """A frame of grey values."""
        height, width = grey.shape
        shrink = max(1.0, max(width, height) / _COARSE)
        size = max(1, round(width / shrink)), max(1, round(height / shrink))
        reduced = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        return cls(_even(grey, _AREA), _even(np.asarray(reduced, np.uint8), _COARSE_AREA))

    def aligned(self, H: Array) -> FlowFrame:
        """The frame warped so that what it shows at pixels H x lies at x."""

        def warped(grey: Grey) -> Grey:
            S = from_reduced(np.divide(self.grey.shape[::-1], grey.shape[::-1]))
            how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            return np.asarray(
                cv2.warpPerspective(grey, np.linalg.inv(S) @ H @ S, grey.shape[::-1], flags=how), np.uint8
            )

        return FlowFrame(warped(self.grey), warped(self.coarse))


def _even(grey: Grey, area: int) -> Grey:
    """Grey values over their mean in an area."""
    mean = cv2.boxFilter(grey, cv2.CV_32F, (area, area))
    return np.asarray(cv2.divide(grey, np.maximum(mean, _DARK), scale=_MEAN, dtype=cv2.CV_8U), np.uint8)


def _followed(
    before: FlowFrame, after: FlowFrame, xy: Places, guess: Places | None = None,
    levels: int = _LEVELS,
) -> tuple[Places, Mask]:  # fmt: skip
    """Where points (n, 2) of a frame lie in another, and which of them (n,) were found there and back again.

    If most were not, the content moved far, and they are looked for again from where the reduced frames show them. (Of
    a few, what covers them would be found.)
    """
    if not len(xy):
        return xy, np.zeros(0, bool)
    start = xy if guess is None else guess
    there, seen = _there_and_back(before.grey, after.grey, xy, start, levels)
    lost = np.flatnonzero(~seen)
    if 2 * len(lost) > len(seen):
        step, half = np.float32(after.grey.shape[1] / after.coarse.shape[1]), np.float32(0.5)
        reduced = [(each[lost] + half) / step - half for each in (xy, start)]
        near, found, _ = _sought(before.coarse, after.coarse, reduced[0], reduced[1], _COARSE_LEVELS)
        again, seen_again = _there_and_back(before.grey, after.grey, xy[lost], (near + half) * step - half, levels)
        there[lost], seen[lost] = again, seen_again & found
    return there, seen


def _there_and_back(before: Grey, after: Grey, xy: Places, start: Places, levels: int) -> tuple[Places, Mask]:
    """Where points lie in another frame, and which of them returned.

    What shows the same returns at the finest level from where it was, or not at all; of other things this finds what
    is alike nearby. So all have to return through the pyramid if many did not without it, and else those whose windows
    differ by much.
    """
    there, found, difference = _sought(before, after, xy, start, levels)
    height, width = after.shape
    found &= (there >= 0).all(1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)

    def returned(asked: Index, levels: int) -> Mask:
        back, seen, _ = _sought(after, before, there[asked], xy[asked], levels)
        return seen & (np.linalg.norm(back - xy[asked], axis=1) < _BACK_PX)

    seen = np.flatnonzero(found)
    near = seen[returned(seen, 0)]
    if len(near) >= _MOST_RETURN * len(xy):
        doubtful = difference[near] > _UNLIKE * np.median(difference[near])
        sure, seen = near[~doubtful], near[doubtful]
    else:
        sure = near[:0]
    return there, np.isin(np.arange(len(xy)), np.concatenate([sure, seen[returned(seen, levels)]]))


def _sought(before: Grey, after: Grey, xy: Places, start: Places, levels: int) -> tuple[Places, Mask, Places]:
    """Where points are found in another picture, looked for from a start (Lucas and Kanade 1981, Bouguet 2000).

    And by how much their windows differ, in grey levels.
    """
    if not len(xy):
        return xy, np.zeros(0, bool), np.zeros(0, np.float32)
    there, found, difference = cv2.calcOpticalFlowPyrLK(
        before, after, xy, start.copy(), winSize=_WINDOW, maxLevel=levels, criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(there, np.float32), found.ravel() == 1, difference.ravel()


def _corners(grey: Grey) -> Places:
    """(n, 2) corners of a frame, the best of each of its cells first, so that no thing in it has most of them."""
    found = cv2.goodFeaturesToTrack(grey, 0, _LEAST_CORNER, _CORNERS_APART * math.hypot(*grey.shape))
    if found is None:
        return np.zeros((0, 2), np.float32)
    xy: Places = found.reshape(-1, 2)  # the best first
    cell = (_CELLS * xy / grey.shape[::-1]).astype(np.int64) @ [1, _CELLS]
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(xy), np.int64)
    rank[order] = np.arange(len(xy)) - np.searchsorted(cell[order], cell[order])
    return xy[np.argsort(rank, kind="stable")[:_CORNERS]]


@dataclass(frozen=True)
class KeyFlow:
    """Corners of a key frame, and where they lie in the next one.

    Attributes
    ----------
    keys : (int, int)
        Both frames.
    first_xy, second_xy : (n, 2) array
        Pixels of the frames as they are followed.
    """

    keys: tuple[int, int]
    first_xy: Places
    second_xy: Places


@dataclass(frozen=True)
class _Since:
    """A frame since the last key frame: how far the content moved, and where corners of the key are still seen."""

    frame: FlowFrame
    sharpness: float
    moved: float
    xy: Places
    corner: Index


class KeyFrameChooser:
    """Choose key frames of a video while its frames pass, and find its cuts.

    Attributes
    ----------
    keys : list of int
        Frames chosen so far; the first one is.
    cuts : list of int
        Frames that do not continue the one before.
    flows : list of KeyFlow
        Corners of key frames in the next one.
    """

    def __init__(self) -> None:
        self.keys: list[int] = []
        self.cuts: list[int] = []
        self.flows: list[KeyFlow] = []
        self._since: list[_Since] = []  # frames from the last key on
        self._number = -1

    def feed(self, frame: FlowFrame) -> None:
        """The next frame."""
        self._number += 1
        sharpness = float(cv2.Laplacian(frame.grey, cv2.CV_32F).var())
        if not self.keys:
            self._begin(self._number, frame, sharpness)
            return
        self._step(frame, sharpness, may_cut=True)

    def finish(self) -> None:
        """The last frame is a key frame, too: nothing is known beyond it."""
        if self.keys and self.keys[-1] != self._number:
            self._join(len(self._since) - 1)
            self.keys.append(self._number)

    def _begin(self, number: int, frame: FlowFrame, sharpness: float) -> None:
        self.keys.append(number)
        self._corners = _corners(frame.grey)
        self._since = [_Since(frame, sharpness, 0.0, self._corners, np.arange(len(self._corners)))]

    def _step(self, frame: FlowFrame, sharpness: float, may_cut: bool) -> None:
        last = self._since[-1]
        xy, seen = _followed(last.frame, frame, last.xy)
        if may_cut and len(last.xy) >= _LEAST_CORNERS and seen.sum() < (1 - _CUT) * len(last.xy):
            self.cuts.append(self._number)
            if self.keys[-1] != self._number - 1:
                self.keys.append(self._number - 1)
            self._begin(self._number, frame, sharpness)
            return
        xy, corner = xy[seen], last.corner[seen]
        apart = np.linalg.norm(xy - self._corners[corner], axis=1)
        moved_by = float(np.median(apart)) / math.hypot(*frame.grey.shape) if len(corner) else 1.0
        self._since.append(_Since(frame, sharpness, moved_by, xy, corner))
        share = len(corner) / max(len(self._corners), 1)
        if moved_by > _MOVED or share < _SEEN or len(self._since) > _MOST_GAP:
            self._choose()

    def _choose(self) -> None:
        """The sharpest of the frames that moved far enough becomes a key; those behind it are followed again."""
        last = self._since[-1].moved
        candidates = [k for k, each in enumerate(self._since) if k > 0 and each.moved >= _CANDIDATE * last]
        best = max(candidates, key=lambda k: (self._since[k].sharpness, k))
        self._join(best)
        chosen, rest = self._since[best], self._since[best + 1 :]
        self._begin(self.keys[-1] + best, chosen.frame, chosen.sharpness)
        for each in rest:
            self._step(each.frame, each.sharpness, may_cut=False)

    def _join(self, place: int) -> None:
        """Look for the corners of the last key in a frame that becomes the next, by their windows in the key itself."""
        key, other = self._since[0], self._since[place]
        start = self._corners[other.corner]
        xy, seen = _followed(key.frame, other.frame, start, other.xy)
        self.flows.append(KeyFlow((self.keys[-1], self.keys[-1] + place), start[seen], xy[seen]))


@dataclass(frozen=True)
class FlowTracks:
    """Where points of a key frame lie in other frames.

    Attributes
    ----------
    frame, point : (o,) int array
        Frame, and index of the point.
    xy : (o, 2) array
        Pixels of the frames as they are followed.
    """

    frame: Index
    point: Index
    xy: Array


def flow_between(
    frames: Sequence[FlowFrame], first_xy: Array, last_xy: Array, *, aligned: bool = False
) -> tuple[FlowTracks, FlowTracks]:
    """Follow points of two key frames to the other one, through all frames between.

    Each point is looked for by the window around it in its key frame, so that errors do not add up, from where the
    frame before showed it. In the end that window may be rotated, stretched and sheared (`align_places`): one that is
    only shifted is off by a fraction of a pixel on the ground before a camera that yaws, everywhere to the same side,
    and a readout time comes out too long by a twelfth.

    Parameters
    ----------
    frames : sequence of FlowFrame
        From the first key to the last, both included.
    first_xy, last_xy : (n, 2), (k, 2) array
        Points of each key.
    aligned : bool
        Whether the points lie nearly where they are in their key frame. Higher levels of pyramids would lose them.

    Returns
    -------
    forward, backward : FlowTracks
        Frames count from the first key; that of the points themselves is left out.
    """
    last, levels = len(frames) - 1, _COARSE_LEVELS if aligned else _LEVELS
    return (
        _through(frames, 0, range(1, last + 1), first_xy, levels),
        _through(frames, last, range(last - 1, -1, -1), last_xy, levels),
    )


def _through(frames: Sequence[FlowFrame], key: int, order: Iterable[int], start: Array, levels: int) -> FlowTracks:
    """Points of a key frame in other frames, in an order in which the content moves on."""
    xy0 = np.asarray(start, np.float32).reshape(-1, 2)
    index, xy = np.arange(len(xy0)), xy0
    found = [(np.zeros(0, np.int64), index[:0], np.zeros((0, 2)))]
    for k in order:
        xy, seen = _followed(frames[key], frames[k], xy0, xy, levels)
        index, xy0, xy = index[seen], xy0[seen], xy[seen]
        both = xy0.astype(np.float64), xy.astype(np.float64)
        places, alike = align_places(frames[key].grey, frames[k].grey, *both, _SPACING, _MOST_OFF)
        found.append((np.full(int(alike.sum()), k), index[alike], places[alike]))
    frame, point, places = (np.concatenate(each) for each in zip(*found, strict=True))
    return FlowTracks(frame.astype(np.int64), point.astype(np.int64), places)
