"""The eight EXIF orientations: what they do to pixels, cameras, poses and motions.

An orientation o takes the stored frame to the shown one by a signed permutation of the axes, `MATRICES[o]`: a rotation
by a multiple of 90 degrees, after which 2, 4, 5 and 7 mirror. A rotation of the image is a rotation of the camera about
its optical axis. A mirror image is no camera's: photos with a pose are rotated, and what is left of their tag is to
mirror (tag 2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .array_types import Array, Index
from .camera import READOUTS, Camera
from .checks import check_finite
from .path import CameraPath
from .reconstruction import Reconstruction
from .solution import Solution, SolvedImage

__all__ = [
    "INVERSE",
    "MATRICES",
    "compose_orientations",
    "in_stored_frame",
    "orient_camera",
    "orient_image",
    "orient_path",
    "orient_pixels",
    "orient_points",
    "orient_reconstruction",
    "orient_solution",
    "split_mirror",
]

#: Of each EXIF orientation, the (2, 2) matrix that takes x right, y down of the stored frame to those of the shown one.
MATRICES: dict[int, Index] = {
    1: np.array([[1, 0], [0, 1]]),
    2: np.array([[-1, 0], [0, 1]]),
    3: np.array([[-1, 0], [0, -1]]),
    4: np.array([[1, 0], [0, -1]]),
    5: np.array([[0, 1], [1, 0]]),
    6: np.array([[0, -1], [1, 0]]),
    7: np.array([[0, -1], [-1, 0]]),
    8: np.array([[0, 1], [-1, 0]]),
}

#: The orientation that undoes each.
INVERSE: dict[int, int] = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}


def compose_orientations(first: int, then: int) -> int:
    """The orientation that does `first`, then `then`."""
    both = MATRICES[then] @ MATRICES[first]
    return next(o for o, matrix in MATRICES.items() if np.array_equal(matrix, both))


def split_mirror(orientation: int) -> tuple[int, int]:
    """An orientation as a rotation (1, 3, 6 or 8) and what is left after it: 1, or 2 to mirror left and right."""
    if np.linalg.det(MATRICES[orientation]) > 0:
        return orientation, 1
    return compose_orientations(orientation, 2), 2


def _swaps(orientation: int) -> bool:
    return bool(MATRICES[orientation][0, 0] == 0)


def orient_pixels(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """(h, w[, channels]) stored pixels as the orientation shows them; 5 to 8 exchange the sides."""
    if _swaps(orientation):
        pixels = np.swapaxes(pixels, 0, 1)
    across, down = MATRICES[orientation].sum(1)
    return np.ascontiguousarray(pixels[:: int(down), :: int(across)])


def orient_points(xy: ArrayLike, width: int, height: int, orientation: int) -> Array:
    """(n, 2) pixels of a stored photo of that size where the orientation shows them; integer centres in both."""
    xy = check_finite(xy, (None, 2), "xy")
    matrix = MATRICES[orientation]
    last = np.array([width - 1.0, height - 1.0])
    # an axis that is reversed runs from the last pixel
    return xy @ matrix.T + (matrix < 0) @ last


def orient_rectangle(
    rectangle: tuple[int, int, int, int], width: int, height: int, orientation: int
) -> tuple[int, int, int, int]:
    """Pixels (x, y, width, height) of a stored photo of that size where the orientation shows them."""
    x, y, w, h = rectangle
    corners = orient_points([[x, y], [x + w - 1, y + h - 1]], width, height, orientation)
    (left, top), (right, bottom) = corners.min(0), corners.max(0)
    return int(left), int(top), int(right - left) + 1, int(bottom - top) + 1


def orient_camera(camera: Camera, orientation: int) -> Camera:
    """The camera whose photos are those of `camera`, shown by the orientation; exact, also for mirrored ones."""
    matrix, swaps = MATRICES[orientation], _swaps(orientation)
    width, height = (camera.height, camera.width) if swaps else (camera.width, camera.height)
    K = np.eye(3)
    K[[0, 1], [0, 1]] = np.abs(matrix) @ np.diag(camera.K)[:2]
    K[:2, 2] = orient_points(camera.K[None, :2, 2], camera.width, camera.height, orientation)[0]
    clock = camera.clock_sign * matrix[:, camera.clock_axis]
    along = int(np.flatnonzero(clock)[0])
    readout = next(name for name, way in READOUTS.items() if way == (along, float(clock[along])))
    dist = np.array(camera.dist)
    if len(dist) >= 4 and camera.lens == "pinhole":
        # decentering shifts by 2 x (p . x) + p r^2 with p = (p2, p1): p rotates with the axes, and so does a thin prism
        dist[[3, 2]] = matrix @ dist[[3, 2]]
        if len(dist) == 12:
            dist[[8, 10]], dist[[9, 11]] = matrix @ dist[[8, 10]], matrix @ dist[[9, 11]]
    return replace(
        camera, width=width, height=height, K=K, dist=dist, readout=readout, field=_oriented_field(camera, matrix)
    )


def _oriented_field(camera: Camera, matrix: Index) -> Array:
    """The field (rows, cols, 2) of a camera whose axes a signed permutation rotates."""
    field = camera.field @ matrix.T
    if matrix[0, 0] == 0:
        field = field.transpose(1, 0, 2)
    return field[:: int(matrix[1].sum()), :: int(matrix[0].sum())]


def orient_image(image: SolvedImage, orientation: int, camera_id: str) -> SolvedImage:
    """A photo of a solution with the pose and motion of its shown frame; world and velocity stay.

    Raises
    ------
    InputError
        When the photo has a pose and the orientation mirrors.
    """
    matrix = np.eye(3)
    matrix[:2, :2] = MATRICES[orientation]
    hand = float(np.linalg.det(matrix))
    if hand < 0 and image.R_cw is not None:
        raise InputError(f"{image.name} has a pose, and no camera takes its mirror image")
    motion = image.motion
    if motion is not None:
        # phi is an axial vector: a mirror reverses it
        bend = None if motion.bend is None else motion.bend.rotated(hand * matrix)
        motion = replace(motion, phi=hand * matrix @ motion.phi, bend=bend)
    sigma_phi, sigma_rotation = (
        None if sigma is None else np.abs(matrix) @ sigma for sigma in (image.sigma_phi, image.sigma_rotation)
    )
    return replace(
        image,
        camera_id=camera_id,
        R_cw=None if image.R_cw is None else matrix @ image.R_cw,
        motion=motion,
        sigma_phi=sigma_phi,
        sigma_rotation=sigma_rotation,
        applied_orientation=compose_orientations(image.applied_orientation, orientation),
    )


def orient_path(path: CameraPath, orientation: int) -> CameraPath:
    """The path of the camera whose frames the orientation shows; one that mirrors is refused, no camera takes these."""
    matrix = np.eye(3)
    matrix[:2, :2] = MATRICES[orientation]
    return replace(path, R_cw=matrix @ path.R_cw, rate=path.rate @ matrix.T, rate_change=path.rate_change @ matrix.T)


def _new_places(pairs: set[tuple[int, int]], count: int) -> dict[tuple[int, int], int]:
    """Place of each (camera, orientation): the camera's own when it is not rotated, else one after all cameras."""
    others = sorted(pair for pair in pairs if pair[1] != 1)
    return {pair: pair[0] for pair in pairs} | {pair: count + k for k, pair in enumerate(others)}


