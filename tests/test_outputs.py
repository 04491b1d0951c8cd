"""What OUT holds for other programs: COLMAP's workspace, nerfstudio, poses, points, poses with the shutter."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from rsundistort_cli import closing
from scipy.spatial.transform import Rotation, Slerp

from rsundistort import RectifyOptions, RsUndistortWarning
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.colmap.rectified_model import ModelIds
from rsundistort.errors import InputError
from rsundistort.io import (
    output_folder,
    read_transforms,
    write_colmap_workspace,
    write_point_cloud,
    write_shutter_poses,
    write_trajectory,
    write_transforms,
)
from rsundistort.model import Bend, Camera, Observations, Reconstruction, RowMotion, Solution, SolvedImage
from rsundistort.model.projection import clock_of, project_points, unproject_points
from rsundistort.rectify import bend_px
from rsundistort.solve import OutputOptions
from rsundistort.solve.run_outputs import Outputs, _left_by_two_poses, photo_times

W, H = 640, 480
LENS = (-0.12, 0.03, 1e-3, -8e-4, 0.01)
FISHEYE = (0.02, -0.01, 0.004, -0.001)


def camera_of(readout="top-to-bottom", lens="pinhole", dist=LENS, fx=520.0):
    K = np.array([[fx, 0, 318.3], [0, 515.0, 243.7], [0, 0, 1]])
    return Camera(W, H, K, np.array(FISHEYE if lens == "fisheye" else dist), readout, lens)


def solved(rng, cameras, model="constant-motion", times=None, names=None):
    """A scene of some photos, one for each camera in turn, with exact measurements; and its solution."""
    names = names or [f"sub {k % 2}/{k}.jpg" for k in range(4)]
    m = len(names)
    idx = np.arange(m) % len(cameras)
    R = Rotation.from_rotvec(rng.normal(0, 0.1, (m, 3))).as_matrix()
    center = rng.normal(0, 0.4, (m, 3))
    motions = [RowMotion(rng.normal(0, 0.06, 3), rng.normal(0, 0.1, 3)) for _ in range(m)]
    points = np.column_stack([rng.uniform(-3, 3, (60, 2)), rng.uniform(5, 9, 60)])
    frame, point, xy = [], [], []
    for i in range(m):
        motion = motions[i].in_camera(R[i])
        seen, valid = project_points((points - center[i]) @ R[i].T, cameras[idx[i]], motion, model)
        valid &= ((seen >= 0) & (seen <= [W - 1, H - 1])).all(1)
        frame += [i] * valid.sum()
        point += np.flatnonzero(valid).tolist()
        xy.append(seen[valid])
    obs = Observations(np.array(frame), np.array(point), np.concatenate(xy))
    phi, velocity = np.array([a.phi for a in motions]), np.array([a.velocity for a in motions])
    rec = Reconstruction(cameras, names, idx, R, center, points, obs, phi, velocity, model)
    keys = [str(1 + k) for k in range(len(cameras))]
    images = [SolvedImage(n, keys[idx[i]], R[i], center[i], motions[i]) for i, n in enumerate(names)]
    named = dict(zip(keys, cameras, strict=True))
    quality = {"readout_times": {key: {"ms": ms, "source": "given"} for key, ms in (times or {}).items()}}
    pinholes = {key: camera.pinhole() for key, camera in named.items()}
    return rec, Solution(model, named, pinholes, images, quality=quality)


# ---------------------------------------------------------------- COLMAP


def files_of(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_workspace_is_what_colmap_writes(tmp_path, rng):
    import pycolmap

    names = ["b.jpg", "sub/deep/a.jpg", "c.jpg", "a 1.jpg"]
    rec, _ = solved(rng, [camera_of(dist=())], "global", names=names)
    photos, model = tmp_path / "photos", tmp_path / "model"
    for name in names:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(photos / name), np.zeros((H, W, 3), np.uint8))
    model.mkdir()
    from rsundistort.colmap.rectified_model import colmap_model

    ids = ModelIds([7], [4, 9, 2, 3], range(1, 61))
    colmap_model(rec, list(rec.cameras), names, None, ids).write(model)
    pycolmap.undistort_images(tmp_path / "theirs", model, photos)
    by_id = [name for _, name in sorted(zip(ids.images, names, strict=True))]
    write_colmap_workspace(tmp_path / "ours", by_id)
    left = {path for path in files_of(tmp_path / "theirs") if path.split("/")[0] not in ("images", "sparse")}
    assert set(files_of(tmp_path / "ours")) == left
    for path in left:
        if (tmp_path / "theirs" / path).is_file():
            assert (tmp_path / "ours" / path).read_bytes() == (tmp_path / "theirs" / path).read_bytes(), path


def test_scripts_are_shell_and_name_no_machine(tmp_path):
    write_colmap_workspace(tmp_path, ["a.jpg"])
    for path in tmp_path.glob("*.sh"):
        assert subprocess.run(["sh", "-n", path], capture_output=True, check=False).returncode == 0
        assert str(tmp_path) not in path.read_text()
        assert b"\r" not in path.read_bytes()


def outputs_of(rng, tmp_path, options=None, turns=None, cameras=None, with_photos=True, times=None, names=None):
    rec, solution = solved(rng, cameras or [camera_of()], names=names)
    options = options or OutputOptions()
    ids = ModelIds.in_order(rec)
    made = Outputs(solution, rec, RectifyOptions(), options, ids, turns or {}, None, with_photos, times or {})
    tmp_path.mkdir(exist_ok=True)
    return made, made.begin(tmp_path, StageLog(None))


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("num_cameras", [1, 3])
def test_sparse_opens_as_text_and_binary(tmp_path, rng, form, num_cameras):
    import pycolmap

    cameras = [camera_of(), camera_of(dist=()), camera_of(lens="fisheye")][:num_cameras]
    names = [f"sub{k % 2}/{k}.jpg" for k in range(4)]
    made, _ = outputs_of(rng, tmp_path, OutputOptions(sparse_format=form), cameras=cameras, names=names)
    parts = {path.name for path in (tmp_path / "sparse").iterdir()}
    assert parts == {f"{part}.{form}" for part in ("cameras", "images", "points3D", "rigs", "frames")}
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert model.num_cameras() == num_cameras
    assert sorted(image.name for image in model.images.values()) == sorted(made.reconstruction.image_names)
    assert model.compute_mean_reprojection_error() < 1e-6
    assert (tmp_path / "stereo" / "fusion.cfg").read_text().split("\n")[:-1] == list(made.reconstruction.image_names)
    for product in ("depth_maps", "normal_maps", "consistency_graphs"):
        assert files_of(tmp_path / "stereo" / product) == ["sub0", "sub1"]


def test_text_that_cuts_names_is_said(tmp_path, rng):
    with pytest.warns(RsUndistortWarning, match="names end at a space in text, such as sub 0/0.jpg"):
        outputs_of(rng, tmp_path, OutputOptions(sparse_format="txt"), with_photos=False)


def write_colmap_array(path, array):
    """A (channels, height, width) map as COLMAP's stereo writes it."""
    channels, height, width = array.shape
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + array.astype("<f4").tobytes())


