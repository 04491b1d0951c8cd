"""The ground truth: rays, row poses and the sample scene, against OpenCV and formulas written anew here."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.model.camera import Camera
from rsundistort.model.motion import RowMotion
from rsundistort.synthetic.recipe import View, load_recipe, look_at
from rsundistort.synthetic.render import line_poses, pixel_rays, render_scene, render_view, rs_shift_px
from rsundistort.synthetic.scene import Light, Opening, Patch, Scene, box, wall
from rsundistort.synthetic.textures import Texture

COURTYARD = Path(__file__).parents[1] / "sample_scenes" / "courtyard"
K = np.array([[410.0, 0, 201.0], [0, 400.0, 148.5], [0, 0, 1]])
LENS = [-0.12, 0.03, 0.001, -0.002, 0.01]
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
    """Raw pixels of world points by the design's Eq. 2, a fixed point in the clock (contracts as |phi|)."""
    axis, sign = DIRECTIONS[camera.readout]
    tau = np.zeros(len(points_w))
    for _ in range(60):
        center = v.center_w + tau[:, None] * v.motion.velocity
        q = Rotation.from_rotvec(tau[:, None] * v.motion.phi).apply((points_w - center) @ v.R_cw.T)
        uv = cv2.projectPoints(q, np.zeros(3), np.zeros(3), camera.K, camera.dist)[0][:, 0]
        tau = sign * (uv[:, axis] - camera.K[axis, 2]) / camera.K[axis, axis]
    return uv


def grid_uv(camera, step):
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step].astype(float)
    return np.stack([u.ravel(), v.ravel()], 1)


@pytest.mark.parametrize("dist", [[], LENS], ids=["pinhole", "lens"])
def test_rays_without_motion_meet_the_points_that_opencv_projects(dist):
    camera, v = Camera(400, 300, K, dist), view()
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-2, 2, 200), np.full(200, 8.0), rng.uniform(-1.5, 1.5, 200)])
    uv = cv2.projectPoints(points, cv2.Rodrigues(np.array(v.R_cw))[0], -v.R_cw @ v.center_w, K, np.array(dist))[0]
    origins, directions = pixel_rays(camera, v, uv[:, 0])
    scene = Scene((Patch([-20, 8, -20], [40, 0, 0], [0, 0, 40], "grey"),), {"grey": GREY})
    patch, distance = scene.cast(origins, directions)
    assert (patch == 0).all()
    np.testing.assert_allclose(origins + distance[:, None] * directions, points, atol=1e-9)


@pytest.mark.parametrize("readout", DIRECTIONS)
@pytest.mark.parametrize("dist", [[], LENS], ids=["pinhole", "lens"])
def test_what_a_pixel_sees_projects_back_to_it(readout, dist):
    camera = Camera(400, 300, K, dist, readout)
    v = view((0.07, -0.05, 0.09), (0.11, -0.06, 0.08))
    uv = grid_uv(camera, 17)
    scene = small_scene()
    origins, directions = pixel_rays(camera, v, uv)
    patch, distance = scene.cast(origins, directions)
    assert len(np.unique(patch)) >= 3  # the wall and two sides of the box
    points = origins + distance[:, None] * directions
    np.testing.assert_allclose(project_forward(camera, v, points), uv, atol=1e-9)


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
    for readout in ("top-to-bottom", "right-to-left"):
        camera = Camera(400, 300, K, LENS, readout)
        v = view((0.07, -0.05, 0.09), (0.11, -0.06, 0.08))
        image = render_view(scene, camera, v).astype(float)[..., 1]
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


def test_committed_photo_is_what_the_recipe_renders(courtyard):
    # Photo 3 moves most, and most at its top. A lower camera with the same K has the same
    # first rows, in a third of the time.
    v = courtyard.views[3]
    camera = Camera(courtyard.camera.width, 192, courtyard.camera.K)
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
    assert Camera(**truth["cameras"]["1"]) == courtyard.camera
    assert Camera(**json.loads((COURTYARD / "camera.json").read_text())) == courtyard.camera
    assert [image["name"] for image in truth["images"]] == [f"{k:04d}.jpg" for k in range(10)]
    for image, v in zip(truth["images"], courtyard.views, strict=True):
        np.testing.assert_array_equal(image["R_cw"], v.R_cw)
        np.testing.assert_array_equal(image["center_w"], v.center_w)
        np.testing.assert_array_equal(image["phi"], v.motion.phi)
        assert image["aspect"] == 1 - image["phi"][0]
        assert image["skew"] == image["phi"][1]
    assert not np.any(truth["images"][0]["phi"])
    angle = np.linalg.norm([image["phi"] for image in truth["images"][1:]], axis=1) * courtyard.camera.frame_span
    assert 0.02 < np.sqrt((angle**2).mean()) < 0.08  # drawn with a spread of 0.05