def orient_solution(solution: Solution, orientations: Mapping[str, int]) -> Solution:
    """A solution of photos that were rotated after they were rectified.

    Parameters
    ----------
    orientations : mapping of photo name to int
        How each was rotated; those left out were not.

    Returns
    -------
    Solution
        Raw and rectified cameras, poses and motions in the frames of the rotated photos. Each camera and orientation
        that occur together get a camera of their own; `SolvedImage.applied_orientation` says how the frame was rotated.

    Raises
    ------
    InputError
        When a photo that has a pose would be mirrored.
    """
    ids = list(solution.cameras)
    pairs = {image.name: (ids.index(image.camera_id), orientations.get(image.name, 1)) for image in solution.images}
    place = _new_places(set(pairs.values()), len(ids))
    numbers = (str(k) for k in range(1, 2 * len(ids) + len(place) + 1))
    ids += [key for key in numbers if key not in solution.cameras][: len(place)]
    cameras, rectified = dict(solution.cameras), dict(solution.rectified_cameras)
    for (old, orientation), new in sorted(place.items(), key=lambda item: item[1]):
        if orientation != 1:
            cameras[ids[new]] = orient_camera(solution.cameras[ids[old]], orientation)
            rectified[ids[new]] = orient_camera(solution.rectified_cameras[ids[old]], orientation)
    images = []
    for image in solution.images:
        old, orientation = pairs[image.name]
        if image.roi is not None:
            target = solution.rectified_cameras[ids[old]]
            image = replace(image, roi=orient_rectangle(image.roi, target.width, target.height, orientation))
        images.append(orient_image(image, orientation, ids[place[old, orientation]]))
    return replace(solution, cameras=cameras, rectified_cameras=rectified, images=tuple(images))