def test_dense_fusion_of_colmap_runs_in_the_workspace(tmp_path, rng):
    import pycolmap

    rec, solution = solved(rng, [camera_of()])
    K = np.array([[75.0, 0, 47.2], [0, 76.0, 35.1], [0, 0, 1]])
    small = Camera(96, 72, K)
    solution = replace(solution, rectified_cameras={"1": small})
    Outputs(solution, rec, RectifyOptions(), OutputOptions(), ModelIds.in_order(rec), {}).begin(
        tmp_path, StageLog(None)
    )
    v, u = np.mgrid[:72, :96]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    for image in solution.images:  # stereo itself needs a graphics card; its maps of the plane z = 8 do not
        (tmp_path / "images" / image.name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / image.name), np.full((72, 96, 3), 90, np.uint8))
        depth = (8 - image.center_w[2]) / (rays @ image.R_cw)[..., 2]
        normal = np.broadcast_to((image.R_cw @ [0, 0, -1.0])[:, None, None], (3, 72, 96))
        for kind, array in (("depth", depth[None]), ("normal", normal)):
            write_colmap_array(tmp_path / "stereo" / f"{kind}_maps" / f"{image.name}.geometric.bin", array)
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 3
    fused = pycolmap.stereo_fusion(tmp_path / "fused.ply", tmp_path, options=options, output_type="PLY")
    points = np.array([point.xyz for point in fused.points3D.values()])
    assert len(points) > 1000
    # COLMAP's stereo takes pixels half a pixel off; the plane is nearly square to the cameras
    assert np.median(np.abs(points[:, 2] - 8)) < 0.02
    assert (tmp_path / "fused.ply").stat().st_size > 15 * len(points)


