from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from folders import tree
from refusals import one_line
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    Observations,
    Reconstruction,
    RowMotion,
    Solution,
    SolvedImage,
    project_points,
    read_solution,
    write_solution,
)
from rsundistort.colmap.rectified_model import rectified_keypoints
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.io import (
    output_folder,
    write_colmap_model,
    write_transforms,
)
from rsundistort.io.record import Record
from rsundistort.model import Bend

K = [[500.0, 0, 322.5], [0, 510.0, 235.25], [0, 0, 1]]


# ---------------------------------------------------------------- solutions


def small_solution(readout="top-to-bottom"):
    first = Camera(640, 480, np.array(K), np.array([-0.1, 0.02, 0.001, -0.002]), readout)
    second = Camera(400, 300, np.array([[300.0, 0, 201.0], [0, 310.0, 148.5], [0, 0, 1]]), readout=readout)
    images = []
    for i, camera_id in enumerate(("1", "2", "1")):
        images.append(
            SolvedImage(
                name=f"{i}.jpg",
                camera_id=camera_id,
                R_cw=Rotation.from_rotvec([0.1 * i, -0.2, 0.3]).as_matrix(),
                center_w=np.array([0.1 + i, 1 / 3, -2.0]),
                motion=RowMotion([0.01 + i, -0.02, 0.03 / 7], [0, 0.1, 0]),
                sigma_phi=np.array([1e-3, 2e-3, 3e-4]),
                num_observations=17 + i,
                rms_px=0.25,
                rs_shift_px=12.5,
            )
        )
    images.append(SolvedImage("lost.jpg", "1", reason="shares too little with the other photos"))
    return Solution(
        shutter_model="rotation",
        cameras={"1": first, "2": second},
        rectified_cameras={"1": first.pinhole(), "2": second.pinhole()},
        images=tuple(images),
        quality={"rms_px": np.float64(0.2), "num_points": np.int64(5), "bad": np.nan},
        stages=({"name": "features", "seconds": 1.5},),
        options={"seed": 3, "still": ["0.jpg"]},
        generator={"rsundistort": "0"},
    )


def test_solution_round_trip(tmp_path):
    solution = small_solution()
    path = tmp_path / "solution.json"
    write_solution(path, solution)
    assert [p.name for p in tmp_path.iterdir()] == ["solution.json"]
    back = read_solution(path)
    assert back.cameras == solution.cameras
    for key, camera in solution.rectified_cameras.items():
        np.testing.assert_array_equal(back.rectified_cameras[key].K, camera.K)
        assert (back.rectified_cameras[key].width, back.rectified_cameras[key].height) == (camera.width, camera.height)
    assert back.shutter_model == solution.shutter_model
    assert back.options == solution.options
    assert back.generator == solution.generator
    assert list(back.stages) == list(solution.stages)
    assert back.quality == {"rms_px": 0.2, "num_points": 5, "bad": None}
    assert [image.name for image in back.registered] == ["0.jpg", "1.jpg", "2.jpg"]
    for a, b in zip(back.images, solution.images, strict=True):
        for name in ("name", "camera_id", "registered", "posed", "num_observations", "rms_px", "rs_shift_px", "reason"):
            assert getattr(a, name) == getattr(b, name)
        if b.motion is None:
            assert a.motion is None
            assert a.R_cw is None
            continue
        np.testing.assert_array_equal(a.R_cw, b.R_cw)
        np.testing.assert_array_equal(a.center_w, b.center_w)
        np.testing.assert_array_equal(a.motion.phi, b.motion.phi)
        np.testing.assert_array_equal(a.motion.velocity, b.motion.velocity)
        np.testing.assert_array_equal(a.sigma_phi, b.sigma_phi)
    text = path.read_text()
    assert "NaN" not in text
    write_solution(path, back)
    assert path.read_text() == text


def test_solution_without_poses_round_trips(tmp_path):
    solution = small_solution()
    images = tuple(replace(image, R_cw=None, center_w=None) for image in solution.images)
    write_solution(tmp_path / "truth.json", replace(solution, images=images))
    back = read_solution(tmp_path / "truth.json")
    assert len(back.registered) == 3
    assert not any(image.posed for image in back.images)


