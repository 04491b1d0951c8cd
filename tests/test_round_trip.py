"""There and back, for any camera and motion: properties that hold whatever hypothesis draws.

Cameras see 25 to 65 degrees along their longer side and rotate by up to 0.1 rad per frame. Zero and tiny motions are
drawn on purpose: series and closed forms meet there.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy_reference import Fisheye, lens_of

from rsundistort import (
    Camera,
    RowMotion,
    distort_points,
    largest_shift_px,
    optimal_new_camera,
    project_points,
    rectify,
    undistort_points,
)
from rsundistort.evaluation import psnr
from rsundistort.model import READOUTS
from rsundistort.model.motion import SHUTTER_MODELS
from rsundistort.rectify import INTERPOLATIONS
from rsundistort.synthetic.lens import undistort_to_rays
from rsundistort.synthetic.warp import warp_photo

# each is invertible over the views drawn here, whose corners lie at 1.07 at most
LENSES = {
    "pinhole": [],
    "barrel": [-0.12, 0.03, 0.001, -0.002],
    "pincushion": [0.1, 0.02, -0.002, 0.001, 0.01],
    "rational": [0.1, -0.01, 0.001, -0.002, 0.01, 0.2, 0.02, 0.005],
    "thin prism": [0.1, -0.01, 0.001, -0.002, 0.01, 0.2, 0.02, 0.005, 0.002, -0.001, 0.001, 0.0015],
    "fisheye": Fisheye([0.03, -0.01, 0.004, -0.001]),
}
MODELS = st.sampled_from(list(SHUTTER_MODELS))
FRAME_RAD = 0.1


@st.composite
def cameras(draw, lenses=tuple(LENSES)):
    width, height = draw(st.integers(90, 180)), draw(st.integers(70, 150))
    f = max(width, height) * draw(st.floats(0.8, 2.2))
    K = [
        [f, 0, width * draw(st.floats(0.4, 0.6))],
        [0, f * draw(st.floats(0.95, 1.05)), height * draw(st.floats(0.4, 0.6))],
        [0, 0, 1],
    ]
    dist = LENSES[draw(st.sampled_from(lenses))]
    return Camera(width, height, K, dist, draw(st.sampled_from(list(READOUTS))), lens_of(dist))


def angles(largest):
    return st.one_of(st.just(0.0), st.floats(-largest, largest), st.floats(-1e-7, 1e-7))


def turned_per_frame(camera, rotation):
    """The motion of a rotation vector (3,) in radians per frame, shortened to `FRAME_RAD`."""
    rotation = np.array(rotation)
    return RowMotion(rotation * min(1.0, FRAME_RAD / max(np.linalg.norm(rotation), 1e-300)) / camera.frame_span)


rotations = st.tuples(*[angles(FRAME_RAD)] * 3)
strong = st.tuples(*[st.one_of(st.floats(-0.1, -0.02), st.floats(0.02, 0.1))] * 3)


def pixel_grid(camera, step=8):
    """Pixels (n, 2) all over the photo, its corners among them."""
    u = np.linspace(0, camera.width - 1, camera.width // step)
    v = np.linspace(0, camera.height - 1, camera.height // step)
    return np.dstack(np.meshgrid(u, v)).reshape(-1, 2)


def scene(x, y, seed, wavelength):
    """Brightness 0 to 1 of directions (x, y, 1): waves, in all directions, no shorter than `wavelength`."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for angle, phase, stretch in rng.uniform([0, 0, 1], [np.pi, 2 * np.pi, 3], (6, 3)):
        total += np.sin(2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y) / (wavelength * stretch) + phase)
    return (0.5 + total / 12).astype(np.float32)


@settings(max_examples=60)
@given(cameras(), strong, st.integers(0, 1000))
def test_warped_photo_is_rectified_to_the_scene_itself(camera, rotation, seed):
    motion = turned_per_frame(camera, rotation)
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    wavelength = 16 / camera.K[0, 0]  # 16 pixels
    ray = undistort_to_rays(np.dstack([u, v]), camera)
    taken_still = scene(ray[..., 0], ray[..., 1], seed, wavelength)
    K = camera.K
    expected = scene((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], seed, wavelength)
    raw, raw_mask = warp_photo(taken_still, camera, np.array(motion.phi))

    rectified, mask = rectify(raw, camera, motion)
    known, _ = rectify(raw_mask, camera, motion, interpolation="nearest")  # the warp repeats its border
    valid = cv2.erode(np.minimum(mask, known), np.ones((7, 7), np.uint8), borderValue=0)
    assert (valid > 0).mean() > 0.5
    # floats in 0 to 1; bicubic at 1/32 px, twice, of waves of 16 px: 52 to 64 dB (measured)
    assert psnr(rectified, expected, valid) >= 48
    unturned, _ = rectify(raw, camera)
    assert psnr(unturned, expected, valid) < psnr(rectified, expected, valid) - 6  # there was something to take out
    turned_twice, _ = rectify(raw, camera, RowMotion(-motion.phi))
    assert psnr(turned_twice, expected, valid) < psnr(unturned, expected, valid)


