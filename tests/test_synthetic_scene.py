"""The ground truth: rays, row poses and the sample scene, against OpenCV and formulas written anew here."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy_twin import Fisheye, lens, lens_of
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.model.bend import Bend
from rsundistort.model.camera import Camera
from rsundistort.model.motion import RowMotion
from rsundistort.simulate import SceneOptions, simulate_scene
from rsundistort.synthetic import load_recipe, look_at, project_rows
from rsundistort.synthetic.recipe import View
from rsundistort.synthetic.render import line_poses, pixel_rays, render_depth, render_view, rs_shift_px
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
    """Ten readings each of a turn and of a way that are not steady."""
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
    assert total < 17e6  # 12 of photos, and a clip of 3 with its truth and twins


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


def test_the_same_recipe_gives_the_same_bytes(tmp_path):
    recipe = tmp_path / "tiny.json"
    recipe.write_text(
        json.dumps({**TINY, "noise": {"read_grey": 2.0}, "shutter": {"readout_ms": 30, "exposure_ms": 9}})
    )
    stages = []
    for out in ("a", "b"):
        simulate_scene(recipe, tmp_path / out, progress=lambda stage, done, total: stages.append((stage, done, total)))
    assert ("rendering", 2, 2) in stages
    names = sorted(str(f.relative_to(tmp_path / "a")) for f in (tmp_path / "a").rglob("*") if f.is_file())
    expected = [f"{d}/000{k}.jpg" for d in ("global", "photos") for k in (0, 1)]
    expected += [f"{d}/000{k}.tif" for d in ("global-depth", "depth") for k in (0, 1)]
    record = ".rsundistort-written"  # with times of change
    assert names == sorted([*expected, "camera.json", "ground_truth.json", "recipe.json", "tracks.npz", record])
    names.remove(record)
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with pytest.raises(FileError, match="not empty"):
        simulate_scene(recipe, tmp_path / "a")
    (tmp_path / "a" / "README.md").write_text("mine")
    simulate_scene(recipe, tmp_path / "a", SceneOptions(overwrite=True))
    assert (tmp_path / "a" / "README.md").read_text() == "mine"


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
        (("seed",), -1, "seed=-1"),
        (("cameras",), {}, "either camera or cameras"),
        # the corner is 1.48 rad from the axis, but not that of the outermost pixel's footprint
        (
            ("camera",),
            {**TINY["camera"], "K": [[19, 0, 23.5], [0, 19, 15.5], [0, 0, 1]], "lens": "fisheye"},
            "camera: no rays within 90 degrees of the axis belong to the corners",
        ),
        (("path", 1, "camera"), "2", r"path\[1\]: camera '2', expected one of 1"),
        (("path",), [], "no places"),
        (("path",), {"kind": "spiral"}, "kind 'spiral'"),
        (
            ("path",),
            {"kind": "orbit", "center_w": [0, 0, 0], "radius_m": 1, "num": 0, "look_at_w": [0, 4, 0]},
            "num: 0",
        ),
        (("path", 1, "look_at_w"), [1, 0, 5], "needs up_w"),
        (("path", 1, "look_at_w"), [1, 0, 0], "where it stands"),
        (("motion", "still"), [2], "still"),
        (("motion",), {"kind": "given", "phi_rad_per_frame": [[0, 0, 0]]}, "phi_rad_per_frame"),
        (("noise",), {"read_grey": -1}, "grey levels"),
        (("shutter",), {"readout_ms": 0}, "readout_ms"),
        (("points",), -1, "points"),
        (("surfaces", 0), {"kind": "mesh", "path": "../x.ply", "texture": "grey"}, "below the recipe"),
        (("surfaces", 0), {"kind": "mesh", "path": "x.stl", "texture": "grey"}, "neither .ply nor .obj"),
        (
            ("surfaces", 0),
            {"kind": "height-field", "origin_w": [0, 0, 0], "size_m": [1, 1], "heights_m": [[0, 1]], "texture": "grey"},
            "no area",
        ),
        (("textures", "grey"), {"kind": "picture", "size_m": [1, 1]}, "path"),
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
    with pytest.raises(FileError, match="cannot be read"):
        load_recipe(tmp_path / "none.json")


def rendered(tmp_path, **changes):
    """The tiny recipe with changes, loaded."""
    path = tmp_path / "changed.json"
    path.write_text(json.dumps({**TINY, **changes}))
    return load_recipe(path)


def test_depth_is_the_analytic_depth_of_the_line(tmp_path):
    recipe = rendered(
        tmp_path, motion={"kind": "random", "rotation_rad_per_frame": 0.1, "translation_m_per_frame": 0.3}
    )
    camera = recipe.cameras["1"]
    for v in recipe.views:
        depth = render_depth(recipe.scene, camera, v)
        row, col = np.mgrid[: camera.height, : camera.width]
        tau = (row - camera.K[1, 2]) / camera.K[1, 1]
        ray = np.stack([(col - camera.K[0, 2]) / camera.K[0, 0], tau, np.ones(tau.shape)], -1)
        R = Rotation.from_rotvec((tau[..., None] * v.motion.phi).reshape(-1, 3)).as_matrix() @ v.R_cw
        y_of_ray = np.einsum("nj,nj->n", ray.reshape(-1, 3), R[:, :, 1]).reshape(tau.shape)
        y_of_camera = v.center_w[1] + tau * v.motion.velocity[1]
        expected = (4 - y_of_camera) / y_of_ray  # the wall is at y = 4, and the ray has depth 1
        on_wall = np.isfinite(depth)
        assert on_wall.mean() > 0.9
        np.testing.assert_allclose(depth[on_wall], expected[on_wall], rtol=1e-5)


def test_true_points_project_to_their_tracks_as_opencv_projects_them(tmp_path):
    simulate_scene(rendered(tmp_path, motion={"kind": "none"}), tmp_path / "out")
    tracks = np.load(tmp_path / "out" / "tracks.npz")
    assert len(tracks["points_w"]) > 300
    for i in range(2):
        mine = tracks["frame_idx"] == i
        points = tracks["points_w"][tracks["point_idx"][mine]]
        R, center = tracks["R_cw"][i], tracks["center_w"][i]
        uv = cv2.projectPoints(points, cv2.Rodrigues(R)[0], -R @ center, tracks["K"], None)[0][:, 0]
        np.testing.assert_allclose(tracks["xy_raw"][mine], uv, atol=1e-9)
        np.testing.assert_allclose(tracks["xy_global"][mine], uv, atol=1e-9)
    assert np.bincount(tracks["point_idx"]).min() >= 2


def test_points_behind_others_are_no_tracks(tmp_path):
    post = {"kind": "box", "center_w": [0, 2, -3], "size_m": [0.5, 0.5, 6], "texture": "grey"}
    recipe = rendered(tmp_path, surfaces=[*TINY["surfaces"], post])
    simulate_scene(recipe, tmp_path / "out")
    tracks = np.load(tmp_path / "out" / "tracks.npz")
    v = recipe.views[0]
    first = tracks["frame_idx"] == 0
    on_wall = first & (tracks["points_w"][tracks["point_idx"], 1] > 3.9)
    points = tracks["points_w"][tracks["point_idx"][on_wall]]
    # seen from the origin the post hides |x| < 0.25 / 1.75 * y and a little less
    assert len(points) > 50
    assert np.abs(points[:, 0] / points[:, 1]).min() > 0.25 / 2.25
    assert np.allclose(v.center_w, 0)


def test_exposure_blurs_along_the_motion(tmp_path):
    # turning about the camera's y axis by 0.5 rad per frame smears columns and leaves rows sharp
    given = {"kind": "given", "phi_rad_per_frame": [[0, 0.5, 0], [0, 0, 0]]}
    stripes = {
        "kind": "blocks", "size_m": [6, 6], "texels_per_m": 40, "colour": [230, 230, 230],
        "joint_colour": [5, 5, 5], "course_m": 0.6, "length_m": 0.6, "joint_m": 0.1, "weather": 0.0,
    }  # fmt: skip
    changes = {"motion": given, "textures": {"grey": stripes}, "render": {"samples": 32, "jpeg_quality": 90}}
    sharp = rendered(tmp_path, **changes)
    blurred = rendered(tmp_path, **changes, shutter={"readout_ms": 30, "exposure_ms": 15})

    def gradients(recipe, k):
        photo = render_view(recipe.scene, recipe.cameras["1"], recipe.views[k], samples=32).astype(float)
        return np.abs(np.diff(photo, axis=1)).mean(), np.abs(np.diff(photo, axis=0)).mean()

    across, along = np.divide(gradients(blurred, 0), gradients(sharp, 0))
    assert across < 0.6
    assert along > 0.6
    np.testing.assert_array_equal(gradients(blurred, 1), gradients(sharp, 1))  # a still camera does not blur


def test_noise_has_the_spread_that_the_recipe_says(tmp_path):
    recipe = rendered(tmp_path, noise={"read_grey": 3.0, "shot_grey": 4.0}, motion={"kind": "none"})
    simulate_scene(recipe, tmp_path / "out")
    from rsundistort.synthetic import add_noise

    flat = np.full((200, 200, 3), 128, np.uint8)
    noisy = add_noise(flat, recipe.noise, 3, 0).astype(float)
    assert noisy.std() == pytest.approx(np.sqrt(9 + 16 * 128 / 255), rel=0.02)
    assert noisy.mean() == pytest.approx(128, abs=0.1)
    assert (add_noise(flat, recipe.noise, 3, 1) != noisy).any()
    photo, twin = (cv2.imread(str(tmp_path / "out" / d / "0000.jpg")).astype(float) for d in ("photos", "global"))
    assert (photo - twin).std() > 1.5


def test_paths_lead_where_they_say(tmp_path):
    orbit = {"kind": "orbit", "center_w": [0, 0, 1], "radius_m": 2, "num": 4, "look_at_w": [0, 0, 1]}
    centers = np.array([v.center_w for v in rendered(tmp_path, path=orbit).views])
    np.testing.assert_allclose(centers, [[2, 0, 1], [0, 2, 1], [-2, 0, 1], [0, -2, 1]], atol=1e-12)
    street = {"kind": "street", "start_w": [0, 0, 1], "end_w": [3, 0, 1], "num": 4, "look_w": [0, 1, 0]}
    views = rendered(tmp_path, path=street, motion={"kind": "random", "drift_m_per_frame": 0.5}).views
    np.testing.assert_allclose([v.center_w for v in views], [[k, 0, 1] for k in range(4)])
    np.testing.assert_allclose(views[2].R_cw, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(views[1].motion.velocity * 32 / 40, [0.5, 0, 0], atol=1e-12)
    flight = {"kind": "flyover", "start_w": [0, 0, 9], "end_w": [0, 6, 9], "num": 3, "lines": 2, "line_spacing_m": 4}
    views = rendered(tmp_path, path=flight, motion={"kind": "none"}).views
    np.testing.assert_allclose(
        [v.center_w for v in views], [[0, 0, 9], [0, 3, 9], [0, 6, 9], [4, 6, 9], [4, 3, 9], [4, 0, 9]]
    )
    for v, up in zip(views, [1, 1, 1, -1, -1, -1], strict=True):
        np.testing.assert_allclose(v.R_cw[2], [0, 0, -1], atol=1e-12)
        np.testing.assert_allclose(v.R_cw[1], [0, -up, 0], atol=1e-12)  # down in the photo is where it came from


def test_height_field_has_its_heights_and_its_texture_from_above():
    from rsundistort.synthetic import height_field

    heights = np.array([[0.0, 1.0, 0.5], [0.2, 2.0, 0.0], [1.0, 0.0, 0.3]])
    patches = height_field(np.array([10.0, 20, 1]), np.array([4.0, 6.0]), heights, "grey")
    scene = Scene(tuple(patches), {"grey": GREY})
    y, x = np.mgrid[0:3, 0:3]
    # a hair inside, where the four neighbours agree to 1e-3
    at = np.column_stack([10 + 2 * x.ravel(), 20 + 3 * y.ravel(), np.full(9, 50.0)])
    at[:, :2] += (np.array([12, 23]) - at[:, :2]) * 1e-4
    distance = scene.cast(at, np.tile([0.0, 0, -1], (9, 1)))[1]
    np.testing.assert_allclose(50 - distance, 1 + heights.ravel(), atol=1e-3)
    for p in patches:  # one metre over ground is one metre of texture
        np.testing.assert_allclose(p.offset_m, p.origin_w[:2] - [10, 20], atol=1e-12)
        np.testing.assert_allclose(p.axes_m, [*p.edge_a_w[:2], *p.edge_b_w[:2]], atol=1e-12)


def save_cube(path, uv=False):
    """A unit cube as OBJ, counter-clockwise from outside."""
    lines = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines += [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in quads]
    path.write_text("\n".join(lines) + "\n")


def test_mesh_is_met_where_the_box_is(tmp_path):
    pytest.importorskip("trimesh")
    save_cube(tmp_path / "cube.obj")
    entry = {"kind": "mesh", "path": "cube.obj", "texture": "grey", "scale": 2.0, "origin_w": [-1, 5, -1]}
    recipe = rendered(tmp_path, surfaces=[entry], motion={"kind": "none"})
    reference = Scene(tuple(box([0, 6, -1], [2, 2, 2], "grey")), {"grey": GREY})
    rng = np.random.default_rng(0)
    origins, directions = np.zeros((500, 3)), rng.normal([0, 2, 0], size=(500, 3))
    found = recipe.scene.cast(origins, directions)[1]
    np.testing.assert_allclose(found, reference.cast(origins, directions)[1], rtol=1e-12)
    assert recipe.files == ("cube.obj",)
    simulate_scene(tmp_path / "changed.json", tmp_path / "out")
    assert (tmp_path / "out" / "cube.obj").is_file()


def test_broken_meshes_and_pictures_are_refused_by_name(tmp_path):
    pytest.importorskip("trimesh")
    entry = {"kind": "mesh", "path": "m.ply", "texture": "grey"}
    with pytest.raises(FileError, match=r"m\.ply does not exist"):
        rendered(tmp_path, surfaces=[entry])
    (tmp_path / "m.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(FormatError, match=r"surfaces\[0\].*m\.ply"):
        rendered(tmp_path, surfaces=[entry])
    grey = {"kind": "picture", "size_m": [2, 2], "texels_per_m": 16, "path": "p.png"}
    recipe = rendered(tmp_path, textures={"grey": grey})
    with pytest.raises(FileError, match=r"p\.png"):
        simulate_scene(recipe, tmp_path / "out")
    (tmp_path / "p.png").write_bytes(b"no picture")
    with pytest.raises(FormatError, match=r"p\.png is no picture"):
        simulate_scene(recipe, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_picture_is_seen_upright(tmp_path):
    quadrants = np.zeros((64, 64, 3), np.uint8)
    quadrants[:32, :32], quadrants[:32, 32:] = (255, 0, 0), (0, 255, 0)  # BGR: blue left above, green right above
    quadrants[32:, :32], quadrants[32:, 32:] = (0, 0, 255), (255, 255, 255)
    cv2.imwrite(str(tmp_path / "p.png"), quadrants)
    grey = {"kind": "picture", "size_m": [6, 6], "texels_per_m": 16, "path": "p.png"}
    recipe = rendered(tmp_path, textures={"grey": grey}, motion={"kind": "none"})
    photo = render_view(recipe.scene, recipe.cameras["1"], recipe.views[0]).astype(int)
    assert np.argmax(photo[8, 12]) == 0
    assert np.argmax(photo[8, 36]) == 1
    assert np.argmax(photo[24, 12]) == 2
    assert photo[24, 36].min() > 60


def refused(tmp_path, message, **changes):
    with pytest.raises(InputError, match=message):
        simulate_scene(rendered(tmp_path, **changes), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_camera_in_a_wall_is_refused(tmp_path):
    solid = {"kind": "box", "center_w": [0, 0, -1], "size_m": [1, 1, 2], "texture": "grey"}
    refused(tmp_path, r"0000\.jpg is taken from inside a surface", surfaces=[*TINY["surfaces"], solid])


def test_a_camera_that_moves_through_a_wall_is_refused(tmp_path):
    given = {"kind": "given", "velocity_m_per_frame": [[0, 0, 0], [0, 20, 0]]}
    refused(tmp_path, r"0001\.jpg: the camera moves through a surface", motion=given)


def test_a_surface_behind_every_camera_is_refused(tmp_path):
    hidden = {"kind": "box", "center_w": [0, -9, 0], "size_m": [1, 1, 1], "texture": "grey"}
    refused(tmp_path, r"surfaces\[1\] \(box\) lies behind every camera", surfaces=[*TINY["surfaces"], hidden])


def test_a_camera_that_sees_only_sky_is_refused(tmp_path):
    path = [*TINY["path"], {"center_w": [0, 0, 0], "look_at_w": [0, -1, 0]}]
    refused(tmp_path, r"0002\.jpg shows nothing but sky", path=path)


def test_rows_that_fold_over_are_refused(tmp_path):
    # a camera that turns as fast as its rows run (1 rad per unit of the clock, 0.8 a frame) sees one thing in all
    given = {"kind": "given", "phi_rad_per_frame": [[-0.9, 0, 0], [0, 0, 0]]}
    refused(tmp_path, r"0000\.jpg.* fold", motion=given)
    simulate_scene(rendered(tmp_path, motion={**given, "phi_rad_per_frame": [[0.9, 0, 0], [0, 0, 0]]}), tmp_path / "o")


def test_several_cameras_are_written_with_the_photos_they_took(tmp_path):
    upright = {**TINY["camera"], "width": 32, "height": 48, "K": [[40, 0, 16], [0, 40, 24], [0, 0, 1]]}
    cameras = {"wide": TINY["camera"], "tall": {**upright, "readout": "left-to-right"}}
    path = [TINY["path"][0], {**TINY["path"][1], "camera": "tall"}]
    changed = {k: v for k, v in TINY.items() if k != "camera"}
    (tmp_path / "two.json").write_text(json.dumps({**changed, "cameras": cameras, "path": path}))
    truth = simulate_scene(tmp_path / "two.json", tmp_path / "out")
    assert cv2.imread(str(tmp_path / "out" / "photos" / "0001.jpg")).shape == (48, 32, 3)
    written = json.loads((tmp_path / "out" / "cameras.json").read_text())
    assert written["images"] == {"0000.jpg": "wide", "0001.jpg": "tall"}
    assert Camera(**written["cameras"]["tall"]) == truth.cameras["tall"]
    assert truth.image("0001.jpg").camera_id == "tall"
