"""The ground truth: rays, row poses and the sample scene, against OpenCV and formulas written anew here."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy_reference import Fisheye, lens, lens_of
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsundistort.errors import InputError
from rsundistort.model.bend import Bend
from rsundistort.model.camera import Camera
from rsundistort.model.motion import RowMotion
from rsundistort.synthetic import load_recipe, look_at, project_rows
from rsundistort.synthetic.recipe import View
from rsundistort.synthetic.render import line_poses, pixel_rays, render_view, rs_shift_px
from rsundistort.synthetic.scene import Light, Opening, Patch, Scene, box, wall
from rsundistort.synthetic.textures import Texture

COURTYARD = Path(__file__).parents[1] / "sample_scenes" / "courtyard"
K = np.array([[410.0, 0, 201.0], [0, 400.0, 148.5], [0, 0, 1]])
LENS = [-0.12, 0.03, 0.001, -0.002, 0.01]
FISHEYE = Fisheye([0.03, -0.01, 0.004, -0.001])
DIRECTIONS = {
    "top-to-bottom": (1, 1),
    "bottom-to-top": (1, -1),
    "left-to-right": (0, 1),
    "right-to-left": (0, -1),
}
GREY = Texture("ground", (4.0, 4.0), 16.0, {"colour": [150, 150, 150], "contrast": 0.0})


@pytest.fixture(scope="module")
def courtyard():
    return load_recipe(COURTYARD / "recipe.json")


@pytest.fixture(scope="module")
def truth():
    return json.loads((COURTYARD / "ground_truth.json").read_text())


def small_scene(*more):
    """A wall across the view with a box before it: every ray of `view()` meets one of them."""
    back = Patch([-20, 8, -20], [40, 0, 0], [0, 0, 40], "grey")
    return Scene((back, *box([0.3, 4, -0.5], [1.2, 0.8, 1.5], "grey", 25.0), *more), {"grey": GREY})


def view(phi=(0, 0, 0), velocity=(0, 0, 0)):
    center = np.array([0.2, -0.3, 0.4])
    return View("0.png", look_at(center, np.array([0.1, 6, 0.2]), 7.0), center, RowMotion(phi, velocity))


def project_forward(camera, v, points_w):
    """Raw pixels of world points by the measurement generator, which goes the other way round."""
    uv, valid = project_rows(points_w, v.R_cw, v.center_w, v.motion, camera)
    assert valid.all()
    return uv


def grid_uv(camera, step):
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step].astype(float)
    return np.stack([u.ravel(), v.ravel()], 1)


@pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
def test_rays_without_motion_meet_the_points_that_opencv_projects(dist):
    camera, v = Camera(400, 300, K, dist, lens=lens_of(dist)), view()
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-2, 2, 200), np.full(200, 8.0), rng.uniform(-1.5, 1.5, 200)])
    in_camera = (points - v.center_w) @ v.R_cw.T
    uv = lens(dist, in_camera[:, :2] / in_camera[:, 2:]) * np.diag(K)[:2] + K[:2, 2]
    origins, directions = pixel_rays(camera, v, uv)
    scene = Scene((Patch([-20, 8, -20], [40, 0, 0], [0, 0, 40], "grey"),), {"grey": GREY})
    patch, distance = scene.cast(origins, directions)
    assert (patch == 0).all()
    np.testing.assert_allclose(origins + distance[:, None] * directions, points, atol=1e-9)


@pytest.mark.parametrize("readout", DIRECTIONS)
@pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
def test_what_a_pixel_sees_projects_back_to_it(readout, dist):
    camera = Camera(400, 300, K, dist, readout, lens_of(dist))
    v = view((0.07, -0.05, 0.09), (0.11, -0.06, 0.08))
    uv = grid_uv(camera, 17)
    scene = small_scene()
    origins, directions = pixel_rays(camera, v, uv)
    patch, distance = scene.cast(origins, directions)
    assert len(np.unique(patch)) >= 3  # the wall and two sides of the box
    points = origins + distance[:, None] * directions
    np.testing.assert_allclose(project_forward(camera, v, points), uv, atol=1e-9)


def bent(camera, rng):
    """Ten readings each of a rotation and of a way that are not steady."""
    axis, sign = DIRECTIONS[camera.readout]
    ends = sign * (np.array([0, [camera.width, camera.height][axis] - 1]) - camera.K[axis, 2]) / camera.K[axis, axis]
    return Bend(*sorted(ends), rng.normal(size=(10, 3)) * 0.003, rng.normal(size=(10, 3)) * 0.01)


@pytest.mark.parametrize("readout", DIRECTIONS)
def test_lines_of_a_bent_motion_have_the_poses_of_its_splines(readout, rng):
    camera = Camera(400, 300, K, [], readout)
    bend, phi, velocity = bent(camera, rng), np.array([0.07, -0.05, 0.09]), np.array([0.11, -0.06, 0.08])
    v = replace(view(), motion=RowMotion(phi, velocity, bend))
    axis, sign = DIRECTIONS[readout]
    tau = sign * (np.arange([400, 300][axis]) - K[axis, 2]) / K[axis, axis]
    turn = tau[:, None] * phi + CubicSpline(bend.clock, bend.rotation)(tau)
    R_cw, center_w = line_poses(camera, v)
    np.testing.assert_allclose(R_cw, Rotation.from_rotvec(turn).as_matrix() @ v.R_cw, atol=1e-13)
    way = tau[:, None] * velocity + CubicSpline(bend.clock, bend.position)(tau)
    np.testing.assert_allclose(center_w, v.center_w + way, atol=1e-13)


@pytest.mark.parametrize("readout", DIRECTIONS)
def test_what_a_pixel_sees_in_a_bent_motion_projects_back_to_it(readout, rng):
    camera = Camera(400, 300, K, LENS, readout)
    v = replace(view(), motion=RowMotion([0.07, -0.05, 0.09], [0.11, -0.06, 0.08], bent(camera, rng)))
    uv, scene = grid_uv(camera, 17), small_scene()
    origins, directions = pixel_rays(camera, v, uv)
    points = origins + scene.cast(origins, directions)[1][:, None] * directions
    np.testing.assert_allclose(project_forward(camera, v, points), uv, atol=1e-9)
    steady = project_forward(camera, replace(v, motion=replace(v.motion, bend=None)), points)
    assert np.abs(steady - uv).max() > 0.5


def test_lines_have_the_poses_of_their_pixels():
    camera = Camera(400, 300, K, [], "right-to-left")
    v = view((0.07, -0.05, 0.09), (0.11, -0.06, 0.08))
    R_cw, center_w = line_poses(camera, v)
    assert R_cw.shape == (400, 3, 3)
    uv = np.array([[0.0, 20.0], [201.0, 20.0], [399.0, 250.0]])
    origins, directions = pixel_rays(camera, v, uv)
    lines = uv[:, 0].astype(int)
    np.testing.assert_allclose(origins, center_w[lines], atol=1e-14)
    rays_c = np.column_stack([(uv - K[:2, 2]) / np.diag(K)[:2], np.ones(3)])
    np.testing.assert_allclose(directions, np.einsum("nji,nj->ni", R_cw[lines], rays_c), atol=1e-14)
    np.testing.assert_allclose(R_cw[201], v.R_cw, atol=1e-14)


def test_reversing_the_readout_negates_the_motion():
    uv = np.array([[10.0, 20.0], [390.0, 280.0]])
    phi, velocity = np.array([0.07, -0.05, 0.09]), np.array([0.1, 0.2, -0.1])
    down = pixel_rays(Camera(400, 300, K, [], "top-to-bottom"), view(phi, velocity), uv)
    up = pixel_rays(Camera(400, 300, K, [], "bottom-to-top"), view(-phi, -velocity), uv)
    np.testing.assert_array_equal(down, up)


def test_rendered_spots_lie_where_their_points_project():
    # Bright squares on a dark wall: their centroids test the renderer itself, rows, strips and samples.
    textures = {"grey": GREY, "dark": Texture("ground", (4, 4), 16.0, {"colour": [5, 5, 5], "contrast": 0.0})}
    xs, zs = np.meshgrid([-1.8, -0.9, 0.0, 0.9, 1.8], [-1.3, -0.4, 0.5, 1.4])
    points = np.column_stack([xs.ravel(), np.full(20, 4.0), zs.ravel()])
    half = 0.06
    spots = [Patch(p - [half, 0.001, half], [2 * half, 0, 0], [0, 0, 2 * half], "grey") for p in points]
    scene = Scene((Patch([-9, 4, -9], [18, 0, 0], [0, 0, 18], "dark"), *spots), textures, Light(clouds=0.0))
    for readout, dist in (("top-to-bottom", LENS), ("right-to-left", LENS), ("bottom-to-top", FISHEYE)):
        camera = Camera(400, 300, K, dist, readout, lens_of(dist))
        v = view((0.07, -0.05, 0.09), (0.11, -0.06, 0.08))
        image = render_view(scene, camera, v, samples=4).astype(float)[..., 1]
        uv = project_forward(camera, v, points)
        seen = ((uv > 15) & (uv < [384, 284])).all(1)
        assert seen.sum() >= 12
        for u0, v0 in uv[seen]:
            c, r = round(u0), round(v0)
            # gamma and the curve weigh the rims, the same on both sides
            window = np.clip(image[r - 14 : r + 15, c - 14 : c + 15] - 30, 0, None)
            rows, cols = np.mgrid[r - 14 : r + 15, c - 14 : c + 15]
            centroid = np.array([(window * cols).sum(), (window * rows).sum()]) / window.sum()
            np.testing.assert_allclose(centroid, [u0, v0], atol=0.12)


def test_wall_with_openings_leaves_no_gap():
    front = Patch([0, 0, 0], [6, 0, 0], [0, 0, 4], "grey")
    openings = [
        Opening((1, 1), (1, 2), 0.3, "grey", "grey"),
        Opening((3, 0), (1, 2.5), 0.5, "grey", "grey"),
        Opening((5, 3), (0.5, 0.5), 0.0),
    ]
    scene = Scene(tuple(wall(front, openings)), {"grey": GREY})
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0, 6, 20000), rng.uniform(0, 4, 20000)
    origins = np.column_stack([x, np.full(20000, -1.0), z])
    distance = scene.cast(origins, np.tile([0.0, 1, 0], (20000, 1)))[1]
    expected = np.ones(20000)
    expected[(x > 1) & (x < 2) & (z > 1) & (z < 3)] = 1.3
    expected[(x > 3) & (x < 4) & (z < 2.5)] = 1.5
    expected[(x > 5) & (x < 5.5) & (z > 3) & (z < 3.5)] = np.inf
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    with pytest.raises(InputError, match="overlap"):
        wall(front, [openings[0], Opening((1.5, 1), (1, 2), 0.3, "grey", "grey")])


def test_tree_finds_what_a_search_through_all_patches_finds(courtyard):
    scene = courtyard.scene
    rng = np.random.default_rng(2)
    origins = rng.uniform([-8, 0, 0.3], [8, 14, 6], (300, 3))
    directions = rng.normal(size=(300, 3))
    patch, distance = scene.cast(origins, directions)
    best = np.full(300, np.inf)
    for p in scene.ordered_patches:
        # Moeller-Trumbore style: [d, -a, -b] (t, s, u) = origin of the patch - origin of the ray
        A = np.stack([directions, np.tile(-p.edge_a_w, (300, 1)), np.tile(-p.edge_b_w, (300, 1))], -1)
        with np.errstate(all="ignore"):
            t, s, u = np.linalg.solve(A, (p.origin_w - origins)[..., None])[..., 0].T
        inside = (t > 1e-9) & (s >= 0) & (u >= 0) & ((s + u <= 1) if p.triangle else ((s <= 1) & (u <= 1)))
        best[inside] = np.minimum(best[inside], t[inside])
    np.testing.assert_allclose(distance, best, rtol=1e-9)
    assert ((patch >= 0) == np.isfinite(best)).all()


@pytest.mark.slow
def test_committed_photo_is_what_the_recipe_renders(courtyard):
    # Photo 3 moves most, and most at its top. A lower camera with the same K has the same
    # first rows, in a third of the time.
    v = courtyard.views[3]
    camera = Camera(courtyard.cameras["1"].width, 192, courtyard.cameras["1"].K)
    image = render_view(courtyard.scene, camera, v, **courtyard.render_options)
    committed = cv2.imread(str(COURTYARD / "photos" / v.name))[:192]
    difference = np.abs(image.astype(float) - committed)
    # what JPEG at quality 94 leaves is 1.1 on average and 44.0 dB, give or take what the decoders of OpenCV 4 and 5
    # differ by; another scene, seed or pose gives more than 10 and less than 25 dB
    assert difference.mean() < 1.5
    assert 20 * np.log10(255 / np.sqrt((difference**2).mean())) > 43


def test_truth_of_the_courtyard_is_what_the_recipe_says(courtyard, truth):
    assert (truth["format"], truth["version"], truth["shutter_model"]) == (
        "rsundistort-solution",
        1,
        "rotation",
    )
    assert Camera(**truth["cameras"]["1"]) == courtyard.cameras["1"]
    assert Camera(**json.loads((COURTYARD / "camera.json").read_text())) == courtyard.cameras["1"]
    assert [image["name"] for image in truth["images"]] == [f"{k:04d}.jpg" for k in range(10)]
    for image, v in zip(truth["images"], courtyard.views, strict=True):
        np.testing.assert_array_equal(image["R_cw"], v.R_cw)
        np.testing.assert_array_equal(image["center_w"], v.center_w)
        np.testing.assert_array_equal(image["phi"], v.motion.phi)
        assert image["aspect"] == 1 - image["phi"][0]
        assert image["skew"] == image["phi"][1]
    assert not np.any(truth["images"][0]["phi"])
    angle = np.linalg.norm([image["phi"] for image in truth["images"][1:]], axis=1) * courtyard.cameras["1"].frame_span
    assert 0.02 < np.sqrt((angle**2).mean()) < 0.08  # drawn with a standard deviation of 0.05


def test_true_motion_rectifies_the_photos(truth):
    camera = Camera(**truth["cameras"]["1"])
    every = 3  # pixels each way: enough for a mean
    rows, columns = (np.unique([*range(0, n, every), n - 1]) for n in (camera.height, camera.width))
    uv = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2).astype(float)
    ideal = np.column_stack([(uv - camera.K[:2, 2]) / np.diag(camera.K)[:2], np.ones(len(uv))])
    before, after = [], []
    for image in truth["images"][1:]:
        raw = cv2.imread(str(COURTYARD / "photos" / image["name"]))
        reference = cv2.imread(str(COURTYARD / "global" / image["name"]))[np.ix_(rows, columns)].astype(float)
        row = ideal[:, 1]
        for _ in range(5):  # |phi| < 0.11 and r < 0.4: each pass gains a digit of some 50 px
            q = Rotation.from_rotvec(row[:, None] * image["phi"]).apply(ideal)
            row = q[:, 1] / q[:, 2]
        seen_at = (q[:, :2] / q[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]).reshape(*reference.shape[:2], 2)
        rectified = cv2.remap(raw, *np.moveaxis(seen_at.astype(np.float32), 2, 0), cv2.INTER_CUBIC)
        valid = ((seen_at > 1) & (seen_at < [camera.width - 2, camera.height - 2])).all(2)
        assert valid.mean() > 0.85
        before.append(20 * np.log10(255 / np.sqrt(((raw[np.ix_(rows, columns)] - reference)[valid] ** 2).mean())))
        after.append(20 * np.log10(255 / np.sqrt(((rectified - reference)[valid] ** 2).mean())))
        # over the raw grid the way back is closed: the row is known
        q = Rotation.from_rotvec(-ideal[:, 1:2] * image["phi"]).apply(ideal)
        shift = (q[:, :2] / q[:, 2:] - ideal[:, :2]) * np.diag(camera.K)[:2]
        assert np.linalg.norm(shift, axis=1).max() == pytest.approx(image["rs_shift_px"], rel=1e-9)
    assert np.median(after) > 40  # 41.5 measured; what JPEG and bicubic interpolation leave
    assert np.median(before) < 25


def test_courtyard_has_features_and_is_small():
    for name in ("0002.jpg", "0009.jpg"):
        photo = cv2.imread(str(COURTYARD / "photos" / name), cv2.IMREAD_GRAYSCALE)
        assert len(cv2.SIFT_create().detect(photo)) > 3000


def test_sample_scenes_are_small_and_whole():
    scenes = [folder for folder in COURTYARD.parent.iterdir() if folder.is_dir()]
    total = 0
    for folder in scenes:
        files = [f for f in folder.rglob("*") if f.is_file() and "depth" not in f.parent.name]
        total += sum(f.stat().st_size for f in files)
        recipe = load_recipe(folder / "recipe.json")
        assert (folder / "README.md").is_file()
        if recipe.clip is not None:  # tests/test_clip.py holds it to its recipe
            assert (folder / recipe.clip.NAME).is_file()
            continue
        for kind in ("photos", "global"):
            assert sorted(f.name for f in (folder / kind).iterdir()) == [v.name for v in recipe.views]
    assert total < 17e6  # 12 of photos, and a clip of 3 with its truth and references


def test_shift_counts_translation_by_depth():
    camera = Camera(400, 300, K)
    center = np.zeros(3)
    wall_only = Scene((Patch([-50, 8, -50], [100, 0, 0], [0, 0, 100], "grey"),), {"grey": GREY})
    v = View("0.png", look_at(center, np.array([0.0, 1, 0])), center, RowMotion([0, 0, 0], [0.2, 0, 0]))
    # at depth 8 the top row, 148.5/400 before the middle one, is off by that times 0.2 m
    top, bottom = 148.5 / 400, (299 - 148.5) / 400
    expected = max(top, bottom) * 0.2 / 8 * 410
    assert rs_shift_px(wall_only, camera, v) == pytest.approx(expected, rel=1e-9)
    assert rs_shift_px(wall_only, camera, view()) == pytest.approx(0, abs=1e-9)
