"""The focal length of a camera that neither a file nor EXIF states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from make_photos import half_courtyard
from scipy.spatial.transform import Rotation

from rsundistort import Camera, read_solution
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import ReconstructionError, RsUndistortWarning
from rsundistort.input.load import load_photos
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.input.unknown_focal import warn_of_weak_focal_lengths, with_focal_lengths
from rsundistort.sfm import USUAL_FOCAL, estimate_focal_length

SIZE = (1280, 960)
CAMERA = Camera(*SIZE, np.diag([1.0, 1.0, 1.0]))


def shown(rng, focal, points_w, turn=0.25, travel=1.0, noise_px=0.4, wrong=0.1, phi_rad=0.0):
    """Matches of two photos, some of them wrong; the camera rotated while they were read."""
    middle = (np.array(SIZE) - 1) / 2
    seen = []
    for _ in range(2):
        R_cw = Rotation.from_rotvec(rng.normal(0, turn, 3)).as_matrix()
        still = (points_w - travel * rng.normal(0, 1.0, 3)) @ R_cw.T
        phi, x_c = rng.normal(0, phi_rad, 3) * focal / SIZE[1], still
        for _ in range(5):
            clock = np.clip(x_c[:, 1:2] / x_c[:, 2:], -1.0, 1.0)
            x_c = Rotation.from_rotvec(clock * phi).apply(still)
        seen.append(x_c)
    ahead = (seen[0][:, 2] > 0.5) & (seen[1][:, 2] > 0.5)
    first, second = (
        focal * x_c[ahead, :2] / x_c[ahead, 2:] + middle + rng.normal(0, noise_px, (ahead.sum(), 2)) for x_c in seen
    )
    lost = rng.random(len(second)) < wrong
    second[lost] = rng.uniform(0, SIZE, (lost.sum(), 2))
    return first, second


def in_a_room(rng):
    return np.column_stack([rng.uniform(-4, 4, (200, 2)), rng.uniform(4, 12, 200)])


@pytest.mark.parametrize("focal", [600.0, 1000.0, 2400.0])
def test_pairs_of_a_scene_tell_the_focal_length_as_well_as_they_say(rng, focal):
    found = estimate_focal_length([shown(rng, focal, in_a_room(rng)) for _ in range(10)], CAMERA)
    assert abs(np.log(found.pixels / focal)) < 2.5 * found.sigma
    assert found.sigma < 0.12
    assert found.num_pairs == 10


def test_a_shutter_does_not_pass_for_another_focal_length():
    errors = []
    for k in range(4):
        rng = np.random.default_rng(k)
        pairs = [shown(rng, 1000.0, in_a_room(rng), turn=0.1, travel=0.4, phi_rad=0.03) for _ in range(10)]
        errors.append(np.log(estimate_focal_length(pairs, CAMERA).pixels / 1000.0))
    assert np.sqrt(np.mean(np.square(errors))) < 0.015  # 0.024 by poses without a shutter


@pytest.mark.parametrize("of", ["a plane", "a camera that rotated"])
def test_what_tells_nothing_is_not_believed(rng, of):
    focal = 1800.0
    plane = np.column_stack([rng.uniform(-4, 4, (200, 2)), np.full(200, 8.0)])
    pairs = [
        shown(rng, focal, plane) if of == "a plane" else shown(rng, focal, in_a_room(rng), travel=0.0)
        for _ in range(10)
    ]
    found = estimate_focal_length(pairs, CAMERA)
    assert found.sigma > 0.15
    assert abs(np.log(found.pixels / focal)) < 2.5 * found.sigma


def test_without_pairs_it_is_what_is_usual():
    found = estimate_focal_length([], CAMERA)
    assert found.num_pairs == 0
    assert (found.pixels, found.sigma) == (pytest.approx(USUAL_FOCAL[0] * SIZE[0]), USUAL_FOCAL[1])


@pytest.fixture
def photos(tmp_path):
    """Photos that a shutter bent, of an unknown focal length of 400 px."""
    folder = half_courtyard(tmp_path / "in")
    (folder.parent / "camera.json").unlink()
    return folder


def test_the_focal_length_of_photos_without_one_is_found_and_said(photos):
    log = StageLog(None)
    loaded = load_photos(photos, None, None, 2000, Workers(1), log)
    assert loaded.cameras.without_focal == [0]
    found = with_focal_lengths(loaded, 0, log).cameras
    (camera,), (sigma,) = found.cameras, found.known_to(loose=False).sigmas
    assert abs(np.log(camera.K[0, 0] / 400.0)) < 2.5 * sigma["f"]
    assert "give --camera if you know it" in found.notes[-1]
    assert not found.calibrated


@pytest.mark.parametrize(
    ("sigmas", "used", "said"),
    [
        ({"f": 4.0}, {0}, False), ({"f": 40.0}, {0}, True), ({}, {0}, True),
        ({"fx": 4.0, "fy": 4.0}, {0}, False), ({"fx": 40.0, "fy": 4.0}, {0}, True),
        # no photo of the camera is registered
        ({"f": 40.0}, {1}, False),
    ],
)  # fmt: skip
def test_a_focal_length_is_called_weak_if_the_solution_leaves_it_so(recwarn, sigmas, used, said):
    guess = Camera(320, 240, [[272.0, 0, 159.5], [0, 272.0, 119.5], [0, 0, 1]])
    cameras = PhotoCameras([guess], ["a"], np.zeros(3, int), False, (False,), "", sigma=[{"f": 0.3}], without_focal=[0])
    warn_of_weak_focal_lengths(cameras, [guess], [sigmas], used)
    assert [str(each.message).startswith("the photos hardly determine") for each in recwarn] == [True] * said
    warn_of_weak_focal_lengths(replace(cameras, without_focal=[]), [guess], [{"f": 100.0}], used)
    assert len(recwarn) == said


@pytest.mark.parametrize(
    ("found", "says"),
    [({"f": 40.0}, "f = 40 would be"), ({"dist": [-2.0, 2.4, 0, 0, -1.0]}, "k1 = -2 would be 10 standard deviations")],
)
def test_a_camera_like_none_is_not_believed(found, says):
    guess = Camera(320, 240, [[272.0, 0, 159.5], [0, 272.0, 119.5], [0, 0, 1]])
    cameras = PhotoCameras([guess], ["a"], np.zeros(3, int), False, (False,), "", sigma=[{"f": 0.3}], without_focal=[0])
    f = found.get("f", 300.0)
    odd = Camera(320, 240, [[f, 0, 159.5], [0, f, 119.5], [0, 0, 1]], found.get("dist", []))
    cameras.check_plausible([replace(guess, dist=np.array([-0.3, 0.1, 0, 0, 0]))])
    with pytest.raises(ReconstructionError, match=f"the photos do not determine their camera: {says}.*--camera"):
        cameras.check_plausible([odd])
    replace(cameras, without_focal=[]).check_plausible([odd])  # EXIF is another matter


def test_photos_that_were_cropped_off_their_middle_are_a_camera_if_they_determine_it():
    guess = Camera(320, 240, [[272.0, 0, 159.5], [0, 272.0, 119.5], [0, 0, 1]])
    cameras = PhotoCameras([guess], ["a"], np.zeros(3, int), False, (False,), "", sigma=[{"f": 0.3}], without_focal=[0])
    cropped = Camera(320, 240, [[272.0, 0, 190], [0, 272.0, 119.5], [0, 0, 1]])
    with pytest.warns(RsUndistortWarning, match=r"at \(190, 120\), far off the middle of 320x240: .* cropped"):
        cameras.check_plausible([cropped], [{"cx": 0.5}])
    with pytest.raises(ReconstructionError, match="do not determine their camera: cx"):
        cameras.check_plausible([cropped], [{"cx": 5.0}])
    # whatever else is odd, too, is no crop
    with pytest.raises(ReconstructionError, match="do not determine their camera"):
        cameras.check_plausible([replace(cropped, dist=[-2.0, 2.4, 0, 0, -1.0])], [{"cx": 0.5, "k1": 0.01}])


@pytest.mark.slow
def test_photos_without_a_focal_length_are_solved_with_the_one_that_they_show(invoke, photos):
    result = invoke("run", photos, "-o", "out", "--no-report", "--model", "rotation")
    assert result.exit_code == 0, result.output
    assert "give --camera if you know it" in " ".join(result.stdout.split())
    K = read_solution("out/solution.json").cameras["1"].K
    assert K[0, 0] == pytest.approx(400.0, rel=0.01), K


def test_a_warp_needs_the_focal_length(invoke, photos):
    result = invoke("simulate", "warp", photos, "-o", "out", "--seed", "1")
    assert result.exit_code == 1
    assert "no focal length" in result.stderr