@pytest.mark.parametrize(
    ("readout", "aspect", "skew"),
    [
        ("top-to-bottom", 1 - 0.1, 0.02),
        ("bottom-to-top", 1 + 0.1, -0.02),
        ("left-to-right", 1 + 0.02, -0.1),
        ("right-to-left", 1 - 0.02, 0.1),
    ],
)
def test_imaginary_camera_follows_the_readout(tmp_path, readout, aspect, skew):
    camera = Camera(640, 480, np.array(K), readout=readout)
    image = SolvedImage("a.jpg", "1", motion=RowMotion([0.1, 0.02, 0.3]))
    write_solution(tmp_path / "s.json", Solution("rotation", {"1": camera}, {"1": camera}, (image,)))
    entry = json.loads((tmp_path / "s.json").read_text())["images"][0]
    assert entry["aspect"] == pytest.approx(aspect)
    assert entry["skew"] == pytest.approx(skew)


@pytest.mark.parametrize("readout", ["top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left"])
def test_imaginary_camera_is_what_a_slight_motion_does(tmp_path, readout):
    camera = Camera(640, 480, np.array(K), readout=readout)
    motion = RowMotion([1e-4, 2e-4, 3e-4])
    image = SolvedImage("a.jpg", "1", motion=motion)
    write_solution(tmp_path / "s.json", Solution("rotation", {"1": camera}, {"1": camera}, (image,)))
    entry = json.loads((tmp_path / "s.json").read_text())["images"][0]
    # near the principal point the raw photo is an affine image of the ideal one
    h = 1e-4
    xy, valid = project_points([[0, 0, 1], [h, 0, 1], [0, h, 1]], camera, motion, "rotation")
    assert valid.all()
    seen = (xy - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    jacobian = (seen[1:] - seen[0]).T / h
    clock, other = (1, 0) if readout in ("top-to-bottom", "bottom-to-top") else (0, 1)
    assert jacobian[clock, clock] == pytest.approx(entry["aspect"], abs=2e-7)
    assert jacobian[other, clock] == pytest.approx(entry["skew"], abs=2e-7)


def garble(path, change):
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def bent_solution(moves=True):
    solution = small_solution()
    rng = np.random.default_rng(2)
    bend = Bend(-0.4, 0.5, rng.normal(size=(9, 3)), rng.normal(size=(9, 3)) if moves else None)
    first = next(image for image in solution.images if image.motion is not None)
    bent = replace(first, motion=replace(first.motion, bend=bend))
    return replace(solution, images=tuple(bent if each is first else each for each in solution.images)), bent


@pytest.mark.parametrize("moves", [True, False])
def test_motion_that_is_not_steady_is_written_and_read_again(tmp_path, moves):
    solution, bent = bent_solution(moves)
    write_solution(tmp_path / "solution.json", solution)
    value = json.loads((tmp_path / "solution.json").read_text())
    assert value["version"] == 2
    (entry,) = (each for each in value["images"] if "bend" in each)
    assert ("position" in entry["bend"]) == moves
    read = read_solution(tmp_path / "solution.json").image(bent.name).motion.bend
    np.testing.assert_allclose(read.clock, bent.motion.bend.clock, atol=1e-15)
    np.testing.assert_array_equal(read.values, bent.motion.bend.values)
    # by any program: a spline of SciPy through what the file says
    clock = np.linspace(-0.4, 0.5, 50)
    spline = CubicSpline(entry["bend"]["clock"], entry["bend"]["rotation"])(clock)
    np.testing.assert_allclose(bent.motion.bend.at(clock)[0], spline, atol=1e-12)


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("clock", lambda clock: [*clock[:-1], clock[-1] + 0.1]),
        ("clock", lambda clock: clock[::-1]),
        ("clock", lambda clock: clock[:5]),
        ("rotation", lambda rotation: rotation[:-1]),
        ("rotation", lambda rotation: [*rotation[:-1], [0, None, 0]]),
        ("position", lambda position: position[1:]),
        ("rotation", None),
    ],
)
def test_garbled_bends_are_refused(tmp_path, key, change):
    path = tmp_path / "solution.json"
    solution, bent = bent_solution()
    write_solution(path, solution)

    def garble_bend(value):
        bend = next(each["bend"] for each in value["images"] if each["name"] == bent.name)
        value = bend.pop(key)
        if change is not None:
            bend[key] = change(value)

    garble(path, garble_bend)
    with pytest.raises(FormatError) as error:
        read_solution(path)
    assert "solution.json" in one_line(error)


