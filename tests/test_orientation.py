"""Rotated photos and their cameras: OpenCV and projections are the oracles."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
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
    rectify,
    write_solution,
)
from rsundistort.errors import InputError
from rsundistort.model import READOUTS
from rsundistort.model.orientation import (
    INVERSE,
    compose_orientations,
    in_stored_frame,
    orient_camera,
    orient_pixels,
    orient_points,
    orient_reconstruction,
    orient_solution,
    split_mirror,
)

DIST = [-0.1, 0.02, 0.003, -0.002, 0.01, 0.02, -0.01, 0.003, 0.002, -0.001, 0.004, 0.0005]
K = [[500.0, 0, 330.5], [0, 520.0, 221.25], [0, 0, 1]]
TURNS = (1, 3, 6, 8)
MIRRORS = (2, 4, 5, 7)


def camera(readout="top-to-bottom"):
    return Camera(640, 480, K, DIST, readout)


def points_before(rng, R_cw, center_w, count=50):
    points_c = rng.uniform([-1.5, -1.2, 4], [1.5, 1.2, 8], (count, 3))
    return points_c @ R_cw + center_w


def solution(rng, readout="top-to-bottom", model="rotation", names=("a", "b", "c")):
    images = tuple(
        SolvedImage(
            name,
            "1",
            Rotation.random(random_state=k).as_matrix(),
            rng.normal(size=3),
            RowMotion([0.06, -0.04, 0.05], [0.02, 0.01, -0.03] if model == "constant-motion" else np.zeros(3)),
            np.array([0.1, 0.2, 0.3]),
        )
        for k, name in enumerate(names)
    )
    cameras = {"1": camera(readout)}
    return Solution(model, cameras, {"1": cameras["1"].pinhole()}, images)


def project(points_w, solution, image, model):
    """Pixels of the raw photo, or of the rectified one where model is None."""
    points_c = (points_w - image.center_w) @ image.R_cw.T
    if model is None:
        return project_points(points_c, solution.rectified_cameras[image.camera_id])
    motion = RowMotion(image.motion.phi, image.R_cw @ image.motion.velocity)
    return project_points(points_c, solution.cameras[image.camera_id], motion, model)


def test_pixels_are_rotated_as_opencv_rotates_them(tmp_path):
    """OpenCV follows the EXIF orientation of a JPEG on reading."""
    stored = np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
    data = bytes(cv2.imencode(".jpg", stored)[1])
    for o in range(1, 9):
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([o, 0, 0, 0]) + bytes(4)
        tagged = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
        shown = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_COLOR)
        plain = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(orient_pixels(plain, o), shown)
        np.testing.assert_array_equal(orient_pixels(orient_pixels(plain, o), INVERSE[o]), plain)


def test_points_go_where_their_pixels_go():
    pixels = np.arange(35, dtype=np.uint16).reshape(5, 7)
    xy = np.array([[x, y] for y in range(5) for x in range(7)], float)
    for o in range(1, 9):
        x, y = orient_points(xy, 7, 5, o).astype(int).T
        np.testing.assert_array_equal(orient_pixels(pixels, o)[y, x], pixels.ravel())


def test_orientations_compose_like_the_pixels():
    pixels = np.arange(35).reshape(5, 7)
    for first in range(1, 9):
        for then in range(1, 9):
            both = orient_pixels(orient_pixels(pixels, first), then)
            np.testing.assert_array_equal(orient_pixels(pixels, compose_orientations(first, then)), both)
        turn, rest = split_mirror(first)
        assert turn in TURNS
        assert rest in (1, 2)
        np.testing.assert_array_equal(orient_pixels(orient_pixels(pixels, turn), rest), orient_pixels(pixels, first))


@pytest.mark.parametrize("model", ["global", "two-step", "linearized", "rotation", "constant-motion"])
@pytest.mark.parametrize("readout", READOUTS)
def test_rotated_solution_sees_the_points_at_the_rotated_pixels(rng, readout, model):
    before = solution(rng, readout, model, [str(o) for o in TURNS])
    after = orient_solution(before, {str(o): o for o in TURNS})
    for o in TURNS:
        old, new = before.image(str(o)), after.image(str(o))
        points_w = points_before(rng, old.R_cw, old.center_w)
        xy, valid = project(points_w, before, old, model)
        xy2, valid2 = project(points_w, after, new, model)
        assert valid.all()
        assert valid2.all()
        np.testing.assert_allclose(xy2, orient_points(xy, 640, 480, o), atol=1e-9)
        # rectified photos: a pinhole at the same pose
        plain = project(points_w, before, old, None)[0]
        np.testing.assert_allclose(project(points_w, after, new, None)[0], orient_points(plain, 640, 480, o), atol=1e-9)
        assert new.applied_orientation == o


@pytest.mark.parametrize("readout", READOUTS)
@pytest.mark.parametrize("orientation", MIRRORS)
def test_mirrored_motion_sees_mirrored_points(rng, readout, orientation):
    """Without a pose a mirror is exact too: directions are mirrored, and the axial phi with them."""
    motion = RowMotion([0.06, -0.04, 0.05])
    before = Solution(
        "rotation", {"1": camera(readout)}, {"1": camera().pinhole()}, (SolvedImage("a", "1", motion=motion),)
    )
    after = orient_solution(before, {"a": orientation})
    new = after.image("a")
    points_c = points_before(rng, np.eye(3), np.zeros(3))
    mirrored = np.column_stack([orient_points(points_c[:, :2], 1, 1, orientation), points_c[:, 2]])
    xy, _ = project_points(points_c, camera(readout), motion)
    xy2, _ = project_points(mirrored, after.cameras[new.camera_id], new.motion)
    np.testing.assert_allclose(xy2, orient_points(xy, 640, 480, orientation), atol=1e-9)


def test_a_posed_photo_is_not_mirrored(rng):
    for o in MIRRORS:
        with pytest.raises(InputError, match="mirror"):
            orient_solution(solution(rng), {"a": o})


def test_rotating_a_photo_and_rectifying_it_commute(rng):
    photo = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), dtype=np.uint8), (0, 0), 3)
    image = solution(rng).images[0]
    plain, mask = rectify(photo, camera(), image.motion)
    for o in range(2, 9):
        before = Solution("rotation", {"1": camera()}, {"1": camera().pinhole()}, (replace(image, R_cw=None),))
        after = orient_solution(before, {"a": o})
        new = after.image("a")
        other, other_mask = rectify(
            orient_pixels(photo, o), after.cameras[new.camera_id], new.motion,
            new_camera=after.rectified_cameras[new.camera_id],
        )  # fmt: skip
        # the grid is float32: a sample may round to the next 1/32 pixel
        both = (orient_pixels(mask, o) > 0) & (other_mask > 0)
        assert (orient_pixels(mask, o) != other_mask).mean() < 1e-4
        assert np.abs(orient_pixels(plain, o).astype(int) - other)[both].max() <= 2


def test_cameras_are_shared_by_photos_of_one_orientation(rng):
    before = solution(rng)
    after = orient_solution(before, {"a": 6, "c": 6})
    assert after.image("a").camera_id == after.image("c").camera_id != "1" == after.image("b").camera_id
    assert set(after.cameras) == set(after.rectified_cameras) == {"1", "2"}
    assert after.cameras["1"] == before.cameras["1"]
    assert (after.cameras["2"].width, after.cameras["2"].height) == (480, 640)
    assert after.cameras["2"].readout == "right-to-left"


def test_a_rotated_solution_is_written_read_and_rotated_back(tmp_path, rng):
    before = solution(rng)
    after = orient_solution(before, {"a": 6, "c": 3})
    write_solution(tmp_path / "s.json", after)
    back = in_stored_frame(read_solution(tmp_path / "s.json"))
    for old, new in zip(before.images, back.images, strict=True):
        np.testing.assert_allclose(new.R_cw, old.R_cw, atol=1e-12)
        np.testing.assert_allclose(new.motion.phi, old.motion.phi)
        np.testing.assert_allclose(new.sigma_phi, old.sigma_phi)
        assert new.applied_orientation == 1
        np.testing.assert_allclose(back.cameras[new.camera_id].K, before.cameras["1"].K)
        np.testing.assert_allclose(back.cameras[new.camera_id].dist, before.cameras["1"].dist)
        assert back.cameras[new.camera_id].readout == before.cameras["1"].readout


def test_a_rotated_reconstruction_has_the_same_residuals_and_cameras(rng):
    before = solution(rng)
    points_w = points_before(rng, before.images[0].R_cw, before.images[0].center_w)
    frames, points = np.repeat(np.arange(3), 50), np.tile(np.arange(50), 3)
    rec = Reconstruction(
        [camera()], ["a", "b", "c"], np.zeros(3, int), np.array([i.R_cw for i in before.images]),
        np.array([i.center_w for i in before.images]), points_w,
        Observations(frames, points, rng.uniform(0, 480, (150, 2))), np.array([i.motion.phi for i in before.images]),
        shutter_model="rotation",
    )  # fmt: skip
    turns = {"a": 8, "b": 6, "c": 8}
    after, turned = orient_solution(before, turns), orient_reconstruction(rec, turns)
    assert list(turned.cameras) == list(after.cameras.values())
    for i, image in enumerate(after.images):
        assert turned.camera(i) == after.cameras[image.camera_id]
        np.testing.assert_allclose(turned.R_cw[i], image.R_cw)
        np.testing.assert_allclose(turned.phi[i], image.motion.phi)
        seen = rec.observations.frame_idx == i
        expected = orient_points(rec.observations.xy_raw[seen], 640, 480, turns[image.name])
        np.testing.assert_allclose(turned.observations.xy_raw[seen], expected)
    with pytest.raises(InputError):
        orient_reconstruction(rec, {"a": 2})


def test_a_garbled_rotation_is_refused(tmp_path, rng):
    write_solution(tmp_path / "s.json", orient_solution(solution(rng), {"a": 6}))
    text = (tmp_path / "s.json").read_text()
    (tmp_path / "s.json").write_text(text.replace('"turned": 6', '"turned": 9'))
    with pytest.raises(InputError, match="1 to 8"):
        read_solution(tmp_path / "s.json")


def test_fisheye_distortion_does_not_rotate():
    fields = Camera.__dataclass_fields__
    if "lens" not in fields:
        pytest.skip("no fisheye lens yet")
    fisheye = Camera(640, 480, K, [0.1, 0.02, 0.003, 0.004], lens="fisheye")
    np.testing.assert_array_equal(orient_camera(fisheye, 6).dist, fisheye.dist)