@given(cameras(), rotations, MODELS)
def test_distort_and_undistort_points_are_inverse_to_each_other(camera, rotation, model):
    motion, raw = turned_per_frame(camera, rotation), pixel_grid(camera)
    ideal = undistort_points(raw, camera, motion, model, P=camera.K)
    assert np.isfinite(ideal).all()
    # px; Newton's iterations end at 1e-14 of the focal length, which lens and shutter stretch by less than two
    np.testing.assert_allclose(distort_points(ideal, camera, motion, model, P=camera.K), raw, rtol=0, atol=1e-9)
    seen = distort_points(raw, camera, motion, model, P=camera.K)
    valid = np.isfinite(seen).all(axis=1)
    assert valid.all()
    np.testing.assert_allclose(undistort_points(seen, camera, motion, model, P=camera.K), raw, rtol=0, atol=1e-9)


def without_depth(x, y, phi, readout):
    """What the two-step model does otherwise than the rotation, to first order in phi (n, 2).

    The rotated direction has the depth 1 + t (phi1 y - phi2 x), t the clock; the two-step model does not divide by it.
    """
    axis, sign = READOUTS[readout]
    t = sign * (y if axis == 1 else x)
    return (t * (phi[0] * y - phi[1] * x))[:, None] * np.column_stack([x, y])


@given(cameras(["pinhole"]), rotations, st.sampled_from(["linearized", "two-step"]))
def test_models_differ_from_the_rotation_by_the_square_of_phi(camera, rotation, model):
    motion = turned_per_frame(camera, rotation)
    f, c = np.array([camera.K[0, 0], camera.K[1, 1]]), camera.K[:2, 2]
    x, y = ((pixel_grid(camera) - c) / f).T
    directions = np.column_stack([x, y, np.ones_like(x)])
    exact, valid = project_points(directions, camera, motion)
    other, also_valid = project_points(directions, camera, motion, model)
    assert valid.all()
    assert also_valid.all()
    gap = (other - exact) / f
    if model == "two-step":
        gap -= without_depth(x, y, motion.phi, camera.readout)
    # whatever the angle, from 0 to 0.22 rad a unit; 0.2 and 2.3 measured. Of first order it would be |phi| itself
    factor = {"linearized": 0.4, "two-step": 4.0}[model]
    assert np.abs(gap).max() <= factor * motion.phi @ motion.phi + 1e-13  # rounding


@given(cameras(), rotations, MODELS)
def test_reversed_readout_with_the_negative_motion_is_the_same(camera, rotation, model):
    motion = turned_per_frame(camera, rotation)
    axis, sign = READOUTS[camera.readout]
    reverse = next(name for name, way in READOUTS.items() if way == (axis, -sign))
    other = replace(camera, readout=reverse)
    back, points = RowMotion(-motion.phi), pixel_grid(camera)
    for function in (distort_points, undistort_points):
        np.testing.assert_allclose(
            function(points, camera, motion, model, P=camera.K),
            function(points, other, back, model, P=camera.K),
            rtol=0,
            atol=1e-10,  # px; the compiler may join products and sums otherwise for the other sign
        )
    photo = scene(*np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)), 0, 16)
    for found, expected in zip(rectify(photo, camera, motion, model), rectify(photo, other, back, model), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-2)  # a step of 1/32 px where rounding differs


# what may be done to a stored photo: as it is, rotated by 90, 180, 270 degrees, and the mirror image of each
ORIENTATIONS = {
    f"{'mirrored ' if mirrored else ''}{90 * turns}": np.linalg.matrix_power([[0, -1], [1, 0]], turns)
    @ np.diag([-1 if mirrored else 1, 1])
    for mirrored in (False, True)
    for turns in range(4)
}