@pytest.mark.parametrize("key", ["cameras", "rectified_cameras", "images", "shutter_model", "format", "version"])
def test_solution_that_lacks_a_key_is_refused(tmp_path, key):
    path = tmp_path / "solution.json"
    write_solution(path, small_solution())
    garble(path, lambda value: value.pop(key))
    with pytest.raises(FormatError) as error:
        read_solution(path)
    assert "solution.json" in one_line(error)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format", "other"),
        ("version", 3),
        ("version", "1"),
        ("cameras", []),
        ("cameras", {}),
        ("images", 5),
        ("images", [1]),
        ("shutter_model", "spiral"),
        ("shutter_model", []),
        ("rectified_cameras", {"1": {"width": 3, "height": 3}}),
        pytest.param("rectified_cameras", {"1": {"width": "wide", "height": 3, "K": K}}),
        pytest.param("rectified_cameras", {}),
    ],
)
def test_garbled_solution_is_refused(tmp_path, key, value):
    path = tmp_path / "solution.json"
    write_solution(path, small_solution())
    garble(path, lambda whole: whole.update({key: value}))
    with pytest.raises(FormatError) as error:
        read_solution(path)
    assert "solution.json" in one_line(error)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("name", "1.jpg"),
        ("name", ["a"]),
        ("camera_id", "9"),
        ("phi", [1, 2]),
        pytest.param("phi", "fast"),
        ("phi", [float("inf"), 0, 0]),
        pytest.param("velocity", ["a", "b", "c"]),
        ("R_cw", [[1, 0, 0], [0, 1, 0], [0, 0, 2]]),
        pytest.param("R_cw", "eye"),
        pytest.param("R_cw", [[1], [2, 3]]),
        ("center_w", [1, 2]),
        ("center_w", "here"),
        pytest.param("sigma_phi", ["a", "b", "c"]),
    ],
)
def test_garbled_photo_of_a_solution_is_refused(tmp_path, key, value):
    path = tmp_path / "solution.json"
    write_solution(path, small_solution())
    garble(path, lambda whole: whole["images"][0].update({key: value}))
    with pytest.raises(FormatError) as error:
        read_solution(path)
    assert "solution.json" in one_line(error)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b"3", b"null"])
def test_what_is_no_solution_is_refused(tmp_path, content):
    path = tmp_path / "solution.json"
    path.write_bytes(content)
    with pytest.raises(FormatError) as error:
        read_solution(path)
    assert "solution.json" in one_line(error)


def test_a_solution_is_not_written_into_what_is_no_folder(tmp_path):
    for path in (tmp_path / "nowhere" / "solution.json", tmp_path):
        with pytest.raises(FileError, match=r"cannot be written .*give a file in a folder that is there"):
            write_solution(path, small_solution())
    assert tree(tmp_path) == {}