def test_depth_maps_of_an_earlier_result_stay_and_are_reported(tmp_path, rng):
    """COLMAP made them, and would take them for those of the new photos."""
    made, _ = outputs_of(rng, tmp_path / "first", OutputOptions(report=False), names=[f"{k}.png" for k in range(4)])
    for name in made.reconstruction.image_names:
        (tmp_path / "photos").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "photos" / name), np.full((H, W, 3), 90, np.uint8))
    (tmp_path / "out" / "stereo").mkdir(parents=True)
    (tmp_path / "out" / "stereo" / "0.png.geometric.bin").write_bytes(b"map")
    with output_folder(tmp_path / "out", overwrite=True) as scratch:
        made.begin(scratch, StageLog(None))
    with pytest.warns(RsUndistortWarning, match="stereo holds maps that COLMAP made of an earlier result"):
        made.rectify(tmp_path / "photos", tmp_path / "out", Workers(1), StageLog(None))
    assert (tmp_path / "out" / "stereo" / "0.png.geometric.bin").read_bytes() == b"map"


def test_workspace_only_where_there_are_photos(tmp_path, rng):
    outputs_of(rng, tmp_path, with_photos=False)
    assert {path.name for path in tmp_path.iterdir()} == {
        "points.ply", "poses.txt", "solution.json", "sparse", "transforms.json",
    }  # fmt: skip


@pytest.mark.parametrize("orientations", [(6, 6, 6, 6), (1, 6, 8, 3)])
def test_rotated_photos_have_their_cameras_in_the_model(tmp_path, rng, orientations):
    import pycolmap

    names = [f"sub {k % 2}/{k}.jpg" for k in range(4)]
    turns = dict(zip(names, orientations, strict=True))
    _, turned = outputs_of(rng, tmp_path, turns=turns, cameras=[camera_of(), camera_of(dist=())])
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert model.num_reg_images() == 4
    assert model.compute_mean_reprojection_error() < 1e-6
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        expected = (H, W) if turns[image.name] in (6, 8) else (W, H)
        assert (camera.width, camera.height) == expected
        assert str(image.camera_id) == turned.image(image.name).camera_id
    assert len(frames) == 4


def test_sparse_format_is_checked():
    with pytest.raises(InputError, match="expected bin or txt"):
        OutputOptions(sparse_format="ply")


# ---------------------------------------------------------------- poses and points


def test_poses_are_tum_text_in_the_order_of_time(tmp_path, rng):
    R = Rotation.random(5, random_state=1).as_matrix()
    center = rng.normal(size=(5, 3))
    times = np.array([0.5, 0.1, 1700000000.25, 0.3, 0.2])
    write_trajectory(tmp_path / "poses.txt", times, R, center)
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    assert lines[0] == "# timestamp tx ty tz qx qy qz qw"
    table = np.loadtxt(tmp_path / "poses.txt")
    order = np.argsort(times)
    np.testing.assert_array_equal(table[:, 0], times[order])
    np.testing.assert_allclose(table[:, 1:4], center[order], rtol=1e-11)
    # the TUM format has the camera in the world
    np.testing.assert_allclose(Rotation.from_quat(table[:, 4:]).as_matrix(), R[order].transpose(0, 2, 1), atol=1e-10)


