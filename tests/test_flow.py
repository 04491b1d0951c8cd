"""Optical flow between frames: what is followed, which frames become key frames, and where a video was cut."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from make_photos import texture
from scipy.spatial.transform import Rotation

from rsundistort.sfm.flow import FlowFrame, KeyFrameChooser, _corners, flow_between, flow_size
from rsundistort.sfm.resection import resect

WIDTH, HEIGHT = 320, 240


def frames(shifts_px: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Windows (grey) of one picture, shifted to the right by so much."""
    grey = cv2.GaussianBlur(texture(900, 400, seed, channels=1), (0, 0), 1.5)
    found = []
    for shift in shifts_px:
        M = np.array([[1, 0, shift], [0, 1, 0]], np.float64)
        found.append(cv2.warpAffine(grey, M, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP))
    return found


def as_followed(greys: list[np.ndarray]) -> list[FlowFrame]:
    return [FlowFrame.of(grey) for grey in greys]


def test_points_are_followed_to_a_twentieth_of_a_pixel() -> None:
    shifts = np.array([0.0, 3.3, 7.1, 9.9])
    xy = np.random.default_rng(1).uniform([40, 30], [280, 210], (80, 2))
    forward, backward = flow_between(as_followed(frames(shifts)), xy, xy - [shifts[-1], 0])
    assert len(forward.frame) > 200
    expected = xy[forward.point] - np.column_stack([shifts[forward.frame], np.zeros(len(forward.frame))])
    assert np.median(np.abs(forward.xy - expected)) < 0.05
    expected = xy[backward.point] - np.column_stack([shifts[backward.frame], np.zeros(len(backward.frame))])
    assert np.median(np.abs(backward.xy - expected)) < 0.05
    assert set(forward.frame) == {1, 2, 3}
    assert set(backward.frame) == {0, 1, 2}


