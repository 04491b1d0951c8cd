"""Parts of a reconstruction whose places contradict the matches between them."""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heapify, heappop, heappush

import numpy as np

from ..colmap.conventions import quiet_pycolmap
from ..model import Reconstruction
from ..model.array_types import Index, Mask
from .connected import common_points
from .database import MatchedPhotos
from .epipolar import FreedMatches, matches_that_fit

__all__ = ["contradicting_photos", "parts_that_agree", "share_that_fits"]

Pair = tuple[int, int]
# Evidence of a pair: the number of matches, and how many more of them fit than would have to.
Vote = tuple[int, float]
Votes = list[Vote]

# Of what a free epipolar geometry fits, poses fit about as much in all pairs that are right: all of it where matches
# are good, three quarters where many are false. A pair supports its poses if they fit these shares of what is usual in
# the set: one to take a place away, one to ask for another. (Right pairs of real photos, warped or not, fit 0.78 to
# 1.00 of their matches together, those between a side in a wrong place and the rest 0.41 to 0.72.)
_WRONG, _SUSPECT = 0.7, 0.8
# Fewer matches may fit an epipolar geometry by chance, most of them.
_LEAST_MATCHES = 30
# So many pairs decide on two parts, those with the most matches: they are neighbours. In a scene that repeats itself
# many more pairs only look alike, and contradict poses that are right.
_DECIDING = 3


def share_that_fits(matched: MatchedPhotos, num_verified: Mapping[Pair, int], reconstruction: Reconstruction) -> float:
    """Share of the matches of photos that poses fit, of those that any epipolar geometry does; 1 if there are none.

    Where something large moves, poses may be those relative to it, and the rest of the scene is left out.

    Parameters
    ----------
    matched, num_verified
        As `contradicting_photos` takes them.
    """
    posed, fitting = set(reconstruction.image_names), matches_that_fit(matched, reconstruction)
    shares = [
        (min(len(fitting.get(pair, ())), count), count)
        for pair, count in num_verified.items()
        if count >= _LEAST_MATCHES and posed >= {matched.names[k] for k in pair}
    ]
    of_fitting, of_all = map(sum, zip(*shares, strict=True)) if shares else (1, 1)
    return of_fitting / of_all


def contradicting_photos(
    matched: MatchedPhotos, num_verified: Mapping[Pair, int], reconstruction: Reconstruction, *, suspects: bool = False
) -> Mask:
    """Photos in parts of a reconstruction that more matches with the largest part contradict than support.

    Mapping may give a whole side of a scene a wrong place, in which its photos agree with each other, and some matches
    with the rest fit by chance or because they lie near the axis that it was rotated about. Each photo has its points
    there, so that residuals do not show it; the matches that were left out do.

    Parameters
    ----------
    matched, num_verified
        Photos, and how many matches of each pair one loose epipolar geometry fits (`read_num_verified`, before new
        tracks overwrite it).
    suspects : bool
        Whether photos whose place is less certain to be wrong are among them.

    Returns
    -------
    (m,) bool array
        By photo of the reconstruction.
    """
    m, support = len(matched.names), _support(matched, num_verified, reconstruction, _SUSPECT if suspects else _WRONG)
    part = parts_that_agree(support, m)
    posed = np.isin(matched.names, reconstruction.image_names)
    sizes = np.bincount(part[posed], minlength=m)
    largest = int(np.argmax(sizes))
    with_largest: dict[int, Votes] = {}
    for (first, second), vote in support.items():
        if largest in (part[first], part[second]) and part[first] != part[second]:
            with_largest.setdefault(int(part[second] if part[first] == largest else part[first]), []).append(vote)
    wrong = [other for other, votes in with_largest.items() if _balance(_deciding(votes)) < 0]
    contradicts = dict(zip(matched.names, np.isin(part, wrong), strict=True))
    return np.array([contradicts[name] for name in reconstruction.image_names], bool)


def _support(
    matched: MatchedPhotos, num_verified: Mapping[Pair, int], reconstruction: Reconstruction, share_of_usual: float
) -> dict[Pair, Vote]:
    """Matches of each pair, and how many of them fit its poses, less those that would have to."""
    freed, pairs, fits, counts = FreedMatches(matched, reconstruction), list[Pair](), list[int](), list[int]()
    with quiet_pycolmap().Database.open(matched.database) as db:
        for pair, count in num_verified.items():
            if count < _LEAST_MATCHES or (freed.posed[list(pair)] < 0).any():
                continue
            matches = np.asarray(db.read_matches(pair[0] + 1, pair[1] + 1), np.int64).reshape(-1, 2)
            # a database of another program may hold what was verified alone
            if len(matches) >= count:
                pairs.append(pair)
                counts.append(count)
                fits.append(int(freed.explained(*pair, matches).sum()))
    if not pairs:
        return {}
    fit, of = np.array(fits, float), np.array(counts)
    order = np.argsort(fit / of)
    # of the matches that fit: pairs of wrong places have few of them, however many pairs they are
    half = order[np.searchsorted(np.cumsum(fit[order]), fit.sum() / 2)]
    least = share_of_usual * fit[half] / of[half]
    # where textures repeat themselves, many verified matches of right pairs are false; their common points are not
    first, second = freed.posed[np.array(pairs)].T
    fit = np.maximum(fit, np.minimum(common_points(reconstruction)[first, second], of))
    return dict(zip(pairs, zip(counts, (fit - least * of).tolist(), strict=True), strict=True))


def parts_that_agree(support: Mapping[Pair, Vote], num: int) -> Index:
    """Partition of so many photos into parts within which pairs support each other, (num,) label of each.

    Parts are joined in the order of the support between them, and pairs that contradict count against it: greedy
    additive edge contraction (Keuper et al., ICCV 2015), in which the pairs with the most matches decide.

    Parameters
    ----------
    support : mapping of pair to (int, float)
        Number of matches of each pair, and how many more of them fit than would have to.
    num : int
        Photos.
    """
    between: list[dict[int, Votes]] = [{} for _ in range(num)]
    for (first, second), vote in support.items():
        between[first][second] = between[second][first] = [vote]
    heap = [(-weight, *pair) for pair, (_, weight) in support.items() if weight > 0]
    heapify(heap)
    label = np.arange(num)
    while heap:
        weight, kept, gone = heappop(heap)
        if _balance(between[kept].get(gone, [])) != -weight:
            continue  # one of them has been joined with another part since
        del between[kept][gone], between[gone][kept]
        label[label == gone] = kept
        shared, between[gone] = between[gone], {}
        for other, more in shared.items():
            del between[other][gone]
            decide = _deciding([*between[kept].get(other, []), *more])
            between[kept][other] = between[other][kept] = decide
            if (total := _balance(decide)) > 0:
                heappush(heap, (-total, kept, other))
    return label


def _deciding(votes: Votes) -> Votes:
    """Those of the pairs with the most matches."""
    return sorted(votes, reverse=True)[:_DECIDING]


def _balance(votes: Votes) -> float:
    return sum(weight for _, weight in votes)