def test_timestamps_are_times_of_frames_or_places_of_photos(tmp_path, rng):
    made, _ = outputs_of(rng, tmp_path / "a")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "a" / "poses.txt")[:, 0], np.arange(4))
    names = made.reconstruction.image_names
    (tmp_path / "frames.csv").write_text("name,time_s\n" + "".join(f"{n},{2 - k / 4}\n" for k, n in enumerate(names)))
    times = photo_times(tmp_path)
    made, _ = outputs_of(rng, tmp_path / "b", times=times)
    table = np.loadtxt(tmp_path / "b" / "poses.txt")
    np.testing.assert_array_equal(table[:, 0], [1.25, 1.5, 1.75, 2.0])
    np.testing.assert_allclose(table[::-1, 1:4], made.reconstruction.center_w, rtol=1e-11)
    del times[names[0]]  # of some only: no times at all
    outputs_of(rng, tmp_path / "c", times=times)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "c" / "poses.txt")[:, 0], np.arange(4))


def test_another_table_called_frames_is_none_of_ours(tmp_path):
    (tmp_path / "frames.csv").write_text("a,b\n1,2\n")
    assert photo_times(tmp_path) == photo_times(tmp_path / "nowhere") == {}


@pytest.mark.parametrize("num", [0, 7])
def test_points_open_in_trimesh(tmp_path, rng, num):
    points, rgb = rng.normal(size=(num, 3)), rng.integers(0, 256, (num, 3), dtype=np.uint8)
    write_point_cloud(tmp_path / "points.ply", points, rgb)
    size = (tmp_path / "points.ply").stat().st_size
    assert size == len((tmp_path / "points.ply").read_bytes().split(b"end_header\n")[0]) + 11 + 15 * num
    if num:
        cloud = trimesh.load(tmp_path / "points.ply")
        np.testing.assert_allclose(cloud.vertices, points, rtol=1e-6)
        np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], rgb)


# ---------------------------------------------------------------- nerfstudio


@pytest.mark.parametrize("num_cameras", [1, 2])
def test_transforms_by_the_rules_of_nerfstudio(tmp_path, rng, num_cameras):
    cameras = [camera_of(), camera_of(fx=600.0)][:num_cameras]
    made, solution = outputs_of(rng, tmp_path, cameras=cameras)
    value = json.loads((tmp_path / "transforms.json").read_text())
    frames = value["frames"]
    assert value["camera_model"] == "OPENCV"  # read from the top level only
    intrinsics = {"w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"}
    # once for all frames, or with each of them
    assert intrinsics <= set(value) or all(intrinsics <= set(frame) for frame in frames)
    assert (intrinsics & set(value) == set()) == (num_cameras > 1)
    assert all("mask_path" in frame for frame in frames)  # all or none
    for path in [value["ply_file_path"], *(frame[key] for frame in frames for key in ("file_path", "mask_path"))]:
        assert not Path(path).is_absolute()
        assert ".." not in Path(path).parts
    # points are taken to be in the frame of the poses if nothing was applied to these
    assert "applied_transform" not in value
    assert "applied_scale" not in value
    points = trimesh.load(tmp_path / value["ply_file_path"]).vertices
    np.testing.assert_allclose(points, made.reconstruction.points_w, rtol=1e-6)
    for frame in frames:
        image = solution.image(frame["file_path"].removeprefix("images/"))
        camera = value | frame
        # theirs: x right, y up, looking along -z; pixels from the border
        X = np.linalg.inv(np.array(frame["transform_matrix"])) @ np.column_stack([points, np.ones(len(points))]).T
        u = camera["fl_x"] * X[0] / -X[2] + camera["cx"] - 0.5
        v = camera["fl_y"] * -X[1] / -X[2] + camera["cy"] - 0.5
        K = solution.rectified_cameras[image.camera_id].K
        ours = (np.asarray(points) - image.center_w) @ image.R_cw.T @ K.T
        np.testing.assert_allclose(np.column_stack([u, v]), ours[:, :2] / ours[:, 2:], atol=1e-6)


