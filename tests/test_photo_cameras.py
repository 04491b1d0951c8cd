"""Which camera took each photo of a folder, which way it is read out, and which of its pixels count."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from make_photos import COURTYARD_NAMES, exif_block, half_courtyard, save_png, texture

from rsundistort import Camera, RectifyOptions, RowMotion, RunOptions, SolveOptions, rectify, rectify_folder, run
from rsundistort.errors import FileError, FormatError, InputError, SkippedPhotoWarning
from rsundistort.input import photo_cameras
from rsundistort.io import Metadata, find_masks, read_exif, read_mask, write_image
from rsundistort.io.cameras import camera_to_json
from rsundistort.model import Observations, Reconstruction
from rsundistort.sfm import detect_features
from rsundistort.solve.outcome import Solved

HANDHELD = Path(__file__).parent.parent / "sample_scenes" / "handheld"
WIDE, TALL = (64, 48), (48, 64)


def camera_of(size, readout="top-to-bottom", f=60.0):
    width, height = size
    return Camera(width, height, [[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]], readout=readout)


@pytest.fixture
def folder(tmp_path):
    """Three landscape photos and one portrait, without EXIF."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, (width, height) in zip("abcd", (WIDE, WIDE, WIDE, TALL), strict=True):
        save_png(photos / f"{name}.png", texture(width, height))
    return photos


def find_cameras(folder, names, sizes, camera=None, readout=None):
    """As a run calls it, with what EXIF says."""
    facts = [read_exif(folder / name) for name in names]
    return photo_cameras.find_cameras(folder, names, sizes, facts, camera, readout)


NAMES, SIZES = ["a.png", "b.png", "c.png", "d.png"], [WIDE, WIDE, WIDE, TALL]


def write_cameras(path, cameras, images=None):
    value = {"cameras": {key: camera_to_json(camera) for key, camera in cameras.items()}}
    path.write_text(json.dumps(value | ({} if images is None else {"images": images})))


def with_sigma(camera, sigma):
    return json.dumps({**camera_to_json(camera), "sigma": sigma})


def test_a_calibration_is_known_as_well_as_its_file_says_and_others_as_calibrations_are(folder):
    (folder / "camera.json").write_text(with_sigma(camera_of(WIDE, f=60.0), {"f": 1.2, "cx": 0.6, "k1": 0.01}))
    known = find_cameras(folder, NAMES[:3], SIZES[:3]).known_to(loose=False)
    assert known.sigmas[0]["f"] == pytest.approx(0.02)  # of the focal length
    assert known.sigmas[0]["cx"] == pytest.approx(0.01)  # focal lengths
    assert known.sigmas[0]["k1"] == 0.01
    assert known.sigmas[0]["cy"] == photo_cameras.GIVEN_SIGMA["cy"]


def test_only_calibrations_of_unknown_accuracy_may_be_decentred(folder):
    (folder / "camera.json").write_text(with_sigma(camera_of(WIDE), {"f": 1.2, "p1": 1e-4}))
    cameras = find_cameras(folder, NAMES[:3], SIZES[:3])
    assert cameras.known_to(loose=False).decentring == [(1e-3, 0.0)]  # p1 goes with cy
    assert not cameras.known_to(loose=True).decentring


def test_the_command_line_knows_better_than_the_file(folder):
    (folder / "camera.json").write_text(with_sigma(camera_of(WIDE), {"f": 1.2, "k1": 0.01}))
    cameras = find_cameras(folder, NAMES[:3], SIZES[:3]).with_sigma({"fx": 0.6, "fy": 0.3})
    known = cameras.known_to(loose=False)
    assert cameras.intrinsics[:2] == ("fx", "fy")
    assert (known.sigmas[0]["fx"], known.sigmas[0]["fy"]) == (pytest.approx(0.01), pytest.approx(0.005))
    assert known.sigmas[0]["k1"] == 0.01


@pytest.mark.parametrize(
    ("sigma", "says"),
    [
        ({"f": 0}, "sigma of f is 0"),
        ({"f": True}, "sigma of f is True"),
        ({"f": "1"}, "sigma of f is '1'"),
        ({"zoom": 1}, "sigma of 'zoom', expected some of f, fx"),
        ([1, 2], "expected an object"),
    ],
)
def test_standard_deviations_that_cannot_be_are_refused(folder, sigma, says):
    (folder / "camera.json").write_text(with_sigma(camera_of(WIDE), sigma))
    with pytest.raises(FormatError, match=re.escape(says)):
        find_cameras(folder, NAMES[:3], SIZES[:3])


