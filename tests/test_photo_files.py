"""Real files through `rectify` and `run`: orientation, RAW, what is rectified already, and what cannot be."""

from __future__ import annotations

import json
import shutil
import warnings

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from make_photos import COURTYARD_NAMES, camera_exif, half_courtyard, small_dng, texture
from rsundistort_cli.main import cli

from rsundistort import (
    Camera,
    RectifyOptions,
    RowMotion,
    RunOptions,
    Solution,
    SolvedImage,
    SolveOptions,
    evaluate,
    read_solution,
    rectify_folder,
    run,
    write_solution,
)
from rsundistort.errors import FileKindWarning, InputError, MetadataWarning, SkippedPhotoWarning
from rsundistort.io import Metadata, read_photo, write_image
from rsundistort.model.orientation import INVERSE, orient_pixels

MOTION = RowMotion([0.05, -0.03, 0.04])


def save_solution(path, names, width=64, height=48, motion=MOTION, posed=False):
    camera = Camera(width, height, [[60.0, 0, 33.25], [0, 61.0, 22.5], [0, 0, 1]], [-0.02, 0.01, 0.002, -0.001])
    pose = {"R_cw": np.eye(3), "center_w": np.ones(3)} if posed else {}
    images = tuple(SolvedImage(name, "1", motion=motion, **pose) for name in names)
    write_solution(path, Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, images))
    return path


def save_oriented(folder, orientations=range(9), suffix=".png"):
    """One scene as eight cameras would have stored it, rotated so that the tag shows it upright; and with the tag 0."""
    folder.mkdir()
    for o in orientations:
        write_image(folder / f"{o}{suffix}", texture(64, 48), Metadata(camera_exif("<", o)))
    return [f"{o}{suffix}" for o in orientations]


# ---------------------------------------------------------------- orientation


def test_tag_and_frame_stay_as_they_are(tmp_path):
    names = save_oriented(tmp_path / "in")
    rectify_folder(tmp_path / "in", save_solution(tmp_path / "s.json", names), tmp_path / "out")
    first = read_photo(tmp_path / "out" / "images" / "1.png").pixels
    for o, name in enumerate(names):
        out = read_photo(tmp_path / "out" / "images" / name)
        before = read_photo(tmp_path / "in" / name)
        np.testing.assert_array_equal(out.pixels, first)
        assert out.metadata.orientation == (o or 1)
        # nothing but the thumbnail is gone
        assert before.metadata.exif.startswith(out.metadata.exif[:100])


def test_applied_orientation_rotates_the_finished_output(tmp_path):
    names = save_oriented(tmp_path / "in")
    solution = save_solution(tmp_path / "s.json", names)
    rectify_folder(tmp_path / "in", solution, tmp_path / "plain")
    with pytest.warns(MetadataWarning, match=r"0\.png: its EXIF orientation 0 means nothing"):
        turned, left_out = rectify_folder(tmp_path / "in", solution, tmp_path / "out", apply_orientation=True)
    assert not left_out
    assert read_solution(tmp_path / "out" / "solution.json").cameras == turned.cameras
    for o, name in enumerate(names):
        for folder in ("images", "masks"):
            plain, out = (read_photo(tmp_path / run / folder / name) for run in ("plain", "out"))
            np.testing.assert_array_equal(out.pixels, orient_pixels(plain.pixels, o or 1))
            assert out.metadata.orientation == 1
        image = turned.image(name)
        rectified = turned.rectified_cameras[image.camera_id]
        assert out.pixels.shape[:2] == (rectified.height, rectified.width)
        assert image.applied_orientation == (o or 1)
        shown = cv2.imread(str(tmp_path / "out" / "images" / name))  # nothing left to apply
        np.testing.assert_array_equal(shown, read_photo(tmp_path / "out" / "images" / name).pixels)


def test_a_rotated_solution_rectifies_the_stored_photos_again(tmp_path):
    names = save_oriented(tmp_path / "in", range(1, 9))
    rectify_folder(tmp_path / "in", save_solution(tmp_path / "s.json", names), tmp_path / "plain")
    rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "out", apply_orientation=True)
    rectify_folder(tmp_path / "in", tmp_path / "out" / "solution.json", tmp_path / "again")
    for name in names:
        plain, again = (read_photo(tmp_path / run / "images" / name).pixels for run in ("plain", "again"))
        np.testing.assert_array_equal(again, plain)


def test_mirrored_photos_lose_their_pose(tmp_path):
    names = save_oriented(tmp_path / "in", (2, 6, 7))
    solution = save_solution(tmp_path / "s.json", names, posed=True)
    with pytest.warns(MetadataWarning, match="mirrored by its EXIF orientation and loses its pose") as caught:
        turned, _ = rectify_folder(tmp_path / "in", solution, tmp_path / "out", apply_orientation=True)
    assert sorted(str(w.message).split()[0] for w in caught) == ["2.png", "7.png"]
    assert [turned.image(name).posed for name in names] == [False, True, False]
    first = read_photo(tmp_path / "out" / "images" / "6.png").pixels
    for name, o in zip(names, (2, 6, 7), strict=True):
        out = read_photo(tmp_path / "out" / "images" / name).pixels
        np.testing.assert_array_equal(orient_pixels(out, INVERSE[o]), orient_pixels(first, INVERSE[6]))