def test_masks_of_a_run_are_black_where_there_is_nothing(rng):
    # the rule is nerfstudio's: one channel, black is ignored; test_pipeline looks at the masks themselves
    from rsundistort import rectify

    _, mask = rectify(np.full((H, W, 3), 200, np.uint8), camera_of(dist=()), RowMotion([0.1, 0.05, 0.1]))
    assert mask.ndim == 2
    assert set(np.unique(mask)) == {0, 255}


# ---------------------------------------------------------------- poses with the shutter


READOUTS = ["top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left"]


def on_line(rng, camera, image, model, line, num=1000):
    """World points (n, 3) that a photo shows on one line of pixels, read at one time; and where."""
    axis = 1 if camera.readout in READOUTS[:2] else 0
    xy = np.column_stack([rng.uniform(5, W - 6, num), rng.uniform(5, H - 6, num)])
    xy[:, axis] = line
    rays, _ = unproject_points(xy, camera, None, "global")
    depth = rng.uniform(3, 20, num)
    q = np.column_stack([rays, np.ones(num)]) * depth[:, None]
    r = float(clock_of(camera, xy)[0])
    turn = Rotation.from_rotvec(r * image.motion.phi).as_matrix()
    moved = r * image.motion.velocity if model == "constant-motion" else 0.0
    return q @ turn @ image.R_cw + image.center_w + moved, xy


def cv_project(points_c, K, dist, fisheye):
    zero = np.zeros(3)
    if fisheye:
        return cv2.fisheye.projectPoints(points_c[:, None], zero, zero, K, dist)[0].reshape(-1, 2)
    return cv2.projectPoints(points_c, zero, zero, K, dist)[0].reshape(-1, 2)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
@pytest.mark.parametrize("model", ["constant-motion", "rotation"])
@pytest.mark.parametrize("readout", READOUTS)
def test_viewmats_are_the_poses_at_the_first_and_last_line(tmp_path, rng, readout, model, lens):
    camera = camera_of(readout, lens)
    _, solution = solved(rng, [camera], model)
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
    read = np.load(tmp_path / "gsplat.npz")
    assert set(read["rolling_shutter"]) == {f"ROLLING_{readout.upper().replace('-', '_')}"}
    assert set(read["camera_model"]) == {lens}
    last = (H if readout in READOUTS[:2] else W) - 1
    first_and_last = (0, last) if readout in (READOUTS[0], READOUTS[2]) else (last, 0)
    for i, image in enumerate(solution.images):
        assert read["names"][i] == image.name
        K = np.array(read["Ks"][i])
        K[:2, 2] -= 0.5
        k, p = read["radial_coeffs"][i], read["tangential_coeffs"][i]
        dist = k[:4] if lens == "fisheye" else np.array([*k[:2], *p, k[2]])
        for line, viewmat in zip(first_and_last, (read["viewmats"][i], read["viewmats_rs"][i]), strict=True):
            X_w, xy = on_line(rng, camera, image, model, line)
            motion = image.motion.in_camera(image.R_cw)
            ours, valid = project_points((X_w - image.center_w) @ image.R_cw.T, camera, motion, model)
            assert valid.all()
            np.testing.assert_allclose(ours, xy, atol=1e-6)
            theirs = cv_project(X_w @ viewmat[:3, :3].T + viewmat[:3, 3], K, dist, lens == "fisheye")
            np.testing.assert_allclose(theirs, ours, atol=1e-6)


def ngp_pose(frame, uv):
    """The pose that instant-ngp takes for a pixel: rotations interpolated on the sphere, centres on a line."""
    A, B, C, _ = frame["rolling_shutter"]
    t = A + B * uv[0] + C * uv[1]
    start, end = (np.array(frame[f"transform_matrix_{which}"]) for which in ("start", "end"))
    turn = Slerp([0, 1], Rotation.from_matrix([start[:3, :3], end[:3, :3]]))(t).as_matrix()
    return turn @ np.diag([1.0, -1, -1]), (1 - t) * start[:3, 3] + t * end[:3, 3]


