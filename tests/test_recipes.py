"""What recipes render, with what is true of it, and which of them are refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.model.camera import Camera
from rsundistort.simulate import SceneOptions, simulate_scene
from rsundistort.synthetic import load_recipe
from rsundistort.synthetic.render import render_depth, render_view
from rsundistort.synthetic.scene import Scene, box
from rsundistort.synthetic.textures import Texture

COURTYARD = Path(__file__).parents[1] / "sample_scenes" / "courtyard"
GREY = Texture("ground", (4.0, 4.0), 16.0, {"colour": [150, 150, 150], "contrast": 0.0})


@pytest.fixture(scope="module")
def truth():
    return json.loads((COURTYARD / "ground_truth.json").read_text())


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
    # rotating about the camera's y axis by 0.5 rad per frame smears columns and leaves rows sharp
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
    photo, reference = (cv2.imread(str(tmp_path / "out" / d / "0000.jpg")).astype(float) for d in ("photos", "global"))
    assert (photo - reference).std() > 1.5


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
    from rsundistort.synthetic.surfaces import height_field

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
    with pytest.raises(FileError, match=r"p\.png cannot be decoded"):
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
    # a camera that rotates as fast as its rows run (1 rad per unit of the clock, 0.8 a frame) sees one thing in all
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
