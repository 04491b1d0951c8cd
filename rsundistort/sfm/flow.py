"""Optical flow between frames of a video: motion of the content, and points of key frames in the others."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["FlowTracks", "KeyFrameChooser", "flow_between", "flow_size"]

Grey = NDArray[np.uint8]

# Larger frames are reduced to this: a twentieth of a pixel there is a tenth in a 4K frame.
_FLOW_MEGAPIXELS = 2.1
_WINDOW = (21, 21)
_LEVELS = 4
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003)
# A point that returns elsewhere, followed there and back again, was lost: pixels.
_BACK_PX = 0.5
# Corners that measure the motion of the content.
_CORNERS = 300
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


def _followed(
    before: Grey, after: Grey, xy: NDArray[np.float32], guess: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points (n, 2) of a frame lie in another, and which of them (n,) were found there and back again."""
    if not len(xy):
        return xy, np.zeros(0, bool)
    start = (xy if guess is None else guess).copy()
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, xy, start, winSize=_WINDOW, maxLevel=_LEVELS, criteria=_CRITERIA, flags=flags
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        after, before, there, xy.copy(), winSize=_WINDOW, maxLevel=_LEVELS, criteria=_CRITERIA, flags=flags
    )
    height, width = after.shape
    inside = (there >= 0).all(1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    same = np.linalg.norm(back - xy, axis=1) < _BACK_PX
    return there, (found.ravel() == 1) & (returned.ravel() == 1) & same & inside


class KeyFrameChooser:
    """Choose key frames of a video while its frames pass, and find its cuts.

    Attributes
    ----------
    keys : list of int
        Frames chosen so far; the first one is.
    cuts : list of int
        Frames that do not continue the one before.
    steps : list of float
        Motion of the content from each frame to the next, pixels of the flow; NaN over a cut.
    """

    def __init__(self) -> None:
        self.keys: list[int] = []
        self.cuts: list[int] = []
        self.steps: list[float] = []
        self._since: list[tuple[Grey, float, float]] = []  # frames from the last key on: grey, sharpness, moved
        self._number = -1

    def feed(self, grey: Grey) -> None:
        """The next frame."""
        self._number += 1
        sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if not self.keys:
            self._begin(self._number, grey, sharpness)
            return
        self._step(grey, sharpness, counts=True)

    def finish(self) -> None:
        """The last frame is a key frame, too: nothing is known beyond it."""
        if self.keys and self.keys[-1] != self._number:
            self.keys.append(self._number)

    def _begin(self, number: int, grey: Grey, sharpness: float) -> None:
        self.keys.append(number)
        found = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 0.02 * math.hypot(*grey.shape))
        self._corners = np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)
        self._xy, self._alive = self._corners.copy(), np.ones(len(self._corners), bool)
        self._since = [(grey, sharpness, 0.0)]

    def _step(self, grey: Grey, sharpness: float, counts: bool) -> None:
        before, alive = self._since[-1][0], np.flatnonzero(self._alive)
        xy, seen = _followed(before, grey, self._xy[alive])
        if counts:
            moved = np.linalg.norm(xy - self._xy[alive], axis=1)[seen]
            self.steps.append(float(np.median(moved)) if seen.any() else np.nan)
            if len(alive) >= _LEAST_CORNERS and seen.sum() < (1 - _CUT) * len(alive):
                self.cuts.append(self._number)
                if self.keys[-1] != self._number - 1:
                    self.keys.append(self._number - 1)
                self._begin(self._number, grey, sharpness)
                return
        self._xy[alive] = xy
        self._alive[alive[~seen]] = False
        apart = np.linalg.norm(self._xy - self._corners, axis=1)[self._alive]
        moved_by = float(np.median(apart)) / math.hypot(*grey.shape) if self._alive.any() else 1.0
        self._since.append((grey, sharpness, moved_by))
        share = float(self._alive.sum()) / max(len(self._corners), 1)
        if moved_by > _MOVED or share < _SEEN or len(self._since) > _MOST_GAP:
            self._choose()

    def _choose(self) -> None:
        """The sharpest of the frames that moved far enough becomes a key; those behind it are followed again."""
        last = self._since[-1][2]
        candidates = [k for k, each in enumerate(self._since) if k > 0 and each[2] >= _CANDIDATE * last]
        best = max(candidates, key=lambda k: (self._since[k][1], k))
        rest, number = self._since[best + 1 :], self.keys[-1] + best
        self._begin(number, *self._since[best][:2])
        for grey, sharpness, _ in rest:
            self._step(grey, sharpness, counts=False)


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

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    xy: NDArray[np.float64]


def flow_between(
    greys: Sequence[Grey], first_xy: NDArray[np.float64], last_xy: NDArray[np.float64]
) -> tuple[FlowTracks, FlowTracks]:
    """Follow points of two key frames to the other one, through all frames between.

    Each point is looked for by the window around it in its key frame, so that errors do not add up, from where the
    frame before showed it.

    Parameters
    ----------
    greys : sequence of (h, w) uint8 array
        The frames, from the first key to the last, both included.
    first_xy, last_xy : (n, 2), (k, 2) array
        Points of each key.

    Returns
    -------
    forward, backward : FlowTracks
        Frames count from the first key; that of the points themselves is left out.
    """
    last = len(greys) - 1
    return _through(greys, 0, range(1, last + 1), first_xy), _through(greys, last, range(last - 1, -1, -1), last_xy)


def _through(greys: Sequence[Grey], key: int, order: Iterable[int], start: NDArray[np.float64]) -> FlowTracks:
    """Points of a key frame in other frames, in an order in which the content moves on."""
    xy0 = np.asarray(start, np.float32).reshape(-1, 2)
    index, xy = np.arange(len(xy0)), xy0
    found = [(np.zeros(0, np.int64), index[:0], xy[:0])]
    for k in order:
        xy, seen = _followed(greys[key], greys[k], xy0, xy)
        index, xy0, xy = index[seen], xy0[seen], xy[seen]
        found.append((np.full(len(index), k), index, xy))
    frame, point, places = (np.concatenate(each) for each in zip(*found, strict=True))
    return FlowTracks(frame.astype(np.int64), point.astype(np.int64), places.astype(np.float64))