@pytest.mark.parametrize("readout", READOUTS)
def test_poses_between_start_and_end_are_those_of_each_line(tmp_path, rng, readout):
    camera = camera_of(readout)
    _, solution = solved(rng, [camera])
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
    value = json.loads((tmp_path / "transforms.json").read_text())
    axis = 1 if readout in READOUTS[:2] else 0
    for frame in value["frames"]:
        image = solution.image(frame["file_path"])
        for line in (0, 17, 333, (W, H)[axis] - 1):
            X_w, xy = on_line(rng, camera, image, "constant-motion", line, 100)
            uv = (xy[0] + 0.5) / [W, H]
            R_wc, center = ngp_pose(frame, uv)
            seen = cv_project((X_w - center) @ R_wc, camera.K, camera.dist, False)
            np.testing.assert_allclose(seen, xy, atol=1e-6)


def gsplat_pose(start, end, t):
    """The view matrix of gsplat between two: quaternions on the sphere, translations of world to camera on a line."""
    turn = Slerp([0, 1], Rotation.from_matrix([start[:3, :3], end[:3, :3]]))(t).as_matrix()
    return turn, (1 - t) * start[:3, 3] + t * end[:3, 3]


def test_gsplat_bends_the_path_between_by_an_eighth_of_the_rotation_squared(tmp_path, rng):
    _, solution = solved(rng, [camera_of()])
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
    read = np.load(tmp_path / "gsplat.npz")
    for i, image in enumerate(solution.images):
        R_cw, t_cw = gsplat_pose(read["viewmats"][i], read["viewmats_rs"][i], 0.5)
        r = float(clock_of(camera_of(), np.array([[0.0, (H - 1) / 2]]))[0])
        R_true, center = image.motion.pose_at(r, image.R_cw, image.center_w)
        np.testing.assert_allclose(R_cw, R_true, atol=1e-12)
        turn = np.linalg.norm(image.motion.phi) * camera_of().frame_span
        moved = np.linalg.norm(image.motion.velocity) * camera_of().frame_span
        bound = np.linalg.norm(center) * turn**2 / 8 + turn * moved / 4
        assert np.linalg.norm(-R_cw.T @ t_cw - center) < 1.01 * bound


