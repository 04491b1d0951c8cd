"""Cameras of files, of numbers and of EXIF."""

from __future__ import annotations

import json

import numpy as np
import pytest
from make_photos import exif_block, texture
from refusals import one_line

from rsundistort import (
    Camera,
)
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.io import (
    Metadata,
    camera_from_exif,
    check_camera_fits,
    read_camera_file,
    write_image,
)
from rsundistort.io.cameras import camera_to_json

K = [[500.0, 0, 322.5], [0, 510.0, 235.25], [0, 0, 1]]
CAMERA = {"width": 640, "height": 480, "K": K, "dist": [-0.1, 0.02, 0.001, -0.002], "readout": "bottom-to-top"}


def camera_of(text, width=640, height=480):
    """The camera of a file or of numbers, for photos of a size."""
    (camera,) = read_camera_file(text, width, height).cameras.values()
    check_camera_fits(camera, width, height, str(text))
    return camera


def test_camera_json(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(CAMERA))
    camera = camera_of(path)
    assert camera == Camera(640, 480, np.array(K), np.array(CAMERA["dist"]), "bottom-to-top")
    path.write_text(json.dumps({k: CAMERA[k] for k in ("width", "height", "K")}))
    assert camera_of(path) == Camera(640, 480, np.array(K))


def test_the_lens_of_a_camera_json(tmp_path):
    path = tmp_path / "camera.json"
    fisheye = Camera(640, 480, np.array(K), np.array([0.1, -0.02, 0.01, 0.0]), "bottom-to-top", "fisheye")
    path.write_text(json.dumps(camera_to_json(fisheye)))
    assert camera_of(path) == fisheye
    # an older reader can read what it knows
    assert "lens" not in camera_to_json(fisheye.pinhole())


@pytest.mark.parametrize("text", ["500 0 322.5\n0 510 235.25\n0 0 1\n", "500,0,322.5,0,510,235.25,0,0,1"])
def test_camera_of_a_text_file(tmp_path, text):
    (tmp_path / "K.txt").write_text(text)
    assert camera_of(tmp_path / "K.txt") == Camera(640, 480, np.array(K))


def test_camera_of_a_scaled_matrix(tmp_path):
    (tmp_path / "K.txt").write_text(" ".join(str(2 * v) for v in np.ravel(K)))
    assert camera_of(tmp_path / "K.txt") == Camera(640, 480, np.array(K))


@pytest.mark.parametrize("lens", [[], [-0.1, 0.02, 0.001, -0.002], [-0.1, 0.02, 0.001, -0.002, 0.003]])
def test_camera_of_numbers(lens):
    text = ",".join(str(v) for v in [500.0, 510.0, 322.5, 235.25, *lens])
    expected = Camera(640, 480, np.array(K), np.array(lens))
    assert camera_of(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "500,510",
        "500,510,322,235,0.1",
        "500,510,322,235,0.1,0.2,0.3",
        "500,510,322,235,1,2,3,4,5,6",
        "500,510,322,",
        "a,b,c,d",
        "nan,510,322,235",
        "500,inf,322,235",
        "-500,510,322,235",
        "0,510,322,235",
        "500,510,-1,235",
        "500,510,322,9999",
    ],
)
def test_garbled_numbers_are_refused(text):
    with pytest.raises(InputError) as error:
        camera_of(text)
    one_line(error)


def test_many_numbers_are_refused():
    with pytest.raises(InputError) as error:
        camera_of(",".join(["1"] * 300))
    one_line(error)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 641},
        {"width": 480, "height": 640},
        {"K": [[500, 0, 700], [0, 500, 240], [0, 0, 1]]},
        {"K": [[500, 0, 320], [0, 500, 240]]},
        {"K": [[500, 1, 320], [0, 500, 240], [0, 0, 1]]},
        {"K": "unit"},
        {"K": [[float("nan")] * 3] * 3},
        {"K": None},
        {"dist": [0.1, 0.2]},
        {"dist": "none"},
        {"dist": {"k1": 0.1}},
        {"readout": "upwards"},
        {"readout": 3},
        {"lens": "fish"},
        {"lens": ["fisheye"]},
        {"lens": "fisheye", "dist": [0.1] * 5},
        {"width": "wide"},
        {"width": float("nan")},
        {"width": None},
        {"width": -640},
        {"focal": 500},
        pytest.param({"width": float("inf")}),
    ],
    ids=str,
)
def test_camera_json_that_does_not_fit_is_refused(tmp_path, change):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**CAMERA, **change}))
    with pytest.raises(InputError) as error:
        camera_of(path)
    assert "camera.json" in one_line(error)