def test_true_motion_rectifies_the_photos(truth):
    camera = Camera(**truth["cameras"]["1"])
    uv = grid_uv(camera, 1)
    ideal = np.column_stack([(uv - camera.K[:2, 2]) / np.diag(camera.K)[:2], np.ones(len(uv))])
    before, after = [], []
    for image in truth["images"][1:]:
        raw = cv2.imread(str(COURTYARD / "photos" / image["name"]))
        twin = cv2.imread(str(COURTYARD / "global" / image["name"])).astype(float)
        row = ideal[:, 1]
        for _ in range(5):  # |phi| < 0.11 and r < 0.4: each pass gains a digit of some 50 px
            q = Rotation.from_rotvec(row[:, None] * image["phi"]).apply(ideal)
            row = q[:, 1] / q[:, 2]
        seen_at = (q[:, :2] / q[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]).reshape(*raw.shape[:2], 2)
        rectified = cv2.remap(raw, *np.moveaxis(seen_at.astype(np.float32), 2, 0), cv2.INTER_CUBIC)
        valid = ((seen_at > 1) & (seen_at < [camera.width - 2, camera.height - 2])).all(2)
        assert valid.mean() > 0.85
        before.append(20 * np.log10(255 / np.sqrt(((raw - twin)[valid] ** 2).mean())))
        after.append(20 * np.log10(255 / np.sqrt(((rectified - twin)[valid] ** 2).mean())))
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
    assert sum(f.stat().st_size for f in COURTYARD.rglob("*") if f.is_file()) < 4.5e6


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


TINY = {
    "format": "rsundistort-recipe",
    "version": 1,
    "name": "tiny",
    "seed": 3,
    "camera": {
        "width": 48, "height": 32, "K": [[40, 0, 24], [0, 40, 16], [0, 0, 1]], "dist": [],
        "readout": "top-to-bottom",
    },
    "render": {"samples": 4, "jpeg_quality": 90},
    "light": {},
    "textures": {"grey": {"kind": "ground", "size_m": [2, 2], "texels_per_m": 16, "colour": [150, 150, 150]}},
    "surfaces": [
        {
            "kind": "rectangle", "origin_w": [-3, 4, -3], "edge_a": [6, 0, 0], "edge_b": [0, 0, 6],
            "texture": "grey",
        },
    ],
    "path": [
        {"center_w": [0, 0, 0], "look_at_w": [0, 1, 0]},
        {"center_w": [1, 0, 0], "look_at_w": [0, 4, 0], "roll_deg": 3},
    ],
    "motion": {"kind": "rotation", "sigma_rad_per_frame": 0.05},
}  # fmt: skip


def test_render_scene_writes_the_same_bytes_twice(tmp_path):
    recipe = tmp_path / "tiny.json"
    recipe.write_text(json.dumps(TINY))
    done = []
    for out in ("a", "b"):
        render_scene(recipe, tmp_path / out, progress=lambda k, n: done.append((k, n)))
    assert done == [(1, 2), (2, 2)] * 2
    names = sorted(str(f.relative_to(tmp_path / "a")) for f in (tmp_path / "a").rglob("*") if f.is_file())
    expected = [f"{d}/000{k}.jpg" for d in ("global", "photos") for k in (0, 1)]
    assert names == sorted([*expected, "camera.json", "ground_truth.json", "recipe.json"])
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with pytest.raises(FileError, match="already holds"):
        render_scene(recipe, tmp_path / "a")
    render_scene(recipe, tmp_path / "a", overwrite=True)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("blur",), 1, "unknown key 'blur'"),
        (("version",), 2, "version 2"),
        (("camera", "fov"), 60, "unknown key 'fov'"),
        (("surfaces", 0, "colour"), "red", r"surfaces\[0\]: unknown key 'colour'"),
        (("surfaces", 0, "kind"), "torus", "kind 'torus', expected one of"),
        (("surfaces", 0, "texture"), "gold", "'gold'"),
        (("textures", "grey", "shine"), 1, "shine"),
        (("path", 1, "yaw"), 1, r"path\[1\]: unknown key 'yaw'"),
        (("motion", "kind"), "walk", "kind 'walk'"),
        (("light", "moon"), 1, "unknown key 'moon'"),
        (("textures",), 3, "wrong type"),
    ],
)
def test_recipes_with_mistakes_are_refused_by_name(tmp_path, path, value, message):
    data = json.loads(json.dumps(TINY))
    entry = data
    for key in path[:-1]:
        entry = entry[key]
    entry[path[-1]] = value
    (tmp_path / "bad.json").write_text(json.dumps(data))
    with pytest.raises(FormatError, match=message):
        load_recipe(tmp_path / "bad.json")


def test_missing_recipe_is_a_file_error(tmp_path):
    with pytest.raises(FileError, match="cannot read"):
        load_recipe(tmp_path / "none.json")
