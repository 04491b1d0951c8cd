"""What rectified photos show and how large they are: against OpenCV, masks, and sixteen samples a pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy_reference import DIRECTIONS

from rsundistort import Camera, DepthMap, Plane, RowMotion, Solution, SolvedImage, optimal_new_camera, rectify
from rsundistort import undistort_points as undistort
from rsundistort.batch.views import with_view
from rsundistort.errors import InputError
from rsundistort.model.orientation import in_stored_frame, orient_pixels, orient_solution
from rsundistort.rectify import ViewOptions, init_rectify_map, rectified_roi, rectified_view, steadiest_pinhole
from rsundistort.rectify.maps import EDGE_PX

W, H = 320, 240
K = np.array([[260.0, 0, 158.3], [0, 255, 121.6], [0, 0, 1]])
LENS = [-0.12, 0.03, 0.001, -0.002]
STRONG = np.array([0.7, -0.5, 0.6]) / np.linalg.norm([0.7, -0.5, 0.6]) * 0.2
MOTIONS = [RowMotion(STRONG), RowMotion(-STRONG), RowMotion([0.02, 0.1, -0.05])]


def make_camera(dist=LENS, readout="top-to-bottom"):
    return Camera(W, H, K, dist, readout)


def mask_of(camera, motion, new_camera):
    return rectify(np.zeros((H, W), np.uint8), camera, motion, new_camera=new_camera, interpolation="nearest")[1]


@pytest.mark.parametrize("readout", DIRECTIONS)
def test_one_camera_does_for_all_photos(readout):
    camera = make_camera(readout=readout)
    new, roi = optimal_new_camera(camera, MOTIONS, alpha=0.0)
    assert roi == (0, 0, W, H)
    for motion in MOTIONS:
        assert (mask_of(camera, motion, new) == 255).all()
    alone = [optimal_new_camera(camera, motion, alpha=0.0)[0].K[0, 0] for motion in MOTIONS]
    assert new.K[0, 0] >= max(alone)
    new, (x, y, w, h) = optimal_new_camera(camera, MOTIONS, alpha=1.0)
    raw = np.dstack(np.meshgrid(np.arange(W), np.arange(H))).reshape(-1, 2).astype(float)
    for motion in MOTIONS:
        kept = undistort(raw, camera, motion, P=new.K)
        assert kept.min() >= -1e-9  # px; rounding
        assert (kept.max(0) <= np.array([W - 1, H - 1]) + 1e-9).all()
        assert (mask_of(camera, motion, new)[y : y + h, x : x + w] == 255).all()


def moved_px(camera, before, new_camera):
    """How far pixels of the rectified photo lie from where those of the camera before were: root mean square."""
    raw = np.dstack(np.meshgrid(np.arange(0, W, 4), np.arange(0, H, 4))).reshape(-1, 2).astype(float)
    now, then = undistort(raw, camera, P=new_camera.K), undistort(raw, before, P=before.K)
    shown = ((then >= 0) & (then <= [W - 1, H - 1])).all(1)
    return float(np.sqrt(((now - then)[shown] ** 2).sum(1).mean()))


@pytest.mark.parametrize("dist", [[], LENS], ids=["no lens", "lens"])
def test_a_camera_that_is_confirmed_keeps_its_view(dist):
    camera = make_camera(dist)
    np.testing.assert_allclose(steadiest_pinhole(camera, camera).K, K, atol=1e-9)


def test_another_focal_length_without_a_lens_zooms_nothing():
    found = Camera(W, H, K * [[1.03], [1.03], [1.0]] + [[0, 0, -2.0], [0, 0, 1.0], [0, 0, 0]])
    np.testing.assert_allclose(steadiest_pinhole(found, make_camera([])).K, found.K, atol=1e-9)


@pytest.mark.parametrize("dist", [[-0.01, 0.02, 0, 0], [0.02, -0.01, 0.0005, 0]], ids=["barrel", "pincushion"])
def test_a_lens_that_is_found_moves_the_picture_little_and_leaves_no_wider_border_empty(dist):
    before, found = make_camera([]), make_camera(dist)
    new = steadiest_pinhole(found, before)
    assert moved_px(found, before, new) < 0.8 * moved_px(found, before, found.pinhole())
    assert new.K[0, 0] / new.K[1, 1] == pytest.approx(K[0, 0] / K[1, 1])
    # but for the pixels of the border itself
    empty, empty_before = (mask_of(found, RowMotion(), each)[1:-1, 1:-1] == 0 for each in (new, found.pinhole()))
    assert empty.sum() <= empty_before.sum()


def test_a_wide_lens_that_was_not_known_leaves_no_border_empty():
    found = make_camera([-0.3, 0.08, 0, 0])
    new = steadiest_pinhole(found, make_camera([]))
    assert 0.9 * K[0, 0] < new.K[0, 0] < K[0, 0]
    assert (mask_of(found, RowMotion(), new)[1:-1, 1:-1] == 255).all()


def test_a_fisheye_keeps_its_middle():
    fisheye = Camera(
        W, H, K * [[0.45], [0.45], [1.0]] + [[0, 0, 87.0], [0, 0, 66.9], [0, 0, 0]], [0.02, 0, 0, 0], lens="fisheye"
    )
    nearly = Camera(W, H, fisheye.K, [0.0205, 0, 0, 0], lens="fisheye")
    assert steadiest_pinhole(nearly, fisheye).K[0, 0] == pytest.approx(fisheye.K[0, 0], rel=2e-3)


@pytest.mark.parametrize("dist", [[-0.12, 0.03, 0, 0], [0.1, 0.02, 0.002, -0.001], [-0.2, 0.05, 0, 0, 0.01]])
def test_without_motion_the_view_is_opencvs(dist):
    K = np.array([[260.0, 0, 158.3], [0, 260.0, 121.6], [0, 0, 1]])
    camera = Camera(W, H, K, dist)
    for alpha, tighter in ((0.0, max), (1.0, min)):
        expected, _ = cv2.getOptimalNewCameraMatrix(K, np.array(dist), (W, H), alpha)
        new, _ = optimal_new_camera(camera, alpha=alpha)
        # OpenCV zooms each axis on its own, ours keep square pixels square; its border has 9 points a side
        assert new.K[0, 0] == pytest.approx(tighter(expected[0, 0], expected[1, 1]), rel=3e-3)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("dist", [[], LENS], ids=["pinhole", "lens"])
def test_roi_has_no_empty_pixel_and_touches_the_border(dist, motion):
    camera = make_camera(dist)
    wide = Camera(400, 300, [[220, 0, 200], [0, 220, 150], [0, 0, 1]])
    x, y, w, h = rectified_roi(camera, motion, "rotation", wide)
    mask = mask_of(camera, motion, wide)
    assert (mask[y : y + h, x : x + w] == 255).all()
    for grown in (mask[y - 1, :], mask[y + h, :], mask[:, x - 1], mask[:, x + w]):
        assert (grown == 0).any()
    assert w * h > 0.3 * (mask > 0).sum()


def test_photos_that_show_nothing_of_a_view_have_no_roi():
    aside = Camera(100, 100, [[260, 0, -900], [0, 255, 50], [0, 0, 1]])
    assert rectified_roi(make_camera(), MOTIONS[0], "rotation", aside) is None
    behind = Camera(W, H, K, [0.0] * 4, lens="fisheye")
    wide = Camera(W, H, np.array([[90.0, 0, 158], [0, 90, 121], [0, 0, 1]]), [0.0] * 4, lens="fisheye")
    assert rectified_roi(behind, None, "rotation", behind.pinhole()) is not None
    assert rectified_roi(wide, None, "rotation", wide.pinhole()) is None  # its corners lie beyond 90 degrees


@pytest.mark.parametrize(("scale", "size"), [(0.5, (160, 120)), (0.333, (106, 79)), (2.0, (640, 480))])
def test_scale_keeps_the_corner(scale, size):
    camera = make_camera([])
    new = rectified_view(camera, MOTIONS, "rotation", ViewOptions(scale=scale), camera.pinhole())
    assert (new.width, new.height) == size
    np.testing.assert_allclose(np.diag(new.K)[:2], scale * np.diag(K)[:2])
    # a ray at (-0.5, -0.5) of the one lies there in the other
    corner = np.linalg.inv(K) @ [-0.5, -0.5, 1]
    np.testing.assert_allclose((new.K @ corner)[:2], -0.5, atol=1e-9)


def test_size_and_alpha_together():
    camera = make_camera()
    view = ViewOptions(alpha=0.0, scale=0.9, max_size=100)
    new = rectified_view(camera, MOTIONS, "rotation", view, camera.pinhole())
    assert (new.width, new.height) == (100, 75)
    for motion in MOTIONS:
        assert (mask_of(camera, motion, new) == 255).all()
    assert rectified_view(camera, MOTIONS, "rotation", ViewOptions(max_size=5000), camera.pinhole()) == camera.pinhole()
    own = Camera(50, 40, [[50, 0, 25], [0, 50, 20], [0, 0, 1]])
    assert rectified_view(camera, MOTIONS, "rotation", ViewOptions(), own) == own
    assert rectified_view(camera, MOTIONS, "rotation", ViewOptions("keep"), own) == camera.pinhole()
    with pytest.raises(InputError, match="leaves 1x1 pixels"):
        rectified_view(camera, MOTIONS, "rotation", ViewOptions(scale=0.005), camera.pinhole())


@pytest.mark.parametrize(
    "wrong",
    [{"alpha": 1.5}, {"alpha": "all"}, {"alpha": float("nan")}, {"scale": 0.0}, {"scale": np.inf}, {"max_size": 1}],
)
def test_impossible_views_are_refused(wrong):
    with pytest.raises(InputError, match=f"{next(iter(wrong))}=.*expected"):
        ViewOptions(**wrong)


@pytest.mark.parametrize("scale", [0.7, 0.5, 0.3, 0.125])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32], ids=["uint8", "float32"])
def test_what_shrinks_is_averaged_over_the_area_of_a_pixel(dtype, scale, rng):
    camera, motion = make_camera(), MOTIONS[0]
    noise = cv2.GaussianBlur(rng.normal(size=(H, W)), (0, 0), 0.7)  # detail to the limit of the pixels
    unit = (noise - noise.min()) / np.ptp(noise)
    photo = (unit * (255 if dtype == np.uint8 else 1)).astype(dtype)
    new = rectified_view(camera, [motion], "rotation", ViewOptions(scale=scale), camera.pinhole())
    found, mask = rectify(photo, camera, motion, new_camera=new, jobs=2)
    # 16 x 16 points a pixel, by hand
    finer = np.array([[1, 0, 0.5 / 16 - 0.5], [0, 1, 0.5 / 16 - 0.5], [0, 0, 1]]) @ np.diag([1 / 16, 1 / 16, 1])
    finer[:2, 2] = 0.5 / 16 - 0.5
    fine_K = np.linalg.inv(finer) @ new.K
    fine = init_rectify_map(camera, motion, new_K=fine_K, size=(16 * new.width, 16 * new.height))
    sampled = cv2.remap(photo.astype(np.float32), *fine, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    exact = sampled.reshape(new.height, 16, new.width, 16).mean((1, 3))
    x, y = init_rectify_map(camera, motion, new_K=new.K, size=(new.width, new.height))
    seen = (x >= -EDGE_PX) & (x <= W - 1 + EDGE_PX) & (y >= -EDGE_PX) & (y <= H - 1 + EDGE_PX)
    np.testing.assert_array_equal(mask > 0, seen)  # by the pixel's centre, as of photos that keep their size
    single = cv2.remap(photo.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def psnr(image):
        return 10 * np.log10(np.ptp(exact) ** 2 / np.mean((image - exact)[seen] ** 2))

    # measured 41 to 52 dB; single samples 7 to 33
    assert psnr(found) > 33
    assert psnr(found) > psnr(single) + 6


def test_labels_are_not_averaged(rng):
    camera = make_camera()
    labels = rng.choice(np.array([3, 90, 200], np.uint8), (H, W))
    new = rectified_view(camera, MOTIONS, "rotation", ViewOptions(scale=0.3), camera.pinhole())
    found, mask = rectify(labels, camera, MOTIONS[0], new_camera=new, interpolation="nearest")
    assert set(np.unique(found[mask > 0])) == {3, 90, 200}


def test_depth_shrinks_with_the_photo(rng):
    camera = make_camera()
    motion = RowMotion([0.05, 0.02, -0.03], [0.4, 0.1, 0.2])
    photo = cv2.GaussianBlur(rng.normal(size=(H, W)).astype(np.float32), (0, 0), 1.0)
    new = rectified_view(camera, [motion], "constant-motion", ViewOptions(scale=0.5), camera.pinhole())
    depths = Plane([0, 0, 1], 5.0), DepthMap(np.full((new.height, new.width), 5.0, np.float32))
    by_plane, by_map = (
        rectify(photo, camera, motion, "constant-motion", new_camera=new, depth=each)[0] for each in depths
    )
    np.testing.assert_allclose(by_map, by_plane, rtol=0, atol=1e-3 * np.ptp(photo))
    far, _ = rectify(photo, camera, motion, "constant-motion", new_camera=new)
    assert abs(far - by_plane).max() > 0.1 * np.ptp(photo)


def test_pixels_beside_what_the_lens_cannot_see_are_not_mixed_with_it():
    camera = Camera(W, H, K, [-0.9, 0, 0, 0])  # folds within the photo
    new = Camera(W // 2, H // 2, [[60, 0, W / 4], [0, 60, H / 4], [0, 0, 1]])
    found, mask = rectify(np.full((H, W), 200, np.uint8), camera, MOTIONS[0], new_camera=new)
    assert 0.02 < (mask > 0).mean() < 0.9
    assert (found[mask > 0] == 200).all()
    assert (found[mask == 0] == 0).all()


def solution_of():
    cameras = {"1": make_camera(), "2": make_camera([], "left-to-right")}
    images = [SolvedImage(f"{k}.png", "12"[k // 3], motion=MOTIONS[k % 3]) for k in range(6)]
    images.append(SolvedImage("lost.png", "2", reason="alone"))
    return Solution("rotation", cameras, {key: each.pinhole() for key, each in cameras.items()}, images)


def test_view_of_a_solution_is_by_camera_with_a_roi_by_photo():
    solution = with_view(solution_of(), ViewOptions(alpha=1.0))
    assert solution.rectified_cameras["1"] != solution.rectified_cameras["2"]
    for image in solution.registered:
        camera, new = solution.cameras[image.camera_id], solution.rectified_cameras[image.camera_id]
        x, y, w, h = image.roi
        assert (mask_of(camera, image.motion, new)[y : y + h, x : x + w] == 255).all()
    assert solution.images[-1].roi is None


def test_view_that_no_camera_has_is_refused_with_the_camera():
    images = [SolvedImage(f"{k}.png", "1", motion=RowMotion([0, 0, phi])) for k, phi in enumerate((9.0, -9.0))]
    solution = Solution("rotation", {"1": make_camera()}, {"1": make_camera().pinhole()}, images)
    with pytest.raises(InputError, match=r"camera 1 and alpha 0\.0: .*check dist and phi"):
        with_view(solution, ViewOptions(alpha=0.0))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_roi_rotates_with_the_photo(orientation):
    solution = with_view(solution_of(), ViewOptions())
    turned = orient_solution(solution, {image.name: orientation for image in solution.images})
    for before, after in zip(solution.registered, turned.registered, strict=True):
        marked = np.zeros((H, W), np.uint8)
        x, y, w, h = before.roi
        marked[y : y + h, x : x + w] = 1
        shown = orient_pixels(marked, orientation)
        x, y, w, h = after.roi
        assert shown[y : y + h, x : x + w].all()
        assert shown.sum() == w * h
    back = in_stored_frame(turned)
    assert [image.roi for image in back.images] == [image.roi for image in solution.images]