def test_a_camera_of_another_size_says_both_sizes(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(CAMERA))
    with pytest.raises(InputError) as error:
        camera_of(path, 320, 240)
    assert "640x480" in one_line(error)
    assert "320x240" in one_line(error)


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"width": 640,\n "height"\n}', b"[1, 2]", b"{}", b"1 2 3", b"word " * 9, b"\xff\xfe\x00"]
)
def test_camera_files_that_are_none_are_refused(tmp_path, content):
    path = tmp_path / "camera.json"
    path.write_bytes(content)
    with pytest.raises((FormatError, FileError)) as error:
        camera_of(path)
    assert str(path) in one_line(error)


def test_missing_camera_files_are_refused(tmp_path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(FileError) as error:
            camera_of(path)
        assert str(path) in one_line(error)


def test_camera_of_exif(tmp_path):
    write_image(tmp_path / "photo.jpg", texture(64, 48), Metadata(exif_block(6, 35).tobytes()))
    camera = camera_from_exif(tmp_path / "photo.jpg", 64, 48, "left-to-right")
    assert camera is not None
    assert (camera.width, camera.height, camera.readout) == (64, 48, "left-to-right")
    # 35 mm on the film's diagonal or width: near the width of the photo
    assert 0.8 * 64 < camera.K[0, 0] < 1.2 * 64
    np.testing.assert_array_equal(camera.K[:2, 2], [31.5, 23.5])
    write_image(tmp_path / "bare.png", texture(64, 48))
    assert camera_from_exif(tmp_path / "bare.png", 64, 48) is None


# ---------------------------------------------------------------- Kalibr

CHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.0, 510.0, 322.5, 235.25]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.03, -0.004]
  distortion_model: equidistant
  intrinsics: [400.0, 401.0, 311.0, 190.0]
  resolution: [600, 400]
  rostopic: /cam1/image_raw
"""


def test_a_camera_chain_of_kalibr_is_read(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(CHAIN)
    found = read_camera_file(path, 640, 480)
    one, other = found.cameras["cam0"], found.cameras["cam1"]
    np.testing.assert_array_equal(one.K, K)
    assert (one.width, one.height, one.lens, other.width, other.height, other.lens) == (
        640, 480, "pinhole", 600, 400, "fisheye",
    )  # fmt: skip
    np.testing.assert_array_equal(one.dist[:4], [-0.1, 0.02, 0.001, -0.002])
    np.testing.assert_array_equal(other.dist[:4], [0.01, -0.02, 0.03, -0.004])
    assert not found.without_size
    assert found.source.endswith("(Kalibr)")


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("[500.0, 510.0, 322.5, 235.25]", "[0.6, 500.0, 510.0, 322.5, 235.25]", "5 numbers, expected fx, fy, cx, cy"),
        ("camera_model: pinhole", "camera_model: omni", "'omni'"),
        ("distortion_model: radtan", "distortion_model: fov", "'fov'"),
        ("[640, 480]", "[640]", "width and a height"),
    ],
)
def test_cameras_of_kalibr_that_are_no_pinholes_are_refused(tmp_path, before, after, says):
    path = tmp_path / "camchain.yaml"
    path.write_text(CHAIN.replace(before, after, 1))
    with pytest.raises(FormatError, match=rf"camchain\.yaml, cam0.*{says}"):
        read_camera_file(path, 640, 480)