@pytest.fixture(scope="module")
def rotated_run(tmp_path_factory):
    """The courtyard, its photos stored under several orientations, which are applied; and rectified without."""
    folder = tmp_path_factory.mktemp("turned")
    photos = half_courtyard(folder)
    orientations = dict(zip(COURTYARD_NAMES, (1, 6, 8, 3, 6, 5), strict=True))
    for name, o in orientations.items():
        write_image(photos / name, read_photo(photos / name).pixels, Metadata(camera_exif("<", o)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        options = RunOptions(
            max_features=1000,
            solve=SolveOptions(shutter_model="rotation"),
            rectify=RectifyOptions(apply_orientation=True),
        )
        solution = run(photos, folder / "out", options)
    plain, _ = rectify_folder(photos, folder / "out" / "solution.json", folder / "plain")
    return folder, orientations, solution, plain, [str(w.message) for w in caught]


def test_a_run_rotates_photos_and_masks(rotated_run):
    folder, orientations, solution, plain, said = rotated_run
    assert len(said) == 1
    assert said[0].startswith("0006.png: mirrored by its EXIF orientation 5, it was rotated")
    for name, o in orientations.items():
        turn = {5: 6}.get(o, o)
        for kind in ("images", "masks"):
            before, after = (read_photo(folder / out / kind / name) for out in ("plain", "out"))
            np.testing.assert_array_equal(after.pixels, orient_pixels(before.pixels, turn))
        assert read_photo(folder / "out" / "images" / name).metadata.orientation == (2 if o == 5 else 1)
        assert solution.image(name).applied_orientation == turn
        assert plain.image(name).applied_orientation == 1


def test_the_colmap_model_of_a_rotated_run_fits_its_photos(rotated_run):
    """Judged by pycolmap: points project to the keypoints as well as they do in the stored frame."""
    folder, orientations, solution, plain, _ = rotated_run
    model = pycolmap.Reconstruction(folder / "out" / "sparse")
    assert model.compute_mean_reprojection_error() < 1.5 * solution.quality["rms_px"]
    assert len(model.cameras) == 4  # one an orientation, none without photos
    names = {image.name: image for image in model.images.values()}
    for name in orientations:
        image, ours = names[name], solution.image(name)
        pixels = read_photo(folder / "out" / "images" / name).pixels
        assert pixels.shape[:2] == (image.camera.height, image.camera.width)
        np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], ours.R_cw, atol=1e-9)
        # rotated about the optical axis
        np.testing.assert_allclose(image.projection_center(), plain.image(name).center_w, atol=1e-9)
        np.testing.assert_allclose(ours.R_cw[2], plain.image(name).R_cw[2], atol=1e-12)
    frames = json.loads((folder / "out" / "transforms.json").read_text())["frames"]
    for frame, name in zip(frames, orientations, strict=True):
        assert (frame["h"], frame["w"]) == read_photo(folder / "out" / "images" / name).pixels.shape[:2]


def test_a_rotated_run_is_evaluated_like_any_other(rotated_run):
    folder, _, _, _, _ = rotated_run
    plain, turned = (
        evaluate(folder / out, folder / "ground_truth.json", twins=folder / "photos") for out in ("plain", "out")
    )
    assert turned.rotation_deg.max < 0.2
    for key in ("rotation_deg", "phi_mrad_per_frame", "psnr_db"):
        for figure, value in plain.to_json()[key].items():
            if figure != "photos":
                assert turned.to_json()[key][figure] == pytest.approx(value, rel=1e-6)


# ---------------------------------------------------------------- once, and not twice


def test_a_photo_is_rectified_once_unless_asked(tmp_path):
    names = save_oriented(tmp_path / "in", (1, 6))
    solution = save_solution(tmp_path / "s.json", names)
    rectify_folder(tmp_path / "in", solution, tmp_path / "once")
    shutil.copy(tmp_path / "in" / "6.png", tmp_path / "once" / "images")
    with pytest.warns(SkippedPhotoWarning, match=r"1\.png: it was rectified already, by rsundistort .*--again"):
        _, left_out = rectify_folder(tmp_path / "once" / "images", solution, tmp_path / "twice")
    assert list(left_out) == ["1.png"]
    _, left_out = rectify_folder(tmp_path / "once" / "images", solution, tmp_path / "thrice", again=True)
    assert not left_out


