"""A camera that only rotates, among things that move otherwise, and over cuts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sift_like import sift_like

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.input.photo_cameras import GUESS_SIGMA
from rsundistort.model.projection import unproject_points
from rsundistort.sfm.features import Features
from rsundistort.solve.clip_pan import _LEFT_PX, _beyond_rotation, _with_likeliest_lens, lens_shows_px, seen_again

F = 500.0
CAMERA = Camera(640, 360, [[F, 0, 320], [0, F, 180], [0, 0, 1]])
NOISE_PX = 0.15


def pixels(rays: NDArray[np.float64], turned: NDArray[np.float64], phi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of directions in a frame that is rotated by `turned`, and by `phi` from the first line to the last."""
    y = np.zeros(len(rays))
    for _ in range(30):  # the line that shows a point is that of its own image
        x = np.einsum("nab,nb->na", Rotation.from_rotvec(turned + y[:, None] * phi * F / 360).as_matrix(), rays)
        y = x[:, 1] / x[:, 2]
    return F * x[:, :2] / x[:, 2:] + [320, 180]


def two_frames(
    rng: np.random.Generator, share: float, num: int = 150
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of a scene in two frames of a hand that pans, and of things that move across them (a share)."""
    xy = rng.uniform([0, 0], [640, 360], (num, 2))
    rays = np.column_stack([(xy - [320, 180]) / F, np.ones(num)])
    phi = [rng.normal(0, 0.015, 3) for _ in range(2)]
    first = pixels(rays, np.zeros(3), phi[0])
    second = pixels(rays, rng.normal(0, 0.03, 3) + np.array([0, 0.07, 0]), phi[1])
    moves = rng.random(num) < share
    step = np.array([[12.0, 1.0], [-25.0, 0.0], [40.0, -2.0]])[rng.integers(3, size=num)]
    second[moves] = (first + step)[moves]
    return first + rng.normal(0, NOISE_PX, (num, 2)), second + rng.normal(0, NOISE_PX, (num, 2))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.35])
@pytest.mark.parametrize("seed", range(6))
def test_rotations_of_lines_explain_a_pan_among_things_that_move(seed: int, share: float) -> None:
    first, second = two_frames(np.random.default_rng(seed), share)
    assert F * _beyond_rotation(first, second, CAMERA) < _LEFT_PX


@pytest.mark.parametrize("seed", range(6))
def test_a_camera_that_travels_does_more_than_rotate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, depth = rng.uniform([0, 0], [640, 360], (150, 2)), rng.uniform(3, 12, 150)
    points = np.column_stack([(xy - [320, 180]) / F, np.ones(150)]) * depth[:, None]
    moved = points - [0.15, 0.01, 0.02]
    second = F * moved[:, :2] / moved[:, 2:] + [320, 180]
    assert F * _beyond_rotation(xy, second, CAMERA) > 1.0


def seen(xy: NDArray[np.float64], descriptors: NDArray[np.uint8]) -> Features:
    return Features(xy, np.ones(len(xy)), descriptors)


def test_a_frame_after_a_cut_is_rotated_by_the_features_that_it_shows_again() -> None:
    rng = np.random.default_rng(1)
    looks = sift_like(rng.uniform(0, 200, (120, 128)))
    xy = rng.uniform([0, 0], [640, 360], (120, 2))
    rays = np.column_stack([(xy - [320, 180]) / F, np.ones(120)])
    turned = np.array([0.02, -0.15, 0.01])
    before, again = seen(xy, looks), pixels(rays, turned, np.zeros(3))
    order, new = rng.permutation(120)[:70], sift_like(rng.uniform(0, 200, (50, 128)))
    after = seen(
        np.concatenate([again[order], rng.uniform([0, 0], [640, 360], (50, 2))]), np.concatenate([looks[order], new])
    )
    chosen = np.arange(0, 120, 2)
    found = seen_again(before, chosen, after, CAMERA)
    assert found is not None
    rotation, place, pixel = found
    assert Rotation.from_matrix(rotation @ Rotation.from_rotvec(turned).as_matrix().T).magnitude() < 1e-6
    assert {*place.tolist()} == {*np.flatnonzero(np.isin(chosen, order)).tolist()}
    np.testing.assert_allclose(pixel, again[chosen[place]], atol=1e-9)
    # another scene shows none of them
    other = replace(after, descriptors=sift_like(rng.uniform(0, 200, (120, 128))))
    assert seen_again(before, chosen, other, CAMERA) is None


@pytest.mark.parametrize("guess", [300.0, 480.0, 700.0])
def test_a_pan_says_the_focal_length_that_nobody_knows(guess: float) -> None:
    corners = [two_frames(np.random.default_rng(seed), 0.1) for seed in range(12)]
    found = _with_likeliest_lens(corners, Camera(640, 360, [[guess, 0, 320], [0, guess, 180], [0, 0, 1]]))
    assert abs(found.K[0, 0] / F - 1.0) < 0.04
    assert found.K[0, 0] == found.K[1, 1]
    np.testing.assert_array_equal(found.K[:2, 2], [320, 180])


def test_corners_that_say_nothing_of_a_focal_length_leave_the_guess() -> None:
    nothing = np.zeros((3, 2)), np.zeros((3, 2))
    assert _with_likeliest_lens([nothing], CAMERA) == CAMERA
    xy = np.random.default_rng(0).uniform([0, 0], [640, 360], (150, 2))
    slides_by = xy, xy + np.array([40.0, 3.0])
    # if its lens is known; some wide one would show a pan so
    known = replace(CAMERA, dist=[-0.01, 0.0, 0.0, 0.0])
    assert _with_likeliest_lens([slides_by], known) == known


def test_a_pan_by_a_lens_that_nobody_knows_is_one() -> None:
    # an action camera's: whatever the focal length, without it rotations leave more than a pixel
    wide = replace(CAMERA, K=[[400.0, 0, 320], [0, 400.0, 180], [0, 0, 1]], dist=[-0.3, 0.1, 0.0, 0.0])
    corners = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        xy = rng.uniform([0, 0], [640, 360], (250, 2))
        rays = np.column_stack([unproject_points(xy, wide, RowMotion(), "global")[0], np.ones(250)])
        turned = rays @ Rotation.from_rotvec([0.01, 0.1, -0.01]).as_matrix().T
        after, valid = project_points(turned, wide, RowMotion(), "global")
        corners.append(tuple(each[valid] + rng.normal(0, 0.05, (valid.sum(), 2)) for each in (xy, after)))
    guess = Camera(640, 360, [[550.0, 0, 320], [0, 550.0, 180], [0, 0, 1]])
    found = _with_likeliest_lens(corners, guess)
    assert found.dist[0] < -0.15
    left = [550.0 * np.median([_beyond_rotation(*each, lens) for each in corners]) for lens in (guess, found)]
    assert left[0] > 2 * _LEFT_PX
    assert left[1] < _LEFT_PX
    # a lens that is known is not made another
    known = replace(guess, dist=[-0.05, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(_with_likeliest_lens(corners, known).dist, known.dist)


@pytest.mark.parametrize(
    ("size_deg", "least", "most"), [(0.0, 0.0, 1e-9), (0.02, 1e-4, 0.05), (1.0, 0.5, 5.0), (40.0, 2.0, 100.0)]
)
def test_frames_that_hardly_rotate_show_no_lens(size_deg: float, least: float, most: float) -> None:
    rng = np.random.default_rng(2)
    turned = Rotation.from_rotvec(np.radians(size_deg) * rng.uniform(-1, 1, (20, 3))).as_matrix()
    frames = Reconstruction(
        [CAMERA], [str(k) for k in range(20)], np.zeros(20, int), turned, np.zeros((20, 3)), np.zeros((0, 3)),
        Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))),
    )  # fmt: skip
    assert least <= lens_shows_px(frames, {**GUESS_SIGMA, "f": 0.28}) <= most
    # a lens that is known to be this one is no other
    assert lens_shows_px(frames, {"f": 1e-9}) < 1e-5