def test_missing_solution_is_refused(tmp_path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(FileError) as error:
            read_solution(path)
        assert str(path) in one_line(error)


# ---------------------------------------------------------------- folders of outputs


def test_outputs_appear_at_the_end(tmp_path):
    out = tmp_path / "deep" / "out"
    with output_folder(out) as scratch:
        (scratch / "images").mkdir()
        (scratch / "images" / "a.png").write_bytes(b"a")
        (scratch / "solution.json").write_bytes(b"s")
        assert not (out / "images").exists()
        assert not (out / "solution.json").exists()
    record = {Record.NAME: (out / Record.NAME).read_bytes()}
    assert tree(out) == {"images": None, "images/a.png": b"a", "solution.json": b"s"} | record


def write_and_fail(out, error, overwrite=False):
    with output_folder(out, overwrite=overwrite) as scratch:
        (scratch / "a.txt").write_text("new")
        raise error


@pytest.mark.parametrize("error", [InputError("bad"), FileError("no disk"), KeyboardInterrupt(), ZeroDivisionError()])
def test_failure_removes_what_was_made(tmp_path, error):
    with pytest.raises(type(error)):
        write_and_fail(tmp_path / "deep" / "out", error)
    assert tree(tmp_path) == {}


def test_failure_leaves_a_folder_that_was_there(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(InputError):
        write_and_fail(out, InputError("bad"))
    assert tree(tmp_path) == {"out": None}
    (out / "a.txt").write_text("old")
    with pytest.raises(InputError):
        write_and_fail(out, InputError("bad"), overwrite=True)
    assert tree(out) == {"a.txt": b"old"}


def test_folder_in_use_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(FileError, match="not empty") as error, output_folder(tmp_path):
        pytest.fail("entered")
    assert str(tmp_path) in one_line(error)
    assert tree(tmp_path) == {"mine.txt": b"mine"}


def test_overwrite_replaces_outputs_and_keeps_the_rest(tmp_path):
    with output_folder(tmp_path) as scratch:
        (scratch / "images" / "sub").mkdir(parents=True)
        (scratch / "images" / "sub" / "old.png").write_bytes(b"old")
        (scratch / "solution.json").write_bytes(b"old")
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "images" / "mine.png").write_bytes(b"mine")
    with output_folder(tmp_path, overwrite=True) as scratch:
        (scratch / "images").mkdir()
        (scratch / "images" / "new.png").write_bytes(b"new")
        (scratch / "solution.json").write_bytes(b"new")
    found = tree(tmp_path)
    assert b"old.png" not in found.pop(Record.NAME)
    assert found == {
        "images": None,
        "images/mine.png": b"mine",
        "images/new.png": b"new",
        "mine.txt": b"mine",
        "solution.json": b"new",
    }


def test_overwrite_replaces_a_file_by_a_folder_of_its_name(tmp_path):
    with output_folder(tmp_path) as scratch:
        (scratch / "sparse").write_bytes(b"old")
    with output_folder(tmp_path, overwrite=True) as scratch:
        (scratch / "images").mkdir()
        (scratch / "sparse").mkdir()
    assert tree(tmp_path) == {"images": None, "sparse": None}


def write_sparse_into(out):
    with output_folder(out, overwrite=True) as scratch:
        (scratch / "sparse").mkdir()


def test_a_file_of_others_in_the_place_of_a_folder_is_refused(tmp_path):
    (tmp_path / "sparse").write_bytes(b"mine")
    with pytest.raises(FileError, match="sparse is in the way of a folder"):
        write_sparse_into(tmp_path)
    assert tree(tmp_path) == {"sparse": b"mine"}


def test_the_photos_folder_is_refused(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    (tmp_path / "link").symlink_to(photos)
    for out in (photos, tmp_path / "link", tmp_path / "photos" / ".." / "photos"):
        with (
            pytest.raises(FileError, match="holds the photos"),
            output_folder(out, overwrite=True, apart_from=[photos]),
        ):
            pytest.fail("entered")
    assert tree(photos) == {}


def test_a_file_and_a_folder_below_a_file_are_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    for out in (tmp_path / "file", tmp_path / "file" / "out", tmp_path / "file" / "deep" / "out"):
        with pytest.raises(FileError) as error, output_folder(out, overwrite=True):
            pytest.fail("entered")
        one_line(error)
    assert tree(tmp_path) == {"file": b"x"}


# ---------------------------------------------------------------- nerfstudio


@pytest.mark.parametrize("cameras", [1, 2])
def test_transforms_project_as_the_solution(tmp_path, cameras):
    solution = small_solution()
    if cameras == 1:
        solution = replace(solution, images=tuple(replace(image, camera_id="1") for image in solution.images))
    files = {f"{i}.jpg": (f"images/{i}.jpg", f"masks/{i}.png") for i in range(3)}
    write_transforms(tmp_path / "transforms.json", solution, files)
    value = json.loads((tmp_path / "transforms.json").read_text())
    assert ("fl_x" in value) == (cameras == 1)
    assert [frame["file_path"] for frame in value["frames"]] == [f"images/{i}.jpg" for i in range(3)]
    assert [frame["mask_path"] for frame in value["frames"]] == [f"masks/{i}.png" for i in range(3)]
    rng = np.random.default_rng(0)
    for frame, image in zip(value["frames"], solution.registered, strict=True):
        assert ("fl_x" in frame) == (cameras == 2)
        intrinsics = {**value, **frame}
        assert intrinsics["camera_model"] == "OPENCV"
        camera = solution.rectified_cameras[image.camera_id]
        assert (intrinsics["w"], intrinsics["h"]) == (camera.width, camera.height)
        assert all(intrinsics[k] == 0 for k in ("k1", "k2", "p1", "p2"))
        points_c = np.column_stack([rng.uniform(-1, 1, (20, 2)), rng.uniform(3, 6, 20)])
        points_w = points_c @ image.R_cw + image.center_w
        ours = points_c @ camera.K.T
        ours = ours[:, :2] / ours[:, 2:] + 0.5
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        x, y, z, _ = np.linalg.inv(matrix) @ np.column_stack([points_w, np.ones(20)]).T
        assert (z < 0).all()  # OpenGL looks along -z, y up
        theirs = np.column_stack(
            [
                intrinsics["cx"] + intrinsics["fl_x"] * x / -z,
                intrinsics["cy"] - intrinsics["fl_y"] * y / -z,
            ]
        )
        np.testing.assert_allclose(theirs, ours, atol=1e-9)


def test_transforms_leave_out_photos_without_a_pose(tmp_path):
    solution = small_solution()
    images = (replace(solution.images[0], R_cw=None, center_w=None), *solution.images[1:])
    files = {f"{i}.jpg": (f"images/{i}.jpg", f"masks/{i}.png") for i in range(3)}
    write_transforms(tmp_path / "transforms.json", replace(solution, images=images), files)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/1.jpg", "images/2.jpg"]


# ---------------------------------------------------------------- COLMAP


def noise_free(model, lens=()):
    """Three photos of two cameras with exact measurements."""
    rng = np.random.default_rng(5)
    cameras = [
        Camera(640, 480, np.array(K), np.array(lens)),
        Camera(400, 300, np.array([[300.0, 0, 201.0], [0, 310.0, 148.5], [0, 0, 1]])),
    ]
    points = np.column_stack([rng.uniform(-2, 2, (80, 2)), rng.uniform(6, 10, 80)])
    camera_idx = np.array([0, 1, 0])
    R = Rotation.from_rotvec(rng.normal(0, 0.05, (3, 3))).as_matrix()
    center = np.array([[-0.5, 0, 0], [0, 0.2, 0.1], [0.6, -0.1, 0]])
    phi = np.zeros((3, 3)) if model == "global" else rng.normal(0, 0.05, (3, 3))
    frame, point, xy = [], [], []
    for i in range(3):
        camera = cameras[camera_idx[i]]
        pixels, valid = project_points((points - center[i]) @ R[i].T, camera, RowMotion(phi[i]), model)
        valid &= (pixels >= 0).all(1) & (pixels <= [camera.width - 1, camera.height - 1]).all(1)
        seen = rng.permutation(np.flatnonzero(valid))
        frame += [i] * len(seen)
        point += seen.tolist()
        xy.append(pixels[seen])
    observations = Observations(np.array(frame), np.array(point), np.concatenate(xy))
    names = ["a.jpg", "b.jpg", "c.jpg"]
    return Reconstruction(cameras, names, camera_idx, R, center, points, observations, phi, shutter_model=model)


@pytest.mark.parametrize(
    ("model", "lens"), [("global", ()), ("global", (-0.1, 0.02, 1e-3, -2e-3)), ("rotation", (-0.1, 0.02, 1e-3, -2e-3))]
)
def test_colmap_model_opens_and_projects_onto_the_measurements(tmp_path, model, lens):
    import pycolmap

    rec = noise_free(model, lens)
    rectified = [camera.pinhole() for camera in rec.cameras]
    colors = np.random.default_rng(6).integers(0, 256, (rec.num_points, 3), dtype=np.uint8)
    write_colmap_model(tmp_path / "sparse", rec, rectified, list(rec.image_names), colors)
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {p.name for p in (tmp_path / "sparse").iterdir()}
    read = pycolmap.Reconstruction(tmp_path / "sparse")
    assert read.num_reg_images() == 3
    assert read.num_cameras() == 2
    for index, camera in enumerate(rec.cameras):
        theirs = read.cameras[index + 1]
        assert theirs.model.name == "PINHOLE"
        assert (theirs.width, theirs.height) == (camera.width, camera.height)
        np.testing.assert_allclose(theirs.params, [*np.diag(camera.K)[:2], *(camera.K[:2, 2] + 0.5)])
    keypoints = rectified_keypoints(rec, rectified)
    assert np.isfinite(keypoints).all()
    if model == "global" and not lens:
        np.testing.assert_allclose(keypoints, rec.observations.xy_raw, atol=1e-9)
    obs = rec.observations
    for i, name in enumerate(rec.image_names):
        image = read.images[i + 1]
        assert image.name == name
        assert image.camera_id == rec.camera_idx[i] + 1
        matrix = image.cam_from_world().matrix()
        np.testing.assert_allclose(matrix[:, :3], rec.R_cw[i], atol=1e-12)
        np.testing.assert_allclose(image.projection_center(), rec.center_w[i], atol=1e-12)
        of_photo = np.flatnonzero(obs.frame_idx == i)
        assert len(image.points2D) == len(of_photo)
        for k, element in zip(of_photo, image.points2D, strict=True):
            np.testing.assert_allclose(element.xy, keypoints[k] + 0.5, atol=1e-9)
            if not element.has_point3D():
                continue
            point = read.points3D[element.point3D_id]
            np.testing.assert_array_equal(point.xyz, rec.points_w[obs.point_idx[k]])
            np.testing.assert_array_equal(point.color, colors[obs.point_idx[k]])
            camera = read.cameras[image.camera_id]
            projected = camera.img_from_cam(image.cam_from_world() * point.xyz)
            np.testing.assert_allclose(np.ravel(projected), element.xy, atol=1e-6)
    tracks = np.bincount(obs.point_idx, minlength=rec.num_points)
    assert read.num_points3D() == (tracks >= 2).sum() > 40
    assert read.compute_mean_reprojection_error() < 1e-6