def test_photos_take_the_cameras_that_a_file_names_for_them(folder):
    cameras = {"x": camera_of(WIDE), "y": camera_of(WIDE, f=70.0), "z": camera_of(TALL, "left-to-right")}
    write_cameras(folder / "cameras.json", cameras, {"a.png": "y", "b.png": "x", "c.png": "y", "d.png": "z"})
    found = find_cameras(folder, NAMES, SIZES)  # in the folder, without being specified
    assert [found.of(i) for i in range(4)] == [cameras[key] for key in "yxyz"]
    assert (found.calibrated, found.readout_specified) == (True, (True, True, True))


def test_a_photo_that_the_file_forgets_is_named(folder):
    write_cameras(folder / "cameras.json", {"x": camera_of(WIDE)}, {"a.png": "x"})
    with pytest.raises(InputError, match=r"no camera that it took b\.png"):
        find_cameras(folder, NAMES, SIZES)


def test_a_folder_of_cameras_is_shared_out_by_size_and_by_group(folder, tmp_path):
    for name, camera in {"phone": camera_of(WIDE), "camera-48x64": camera_of(TALL)}.items():
        (tmp_path / "cameras").mkdir(exist_ok=True)
        (tmp_path / "cameras" / f"{name}.json").write_text(json.dumps(camera_to_json(camera)))
    found = find_cameras(folder, NAMES, SIZES, str(tmp_path / "cameras"))
    assert found.labels == ("phone", "camera-48x64")
    assert found.camera_idx.tolist() == [0, 0, 0, 1]
    # a second one of the size: only a name can distinguish them
    (tmp_path / "cameras" / "drone.json").write_text(json.dumps(camera_to_json(camera_of(WIDE))))
    with pytest.raises(InputError, match=r"several cameras of the size of a\.png.*call its file camera-64x48\.json"):
        find_cameras(folder, NAMES, SIZES, str(tmp_path / "cameras"))


def test_cameras_of_a_folder_that_say_no_size_have_that_of_their_photos(folder, tmp_path):
    texts = {name: f"{f} 0 24\n0 {f} 20\n0 0 1\n" for name, f in {"phone": 60, "camera-48x64": 50, "drone": 70}.items()}
    opencv = "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [{}]\n"
    cameras = tmp_path / "cameras"
    cameras.mkdir()

    def find():
        found = find_cameras(folder, NAMES, SIZES, str(cameras))
        return [(each.width, each.height, each.K[0, 0]) for each in map(found.of, range(4))]

    (cameras / "phone.txt").write_text(texts["phone"])
    with pytest.raises(InputError, match=r"for d\.png is for 64x48 pixels but the photos have 48x64"):
        find()  # one K is of one size
    (cameras / "camera-48x64.txt").write_text(texts["camera-48x64"])
    assert find() == [(*WIDE, 60)] * 3 + [(*TALL, 50)]
    (cameras / "phone.txt").rename(cameras / "camera-64x48.txt")
    assert find() == [(*WIDE, 60)] * 3 + [(*TALL, 50)]
    (cameras / "camera-48x64.txt").unlink()
    (cameras / "camera-48x64.yml").write_text(opencv.format("45, 0, 24, 0, 45, 20, 0, 0, 1"))
    assert find() == [(*WIDE, 60)] * 3 + [(*TALL, 45)]
    # what has a size takes the photos of that size, and one camera without a size the others
    (cameras / "camera-48x64.yml").unlink()
    (cameras / "camera-64x48.txt").rename(cameras / "phone.txt")
    (cameras / "upright.json").write_text(json.dumps(camera_to_json(camera_of(TALL))))
    assert find() == [(*WIDE, 60)] * 3 + [(*TALL, 60)]
    (cameras / "drone.txt").write_text(texts["drone"])
    with pytest.raises(InputError, match=r"several cameras of the size of a\.png"):
        find()
    (cameras / "phone.txt").unlink()
    (cameras / "wide.json").write_text(json.dumps(camera_to_json(camera_of(WIDE))))
    with pytest.raises(InputError, match=r"several cameras of the size of a\.png"):
        find()


def test_one_camera_is_not_stretched_over_photos_of_another_size(folder):
    with pytest.raises(InputError, match=r"d\.png"):
        find_cameras(folder, NAMES, SIZES, "60,60,32,24")


