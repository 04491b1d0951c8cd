"""Camera paths of two reconstructions of photos taken in motion, against the same photos taken still."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..evaluation import align_points, pose_errors
from ..model import Solution
from ..model.array_types import Array

__all__ = ["PathComparison", "compare_paths"]


@dataclass(frozen=True)
class PathComparison:
    """Camera poses of the photos taken in motion, beside those of the same photos taken still.

    Lengths are in baselines: the mean distance of consecutive centres of the still photos compared.

    Attributes
    ----------
    names : tuple of str
        Photos that have a pose in all three reconstructions, sorted.
    still_w : (m, 3) array
        Centres of the photos taken still, in the world frame of their reconstruction.
    R_cw : (m, 3, 3) array
        Their orientations, world to camera.
    centers_w : mapping of "with" and "without" to (m, 3) array
        Centres with and without the shutter model, after the similarity that takes them nearest to `still_w`.
    position : mapping of "with" and "without" to (m,) array
        Distances from `still_w`.
    rotation_deg : mapping of "with" and "without" to (m,) array
        Angles left after the common rotation that best aligns all orientations, degrees.
    """

    names: tuple[str, ...]
    still_w: Array
    R_cw: Array
    centers_w: Mapping[str, Array]
    position: Mapping[str, Array]
    rotation_deg: Mapping[str, Array]


def compare_paths(still: Solution, with_model: Solution, without: Solution) -> PathComparison:
    """Errors of two reconstructions of photos taken in motion, on the photos that both share with the still one.

    Parameters
    ----------
    still : Solution
        Of the photos taken without motion: what the others are measured against.
    with_model, without : Solution
        Of the photos taken in motion, with and without a shutter model. Photos are matched by name.

    Raises
    ------
    InputError
        When fewer than three photos have a pose in all three, or the still ones were taken from one place.
    """
    posed = [{image.name for image in solution.images if image.posed} for solution in (still, with_model, without)]
    names = sorted(posed[0] & posed[1] & posed[2])
    if len(names) < 3:
        raise InputError(
            f"{len(names)} photos were registered in all three reconstructions, expected at least three "
            f"({len(posed[0])} still, {len(posed[1])} swung, {len(posed[2])} swung without a shutter model)"
        )

    def only(solution: Solution) -> Solution:
        """The solution of the photos compared alone, in their order."""
        return replace(solution, images=tuple(solution.image(name) for name in names))

    truth = only(still)
    centers, R_cw = _centers(truth), np.array([image.R_cw for image in truth.images])
    baseline = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).mean())
    # normalized reconstructions have baselines around 1; below this nothing but rounding is left
    if not baseline > 1e-12:
        raise InputError("the photos taken still were all taken from one place; they show no path")
    still_w = centers / baseline
    centers_w, position, rotation = {}, {}, {}
    for key, solution in (("with", only(with_model)), ("without", only(without))):
        found = _centers(solution)
        scale, A, shift = align_points(found, still_w)
        centers_w[key] = scale * found @ A.T + shift
        # orientations are aligned by themselves: of a walk along a straight line, the similarity of the centres leaves
        # the rotation about that line open
        errors = pose_errors(solution, truth)
        position[key], rotation[key] = errors.center, errors.rotation_deg
    return PathComparison(tuple(names), still_w, R_cw, centers_w, position, rotation)


def _centers(solution: Solution) -> Array:
    return np.array([image.center_w for image in solution.images])
