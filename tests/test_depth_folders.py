"""Depths in folders of photos: from the points of a solution, a plane, or maps."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy_reference
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import (
    DepthMap,
    Plane,
    RectifyOptions,
    RowMotion,
    RsUndistortWarning,
    Solution,
    SolvedImage,
    read_solution,
    rectify,
    rectify_folder,
    write_solution,
)
from rsundistort.batch.geometry import SceneGeometry, ScenePoints
from rsundistort.errors import FileError, InputError
from rsundistort.io import find_depth_maps, read_depth_map, write_colmap_model
from rsundistort.model import Observations, Reconstruction
from rsundistort.rectify import depth_from_points

W, H = 200, 160
K = np.array([[210.0, 0, 97.3], [0, 205.0, 81.6], [0, 0, 1]])
make_camera = partial(numpy_reference.make_camera, W, H, K)
LENS = [-0.12, 0.03, 0.001, -0.002]
MODEL = "constant-motion"


def small_scene(rng, velocity=(0.4, 0.2, 0.1), num=400):
    """Four photos of points before two walls, taken by a moving camera, as a reconstruction without noise."""
    camera = make_camera(LENS)
    points = rng.uniform([-4, -3, 0], [4, 3, 1], (num, 3))
    points[:, 2] = np.where(points[:, 0] > 0.5, 5.0, 9.0) + 0.2 * points[:, 2]
    centers = np.array([[0.5 * k, 0.1 * k, 0] for k in range(4)])
    turns = Rotation.from_rotvec(rng.normal(0, 0.05, (4, 3))).as_matrix()
    motions = [RowMotion(rng.normal(0, 0.03, 3), velocity) for _ in range(4)]
    frame, point = np.repeat(np.arange(4), num), np.tile(np.arange(num), 4)
    seen = numpy_reference.measure(points, turns, centers, motions, [camera] * 4, frame, point)
    inside = ((seen > 0) & (seen < [W - 1, H - 1])).all(1)
    names = [f"{k}.png" for k in range(4)]
    rec = Reconstruction(
        [camera], names, np.zeros(4, int), turns, centers, points,
        Observations(frame, point, seen).select(inside),
        np.array([m.phi for m in motions]), np.array([m.velocity for m in motions]), MODEL,
    )  # fmt: skip
    images = tuple(SolvedImage(n, "1", turns[k], centers[k], motions[k]) for k, n in enumerate(names))
    return rec, Solution(MODEL, {"1": camera}, {"1": camera.pinhole()}, images)


def scene_folder(folder, rng, **options):
    rec, solution = small_scene(rng, **options)
    (folder / "photos").mkdir()
    photo = cv2.GaussianBlur(rng.integers(0, 256, (H, W, 3), dtype=np.uint8), (0, 0), 1)
    for name in rec.image_names:
        cv2.imwrite(str(folder / "photos" / name), photo)
    write_solution(folder / "solution.json", solution)
    write_colmap_model(folder / "sparse", rec, [rec.cameras[0].pinhole()], list(rec.image_names))
    return rec, solution


def test_colmap_model_projects_onto_the_measurements_of_a_moving_camera(tmp_path, rng):
    import pycolmap

    rec, _ = small_scene(rng)
    write_colmap_model(tmp_path / "sparse", rec, [rec.cameras[0].pinhole()], list(rec.image_names))
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert model.num_observations() > 800 if hasattr(model, "num_observations") else True
    assert model.compute_mean_reprojection_error() < 1e-6  # px; the measurements have no noise
    noisy = rec.observations.xy_raw + rng.normal(0, 0.3, rec.observations.xy_raw.shape)
    rec = replace(rec, observations=replace(rec.observations, xy_raw=noisy))
    write_colmap_model(tmp_path / "noisy", rec, [rec.cameras[0].pinhole()], list(rec.image_names))
    mean = pycolmap.Reconstruction(tmp_path / "noisy").compute_mean_reprojection_error()
    assert mean == pytest.approx(0.3 * np.sqrt(np.pi / 2), rel=0.1)  # mean length of such an error, the lens bends it


def test_rectify_takes_depths_from_the_model_beside_the_solution(tmp_path, rng):
    rec, _ = scene_folder(tmp_path, rng)
    written, _ = rectify_folder(tmp_path / "photos", tmp_path / "solution.json", tmp_path / "out")
    assert {image.depth for image in written.images} == {"points"}
    stored = read_solution(tmp_path / "out" / "solution.json")
    for image in stored.images:
        assert image.translation_shift_px > 5
        assert image.rs_shift_px > 1  # the rotation may undo some of it
        assert image.depth == "points"
    photo = cv2.imread(str(tmp_path / "photos" / "1.png"))
    points = rec.points_w[rec.observations.point_idx[rec.observations.frame_idx == 1]]
    X_c = (points - rec.center_w[1]) @ rec.R_cw[1].T
    xy = X_c[:, :2] / X_c[:, 2:] * np.diag(K)[:2] + K[:2, 2]
    depth = depth_from_points(xy, X_c[:, 2], (W, H))
    expected, mask = rectify(photo, rec.cameras[0], rec.motion(1).in_camera(rec.R_cw[1]), MODEL, depth=depth)
    found = cv2.imread(str(tmp_path / "out" / "images" / "1.png"))
    # a point that its measurement puts beyond the border is in the solution, not in the COLMAP model
    assert np.mean(np.abs(found.astype(int) - expected)[mask > 0] > 2) < 0.01


def test_rectify_at_infinity_is_the_rotation_alone(tmp_path, rng):
    rec, _ = scene_folder(tmp_path, rng)
    written, _ = rectify_folder(tmp_path / "photos", tmp_path / "solution.json", tmp_path / "out", depth="infinity")
    assert {image.depth for image in written.images} == {"infinity"}
    photo = cv2.imread(str(tmp_path / "photos" / "1.png"))
    expected, _ = rectify(photo, rec.cameras[0], RowMotion(rec.phi[1]))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / "images" / "1.png")), expected)


def test_rectify_says_that_the_points_are_missing(tmp_path, rng):
    scene_folder(tmp_path, rng)
    (tmp_path / "sparse").rename(tmp_path / "elsewhere")
    with pytest.warns(RsUndistortWarning, match="sparse is missing.*as if all were far away"):
        rectify_folder(tmp_path / "photos", tmp_path / "solution.json", tmp_path / "out")
    for depth in ("points", "plane"):
        with pytest.raises(InputError, match=f"sparse is missing.*depth {depth} needs them"):
            rectify_folder(tmp_path / "photos", tmp_path / "solution.json", tmp_path / "two", depth=depth)
    assert not (tmp_path / "two").exists()
    with pytest.raises(FileError, match="'somewhere' is no folder, nor one of auto, infinity, plane, points"):
        rectify_folder(tmp_path / "photos", tmp_path / "solution.json", tmp_path / "two", depth="somewhere")
    with pytest.raises(FileError, match="is no folder"):
        RectifyOptions(depth="somewhere")


def test_auto_leaves_photos_alone_that_hardly_travelled(rng):
    for velocity, kind in (((0.004, 0.0, 0.0), "infinity"), ((0.1, 0.0, 0.0), "points")):
        rec, solution = small_scene(rng, velocity)
        found = SceneGeometry(solution, "auto", ScenePoints.of_reconstruction(rec)).of("1.png").find_depth()
        assert found.kind == kind
        assert (found.shift_px > 0.5) == (kind == "points")


def test_auto_takes_the_plane_of_a_flat_scene(rng):
    rec, solution = small_scene(rng)
    flat = np.array(rec.points_w)
    flat[:, 2] = 7.0 + 0.1 * flat[:, 0] + rng.normal(0, 0.02, len(flat))
    points = ScenePoints.of_reconstruction(replace(rec, points_w=flat))
    found = SceneGeometry(solution, "auto", points).of("2.png").find_depth()
    assert found.kind == "plane"
    assert isinstance(found.depth, Plane)
    assert SceneGeometry(solution, "points", points).of("2.png").find_depth().kind == "points"
    assert SceneGeometry(solution, "plane", ScenePoints.of_reconstruction(rec)).of("2.png").find_depth().kind == "plane"


def test_rotation_models_know_no_depth(rng):
    rec, solution = small_scene(rng)
    rotating = replace(solution, shutter_model="rotation")
    found = SceneGeometry(rotating, "auto", ScenePoints.of_reconstruction(rec)).of("1.png").find_depth()
    assert (found.kind, found.shift_px) == ("infinity", 0.0)


@pytest.mark.parametrize("suffix", ["npy", "npz", "tif"])
def test_own_maps(tmp_path, rng, suffix):
    rec, _ = scene_folder(tmp_path, rng)
    folder = tmp_path / "maps"
    folder.mkdir()
    depth = np.full((H // 2, W // 2), 7.0, np.float32)
    for name in ("0", "1.png", "2"):
        to = folder / f"{name}.{suffix}"
        if suffix == "tif":
            cv2.imwrite(str(to), depth)
        else:
            np.save(to, depth) if suffix == "npy" else np.savez(to, depth=depth)
    with pytest.warns(RsUndistortWarning, match=r"3\.png has no depth map and is rectified at infinity"):
        written, _ = rectify_folder(tmp_path / "photos", tmp_path / "solution.json", tmp_path / "out", depth=folder)
    assert [image.depth for image in written.images] == ["map", "map", "map", "infinity"]
    photo = cv2.imread(str(tmp_path / "photos" / "1.png"))
    motion = rec.motion(1).in_camera(rec.R_cw[1])
    expected, _ = rectify(photo, rec.cameras[0], motion, MODEL, depth=DepthMap(depth, (W, H)))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / "images" / "1.png")), expected)


def test_maps_of_photos_in_sub_folders_are_in_sub_folders_of_the_same_names(tmp_path):
    for name in ("a.npy", "one/a.npy", "two/a.jpg.tif", "two/b.npz", "three.npy"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = find_depth_maps(tmp_path, ["one/a.jpg", "one/b.jpg", "two/a.jpg", "two/b.jpg"])
    assert {name: path.relative_to(tmp_path).as_posix() for name, path in found.items()} == {
        "one/a.jpg": "one/a.npy",
        "two/a.jpg": "two/a.jpg.tif",
        "two/b.jpg": "two/b.npz",
    }
    with pytest.raises(InputError, match=r"no depth map of any photo; it should hold two/three\.npy and so on"):
        find_depth_maps(tmp_path, ["two/three.jpg"])


def test_it_is_never_a_guess_whose_map_a_file_is(tmp_path):
    (tmp_path / "a.npy").write_bytes(b"")
    with pytest.raises(InputError, match=r"would be of a\.jpg and of a\.png; call it a\.png\.npy"):
        find_depth_maps(tmp_path, ["a.jpg", "a.png"])
    (tmp_path / "a.png.npy").write_bytes(b"")
    assert [path.name for path in find_depth_maps(tmp_path, ["a.jpg", "a.png"]).values()] == ["a.npy", "a.png.npy"]
    (tmp_path / "a.tif").write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.jpg has several depth maps: a\.npy, a\.tif; keep one of them"):
        find_depth_maps(tmp_path, ["a.jpg"])


def test_maps_of_another_scale_are_noticed(tmp_path, rng):
    rec, solution = small_scene(rng)
    np.save(tmp_path / "1.npy", np.full((H, W), 700.0))
    with pytest.warns(RsUndistortWarning, match=r"depths are [\d.]+ times those of the solution's points"):
        SceneGeometry(solution, tmp_path, ScenePoints.of_reconstruction(rec)).of("1.png").find_depth()


def test_maps_that_cannot_be_used_are_refused(tmp_path, rng):
    with pytest.raises(FileError, match="is no folder"):
        find_depth_maps(tmp_path / "none", ["a.jpg"])
    with pytest.raises(InputError, match=r"holds no depth map of any photo.*a\.npy"):
        find_depth_maps(tmp_path, ["a.jpg"])
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY cut short")
    (tmp_path / "b.tif").write_bytes(b"no picture")
    np.save(tmp_path / "c.npy", np.zeros((3, 4, 5)))
    np.savez(tmp_path / "d.npz", one=np.zeros((2, 2)), two=np.zeros((2, 2)))
    np.save(tmp_path / "e.npy", np.array([{"an": "object"}]), allow_pickle=True)
    for name, says in {
        "a.npy": "is garbled",
        "b.tif": "no picture of a known kind",
        "c.npy": "expected one number per pixel",
        "d.npz": "several arrays",
        "e.npy": "is garbled",
    }.items():
        with pytest.raises((FileError, InputError), match=says):
            read_depth_map(tmp_path / name)
    _, solution = small_scene(rng)
    for values, says in (
        (np.ones((H, H)), "160x160 pixels, the rectified photo 200x160"),
        (np.zeros((H, W)), "no positive"),
    ):
        np.save(tmp_path / "1.npy", values)
        with pytest.raises(InputError, match=says):
            SceneGeometry(solution, tmp_path, None).of("1.png").find_depth()


def test_depth_in_the_solution_survives_the_file(tmp_path, rng):
    _, solution = small_scene(rng)
    image = replace(solution.images[0], depth="plane", translation_shift_px=3.25)
    write_solution(tmp_path / "s.json", replace(solution, images=(image, *solution.images[1:])))
    entries = json.loads(Path(tmp_path / "s.json").read_text())["images"]
    assert (entries[0]["depth"], entries[0]["translation_shift_px"]) == ("plane", 3.25)
    assert "depth" not in entries[1]
    back = read_solution(tmp_path / "s.json").images
    assert (back[0].depth, back[0].translation_shift_px, back[1].depth) == ("plane", 3.25, None)


def test_observations_that_a_photo_repeats_count_once(rng):
    rec, _ = small_scene(rng)
    obs = rec.observations
    twice = Observations(*(np.concatenate([a, a]) for a in (obs.frame_idx, obs.point_idx, obs.xy_raw)))
    seen = ScenePoints.of_reconstruction(replace(rec, observations=twice)).seen["1.png"]
    assert len(seen) == len(set(seen.tolist()))