@settings(max_examples=60)
@given(cameras(["pinhole", "barrel", "fisheye"]), rotations, MODELS, st.sampled_from(list(ORIENTATIONS)))
def test_rotated_or_mirrored_photo_is_rectified_to_the_rotated_or_mirrored_one(camera, rotation, model, orientation):
    if len(camera.dist) and camera.lens == "pinhole":  # without the tangential part, which would have to be rotated too
        camera = replace(camera, dist=camera.dist * [1, 1, 0, 0])
    turn, motion = ORIENTATIONS[orientation], turned_per_frame(camera, rotation)
    axis, sign = READOUTS[camera.readout]
    size, center = np.array([camera.width, camera.height]), camera.K[:2, 2]
    middle = (size - 1) / 2
    new_size, new_center = np.abs(turn) @ size, turn @ (center - middle) + (np.abs(turn) @ size - 1) / 2
    new_focal = np.abs(turn) @ [camera.K[0, 0], camera.K[1, 1]]
    clock = turn[:, axis] * sign
    readout = next(name for name, (a, s) in READOUTS.items() if clock[a] == s)
    K = [[new_focal[0], 0, new_center[0]], [0, new_focal[1], new_center[1]], [0, 0, 1]]
    other = Camera(*new_size, K, camera.dist, readout, camera.lens)
    # a rotation vector keeps its sense in a mirror only after its sign is changed
    full = np.eye(3)
    full[:2, :2] = turn
    turned = RowMotion(np.linalg.det(full) * full @ motion.phi)

    points = pixel_grid(camera)
    for function in (distort_points, undistort_points):
        found = function((points - middle) @ turn.T + (new_size - 1) / 2, other, turned, model, P=other.K)
        expected = (function(points, camera, motion, model, P=camera.K) - middle) @ turn.T + (new_size - 1) / 2
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)  # px; as in the round trip of points


@given(
    cameras(),
    rotations,
    st.sampled_from(list(INTERPOLATIONS)),
    st.sampled_from([np.uint8, np.uint16, np.float32]),
)
def test_even_grey_stays_even_where_seen_and_is_zero_elsewhere(camera, rotation, interpolation, dtype):
    motion = turned_per_frame(camera, rotation)
    grey = dtype(0.7 if dtype == np.float32 else 0.7 * np.iinfo(dtype).max)
    photo = np.full((camera.height, camera.width), grey)
    rectified, mask = rectify(photo, camera, motion, interpolation=interpolation)
    assert set(np.unique(mask)) <= {0, 255}
    assert (mask > 0).mean() > 0.5
    assert (rectified[mask == 0] == 0).all()
    # taps of a kernel add up to one; bounds of its rounding
    rounding = 1e-6 if dtype == np.float32 else 0
    np.testing.assert_allclose(rectified[mask > 0].astype(float), float(grey), rtol=0, atol=rounding)


@given(cameras(), rotations, st.floats(0, 1))
def test_best_new_camera_leaves_its_rectangle_without_empty_pixels(camera, rotation, alpha):
    motion = turned_per_frame(camera, rotation)
    new_camera, (x, y, w, h) = optimal_new_camera(camera, motion, alpha=alpha)
    _, mask = rectify(np.zeros((camera.height, camera.width), np.uint8), camera, motion, new_camera=new_camera)
    assert (mask[y : y + h, x : x + w] == 255).all()
    if alpha == 0:
        assert (mask == 255).all()


@given(cameras(), rotations)
def test_no_pixel_moves_farther_than_the_largest_shift(camera, rotation):
    motion, raw = turned_per_frame(camera, rotation), pixel_grid(camera, step=3)
    still = distort_points(undistort_points(raw, camera, motion), camera)
    farthest = np.linalg.norm(still - raw, axis=1).max()
    # found on a grid of its own, which has the border in common with this one
    assert largest_shift_px(camera, motion) == pytest.approx(farthest, rel=0.01, abs=1e-9)


@pytest.mark.parametrize("readout", READOUTS)
def test_a_warp_does_not_depend_on_how_many_rows_are_in_memory(monkeypatch, readout):
    camera = Camera(120, 90, [[110, 0, 60], [0, 110, 44], [0, 0, 1]], LENSES["pincushion"], readout)
    photo = np.random.default_rng(3).integers(0, 256, (90, 120, 3), np.uint8)
    motion = RowMotion(np.array([4e-4, -6e-4, 5e-4]))
    at_once = warp_photo(photo, camera, motion)
    monkeypatch.setattr("rsundistort.synthetic.warp._TOGETHER", 7 * 120)
    for some, whole in zip(warp_photo(photo, camera, motion), at_once, strict=True):
        np.testing.assert_array_equal(some, whole)