def in_stored_frame(solution: Solution) -> Solution:
    """The solution of the photos as the sensor stored them, of one whose photos may have been rotated.

    Cameras that no photo has are left out.
    """
    stored = orient_solution(solution, {image.name: INVERSE[image.applied_orientation] for image in solution.images})
    used = {image.camera_id for image in stored.images}
    cameras, rectified = (
        {key: camera for key, camera in each.items() if key in used}
        for each in (stored.cameras, stored.rectified_cameras)
    )
    return replace(stored, cameras=cameras, rectified_cameras=rectified)


def orient_reconstruction(reconstruction: Reconstruction, orientations: Mapping[str, int]) -> Reconstruction:
    """A reconstruction from rotated photos: cameras, poses, motions and measurements; the scene stays.

    Parameters
    ----------
    orientations : mapping of photo name to int
        As in `orient_solution`, whose cameras come in the same order. None may mirror.
    """
    rec = reconstruction
    applied = [orientations.get(name, 1) for name in rec.image_names]
    pairs = [(int(k), o) for k, o in zip(rec.camera_idx, applied, strict=True)]
    place = _new_places(set(pairs), len(rec.cameras))
    new = sorted((k, pair) for pair, k in place.items() if pair[1] != 1)
    matrix = np.tile(np.eye(3), (rec.num_images, 1, 1))
    matrix[:, :2, :2] = [MATRICES[o] for o in applied]
    if (np.linalg.det(matrix) < 0).any():
        raise InputError("a reconstruction cannot be mirrored")
    obs = rec.observations
    xy = np.array(obs.xy_raw)
    for i, (orientation, of_photo) in enumerate(zip(applied, obs.by_photo(rec.num_images), strict=True)):
        camera = rec.camera(i)
        xy[of_photo] = orient_points(xy[of_photo], camera.width, camera.height, orientation)
    return replace(
        rec,
        cameras=(*rec.cameras, *(orient_camera(rec.cameras[old], o) for _, (old, o) in new)),
        camera_idx=np.array([place[pair] for pair in pairs], np.int64),
        R_cw=matrix @ rec.R_cw,
        phi=np.einsum("mij,mj->mi", matrix, rec.phi),
        bend=np.concatenate([np.einsum("mij,mnj->mni", matrix, rec.bend[..., :3]), rec.bend[..., 3:]], axis=2),
        variation=np.concatenate(
            [rec.variation[:, :1], np.einsum("mij,mj->mi", matrix[:, :2, :2], rec.variation[:, 1:])], axis=1
        ),
        observations=replace(obs, xy_raw=xy),
    )