def test_what_the_user_says_of_the_readout_overrides_the_file_and_the_guess(folder):
    write_cameras(folder / "cameras.json", {"x": camera_of(WIDE), "z": camera_of(TALL)})
    found = find_cameras(folder, NAMES, SIZES, readout={"z": "right-to-left"})
    assert [camera.readout for camera in found.cameras] == ["top-to-bottom", "right-to-left"]
    everywhere = find_cameras(folder, NAMES, SIZES, readout="bottom-to-top")
    assert {camera.readout for camera in everywhere.cameras} == {"bottom-to-top"}
    with pytest.raises(InputError, match="no such group of photos, there are x, z"):
        find_cameras(folder, NAMES, SIZES, readout={"q": "right-to-left"})
    with pytest.raises(InputError, match="upwards"):
        SolveOptions(readout={"z": "upwards"})


def test_directions_that_nobody_specified_are_guesses(folder, tmp_path):
    camera = camera_to_json(camera_of(WIDE))
    del camera["readout"]
    (tmp_path / "c.json").write_text(json.dumps(camera))
    assert find_cameras(folder, NAMES[:3], SIZES[:3], str(tmp_path / "c.json")).readout_specified == (False,)
    assert find_cameras(folder, NAMES[:3], SIZES[:3], "60,60,32,24").readout_specified == (False,)
    assert find_cameras(folder, NAMES[:3], SIZES[:3], "60,60,32,24", "left-to-right").readout_specified == (True,)


def test_exif_groups_photos_and_rotated_ones_are_read_out_across(tmp_path):
    for name, (width, height) in zip(NAMES, SIZES, strict=True):
        path = tmp_path / name.replace("png", "jpg")
        write_image(path, texture(width, height), Metadata(exif=bytes(exif_block(1, focal_35mm=28))))
    names = [name.replace("png", "jpg") for name in NAMES]
    found = find_cameras(tmp_path, names, SIZES)
    assert [camera.readout for camera in found.cameras] == ["top-to-bottom", "left-to-right"]
    assert (found.calibrated, found.readout_specified) == (False, (False, False))
    assert len(found.notes) == 1
    assert "portrait" in found.notes[0]
    assert found.cameras[0].K[0, 0] == found.cameras[1].K[0, 0]


def test_photos_that_are_not_registered_keep_the_camera_that_took_them(tmp_path):
    photos = half_courtyard(tmp_path, COURTYARD_NAMES[:4])
    save_png(photos / "other.png", texture(160, 240))
    (photos / "z.png").write_bytes(b"no photo at all")
    given = json.loads((tmp_path / "camera.json").read_text())
    cameras = {"small": camera_to_json(camera_of((160, 240), f=200.0)), "phone": given}
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    options = RunOptions(
        max_features=1000, solve=SolveOptions(shutter_model="rotation"), camera=str(tmp_path / "cameras.json")
    )
    with pytest.warns(SkippedPhotoWarning, match=r"z\.png"):
        solution = run(photos, tmp_path / "out", options)
    first, other = solution.image(COURTYARD_NAMES[0]), solution.image("other.png")
    assert first.registered
    assert not other.registered
    assert solution.cameras[first.camera_id].width == 480
    assert solution.cameras[other.camera_id].width == 160


def test_where_lenses_vary_the_camera_of_a_lost_photo_is_that_of_another_photo_by_it():
    cameras = [camera_of(WIDE), camera_of(WIDE, f=70.0), camera_of(TALL)]
    seen = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    rec = Reconstruction(
        cameras, ["a", "b", "c", "d"], np.array([0, 1, 1, 0]), np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)),
        np.zeros((0, 3)), seen, variation=np.full((4, 3), 0.01),
    )  # fmt: skip
    camera_of_photo = {"lost": 1, "alone": 2}
    solved = Solved(SimpleNamespace(reconstruction=rec), None, None, camera_of=camera_of_photo)
    assert [solved.camera_id_of(name) for name in ("lost", "alone", "unread")] == [2, 1, 1]
    shared = replace(solved, result=SimpleNamespace(reconstruction=replace(rec, variation=np.zeros(0))))
    assert [shared.camera_id_of(name) for name in ("lost", "alone", "unread")] == [2, 3, 1]
    assert replace(shared, shared_ids=[4, 7, 9]).camera_id_of("lost") == 7


# ---------------------------------------------------------------- masks


