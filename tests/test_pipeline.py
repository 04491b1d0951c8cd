from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from folders import tree
from make_photos import COURTYARD_NAMES, half_courtyard, save_png, save_textures, texture

from rsundistort import (
    Camera,
    RectifyOptions,
    RowMotion,
    RsUndistortWarning,
    RunOptions,
    Solution,
    SolvedImage,
    SolveOptions,
    ViewOptions,
    evaluate,
    read_solution,
    rectify,
    rectify_folder,
    run,
    write_solution,
)
from rsundistort.errors import FileError, InputError, ReconstructionError, SkippedPhotoWarning
from rsundistort.evaluation import psnr
from rsundistort.io import read_photo
from rsundistort.io.record import Record
from rsundistort.model import READOUTS
from rsundistort.simulate import WarpOptions, simulate_warp
from rsundistort.solve import OutputOptions
from rsundistort.solve.run_outputs import files_of_run
from rsundistort.synthetic.warp import largest_rectangle

CAMERA = "300,300,160,120"
OPTIONS = RunOptions(max_features=1200)
BROKEN = "0009.png"


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory):
    """Six photos of the courtyard at half size, and one that was cut short."""
    folder = tmp_path_factory.mktemp("courtyard")
    photos = half_courtyard(folder)
    whole = (photos / COURTYARD_NAMES[0]).read_bytes()
    (photos / BROKEN).write_bytes(whole[: len(whole) // 2])
    return folder


@pytest.fixture(scope="module")
def solved(courtyard):
    """One run: its solution, its outputs, its messages."""
    steps = []
    with pytest.warns(SkippedPhotoWarning, match=f"skipped: {BROKEN}") as caught:
        solution = run(courtyard / "photos", courtyard / "out", OPTIONS, lambda *args: steps.append(args))
    assert len(caught) == 1
    return solution, courtyard / "out", steps


# ---------------------------------------------------------------- run


def test_all_whole_photos_register(solved):
    solution, _, _ = solved
    assert [image.name for image in solution.registered] == COURTYARD_NAMES
    assert solution.shutter_model == "rotation"
    for image in solution.registered:
        assert image.posed
        assert image.num_observations > 100
        assert image.rms_px < 1.0
        assert (image.sigma_phi > 0).all()
    assert solution.quality["rms_px"] < 0.5 * solution.quality["global_rms_px"]


def test_unreadable_photo_is_in_the_solution_with_its_reason(solved):
    solution, out, _ = solved
    image = solution.image(BROKEN)
    assert not image.registered
    assert BROKEN in image.reason
    entries = {e["name"]: e for e in json.loads((out / "solution.json").read_text())["images"]}
    assert list(entries) == [*COURTYARD_NAMES, BROKEN]
    assert entries[BROKEN]["registered"] is False
    assert entries[BROKEN]["reason"] == image.reason
    assert entries[BROKEN]["phi"] is None
    assert not (out / "images" / BROKEN).exists()
    assert not (out / "masks" / BROKEN).exists()


def test_poses_and_motions_are_near_the_truth(courtyard, solved):
    result = evaluate(solved[1], courtyard / "ground_truth.json")
    assert result.photos == 7
    assert result.registered == 6
    assert result.rotation_deg.max <= 0.15
    assert result.center.max <= 0.02
    assert result.phi_mrad_per_frame.mean <= 4.0
    truth = read_solution(courtyard / "ground_truth.json")
    still = np.mean([np.abs(image.motion.phi).mean() for image in truth.images]) * 320 / 400 * 1e3
    assert result.phi_mrad_per_frame.mean < 0.25 * still  # the photos do move


@pytest.mark.filterwarnings("ignore:skipped")
def test_references_are_nearer_to_the_rectified_photos(courtyard, solved, tmp_path):
    truth = read_solution(courtyard / "ground_truth.json")
    camera = truth.cameras["1"]
    for name in COURTYARD_NAMES:
        raw = read_photo(courtyard / "photos" / name).pixels
        save_png(tmp_path / name, rectify(raw, camera, truth.image(name).motion)[0])
    result = evaluate(solved[1], courtyard / "ground_truth.json", twins=tmp_path)
    assert set(result.psnr_db.photos) == set(COURTYARD_NAMES)
    assert result.psnr_db.median > result.psnr_before_db.median + 3
    # they are brought to the size of others
    small, options = tmp_path / "small", RectifyOptions(view=ViewOptions(scale=0.5))
    rectify_folder(courtyard / "photos", solved[1] / "solution.json", small, options)
    again = evaluate(small, courtyard / "ground_truth.json", twins=tmp_path)
    assert again.psnr_db.median > result.psnr_db.median - 1
    assert again.psnr_before_db.median < again.psnr_db.median - 3  # of the whole photos


def test_outputs_of_a_run(solved):
    solution, out, _ = solved
    assert sorted(p.name for p in out.iterdir()) == [
        ".rsundistort-written", "images", "masks", "points.ply", "poses.txt", "report.html", "report.npz",
        "run-colmap-geometric.sh", "run-colmap-photometric.sh", "solution.json", "sparse", "stereo", "transforms.json",
    ]  # fmt: skip
    assert sorted(p.name for p in (out / "images").iterdir()) == COURTYARD_NAMES
    assert sorted(p.name for p in (out / "masks").iterdir()) == COURTYARD_NAMES
    # what is in their way is refused before the work
    written = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file() and not p.name.startswith(".")}
    assert written == {*files_of_run(COURTYARD_NAMES, "tif", OutputOptions())}
    for name in COURTYARD_NAMES:
        image = read_photo(out / "images" / name).pixels
        mask = read_photo(out / "masks" / name).pixels
        assert image.shape == (320, 480, 3)
        assert image.dtype == mask.dtype == np.uint8
        assert mask.shape == (320, 480)
        assert set(np.unique(mask)) <= {0, 255}
        assert (mask == 255).mean() > 0.8
        assert (image[mask == 0] == 0).all()
    back = read_solution(out / "solution.json")
    assert [image.name for image in back.images] == [image.name for image in solution.images]
    for a, b in zip(back.registered, solution.registered, strict=True):
        np.testing.assert_array_equal(a.motion.phi, b.motion.phi)
        np.testing.assert_array_equal(a.R_cw, b.R_cw)
    assert back.options["max_features"] == 1200
    assert all(stage["seconds"] >= 0 for stage in back.stages)


def test_images_are_what_the_solution_says(courtyard, solved):
    solution, out, _ = solved
    image = solution.registered[2]
    raw = read_photo(courtyard / "photos" / image.name).pixels
    new_camera = solution.rectified_cameras["1"]
    pixels, mask = rectify(raw, solution.cameras["1"], image.motion, solution.shutter_model, new_camera)
    np.testing.assert_array_equal(read_photo(out / "images" / image.name).pixels, pixels)
    np.testing.assert_array_equal(read_photo(out / "masks" / image.name).pixels, mask)


def test_colmap_model_of_a_run(solved):
    import pycolmap

    solution, out, _ = solved
    model = pycolmap.Reconstruction(out / "sparse")
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == COURTYARD_NAMES
    for image in solution.registered:
        np.testing.assert_allclose(images[image.name].cam_from_world().matrix()[:, :3], image.R_cw, atol=1e-9)
        np.testing.assert_allclose(images[image.name].projection_center(), image.center_w, atol=1e-9)
    assert model.num_points3D() > 200
    assert model.compute_mean_reprojection_error() < 1.0
    colors = np.array([point.color for point in model.points3D.values()])
    assert colors.std() > 5


def test_transforms_of_a_run(solved):
    solution, out, _ = solved
    value = json.loads((out / "transforms.json").read_text())
    assert (value["w"], value["h"]) == (480, 320)
    assert value["cx"] == solution.rectified_cameras["1"].K[0, 2] + 0.5
    assert [frame["file_path"] for frame in value["frames"]] == [f"images/{n}" for n in COURTYARD_NAMES]
    for frame in value["frames"]:
        assert (out / frame["file_path"]).is_file()
        assert (out / frame["mask_path"]).is_file()


def test_progress_is_reported(solved):
    _, _, steps = solved
    stages = [stage for stage, _, _ in steps]
    assert stages[0] == "features"
    assert {"matching", "mapping", "rectifying", "writing"} <= set(stages)
    assert ("features", 7, 7) in steps
    assert ("rectifying", 6, 6) in steps
    assert all(0 <= done <= total or total == 0 for _, done, total in steps)


@pytest.mark.filterwarnings("ignore::rsundistort.errors.SkippedPhotoWarning")
@pytest.mark.slow
def test_same_seed_same_poses(courtyard, solved, tmp_path):
    first = solved[0]
    second = run(courtyard / "photos", tmp_path / "out", OPTIONS)
    assert [image.name for image in second.registered] == [image.name for image in first.registered]
    for a, b in zip(first.registered, second.registered, strict=True):
        np.testing.assert_allclose(b.R_cw, a.R_cw, atol=1e-6)
        np.testing.assert_allclose(b.center_w, a.center_w, atol=1e-6)
        np.testing.assert_allclose(b.motion.phi, a.motion.phi, atol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:skipped")
def test_guessed_focal_length_is_refined(courtyard, solved, tmp_path):
    true = read_solution(courtyard / "ground_truth.json").cameras["1"]
    fx, fy, cx, cy = 1.04 * true.K[0, 0], 1.04 * true.K[1, 1], true.K[0, 2], true.K[1, 2]
    options = replace(OPTIONS, camera=f"{fx},{fy},{cx},{cy}", solve=SolveOptions(refine=("f", "k1", "k2")))
    solution = run(courtyard / "photos", tmp_path / "out", options)
    found = solution.cameras["1"]
    sigma = solution.quality["sigma_intrinsics"]["1"]
    assert set(sigma) == {"f", "k1", "k2"}
    assert abs(found.K[0, 0] - true.K[0, 0]) < 5 * sigma["f"] < 5.0  # px; the guess was 16 off
    assert np.abs(found.dist[:2]).max() < 0.01
    before, after = (evaluate(out, courtyard / "ground_truth.json") for out in (solved[1], tmp_path / "out"))
    assert after.phi_mrad_per_frame.mean < 1.5 * before.phi_mrad_per_frame.mean + 0.5


@pytest.mark.slow
def test_a_wrong_anchor_is_obeyed_and_warned_of(courtyard, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in COURTYARD_NAMES:
        shutil.copy(courtyard / "photos" / name, photos)
    shutil.copy(courtyard / "camera.json", photos)
    truth = read_solution(courtyard / "ground_truth.json")
    moved = max(truth.images, key=lambda image: np.linalg.norm(image.motion.phi[1:])).name
    options = replace(OPTIONS, solve=SolveOptions(still={moved: 0.0}, shutter_model="rotation"))
    with pytest.warns(RsUndistortWarning, match=f"{moved} was specified as still"):
        solution = run(photos, tmp_path / "out", options)
    assert solution.image(moved).motion.phi[0] == 0.0
    assert solution.critical_motion["remedy"] == "given"
    assert solution.critical_motion["anchors"] == {moved: 0.0}


def test_what_a_solution_says_of_critical_motions(solved):
    said = solved[0].critical_motion
    assert len(said["singular_values"]) == len(said["null_vector"]) == 5
    assert 0 < said["sigma_log_k"] < 0.01
    assert said["remedy"] in ("none needed", "prior", "anchor")
    assert "the height of the scene is uncertain by" in said["sentence"]


def test_calibrated_intrinsics_stay_near_what_was_given(courtyard, solved):
    solution = solved[0]
    found, given = solution.cameras["1"], read_solution(courtyard / "ground_truth.json").cameras["1"]
    np.testing.assert_allclose(found.K, given.K, atol=2e-3 * given.K[0, 0])
    assert max(abs(value) for value in found.coefficients.values()) < 0.02
    assert solution.options["refine"] == ["f", "cx", "cy", "k1", "k2", "k3", "p1", "p2"]
    assert set(solution.quality["sigma_intrinsics"]["1"]) == set(solution.options["refine"])


@pytest.mark.slow
def test_grey_16_bit_and_global_model(courtyard, tmp_path):
    """Other kinds of photos than the fixture's, through the whole run."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in COURTYARD_NAMES:
        grey = cv2.imread(str(courtyard / "photos" / name), cv2.IMREAD_GRAYSCALE)
        done = cv2.imwrite(str(photos / name.replace(".png", ".tif")), grey.astype(np.uint16) * 257)
        assert done
    shutil.copy(courtyard / "camera.json", photos)
    solution = run(photos, tmp_path / "out", RunOptions(max_features=1200, solve=SolveOptions(shutter_model="global")))
    assert len(solution.registered) >= 5
    assert all((image.motion.phi == 0).all() for image in solution.registered)
    image = read_photo(tmp_path / "out" / "images" / "0001.tif").pixels
    assert image.dtype == np.uint16
    assert image.shape == (320, 480)


def test_failing_run_leaves_out_as_it_was(tmp_path):
    photos = save_textures(tmp_path / "photos", ["a.png", "b.png", "c.png"])
    out = tmp_path / "out"
    (out / "images").mkdir(parents=True)
    (out / "images" / "a.png").write_bytes(b"earlier")
    with Record(out).writing(["images/a.png"]):
        pass
    (out / "mine.txt").write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(ReconstructionError):
        run(photos, out, RunOptions(camera=CAMERA, max_features=500), overwrite=True)
    assert tree(tmp_path) == before
    with pytest.raises(FileError, match="not empty"):
        run(photos, out, RunOptions(camera=CAMERA))
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("kind", "options", "says"),
    [
        (SolveOptions, {"shutter_model": "spiral"}, "shutter model 'spiral'"),
        (RectifyOptions, {"interpolation": "magic"}, "interpolation='magic'"),
        (RunOptions, {"max_features": 5}, "max_features=5"),
        (RectifyOptions, {"quality": 0}, "quality=0"),
        (SolveOptions, {"refine": ("k9",)}, "cannot refine 'k9'"),
    ],
)
def test_options_are_checked(kind, options, says):
    with pytest.raises(InputError, match=says):
        kind(**options)


def test_options_of_another_kind_are_refused(tmp_path):
    with pytest.raises(InputError, match="options: expected a RunOptions"):
        run(tmp_path, tmp_path / "out", {"jobs": 1})
    with pytest.raises(InputError, match="options: expected a RectifyOptions"):
        rectify_folder(tmp_path, tmp_path / "solution.json", tmp_path / "out", {"quality": 90})
    for function, given in ((run, (tmp_path, tmp_path / "out")), (rectify_folder, (tmp_path, tmp_path, tmp_path))):
        with pytest.raises(InputError, match="overwrite begins anew and resume continues"):
            function(*given, overwrite=True, resume=True)
    with pytest.raises(InputError, match=r"jobs=1\.5, expected a whole number"):
        run(tmp_path, tmp_path / "out", jobs=1.5)
    with pytest.raises(InputError, match="seed=-1, expected a whole number"):
        SolveOptions(seed=-1)
    with pytest.raises(InputError, match="max_megapixels=-1, expected a positive number"):
        RectifyOptions(max_megapixels=-1)
    with pytest.raises(InputError, match="known motion of 'a': expected phi and sigma of three numbers each"):
        SolveOptions(known={"a": ([0, 0], [1, 1, 1])})
    with pytest.raises(InputError, match="known motion of 'a': expected phi and sigma of three numbers each"):
        SolveOptions(known={"a": 1})


def test_number_of_jobs_is_checked(tmp_path):
    with pytest.raises(InputError, match="jobs=-1, expected a whole number, at least 0"):
        run(tmp_path, tmp_path / "out", jobs=-1)
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- rectify_folder


def test_rectify_folder_with_the_truth(courtyard, tmp_path):
    truth = read_solution(courtyard / "ground_truth.json")
    with pytest.warns(SkippedPhotoWarning, match=BROKEN):
        used, left_out = rectify_folder(
            courtyard / "photos", courtyard / "ground_truth.json", tmp_path / "out", interpolation="linear"
        )
    assert list(left_out) == [BROKEN]
    assert used.shutter_model == "rotation"
    assert sorted(p.name for p in (tmp_path / "out" / "images").iterdir()) == COURTYARD_NAMES
    for name in COURTYARD_NAMES:
        raw = read_photo(courtyard / "photos" / name).pixels
        pixels, mask = rectify(
            raw,
            truth.cameras["1"],
            truth.image(name).motion,
            truth.shutter_model,
            truth.rectified_cameras["1"],
            "linear",
        )
        np.testing.assert_array_equal(read_photo(tmp_path / "out" / "images" / name).pixels, pixels)
        np.testing.assert_array_equal(read_photo(tmp_path / "out" / "masks" / name).pixels, mask)
    copied = read_solution(tmp_path / "out" / "solution.json")
    for image in copied.registered:
        np.testing.assert_array_equal(image.motion.phi, truth.image(image.name).motion.phi)


def test_masks_of_photos_of_one_stem_are_kept_apart(tmp_path):
    names = ["a.jpg", "a.png", "b.png"]
    photos = save_textures(tmp_path / "photos", names)
    camera = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
    images = tuple(SolvedImage(n, "1", motion=RowMotion([0.05 * k, 0, 0])) for k, n in enumerate(names))
    write_solution(tmp_path / "s.json", Solution("rotation", {"1": camera}, {"1": camera}, images))
    rectify_folder(photos, tmp_path / "s.json", tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out" / "images").iterdir()) == names
    assert sorted(p.name for p in (tmp_path / "out" / "masks").iterdir()) == ["a.jpg.png", "a.png.png", "b.png"]


# ---------------------------------------------------------------- simulate_warp


def test_simulate_warp_with_given_motions(tmp_path):
    names = ["a.png", "b.png", "c.png"]
    photos = save_textures(tmp_path / "photos", names)
    phi = [0.02, -1 / 30, 0.04]
    given = WarpOptions(
        camera="300,310,161.5,118.25,-0.05,0.01,0.001,-0.001", motion={"b.png": phi, "c.png": phi}, still=("c.png",)
    )
    truth = simulate_warp(photos, tmp_path / "out", given)
    written = read_solution(tmp_path / "out" / "ground_truth.json")
    for solution in (truth, written):
        assert [image.name for image in solution.images] == names
        np.testing.assert_array_equal(solution.image("a.png").motion.phi, np.zeros(3))
        np.testing.assert_array_equal(solution.image("b.png").motion.phi, phi)
        np.testing.assert_array_equal(solution.image("c.png").motion.phi, np.zeros(3))
        assert not any(image.posed for image in solution.images)
    assert written.image("b.png").rs_shift_px > 3
    for name in ("a.png", "c.png"):
        raw = read_photo(photos / name).pixels
        np.testing.assert_array_equal(read_photo(tmp_path / "out" / "photos" / name).pixels, raw)
        assert (read_photo(tmp_path / "out" / "masks" / name).pixels == 255).mean() > 0.98
    warped = read_photo(tmp_path / "out" / "photos" / "b.png").pixels
    assert np.abs(warped.astype(int) - read_photo(photos / "b.png").pixels).mean() > 5
    camera = Camera(**json.loads((tmp_path / "out" / "camera.json").read_text()))
    assert camera == written.cameras["1"]
    # rectifying what was warped gives the original back, away from what neither photo holds
    rectify_folder(tmp_path / "out" / "photos", tmp_path / "out" / "ground_truth.json", tmp_path / "back")
    assert (tmp_path / "back" / "images" / "b.png").is_file()


def test_warping_and_rectifying_gives_the_photo_back(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    original = cv2.GaussianBlur(texture(320, 240, 1), (0, 0), 2.0)
    save_png(photos / "a.png", original)
    simulate_warp(photos, tmp_path / "out", WarpOptions(camera=CAMERA, motion={"a.png": [0.05, -0.04, 0.06]}))
    rectify_folder(tmp_path / "out" / "photos", tmp_path / "out" / "ground_truth.json", tmp_path / "back")
    back = read_photo(tmp_path / "back" / "images" / "a.png").pixels
    inner = (slice(30, -30), slice(30, -30))
    assert np.abs(back[inner].astype(int) - original[inner]).mean() < 1.0


def test_simulate_warp_follows_its_seed(tmp_path):
    names = ["a.png", "b.png", "c.png"]
    photos = save_textures(tmp_path / "photos", names)
    truths = {}
    for out, options in {
        "first": WarpOptions(camera=CAMERA, seed=5, still=("b.png",), jobs=1),
        "again": WarpOptions(camera=CAMERA, seed=5, still=("b.png",), jobs=2),
        "other": WarpOptions(camera=CAMERA, seed=6, still=("b.png",)),
        "moved": WarpOptions(camera=CAMERA, seed=5),
    }.items():
        truths[out] = simulate_warp(photos, tmp_path / out, options)
    contents = {out: tree(tmp_path / out) for out in truths}
    for name in contents["first"]:
        if name not in ("ground_truth.json", ".rsundistort-written"):  # they hold times
            assert contents["again"][name] == contents["first"][name], name
    for name in names:
        first, again = truths["first"].image(name).motion.phi, truths["again"].image(name).motion.phi
        np.testing.assert_array_equal(again, first)
    assert contents["other"]["photos/a.png"] != contents["first"]["photos/a.png"]
    assert contents["other"]["photos/b.png"] == contents["first"]["photos/b.png"]
    # a still photo does not change the others
    assert contents["moved"]["photos/a.png"] == contents["first"]["photos/a.png"]
    assert contents["moved"]["photos/c.png"] == contents["first"]["photos/c.png"]
    np.testing.assert_array_equal(read_photo(tmp_path / "first" / "photos" / "b.png").pixels, texture(320, 240, 1))


def test_simulated_masks_of_photos_of_one_stem_are_kept_apart(tmp_path):
    photos = save_textures(tmp_path / "photos", ["a.jpg", "a.png"])
    simulate_warp(photos, tmp_path / "out", WarpOptions(camera=CAMERA))
    assert len(list((tmp_path / "out" / "photos").iterdir())) == 2
    assert len(list((tmp_path / "out" / "masks").iterdir())) == 2


CROPPED = "300,310,161.5,118.25,-0.05,0.01,0.001,-0.001"
TWISTS = {"a.png": [0.05, -0.04, 0.06], "b.png": [-0.03, 0.05, -0.08]}


DAILY = "top-to-bottom", "right-to-left"  # both axes, both signs


@pytest.fixture(
    scope="module", params=[pytest.param(each, marks=[] if each in DAILY else [pytest.mark.slow]) for each in READOUTS]
)
def crops(request, tmp_path_factory):
    """One folder warped whole and cropped, through a lens: where, the truth of the crop, its rectangle."""
    folder = tmp_path_factory.mktemp("crops")
    photos = folder / "photos"
    photos.mkdir()
    for seed, name in enumerate(("a.png", "b.png", "c.png")):
        save_png(photos / name, cv2.GaussianBlur(texture(320, 240, seed), (0, 0), 2.0))
    options = WarpOptions(camera=CROPPED, readout=request.param, motion=TWISTS)
    simulate_warp(photos, folder / "whole", options)
    truth = simulate_warp(photos, folder / "cut", replace(options, crop=True))
    return folder, truth, truth.options["crop_xywh"]


def test_cropped_photos_are_the_crop_of_the_whole_ones(crops):
    folder, _, (x, y, width, height) = crops
    assert 0.5 * 320 * 240 < width * height < 320 * 240
    kept = np.s_[y : y + height, x : x + width]
    for name in ("a.png", "b.png", "c.png"):
        for cut, whole in (("cut/photos", "whole/photos"), ("cut/masks", "whole/masks"), ("cut/global", "photos")):
            expected = read_photo(folder / whole / name).pixels[kept]
            np.testing.assert_array_equal(read_photo(folder / cut / name).pixels, expected)
        assert (read_photo(folder / "cut" / "masks" / name).pixels == 255).all()
    # one pixel more on any side, and it leaves the frame or some photo does not fill it
    filled = np.zeros((242, 322), bool)
    masks = [read_photo(folder / "whole" / "masks" / name).pixels for name in ("a.png", "b.png", "c.png")]
    filled[1:-1, 1:-1] = np.min(masks, axis=0) == 255
    x, y = x + 1, y + 1
    assert filled[y : y + height, x : x + width].all()
    assert not filled[y - 1, x : x + width].all()
    assert not filled[y + height, x : x + width].all()
    assert not filled[y : y + height, x - 1].all()
    assert not filled[y : y + height, x + width].all()


def test_camera_of_cropped_photos(crops):
    folder, truth, (x, y, width, height) = crops
    whole = read_solution(folder / "whole" / "ground_truth.json")
    camera = truth.cameras["1"]
    assert camera == Camera(**json.loads((folder / "cut" / "camera.json").read_text()))
    assert camera == read_solution(folder / "cut" / "ground_truth.json").cameras["1"]
    assert (camera.width, camera.height) == (width, height)
    np.testing.assert_array_equal(camera.K[:2, 2], [161.5 - x, 118.25 - y])
    np.testing.assert_array_equal(np.diag(camera.K), [300, 310, 1])
    np.testing.assert_array_equal(camera.dist, whole.cameras["1"].dist)
    assert camera.readout == whole.cameras["1"].readout
    assert camera.frame_span < whole.cameras["1"].frame_span
    for image in truth.images:
        np.testing.assert_array_equal(image.motion.phi, whole.image(image.name).motion.phi)
        assert image.rs_shift_px <= whole.image(image.name).rs_shift_px


def test_cropped_photos_rectify_to_their_references(crops):
    """The references have the lens of the photos: it is put on the rectified photo again by the lens's own map."""
    folder, truth, _ = crops
    camera = truth.cameras["1"]
    for image in truth.images:
        raw = read_photo(folder / "cut" / "photos" / image.name).pixels
        reference = read_photo(folder / "cut" / "global" / image.name).pixels
        rectified, mask = rectify(raw, camera, image.motion)
        flat, flat_mask = rectify(reference, camera)
        # noise of 2 pixels, interpolated once more than the reference and at 1/32 pixel: 52.4 to 52.8 dB
        assert psnr(rectified, flat, np.minimum(mask, flat_mask), 3) > 50
        assert mask.mean() > 0.8 * 255


def test_crop_of_random_motions_is_drawn_for_the_whole_frame(tmp_path):
    photos = save_textures(tmp_path / "photos", ["a.jpg", "b.jpg"])
    options = WarpOptions(camera=CAMERA, seed=4)
    whole = simulate_warp(photos, tmp_path / "whole", options)
    cut = simulate_warp(photos, tmp_path / "cut", replace(options, crop=True))
    for image in cut.images:
        np.testing.assert_array_equal(image.motion.phi, whole.image(image.name).motion.phi)
        x, y, width, height = cut.options["crop_xywh"]
        reference = read_photo(tmp_path / "cut" / "global" / image.name).pixels
        original = read_photo(photos / image.name).pixels[y : y + height, x : x + width]
        # quality 100: rounding in 8-bit YCbCr and of the coefficients to whole numbers
        assert psnr(reference, original) > 48
    assert not (tmp_path / "whole" / "global").exists()


def test_webp_references_lose_nothing(tmp_path):
    photos = save_textures(tmp_path / "photos", ["a.webp"])
    truth = simulate_warp(photos, tmp_path / "cut", WarpOptions(camera=CAMERA, crop=True))
    x, y, width, height = truth.options["crop_xywh"]
    original = read_photo(photos / "a.webp").pixels[y : y + height, x : x + width]
    np.testing.assert_array_equal(read_photo(tmp_path / "cut" / "global" / "a.webp").pixels, original)


@pytest.mark.parametrize("crop", [False, True])
def test_folding_motions_are_refused(tmp_path, crop):
    photos = save_textures(tmp_path / "photos", ["a.png", "b.png"])
    before = tree(tmp_path)
    options = WarpOptions(camera=CAMERA, motion={"b.png": [-0.95, 0, 0]}, crop=crop)
    with pytest.raises(InputError, match=r"the rows of b\.png fold over"):
        simulate_warp(photos, tmp_path / "out", options)
    assert tree(tmp_path) == before


def test_largest_rectangle_is_the_largest(rng):
    """Against all rectangles, one by one."""
    for _ in range(150):
        height, width = rng.integers(1, 8, 2)
        valid = rng.random((height, width)) < rng.uniform(0.2, 1.0)
        best = 0
        for top, left in np.argwhere(valid):
            for bottom in range(top + 1, height + 1):
                for right in range(left + 1, width + 1):
                    if valid[top:bottom, left:right].all():
                        best = max(best, (bottom - top) * (right - left))
        x, y, w, h = largest_rectangle(valid)
        assert w * h == best
        assert valid[y : y + h, x : x + w].all()
    assert largest_rectangle(np.zeros((4, 5), bool)) == (0, 0, 0, 0)