@pytest.mark.parametrize(("times", "unit", "seconds"), [({"1": 20.0}, "second", 0.02), ({}, "readout of a frame", 1.0)])
@pytest.mark.parametrize("readout", READOUTS[:2])
def test_velocities_take_the_photo_from_its_first_row_to_its_last(tmp_path, rng, readout, times, unit, seconds):
    _, solution = solved(rng, [camera_of(readout)], times=times)
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "../points.ply")
    value = json.loads((tmp_path / "transforms.json").read_text())
    assert (value["rolling_shutter_time"], value["time_unit"], value["exposure_time"]) == (seconds, unit, 0.0)
    assert value["ply_file_path"] == "../points.ply"
    for frame in value["frames"]:
        middle = np.array(frame["transform_matrix"])
        ends = [np.array(frame[f"transform_matrix_{which}"]) for which in ("start", "end")]
        top, bottom = ends if readout == "top-to-bottom" else ends[::-1]
        # as its own conversion of synthetic photos has it: from two poses to velocities in the camera
        angular = Rotation.from_matrix(bottom[:3, :3] @ top[:3, :3].T).as_rotvec() / seconds
        linear = (bottom[:3, 3] - top[:3, 3]) / seconds
        np.testing.assert_allclose(frame["camera_angular_velocity"], middle[:3, :3].T @ angular, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(frame["camera_linear_velocity"], middle[:3, :3].T @ linear, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(middle[:3, 3], (top[:3, 3] + bottom[:3, 3]) / 2, atol=1e-12)


def test_velocities_of_cameras_that_differ_are_by_the_frame(tmp_path, rng):
    _, solution = solved(rng, [camera_of(), camera_of(dist=())], times={"1": 20.0, "2": 30.0})
    files = {image.name: image.name for image in solution.images}
    write_shutter_poses(tmp_path, solution, files, "points.ply")
    assert json.loads((tmp_path / "transforms.json").read_text())["rolling_shutter_time"] == 1.0
    columns = replace(solution, cameras={**solution.cameras, "2": camera_of("left-to-right")})
    write_shutter_poses(tmp_path, columns, files, "points.ply")
    value = json.loads((tmp_path / "transforms.json").read_text())
    assert "rolling_shutter_time" not in value  # it knows of rows only
    assert all("camera_linear_velocity" not in frame for frame in value["frames"])


def test_intrinsics_are_those_of_the_original_photos(tmp_path, rng):
    _, solution = solved(rng, [camera_of(), camera_of(lens="fisheye")])
    write_shutter_poses(tmp_path, solution, {image.name: f"../{image.name}" for image in solution.images[:2]}, "p.ply")
    first, second = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert first["file_path"] == "../sub 0/0.jpg"
    assert [first[key] for key in ("k1", "k2", "p1", "p2", "k3")] == list(LENS)
    assert "is_fisheye" not in first
    assert [second[key] for key in ("k1", "k2", "k3", "k4")] == list(FISHEYE)
    assert second["is_fisheye"] is True
    assert "p1" not in second  # instant-ngp would take it for k3
    assert (second["cx"], second["cy"]) == (318.8, 244.2)


def test_lens_without_room_in_transforms_is_said(tmp_path, rng):
    _, solution = solved(rng, [camera_of(dist=(-0.1, 0.02, 0, 0, 0, 0.03, 0, 0))])
    files = {image.name: image.name for image in solution.images}
    assert "lens coefficients k4" in write_shutter_poses(tmp_path, solution, files, "points.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["gsplat.npz"]
    np.testing.assert_array_equal(np.load(tmp_path / "gsplat.npz")["radial_coeffs"][0], [-0.1, 0.02, 0, 0.03, 0, 0])


def test_velocity_counts_in_the_model_that_heeds_it_alone(tmp_path, rng):
    for model in ("rotation", "global"):
        _, solution = solved(rng, [camera_of()], model)
        write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
        frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
        assert not np.any(frame["camera_linear_velocity"])
        assert np.any(frame["camera_angular_velocity"]) == (model == "rotation")


def test_rs_poses_go_beside_the_model_and_name_the_originals(tmp_path, rng):
    outputs_of(rng, tmp_path / "without")
    assert not (tmp_path / "without" / "rs-poses").exists()
    turns = {f"sub {k % 2}/{k}.jpg": 6 for k in range(4)}
    made, _ = outputs_of(rng, tmp_path / "with", OutputOptions(rs_poses=True), turns)
    value = json.loads((tmp_path / "with" / "rs-poses" / "transforms.json").read_text())
    assert (value["w"], value["h"]) == (W, H)  # as stored, not as rotated
    assert [frame["file_path"] for frame in value["frames"]] == list(made.reconstruction.image_names)
    assert (tmp_path / "with" / "rs-poses" / value["ply_file_path"]).resolve() == tmp_path / "with" / "points.ply"
    R_cw, _ = read_transforms(tmp_path / "with" / "rs-poses" / "transforms.json")
    assert len(R_cw) == 4


def test_frames_without_files_are_left_out(tmp_path, rng):
    _, solution = solved(rng, [camera_of()])
    write_transforms(tmp_path / "transforms.json", solution, {})
    assert json.loads((tmp_path / "transforms.json").read_text())["frames"] == []


def bent_solution(rng, camera, model="constant-motion", scale=1.0):
    """Motions with a rotation and a way that are not steady, and shakes that are of no steady motion."""
    _, solution = solved(rng, [camera], model)
    images = []
    for image in solution.images:
        clock = np.linspace(*camera.clock_range, 201)
        turn = scale * (rng.normal(0, 2e-3, (1, 3)) * np.sin(9 * clock)[:, None] + rng.normal(0, 5e-3, 3))
        way = scale * rng.normal(0, 5e-3, (1, 3)) * np.cos(11 * clock)[:, None]
        bend = Bend(clock[0], clock[-1], turn, way)  # neither orthogonal to 1 nor to the clock
        images.append(replace(image, motion=replace(image.motion, bend=bend)))
    return replace(solution, images=tuple(images))


@pytest.mark.parametrize("readout", READOUTS)
def test_two_poses_of_a_bent_motion_are_the_best_two_and_the_rest_is_said(tmp_path, rng, readout):
    camera = camera_of(readout, dist=())
    solution = bent_solution(rng, camera)
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
    value, read = json.loads((tmp_path / "transforms.json").read_text()), np.load(tmp_path / "gsplat.npz")
    axis = 1 if readout in READOUTS[:2] else 0
    for i, image in enumerate(solution.images):
        frame = next(each for each in value["frames"] if each["file_path"] == image.name)
        worst, turned = 0.0, []
        for line in np.linspace(0, (W, H)[axis] - 1, 81):
            xy = np.linspace(0, 1, 20)[:, None] * [W - 1, H - 1]
            xy[:, axis] = line
            r = float(clock_of(camera, xy[:1])[0])
            R_cw, center = image.motion.pose_at(r, image.R_cw, image.center_w)
            rays = np.column_stack([(xy - camera.K[:2, 2]) / np.diag(camera.K)[:2], np.ones(20)])
            X_w = 4.0 * rays @ R_cw + center
            R_wc, stated = ngp_pose(frame, (xy[0] + 0.5) / [W, H])
            off = cv_project((X_w - stated) @ R_wc, camera.K, camera.dist, False) - xy
            worst = max(worst, np.linalg.norm(off, axis=1).max())
            turned.append((Rotation.from_matrix(R_wc.T) * Rotation.from_matrix(R_cw).inv()).as_rotvec())
        # here at the moment of the line that the point was on, and not at that of the one it has gone to: the share of
        # the clock at which images run, up to a sixth
        assert bend_px(camera, image.motion.in_camera(image.R_cw), 4.0) == pytest.approx(worst, rel=0.2)
        # of no other steady motion is the rest smaller: it has no mean and no slope
        assert np.abs(np.polyfit(np.linspace(-1, 1, 81), turned, 1)).max() < 0.03 * np.abs(turned).max()
        # and each line's own pose is there, too
        lines = read["lines"][i]
        assert sorted(lines[[0, -1]]) == [0, (W, H)[axis] - 1]
        for k in (0, 20, 64):
            r = float(clock_of(camera, np.array([[lines[k], lines[k]]]))[0])
            R_cw, center = image.motion.pose_at(r, image.R_cw, image.center_w)
            np.testing.assert_allclose(read["viewmats_lines"][i, k, :3, :3], R_cw, atol=1e-12)
            np.testing.assert_allclose(read["viewmats_lines"][i, k, :3, 3], -R_cw @ center, atol=1e-12)


def test_rs_poses_of_bent_rotations_do_not_travel(tmp_path, rng):
    solution = bent_solution(rng, camera_of(), "rotation")
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
    read = np.load(tmp_path / "gsplat.npz")["viewmats_lines"]
    centers = -np.einsum("nkji,nkj->nki", read[..., :3, :3], read[..., :3, 3])
    assert np.ptp(centers, axis=1).max() < 1e-12


def test_steady_motions_are_written_as_ever(tmp_path, rng):
    _, solution = solved(rng, [camera_of()])
    write_shutter_poses(tmp_path, solution, {image.name: image.name for image in solution.images}, "points.ply")
    assert "lines" not in np.load(tmp_path / "gsplat.npz")
    assert bend_px(camera_of(), solution.images[0].motion) == 0.0


def test_closing_line_says_what_two_poses_leave(rng):
    made, solution = solved(rng, [camera_of(dist=())])
    assert "rs-poses" not in dict(closing._shutter(solution))
    bent = bent_solution(rng, camera_of(dist=()))
    rec = made.with_motions([image.motion for image in bent.images])
    left = _left_by_two_poses(rec)
    assert left > 1
    said = dict(closing._shutter(replace(solution, quality={"rs_poses_px": left})))
    assert said["rs-poses"] == f"motions are not steady: two poses per photo are off by up to {left:.1f} px"
    assert _left_by_two_poses(made) == 0.0