def test_masks_are_found_by_stem_and_by_whole_name(tmp_path):
    for name in ("a.png", "b.jpg.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    found = find_masks(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])
    assert {name: path.name for name, path in found.items()} == {"a.jpg": "a.png", "b.jpg": "b.jpg.png"}
    with pytest.raises(InputError, match=r"no mask of any photo; it should hold z\.png"):
        find_masks(tmp_path, ["z.jpg"])
    with pytest.raises(FileError, match="no folder"):
        find_masks(tmp_path / "none", ["a.jpg"])
    (tmp_path / "a.webp").write_bytes(b"")
    with pytest.raises(InputError, match="several masks"):
        find_masks(tmp_path, ["a.jpg"])


def test_masks_are_black_or_white_and_of_the_photos_size(tmp_path):
    pixels = np.array([[0, 127, 128, 255]], np.uint8)
    save_png(tmp_path / "m.png", pixels)
    assert read_mask(tmp_path / "m.png", 4, 1).tolist() == [[0, 0, 255, 255]]
    with pytest.raises(InputError, match="4x1 pixels, its photo 8x2"):
        read_mask(tmp_path / "m.png", 8, 2)
    (tmp_path / "m.png").write_bytes(b"no image")
    with pytest.raises(FileError, match="cannot be decoded"):
        read_mask(tmp_path / "m.png", 4, 1)


def test_no_features_where_the_mask_is_black():
    photo = texture(320, 240)
    mask = np.zeros((240, 320), np.uint8)
    mask[:, :160] = 255
    xy = detect_features(photo, 1000, mask).xy_raw
    assert len(xy) > 50
    assert xy[:, 0].max() < 160.5
    assert detect_features(photo, 1000).xy_raw[:, 0].max() > 300


def test_a_mask_goes_through_the_map_with_its_photo():
    camera, motion = camera_of((160, 120), f=150.0), RowMotion([0.05, 0.1, 0.03])
    photo = np.zeros((120, 160), np.uint8)
    cv2.circle(photo, (90, 40), 15, 255, -1)
    mask = np.where(photo > 0, 0, 255).astype(np.uint8)  # the disc does not count
    image, valid = rectify(photo, camera, motion, interpolation="linear", mask=mask)
    _, seen = rectify(photo, camera, motion)
    assert (image[(seen > 0) & (valid == 0)] > 0).mean() > 0.95
    # the nearest of four pixels is black and weighs a quarter at least
    assert (image[valid > 0] <= 192).all()
    with pytest.raises(InputError, match="mask is"):
        rectify(photo, camera, motion, mask=mask[:10])


def test_run_and_rectify_keep_masks_out_of_features_and_outputs(tmp_path):
    photos = half_courtyard(tmp_path, COURTYARD_NAMES[:4])
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.full((320, 480), 255, np.uint8)
    mask[:, 300:] = 0
    for name in COURTYARD_NAMES[:3]:  # the last photo has none
        save_png(masks / name, mask)
    options = RunOptions(
        max_features=1000, solve=SolveOptions(shutter_model="rotation"), rectify=RectifyOptions(masks=masks)
    )
    solution = run(photos, tmp_path / "out", options)
    shown = [cv2.imread(str(tmp_path / "out" / "masks" / name), cv2.IMREAD_GRAYSCALE) for name in COURTYARD_NAMES[:4]]
    for valid in shown[:3]:
        assert (valid[:, 360:] == 0).all()
        assert (valid[60:260, 60:240] == 255).all()
    assert (shown[3][80:240, 320:420] == 255).all()
    shutil.rmtree(tmp_path / "out" / "images")
    rectify_folder(photos, tmp_path / "out" / "solution.json", tmp_path / "again", masks=masks)
    again = cv2.imread(str(tmp_path / "again" / "masks" / COURTYARD_NAMES[0]), cv2.IMREAD_GRAYSCALE)
    assert (again == shown[0]).all()
    assert len(solution.registered) >= 3


# ---------------------------------------------------------------- four directions in one folder


@pytest.mark.slow
def test_directions_of_handheld_are_found_when_nobody_tells_them(tmp_path):
    shutil.copytree(HANDHELD / "photos", tmp_path / "photos")
    value = json.loads((HANDHELD / "cameras.json").read_text())
    true = {key: camera.pop("readout") for key, camera in value["cameras"].items()}
    (tmp_path / "cameras.json").write_text(json.dumps(value))
    solution = run(tmp_path / "photos", tmp_path / "out")
    axis = {"top-to-bottom": 1, "bottom-to-top": 1, "left-to-right": 0, "right-to-left": 0}
    found = solution.options["readout"]
    assert {key: axis[found[key]] for key in true} == {key: axis[each] for key, each in true.items()}
