"""Photos beside a break of the scale: what three photos show, and two of them do not."""

from __future__ import annotations

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Mask
from .connected import LEAST_TIES, common_points, connected_parts
from .database import MatchedPhotos
from .epipolar import MIN_EXPLAINED, FreedMatches, read_matches
from .registration import points_of_keypoints

__all__ = ["photos_beside_breaks"]

# A break needs so many points that a photo should show by its matches, of which it shows fewer than this share. (Right
# photos of real and rendered sets show 0.85 to 0.98 with new tracks, 0.5 to 0.8 while poses are rough; those beside a
# break from 0.9 to 0.3 of the scale 0 to 0.5.)
_LEAST_DUE, _LEAST_SHOWN = 10, 0.5
# So many points for each photo are as good as all, and take less memory.
_POINTS, _POINTS_OF_PHOTO = 20_000, 200


def photos_beside_breaks(matched: MatchedPhotos, reconstruction: Reconstruction) -> Mask:
    """Photos in parts of a reconstruction that have another scale than the largest one, as their matches say.

    What two photos show of each other says nothing of the distance between them: all matches fit, whatever the scale.
    The third photo does. Where the scale breaks, keypoints match photos on both sides and fit the poses of each pair,
    but are in two points, one of each side, since no point fits all three. So a set of photos grows from a pair: a
    photo is added if it shows at least half of the points of the set that it should, since it matches two of its
    photos there.

    Parameters
    ----------
    reconstruction : Reconstruction
        Poses, motions, and points whose measurements are keypoints of `matched`.

    Returns
    -------
    (m,) bool array
        By photo of the reconstruction. Parts that have no such points at all are not among them.
    """
    due = _Due(matched, reconstruction)
    common = common_points(reconstruction)
    np.fill_diagonal(common, 0.0)
    left, sets = np.ones(reconstruction.num_images, bool), list[tuple[Mask, Mask]]()
    while left.any():
        first = int(np.argmax(np.where(left, common.max(1), -1.0)))
        start = np.arange(len(left)) == first
        connected, contradicted = start, np.zeros_like(start)
        if common[first].max() >= LEAST_TIES:
            connected, contradicted = due.grown(start | (np.arange(len(left)) == np.argmax(common[first])))
        sets.append((connected, contradicted))
        left = left & ~(connected | start)
    largest, wrong = max(sets, key=lambda each: int(each[0].sum()), default=(left, left))
    for connected, contradicted in sets:
        # the points at a break may be those of one side alone
        if (contradicted & largest).any():
            wrong = wrong | connected
    rest, found = ~largest, np.zeros(len(left), bool)
    part = connected_parts(reconstruction.take_photos(rest))
    found[rest] = np.isin(part, part[wrong[rest]])
    return found


class _Due:
    """The points that photos should show, since they match photos that show them."""

    def __init__(self, matched: MatchedPhotos, rec: Reconstruction) -> None:
        m, n = rec.num_images, rec.num_points
        self._num_images, self._num_points = m, n
        every = max(1, n // max(_POINTS, _POINTS_OF_PHOTO * m))
        freed, point_of = FreedMatches(matched, rec), points_of_keypoints(matched, rec)
        rows = [np.zeros((0, 3), np.int64)]
        for pair, matches in read_matches(matched).items():
            i, j = freed.posed[list(pair)].tolist()
            if i < 0 or j < 0:
                continue
            explained = matches[freed.explained(*pair, matches)]
            if len(explained) < MIN_EXPLAINED:
                continue
            for photo, keypoint, other in ((pair[0], explained[:, 0], j), (pair[1], explained[:, 1], i)):
                point = point_of[photo][keypoint]
                point = point[(point >= 0) & (point % every == 0)]
                rows.append(np.column_stack([np.broadcast_to([freed.posed[photo], other], (len(point), 2)), point]))
        shower, photo, point = np.concatenate(rows).T
        # what is due of which photo, and by which others
        pairs, self._due = np.unique(photo * n + point, return_inverse=True)
        self._photo, self._point = pairs // max(n, 1), pairs % max(n, 1)
        order = np.argsort(shower, kind="stable")
        self._due, self._shower = self._due[order], np.searchsorted(shower[order], np.arange(m + 1))
        obs = rec.observations
        self._points_of = [obs.point_idx[mine] for mine in obs.by_photo(m)]
        self._shown = np.isin(pairs, obs.frame_idx * n + obs.point_idx)

    def grown(self, start: Mask) -> tuple[Mask, Mask]:
        """(m,) a set of photos that grew from a pair, and (m,) those whose matches contradict their place in it."""
        connected, new = start, start
        showers, known = np.zeros(len(self._photo), np.int64), np.zeros(self._num_points, np.int64)
        while True:
            for i in np.flatnonzero(new).tolist():
                np.add.at(showers, self._due[self._shower[i] : self._shower[i + 1]], 1)
                known[self._points_of[i]] += 1
            due = (showers >= 2) & (known >= 2)[self._point]
            num_due = np.bincount(self._photo[due], minlength=self._num_images)
            num_shown = np.bincount(self._photo[due & self._shown], minlength=self._num_images)
            agrees = num_shown >= _LEAST_SHOWN * num_due
            new = ~connected & agrees & (num_shown >= LEAST_TIES)
            # those that are nearest first: what others say of the rest counts, too, before that is added
            new &= 2 * num_shown >= np.where(new, num_shown, 0).max()
            if not new.any():
                # one that came in by what the first few said may contradict what more of them say
                contradicted = ~agrees & (num_due >= _LEAST_DUE)
                return connected & ~contradicted, contradicted
            connected = connected | new
