"""Cameras from files: each format is written by its own writer, read back and compared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import one_line

from rsundistort import Camera, RsUndistortError
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.io import check_camera_fits, read_camera_file
from rsundistort.io.cameras import camera_to_json
from rsundistort.model.projection import project_points

SCENES = Path(__file__).parent.parent / "sample_scenes"

K = np.array([[500.1, 0, 322.7], [0, 1530 / 3.1, 235.25], [0, 0, 1]])
DIST = [-0.1, 0.02, 1 / 3000, -0.002, 0.003, 0.1, -0.01, 1e-17, 1e-4, 2e-4, -3e-4, 4e-5]
LENSES = [("pinhole", n) for n in (0, 4, 5, 8, 12)] + [("fisheye", 4)]
lenses = pytest.mark.parametrize(("lens", "length"), LENSES)


def calibrated(lens="pinhole", length=5):
    return Camera(640, 480, K, np.array(DIST[:length]), lens=lens)


def read_one(path, width=640, height=480):
    found = read_camera_file(str(path), width, height)
    assert not found.camera_of_image
    assert str(path) in found.source
    (camera,) = found.cameras.values()
    return camera


# ---------------------------------------------------------------- OpenCV


# the names of OpenCV's calibration program since 3.0, of the one before, and of what people write
NAMES = {
    "sample": ("image_width", "image_height", "camera_matrix", "distortion_coefficients"),
    "old sample": ("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients"),
    "arguments": ("imageWidth", "imageHeight", "cameraMatrix", "distCoeffs"),
    "letters": ("width", "height", "K", "D"),
}


def write_opencv(path, camera, names=NAMES["sample"], flag="fisheye_model", size=True):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Do 2. Jän 2025: 12 Uhr")
    if size:
        storage.write(names[0], camera.width)
        storage.write(names[1], camera.height)
    storage.write("board_width", 9)
    if path.suffix != ".json":  # OpenCV's comments are no JSON
        storage.writeComment("flags: +fix_k3")
    storage.write("flags", 128)
    if flag == "fisheye_model":
        storage.write(flag, int(camera.lens == "fisheye"))
    elif flag:
        storage.write(flag, "equidistant" if camera.lens == "fisheye" else "plumb_bob")
    storage.write(names[2], camera.K)
    if len(camera.dist):
        storage.write(names[3], camera.dist[:, None])
    storage.write("per_view_reprojection_errors", np.linspace(0.1, 0.3, 7, dtype=np.float32))
    storage.release()


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
@lenses
def test_opencv_round_trip(tmp_path, suffix, lens, length):
    path = tmp_path / f"out camera.{suffix}"
    write_opencv(path, calibrated(lens, length))
    assert read_one(path, 64, 48) == calibrated(lens, length)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("flag", ["", "fisheye_model", "distortion_model", "camera_model"])
def test_opencv_names(tmp_path, suffix, names, flag):
    camera = calibrated("fisheye", 4) if flag else calibrated()
    write_opencv(tmp_path / f"c.{suffix}", camera, names, flag)
    assert read_one(tmp_path / f"c.{suffix}") == camera


def test_opencv_without_a_size_has_that_of_the_photos(tmp_path):
    write_opencv(tmp_path / "c.yml", calibrated(), size=False)
    assert read_one(tmp_path / "c.yml") == calibrated()
    assert read_one(tmp_path / "c.yml", 800, 600) == replace(calibrated(), width=800, height=600)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencv_size_as_a_pair(tmp_path, suffix):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.startWriteStruct("image_size", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
    storage.write("", 640)
    storage.write("", 480)
    storage.endWriteStruct()
    storage.write("camera_matrix", K)
    storage.release()
    assert read_one(path, 64, 48) == calibrated(length=0)


def test_opencv_from_windows(tmp_path):
    write_opencv(tmp_path / "c.yml", calibrated())
    text = (tmp_path / "c.yml").read_bytes()
    (tmp_path / "c.yml").write_bytes(b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n"))
    assert read_one(tmp_path / "c.yml") == calibrated()


def test_the_header_of_opencv_4_and_5(tmp_path):
    write_opencv(tmp_path / "c.yml", calibrated())
    lines = (tmp_path / "c.yml").read_text().splitlines(keepends=True)
    for header in ("%YAML:1.0\n---\n", "%YAML:1.0\n", "%YAML 1.2\n---\n", "---\n", ""):
        (tmp_path / "c.yml").write_text(header + "".join(lines[2:]))
        assert read_one(tmp_path / "c.yml") == calibrated()


def test_a_tilted_sensor(tmp_path):
    """calibrateCamera gives 14 coefficients where it may tilt the sensor; our model ends at 12."""
    path = tmp_path / "c.json"
    value = {"camera_matrix": K.tolist(), "dist_coeffs": [[*DIST, 0.0, 0.0]]}
    path.write_text(json.dumps(value))
    assert read_one(path) == calibrated(length=12)
    value["dist_coeffs"][0][-1] = 0.01
    path.write_text(json.dumps(value))
    with pytest.raises(FormatError) as error:
        read_one(path)
    assert "tilted" in one_line(error)


# ---------------------------------------------------------------- ROS


def ros_text(camera, style="calibrator", **more):
    """As `camera_calibration`, `camera_calibration_parsers` and `ros2 topic echo` write it."""
    if camera.lens == "fisheye":
        model = "equidistant"
    else:
        model = "rational_polynomial" if len(camera.dist) > 5 else "plumb_bob"
    block = style == "parsers"

    def numbers(values):
        if block:
            return "".join(f"\n  - {float(v)!r}" for v in values)
        return " [" + ", ".join(repr(float(v)) for v in values) + "]"

    P = np.column_stack([camera.K, np.zeros(3)])
    if style == "echo":
        lines = ["header:", "  stamp:", "    sec: 1", "  frame_id: ''", f"height: {camera.height}"]
        lines += [f"width: {camera.width}", f"distortion_model: {model}", f"d:{numbers(camera.dist)}"]
        lines += [f"k:{numbers(camera.K.ravel())}", f"p:{numbers(P.ravel())}"]
        return "\n".join(
            lines + [f"{key}: {value}" for key, value in more.items()] + ["---", "header: next", "---", ""]
        )
    name = "00b09d0100990bb6" if block else "Kamera für vorn: links"
    lines = [f"image_width: {camera.width}", f"image_height: {camera.height}", f"camera_name: {name!r}"]
    lines += ["camera_matrix:", "  rows: 3", "  cols: 3", f"  data:{numbers(camera.K.ravel())}"]
    lines += [f"distortion_model: {model}", "distortion_coefficients:", "  rows: 1"]
    lines += [f"  cols: {len(camera.dist)}", f"  data:{numbers(camera.dist) if len(camera.dist) else ' []'}"]
    lines += ["rectification_matrix:", "  rows: 3", "  cols: 3", f"  data:{numbers(np.eye(3).ravel())}"]
    lines += ["projection_matrix:", "  rows: 3", "  cols: 4", f"  data:{numbers(P.ravel())}"]
    return "\n".join(lines + [f"{key}: {value}" for key, value in more.items()]) + "\n"


@pytest.mark.parametrize("style", ["calibrator", "parsers", "echo"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(("lens", "length"), [("pinhole", 5), ("pinhole", 8), ("fisheye", 4)])
def test_ros_round_trip(tmp_path, style, newline, lens, length):
    path = tmp_path / "head camera.yaml"
    path.write_text(ros_text(calibrated(lens, length), style), encoding="utf-8", newline=newline)
    assert read_one(path, 64, 48) == calibrated(lens, length)


def test_ros_before_it_is_calibrated(tmp_path):
    """A driver without a calibration publishes zeros."""
    text = ros_text(calibrated()).replace(repr(float(K[0, 0])), "0.0").replace(repr(float(K[1, 1])), "0.0")
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(FormatError) as error:
        read_one(tmp_path / "c.yaml")
    assert "focal" in one_line(error)


def test_binning_and_region_of_interest_of_ros(tmp_path):
    """The camera of the pixels that the driver hands out: a region of the sensor, whose pixels are then averaged."""
    roi = "{x_offset: 100, y_offset: 40, width: 400, height: 300, do_rectify: false}"
    (tmp_path / "c.yaml").write_text(ros_text(calibrated(), "echo", binning_x=2, binning_y=4, roi=roi))
    camera = read_one(tmp_path / "c.yaml")
    assert (camera.width, camera.height) == (200, 75)
    assert np.array_equal(camera.dist, calibrated().dist)
    points = np.random.default_rng(2).uniform([-0.5, -0.5, 1], [0.5, 0.5, 2], (20, 3))
    full, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, calibrated().dist)
    handed, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.dist)
    # edges of pixels, at half, stay edges: (u + 1/2) scales
    expected = (full[:, 0] + 0.5 - [100, 40]) / [2, 4] - 0.5
    np.testing.assert_allclose(handed[:, 0], expected, atol=1e-11)


@pytest.mark.parametrize("unset", ["{x_offset: 0, y_offset: 0, width: 0, height: 0}", "{}", "null"])
def test_binning_of_zero_is_none(tmp_path, unset):
    (tmp_path / "c.yaml").write_text(ros_text(calibrated(), "echo", binning_x=0, binning_y=1, roi=unset))
    assert read_one(tmp_path / "c.yaml") == calibrated()


# ---------------------------------------------------------------- COLMAP

COLMAP = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 0,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 2,
    "OPENCV": 4,
    "FULL_OPENCV": 8,
    "SIMPLE_FISHEYE": 0,
    "FISHEYE": 0,
    "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 2,
    "OPENCV_FISHEYE": 4,
}
needs_model = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(name not in pycolmap.CameraModelId.__members__, reason="this pycolmap is older"),
    )
    for name in COLMAP
]


def colmap_camera(name, camera_id=1, width=640, height=480):
    focal = [500.1] if name.startswith(("SIMPLE", "RADIAL")) else [500.1, 510.7]
    params = [*focal, width / 2 + 1.25, height / 2 - 3.5, *DIST[: COLMAP[name]]]
    return pycolmap.Camera(model=name, width=width, height=height, params=params, camera_id=camera_id)


def colmap_model(cameras, images=()):
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for number, (name, camera_id) in enumerate(images):
        image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=camera_id, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    return model


def save_colmap(folder, model, suffix):
    folder.mkdir()
    (model.write_binary if suffix == "bin" else model.write_text)(folder)
    return folder


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("name", needs_model)
def test_colmap_round_trip(tmp_path, suffix, name):
    """Points lie where COLMAP sees them, half a pixel to the left and up."""
    theirs = colmap_camera(name)
    save_colmap(tmp_path / "model", colmap_model([theirs]), suffix)
    alone = tmp_path / f"cameras of mine.{suffix}"
    (tmp_path / "model" / f"cameras.{suffix}").rename(alone)
    ours = read_one(alone, 64, 48)
    assert (ours.width, ours.height) == (640, 480)
    points = np.random.default_rng(1).uniform([-0.6, -0.5, 1], [0.6, 0.5, 2], (50, 3))
    if ours.lens == "fisheye":
        dist = np.zeros(4)
        dist[: len(ours.dist)] = ours.dist
        xy, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), ours.K, dist)
    else:
        xy, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), ours.K, ours.dist)
    np.testing.assert_allclose(xy.reshape(-1, 2) + 0.5, theirs.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_colmap_says_whose_each_photo_is(tmp_path, suffix):
    # in COLMAP's text format a name ends at the first blank
    photos = [("a 1.jpg" if suffix == "bin" else "a_1.jpg", 3), ("links/Größe.jpg", 7), ("b.jpg", 3)]
    model = colmap_model([colmap_camera("OPENCV", 3), colmap_camera("PINHOLE", 7, 480, 640)], photos)
    folder = save_colmap(tmp_path / "größe model", model, suffix)
    for text in (folder, folder / f"cameras.{suffix}"):
        found = read_camera_file(text, 64, 48)
        assert dict(found.camera_of_image) == {name: str(key) for name, key in photos}
        assert {key: (camera.width, camera.height) for key, camera in found.cameras.items()} == {
            "3": (640, 480),
            "7": (480, 640),
        }
    (folder / f"images.{suffix}").unlink()
    assert not read_camera_file(folder, 64, 48).camera_of_image


@pytest.mark.parametrize(
    ("name", "extra"),
    [("FOV", [0.7]), ("SIMPLE_DIVISION", [-0.08]), ("THIN_PRISM_FISHEYE", [0.02, -0.01, 0, 0, 0.003, -0.001, 0, 0])],
)
def test_other_smooth_models_of_colmap_are_followed(tmp_path, name, extra):
    camera = pycolmap.Camera.create_from_model_name(4, name, 500, 640, 480)
    params = np.array(camera.params)
    params[len(params) - len(extra) :] = extra
    camera.params = params
    folder = save_colmap(tmp_path / "model", colmap_model([camera]), "bin")
    found = read_camera_file(folder, 640, 480).cameras["4"]
    xy = np.random.default_rng(0).uniform(0, [640, 480], (200, 2))
    rays = np.column_stack([camera.cam_from_img(xy), np.ones(200)])
    assert np.abs(project_points(rays, found, None, "global")[0] + 0.5 - xy).max() <= 0.05


def test_a_model_that_cannot_be_followed_is_named(tmp_path):
    camera = pycolmap.Camera.create_from_model_name(4, "THIN_PRISM_FISHEYE", 500, 640, 480)
    camera.params = np.array([*camera.params[:4], 0, 0, 0, 0, 0, 0, 0.02, 0.01])
    folder = save_colmap(tmp_path / "model", colmap_model([camera]), "txt")
    with pytest.raises(FormatError) as error:
        read_camera_file(folder, 640, 480)
    assert "camera 4 is THIN_PRISM_FISHEYE" in one_line(error)


# ---------------------------------------------------------------- ours


def test_cameras_json():
    found = read_camera_file(SCENES / "handheld" / "cameras.json", 64, 48)
    value = json.loads((SCENES / "handheld" / "cameras.json").read_text())
    assert found.camera_of_image == value["images"]
    assert {key: camera_to_json(camera) for key, camera in found.cameras.items()} == value["cameras"]


@lenses
def test_camera_json_round_trip(tmp_path, lens, length):
    camera = replace(calibrated(lens, length), readout="right-to-left")
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(camera)))
    assert read_one(tmp_path / "camera.json", 64, 48) == camera


@pytest.mark.parametrize(
    ("change", "stated"),
    [
        ({"cameras": {}}, "no camera"),
        ({"cameras": [1]}, "expected"),
        ({"cameras": {"1": {"width": 640}}}, "camera 1"),
        ({"images": {"a.jpg": "2"}}, "'2'"),
        ({"images": {"a.jpg": 1}}, "a.jpg"),
        ({"images": {"a.jpg": ["1"]}}, "a.jpg"),
        ({"images": ["a.jpg"]}, "expected"),
        ({"format": "rsundistort-solution"}, "expected"),
    ],
    ids=str,
)
def test_cameras_json_that_make_no_sense_are_refused(tmp_path, change, stated):
    value = {"cameras": {"1": camera_to_json(calibrated())}, "images": {"a.jpg": "1"}, **change}
    (tmp_path / "cameras.json").write_text(json.dumps(value))
    with pytest.raises(FormatError) as error:
        read_camera_file(tmp_path / "cameras.json", 640, 480)
    assert stated in one_line(error)
    assert "cameras.json" in one_line(error)


@pytest.mark.parametrize("part", ["cameras", "images"])
def test_a_name_given_twice_is_refused(tmp_path, part):
    camera = json.dumps(camera_to_json(calibrated()))
    twice = {"cameras": f'"front": {camera}, "front": {camera}', "images": f'"front": {camera}'}[part]
    images = '"a.jpg": "front"' + (', "a.jpg": "front"' if part == "images" else "")
    (tmp_path / "cameras.json").write_text(f'{{"cameras": {{{twice}}}, "images": {{{images}}}}}')
    with pytest.raises(FormatError) as error:
        read_camera_file(tmp_path / "cameras.json", 640, 480)
    assert "twice" in one_line(error)


def test_numbers():
    found = read_camera_file("500.1,510,322.7,235.25,-0.1,0.02,0,0", 640, 480)
    assert found.cameras["camera"] == Camera(
        640, 480, [[500.1, 0, 322.7], [0, 510, 235.25], [0, 0, 1]], [-0.1, 0.02, 0, 0]
    )


# ---------------------------------------------------------------- folders


def test_a_folder_of_cameras_of_any_format(tmp_path):
    """Each is known by the stem of its file."""
    wide, long = calibrated("fisheye", 4), calibrated()
    (tmp_path / "apple-iphone-6-4.15mm-640x480.json").write_text(json.dumps(camera_to_json(long)))
    (tmp_path / "Größe 2.yaml").write_text(ros_text(wide), encoding="utf-8")
    write_opencv(tmp_path / "c.xml", wide)
    (tmp_path / "k,1.txt").write_text(" ".join(str(v) for v in K.ravel()))
    model = save_colmap(tmp_path / "inner", colmap_model([colmap_camera("PINHOLE", 9)]), "txt")
    (model / "cameras.txt").rename(tmp_path / "from colmap.txt")
    (tmp_path / "README.md").write_text("not a camera")
    (tmp_path / ".hidden.json").write_text("{")
    found = read_camera_file(tmp_path, 640, 480)
    pinhole = Camera(640, 480, [[500.1, 0, 320.75], [0, 510.7, 236.0], [0, 0, 1]])
    assert found.cameras == {
        "apple-iphone-6-4.15mm-640x480": long,
        "Größe 2": wide,
        "c": wide,
        "k,1": calibrated(length=0),
        "from colmap": pinhole,
    }
    assert not found.camera_of_image


def test_folders_that_make_no_sense_are_refused(tmp_path):
    with pytest.raises(FileError) as error:
        read_camera_file(tmp_path, 640, 480)
    assert "no camera files" in one_line(error)
    (tmp_path / "front.json").write_text(json.dumps(camera_to_json(calibrated())))
    (tmp_path / "front.yaml").write_text(ros_text(calibrated()))
    with pytest.raises(InputError) as error:
        read_camera_file(tmp_path, 640, 480)
    assert "one name" in one_line(error)
    (tmp_path / "front.yaml").unlink()
    (tmp_path / "several.json").write_text((SCENES / "handheld" / "cameras.json").read_text())
    with pytest.raises(InputError) as error:
        read_camera_file(tmp_path, 640, 480)
    assert "several.json" in one_line(error)


# ---------------------------------------------------------------- whether a camera fits


def fit_error(camera, width, height):
    with pytest.raises(InputError) as error:
        check_camera_fits(camera, width, height, "c.yaml")
    text = one_line(error)
    assert f"{camera.width}x{camera.height}" in text
    assert f"{width}x{height}" in text
    return text


def test_a_camera_of_another_size_is_refused_with_what_to_do():
    camera = calibrated()
    assert "that is 1/2 of its size" in fit_error(camera, 320, 240)
    assert "that is 3 of its size" in fit_error(camera, 1920, 1440)
    assert "that is" not in fit_error(camera, 320, 241)
    text = fit_error(camera, 480, 640)
    assert "portrait" in text
    # K is (500.1, 1530 / 3.1, 322.7, 235.25), of 640x480: rotated either way
    assert "cx 235.25, cy 316.3 and the readout left-to-right" in text
    assert "cx 243.75, cy 322.7 and the readout right-to-left" in text
    assert "landscape" in fit_error(replace(camera, width=480, height=640), 640, 480)


# ---------------------------------------------------------------- bad files


@pytest.mark.parametrize(
    ("old", "new", "stated"),
    [
        ("camera_matrix", "kamera_matrix", "no camera"),
        ("distortion_coefficients", "distortion_coeficients", "distortioncoeficients"),
        ("plumb_bob", "Mei", "'Mei'"),
        ("image_width: 640", "image_width: 640.5", "image size"),
        ("image_width: 640", "image_width: -640", "image size"),
        ("image_width: 640", "image_width:", "image size"),
        ("image_width: 640", "image_width: wide", "wide"),
        ("image_width: 640", "image_width: .inf", ".inf"),
        ("image_width: 640", "image_width: nan", "image size"),
        ("500.1", ".nan", ".nan"),
        ("500.1", "nan", "K"),
        ("500.1", "inf", "K"),
        ("500.1", "-500.1", "focal"),
        ("500.1, ", "", "8 numbers"),
        ("500.1, ", "[500.1], ", ""),
        ("-0.1, 0.02, ", "", "3 numbers"),
        ("[-0.1", "[{a: 1}", ""),
        ("rows: 3", "rows: [", ""),
        ("image_height: 480", "\timage_height: 480", "line"),
        ("image_height: 480", "image_height: &a [*a]", ""),
        ("image_height: 480", "image_height: 480\nbinning_x: 1.5", "binningx"),
        ("image_height: 480", "image_height: 480\nroi: {x_offset: -1}", "xoffset"),
    ],
    ids=str,
)
def test_ros_calibrations_that_make_no_sense_are_refused(tmp_path, old, new, stated):
    text = ros_text(calibrated())
    assert old in text
    path = tmp_path / "c.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(FormatError) as error:
        read_one(path)
    assert str(path) in one_line(error)
    assert stated in one_line(error)


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 600,
        b"%YAML:1.0\n---\na: " + b"[" * 600,
        b"{" + b'"a":{' * 600,
        b"<a>" * 600,
        b"<html><body>camera_matrix</body></html>",
        b"<?xml version='1.0'?><opencv_storage></opencv_storage>",
        b"%YAML:1.0",
        b"\xef\xbb\xbf",
        b"a: \x07",
        b"1 FOO 640 480 500 320 240\n",
        b"1 PINHOLE 640 480 500 500 320\n",
        b"1 PINHOLE 640 480 500 500 nan 240\n",
        b"1 PINHOLE 0 480 500 500 320 240\n",
        b"1 PINHOLE 640 480 500 500 320 240\n1 PINHOLE 640 480 501 500 320 240\n",
        b"1 2 3 4 5 6 7 8 inf",
        b"nan 0 1 0 1 1 0 0 1",
        b"K: 5",
        b"K: [1, 2, 3]",
        b'{"K": 5}',
        b'{"camera_matrix": 5}',
        b'{"width": ' + b"9" * 5000 + b"}",
    ],
    ids=lambda content: content[:20],
)
@pytest.mark.parametrize("suffix", ["yaml", "txt", "json", "bin"])
def test_files_that_are_no_cameras_are_refused(tmp_path, content, suffix):
    path = tmp_path / f"ö a.{suffix}"
    path.write_bytes(content)
    with pytest.raises((FormatError, FileError)) as error:
        read_camera_file(path, 640, 480)
    assert str(path) in one_line(error)


def test_texts_that_are_no_files_are_refused(tmp_path):
    for text in ("", "none.yaml", "a\0b", "a\0b,c", "x" * 5000, "," * 5000, str(tmp_path / "cameras.bin")):
        with pytest.raises((FileError, InputError)) as error:
            read_camera_file(text, 640, 480)
        assert len(one_line(error)) < 6000


FILES = {
    "ros.yaml": ros_text(calibrated(), "parsers"),
    "colmap.txt": "# cameras\n1 OPENCV 640 480 500 500 320 240 0.1 0.01 0 0\n",
    "camera.json": json.dumps(camera_to_json(calibrated())),
    "k.txt": "500 0 320 0 500 240 0 0 1",
    "c.xml": "<opencv_storage><K type_id='opencv-matrix'><data>5 0 3 0 5 2 0 0 1</data></K></opencv_storage>",
}


@given(
    st.sampled_from(sorted(FILES)),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 8), st.text(max_size=4)), max_size=4),
    st.integers(0, 2000),
)
def test_damaged_files_are_read_or_refused(tmp_path_factory, name, damages, end):
    """Whatever is cut out of a file or put into it: a camera, or one line that names the file."""
    text = FILES[name]
    for at, length, put in damages:
        text = text[:at] + put + text[at + length :]
    path = tmp_path_factory.getbasetemp() / f"damaged {name}"
    path.write_text(text[:end] if end < len(text) else text, encoding="utf-8", errors="replace")
    try:
        read_camera_file(path, 640, 480)
    except RsUndistortError as error:
        assert str(path) in str(error)  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_colmap_files_cut_short_are_refused(tmp_path, suffix):
    folder = save_colmap(tmp_path / "model", colmap_model([colmap_camera("OPENCV")]), suffix)
    path = tmp_path / f"cameras.{suffix}"
    whole = (folder / f"cameras.{suffix}").read_bytes()
    # the last number of a text may lose digits and still be one
    for end in (0, 4, 12, len(whole) // 2, len(whole) - (30 if suffix == "txt" else 1)):
        path.write_bytes(whole[:end])
        with pytest.raises((FormatError, FileError)) as error:
            read_camera_file(path, 640, 480)
        assert str(path) in one_line(error)


@given(
    st.floats(1, 1e5),
    st.floats(0.5, 2),
    st.lists(st.floats(-1, 1), min_size=5, max_size=5),
    st.integers(1, 30_000),
    st.integers(1, 30_000),
)
def test_calibrations_keep_every_digit(tmp_path_factory, focal, aspect, dist, width, height):
    camera = Camera(width, height, [[focal, 0, width / 3], [0, focal * aspect, height / 7], [0, 0, 1]], dist)
    folder = tmp_path_factory.getbasetemp()
    write_opencv(folder / "digits.yml", camera)
    assert read_one(folder / "digits.yml") == camera
    write_opencv(folder / "digits.xml", camera)
    assert read_one(folder / "digits.xml") == camera
    (folder / "digits.yaml").write_text(ros_text(camera), encoding="utf-8")
    assert read_one(folder / "digits.yaml") == camera


def test_an_object_for_a_list_is_named(tmp_path):
    path = tmp_path / "camera.json"
    camera = {"width": 640, "height": 480, "K": K.tolist(), "dist": {"k1": 0.1}, "readout": "top-to-bottom"}
    path.write_text(json.dumps(camera))
    with pytest.raises(FormatError, match="dist is an object, expected a list of numbers"):
        read_camera_file(path, 640, 480)