def of_all_scales(width: int, height: int) -> np.ndarray:
    """A picture (grey) with things of all sizes in it, as scenes have them."""
    rng, total = np.random.default_rng(2), np.zeros((height, width), np.float32)
    for size in width // np.array([240, 120, 60, 30, 15, 8]):
        small = rng.normal(0, 1, (height // size + 2, width // size + 2)).astype(np.float32)
        total += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 30 * total, 0, 255).astype(np.uint8)


def steps(chooser: KeyFrameChooser) -> np.ndarray:
    """How far corners of each key frame moved to the next, pixels a frame, in the middle."""
    moved = [np.median(np.linalg.norm(each.second_xy - each.first_xy, axis=1)) for each in chooser.flows]
    return np.divide(moved, np.diff([each.keys for each in chooser.flows], axis=1)[:, 0])


@pytest.mark.parametrize(("width", "shift"), [(640, 70), (1920, 210)])
def test_a_fast_pan_is_followed(width: int, shift: int) -> None:
    height = 9 * width // 16
    whole = of_all_scales(width + shift, height)
    first, second = as_followed([np.ascontiguousarray(whole[:, :width]), np.ascontiguousarray(whole[:, shift:])])
    xy = np.random.default_rng(1).uniform([shift + 30, 30], [width - 30, height - 30], (80, 2))
    forward, _ = flow_between([first, second], xy, xy[:0])
    assert (np.linalg.norm(forward.xy - xy[forward.point] + [shift, 0], axis=1) < 0.1).sum() > 70
    chooser = KeyFrameChooser()
    chooser.feed(first)
    chooser.feed(second)
    chooser.finish()
    assert chooser.cuts == []
    assert steps(chooser) == pytest.approx([shift], abs=0.1)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_what_is_covered_is_not_followed(share: float) -> None:
    first, cover = of_all_scales(640, 360), of_all_scales(640, 360)[::-1, ::-1]
    second, edge = np.roll(first, 5, axis=1), round(640 * (1 - share))
    second[:, edge:] = cover[:, edge:]
    xy = np.random.default_rng(1).uniform([30, 30], [610, 330], (400, 2))
    forward, _ = flow_between(as_followed([first, second]), xy, xy[:0])
    right = np.linalg.norm(forward.xy - xy[forward.point] - [5, 0], axis=1) < 0.2
    in_view = (xy[:, 0] + 5 < edge - 15).sum()
    assert right.sum() > 0.97 * in_view
    assert (~right).sum() < 0.1 * (len(xy) - in_view)


def under_lamps(greys: list[np.ndarray]) -> list[np.ndarray]:
    """The same with bands of lamps that flicker, brighter and darker by a quarter, two in each frame."""
    y = np.arange(HEIGHT)[:, None]
    bands = [1 + 0.25 * np.sin(2 * np.pi * (2 * y / HEIGHT + 0.37 * k)) for k in range(len(greys))]
    return [np.clip(0.8 * band * grey, 0, 255).astype(np.uint8) for band, grey in zip(bands, greys, strict=True)]


def test_lamps_that_flicker_are_no_motion_and_no_cut() -> None:
    shifts = 3.3 * np.arange(12)
    seen = as_followed(under_lamps(frames(shifts)))
    chooser = KeyFrameChooser()
    for frame in seen:
        chooser.feed(frame)
    chooser.finish()
    assert chooser.cuts == []
    np.testing.assert_allclose(steps(chooser), 3.3, atol=0.1)
    xy = np.random.default_rng(1).uniform([60, 30], [280, 210], (80, 2))
    forward, _ = flow_between(seen, xy, xy[:0])
    in_steady_light, _ = flow_between(as_followed(frames(shifts)), xy, xy[:0])
    assert len(forward.frame) > 0.95 * len(in_steady_light.frame)
    expected = xy[forward.point] - np.column_stack([shifts[forward.frame], np.zeros(len(forward.frame))])
    assert np.median(np.abs(forward.xy - expected)) < 0.1


def test_noise_in_the_dark_is_no_texture() -> None:
    dark = np.random.default_rng(0).integers(0, 3, (HEIGHT, WIDTH), np.uint8)
    assert FlowFrame.of(dark).grey.std() < 5
    assert FlowFrame.of(np.zeros_like(dark)).grey.max() == 0


def test_what_leaves_the_frame_is_not_followed() -> None:
    forward, _ = flow_between(
        as_followed(frames(np.array([0.0, 12.5, 25.0]))), np.array([[20.0, 120.0], [200.0, 120.0]]), np.zeros((0, 2))
    )
    assert forward.point[forward.frame == 2].tolist() == [1]


def test_what_a_slanted_plane_shows_is_where_it_is() -> None:
    """Ground before a camera that comes nearer: windows that are only shifted are off to one side.

    Their texture is finer, and has more weight, in the farther half.
    """
    K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
    ground = cv2.GaussianBlur(texture(1600, 1200, 5, channels=1), (0, 0), 1.5)

    def frame(ahead: float) -> np.ndarray:
        # metres across and ahead of the ground, 1.2 m below, 80 texels a metre
        to_ground = np.array([[80.0, 0, 800], [0, 80.0, 100], [0, 0, 1]])
        to_pixels = K @ np.array([[1.0, 0, 0], [0, 0, 1.2], [0, 1.0, -ahead]])
        # four samples a pixel
        fine = np.diag([4.0, 4.0, 1.0]) @ [[1, 0, 0.375], [0, 1, 0.375], [0, 0, 1]]
        shown = cv2.warpPerspective(ground, fine @ to_pixels @ np.linalg.inv(to_ground), (1280, 960))
        return FlowFrame.of(cv2.resize(shown, (320, 240), interpolation=cv2.INTER_AREA))

    xs, ys = np.meshgrid(np.arange(40.0, 281, 12), np.arange(170.0, 201, 6))
    xy = np.column_stack([xs.ravel(), ys.ravel()])
    forward, _ = flow_between([frame(float(each)) for each in np.linspace(0.0, 0.4, 5)], xy, xy[:0])
    mine = forward.frame == 4
    found, start = forward.xy[mine], xy[forward.point[mine]]
    depth = 300.0 * 1.2 / (start[:, 1] - 119.5)
    there = (start - [159.5, 119.5]) * (depth / (depth - 0.4))[:, None] + [159.5, 119.5]
    assert mine.sum() > 60
    assert np.abs(np.median(found - there, axis=0)).max() < 0.03


def test_key_frames_follow_the_motion_of_the_picture() -> None:
    chooser = KeyFrameChooser()
    for grey in frames(8.0 * np.arange(20)):
        chooser.feed(FlowFrame.of(grey))
    chooser.finish()
    # 0.06 of a diagonal of 400 pixels
    apart = 8.0 * np.diff(chooser.keys)
    assert chooser.keys[0] == 0
    assert chooser.keys[-1] == 19
    assert (apart <= 32).all()
    assert np.median(apart) >= 16
    assert chooser.cuts == []
    np.testing.assert_allclose(steps(chooser), 8.0, atol=0.1)


def test_corners_of_key_frames_are_found_in_the_next() -> None:
    chooser = KeyFrameChooser()
    for grey in frames(8.0 * np.arange(14)):
        chooser.feed(FlowFrame.of(grey))
    chooser.finish()
    assert [each.keys for each in chooser.flows] == list(pairwise(chooser.keys))
    for each in chooser.flows:
        assert len(each.first_xy) > 20
        moved = 8.0 * (each.keys[1] - each.keys[0])
        assert np.abs(np.median(each.first_xy - each.second_xy - [moved, 0], axis=0)).max() < 0.05


def test_the_sharpest_of_the_candidates_is_taken() -> None:
    greys = frames(7.0 * np.arange(8))
    blurred = [grey if k == 3 else cv2.GaussianBlur(grey, (0, 0), 0.8) for k, grey in enumerate(greys)]
    chooser = KeyFrameChooser()
    for grey in blurred:
        chooser.feed(FlowFrame.of(grey))
    assert chooser.keys[1] == 3


def test_a_cut_begins_anew() -> None:
    chooser = KeyFrameChooser()
    for grey in frames(1.0 * np.arange(5)) + frames(1.0 * np.arange(5), seed=9):
        chooser.feed(FlowFrame.of(grey))
    chooser.finish()
    assert chooser.cuts == [5]
    assert {4, 5} <= {*chooser.keys}


@pytest.mark.parametrize("size", [(640, 360), (1920, 1080), (3840, 2160)])
def test_large_frames_are_shrunk(size: tuple[int, int]) -> None:
    width, height = flow_size(*size)
    assert width * height <= 2.2e6
    assert width / height == pytest.approx(size[0] / size[1], rel=1e-2)
    assert (width, height) == size or width * height > 1.9e6


def test_a_photo_is_placed_from_a_pose_nearby() -> None:
    rng = np.random.default_rng(3)
    points_w = rng.uniform([-3, -2, 4], [3, 2, 9], (200, 3)) + np.array([100.0, 0, 0])
    R_cw, center_w = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([100.3, -0.1, 0.2])
    x_c = (points_w - center_w) @ R_cw.T
    rays = x_c[:, :2] / x_c[:, 2:] + rng.normal(0, 2e-4, (200, 2))
    rays[:40] += rng.uniform(-0.5, 0.5, (40, 2))  # false ones
    guess = Rotation.from_rotvec([0.12, -0.17, 0.05]).as_matrix(), center_w + np.array([0.05, 0.05, -0.05])
    found = resect(rays, points_w, *guess, within=0.01)
    assert found is not None
    assert Rotation.from_matrix(found[0] @ R_cw.T).magnitude() < 1e-3
    np.testing.assert_allclose(found[1], center_w, atol=5e-3)


def test_too_few_points_place_nothing() -> None:
    points_w = np.random.default_rng(4).uniform([-3, -2, 4], [3, 2, 9], (11, 3))
    assert resect(points_w[:, :2] / points_w[:, 2:], points_w, np.eye(3), np.zeros(3), within=0.01) is None


def test_no_thing_in_a_frame_has_most_of_its_corners() -> None:
    """A quarter of the frame is far richer in contrast than the rest."""
    grey = (0.2 * frames(np.zeros(1))[0] + 100).astype(np.uint8)
    rich = np.random.default_rng(0).integers(0, 2, (HEIGHT // 16, WIDTH // 16)) * 255
    grey[: HEIGHT // 2, : WIDTH // 2] = cv2.resize(rich.astype(np.uint8), (WIDTH // 2, HEIGHT // 2), interpolation=0)
    found = _corners(grey)
    inside = (found < [WIDTH / 2, HEIGHT / 2]).all(axis=1)
    assert len(found) > 100
    assert 0.15 < inside.mean() < 0.4
    assert not len(_corners(np.full((HEIGHT, WIDTH), 90, np.uint8)))