def test_run_leaves_out_what_is_rectified(tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(3):
        write_image(tmp_path / "in" / f"{k}.png", texture(64, 48, k), Metadata().marked("0.0"))
    done = CliRunner().invoke(
        cli, ["run", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--camera", "60,60,32,24"]
    )
    assert done.exit_code == 1
    assert done.output.count("rectified already") >= 3
    assert "--again" in done.output
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- RAW, and what is left out


@pytest.mark.parametrize("raw_as", ["tif", "jpg", "png"])
def test_raw_is_written_as_asked(tmp_path, raw_as):
    (tmp_path / "in").mkdir()
    for o in (1, 6):
        (tmp_path / "in" / f"{o}.dng").write_bytes(small_dng(o))
    solution = save_solution(tmp_path / "s.json", ["1.dng", "6.dng"])
    arguments = ["rectify", str(tmp_path / "in"), "--solution", str(solution), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(cli, [*arguments, "--raw-as", raw_as], catch_exceptions=False)
    assert done.exit_code == 0
    first, second = (read_photo(tmp_path / "out" / "images" / f"{o}.{raw_as}") for o in (1, 6))
    np.testing.assert_array_equal(first.pixels, second.pixels)
    assert first.pixels.dtype == (np.uint8 if raw_as == "jpg" else np.uint16)
    assert (first.metadata.orientation, second.metadata.orientation) == (1, 6)
    assert len({p.name for p in (tmp_path / "out" / "images").iterdir()}) == 2


def test_the_others_go_on(tmp_path):
    """Bad files of several kinds beside good ones: each is named, with the reason."""
    names = save_oriented(tmp_path / "in", (1, 6))
    good = (tmp_path / "in" / "1.png").read_bytes()
    (tmp_path / "in" / "cut.png").write_bytes(good[: len(good) // 2])
    (tmp_path / "in" / "picture.nef").write_bytes(bytes(cv2.imencode(".jpg", texture(64, 48))[1]))
    (tmp_path / "in" / "raw.nef").write_bytes(small_dng()[:3000])
    write_image(tmp_path / "in" / "wide.png", np.zeros((2, 40000), np.uint8))
    write_image(tmp_path / "in" / "large.png", texture(128, 96))
    (tmp_path / "in" / "other.webp").write_bytes(good)
    bad = ["cut.png", "picture.nef", "raw.nef", "wide.png", "large.png"]
    solution = save_solution(tmp_path / "s.json", [*names, *bad, "other.webp"])
    arguments = ["rectify", str(tmp_path / "in"), "--solution", str(solution), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(cli, [*arguments, "--max-pixels", "0.01"], catch_exceptions=False)
    assert done.exit_code == 3
    assert "3 photos rectified" in done.output
    assert sorted(p.name for p in (tmp_path / "out" / "images").iterdir()) == ["1.png", "6.png", "other.webp"]
    for name in bad:
        line = next(line for line in done.output.splitlines() if line.startswith(f"warning: skipped: {name}"))
        assert line.count(name) >= 1
    assert "128x96 pixels, more than the limit of 0.01 million" in done.output
    assert "40000x2" in done.output
    assert "other.webp is PNG by its content" in done.output
    assert "Traceback" not in done.output


def test_options_are_checked():
    with pytest.raises(InputError, match="raw_as"):
        RectifyOptions(raw_as="bmp")


def test_a_png_under_the_name_of_a_jpeg_is_written_as_its_name_says(tmp_path):
    (tmp_path / "in").mkdir()
    write_image(tmp_path / "in" / "a.png", texture(64, 48, channels=4))
    (tmp_path / "in" / "a.png").rename(tmp_path / "in" / "a.jpg")
    with pytest.warns(FileKindWarning, match=r"a\.jpg is PNG by its content, not JPEG"):
        rectify_folder(tmp_path / "in", save_solution(tmp_path / "s.json", ["a.jpg"]), tmp_path / "out")
    assert (tmp_path / "out" / "images" / "a.jpg").read_bytes()[:3] == b"\xff\xd8\xff"


def test_photos_keep_their_endings_and_those_not_read_are_named(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("a.jfif", "b.JPE", "c.png"):
        write_image(tmp_path / "in" / name, texture(64, 48))
    (tmp_path / "in" / "d.nrw").write_bytes(small_dng())
    for name in ("e.gpr", "f.mpo", "g.bmp", "h.psd"):
        (tmp_path / "in" / name).write_bytes(b"x")
    names = ["a.jfif", "b.JPE", "c.png", "d.nrw"]
    solution = save_solution(tmp_path / "s.json", names)
    _, left_out = rectify_folder(tmp_path / "in", solution, tmp_path / "out")
    assert not left_out
    for name in ("a.jfif", "b.JPE", "c.png", "d.tif"):
        assert read_photo(tmp_path / "out" / "images" / name).pixels.shape == (48, 64, 3)
    done = CliRunner().invoke(cli, ["run", str(tmp_path / "in"), "-o", str(tmp_path / "run")])
    line = next(line for line in done.output.splitlines() if "passed over" in line)
    assert "e.gpr, f.mpo, g.bmp and 1 more passed over" in line
    assert "RAW to DNG" in line
