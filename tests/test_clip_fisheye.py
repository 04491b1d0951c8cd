"""A video by a fisheye that nobody described: when it is tried, and what is kept of the trial."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, project_points
from rsundistort.errors import ReconstructionError
from rsundistort.input.fisheyes import cameras_as_pinholes
from rsundistort.input.load import LoadedPhotos
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.model.projection import unproject_points
from rsundistort.sfm.flow import flow_size
from rsundistort.solve.clip_pan import rotates_by

MODULE = import_module("rsundistort.solve.clip_fisheye")


def camera_of(f, dist=(), lens="pinhole"):
    return Camera(640, 360, [[f, 0, 319.5], [0, f, 179.5], [0, 0, 1]], list(dist), lens=lens)


# the tangent as a fisheye's coefficients
TAN = [0.333, 0.133, 0.054, 0.022]
GUESS, NARROW, WIDE, FISHEYE = (
    camera_of(528),
    camera_of(520),
    camera_of(300, [-0.24, 0.05, 0, 0]),
    camera_of(288, [], "fisheye"),
)
TRAVELS, ROTATES = np.arange(9.0).reshape(3, 3), np.zeros((3, 3))


def result_of(camera, sigma_px, center_w=TRAVELS, shape="trusted", **evidence):
    """A path through three frames."""
    rec = SimpleNamespace(cameras=[camera], center_w=center_w, num_images=3)
    return SimpleNamespace(
        shared=rec, whole=rec, result=SimpleNamespace(sigma_px=sigma_px), verdict=SimpleNamespace(shape=shape),
        evidence=evidence,
    )  # fmt: skip


@pytest.fixture
def solve(monkeypatch):
    """`by_likeliest_lens` where cameras have these results, one after the other, and say so.

    Returns the result, the cameras that were asked, whether these were to rotate only, what was said, and the notes.
    """

    def solve(*results, rotates=False, cameras=(GUESS,), without_focal=(0,), calibrated=False):
        asked, only, said, left = [], [], [], [*results]

        def solved(keys, *, kept=None, rotates=False):
            asked.append(keys.cameras.of(0))
            only.append(rotates)
            result = left.pop(0)
            said.append(f"{len(asked)}")
            if result is None:
                raise ReconstructionError("the photos do not determine their camera")
            return result

        monkeypatch.setattr(MODULE, "rotates_by", lambda *_: rotates)
        photo_cameras = PhotoCameras(
            cameras, ("clip",), np.zeros(3, int), calibrated, (False,), "the photos", without_focal=without_focal
        )
        keys = LoadedPhotos(["a", "b", "c"], [], [], {}, photo_cameras, {}, Path(), {}, 1.0)
        found, notes = MODULE.by_likeliest_lens(solved, None, keys, said)
        return SimpleNamespace(found=found, asked=asked, only=only, said=said, notes=notes)

    return solve


def test_a_wide_view_is_tried_as_a_fisheyes(solve):
    by_pinhole, by_fisheye = result_of(WIDE, 0.12), result_of(FISHEYE, 0.06)
    got = solve(by_pinhole, by_fisheye)
    assert got.found is by_fisheye
    assert [each.lens for each in got.asked] == ["pinhole", "fisheye"]
    assert got.asked[1].K[0, 0] == 300
    assert not got.asked[1].dist.any()
    assert got.said == ["2"]
    assert got.notes[0].startswith("no pinhole lens explains the photos of clip, and a fisheye does")
    # what it does not explain better stays, with what was said of it
    for failed in (None, result_of(FISHEYE, 0.1199)):
        got = solve(by_pinhole, failed)
        assert (got.found, got.said, got.notes) == (by_pinhole, ["1"], [])


@pytest.mark.parametrize(
    ("found", "changes"),
    [
        (result_of(NARROW, 0.12), {}),
        (result_of(NARROW, 0.12), {"rotates": True, "without_focal": ()}),
        (result_of(WIDE, 0.12), {"calibrated": True}),
        (result_of(NARROW, 0.12, ROTATES, stands=True), {}),
    ],
    ids=["narrow", "of a known focal length", "given", "stands"],
)
def test_other_videos_are_not(solve, found, changes):
    got = solve(found, **changes)
    assert (got.found, got.asked, got.said, got.notes) == (found, [GUESS], ["1"], [])


@pytest.mark.parametrize(("center_w", "sigma_px"), [(TRAVELS, 0.0401), (ROTATES, 0.03)], ids=["a scene", "rotations"])
def test_what_rotations_of_a_fisheye_explain_is_tried_as_one(solve, center_w, sigma_px):
    """And a scene that leaves as much is none."""
    by_fisheye, by_pinhole = result_of(FISHEYE, sigma_px, ROTATES), result_of(camera_of(680), 0.04, center_w)
    hovers, rotates = result_of(FISHEYE, sigma_px, TRAVELS), center_w is TRAVELS
    got = solve(by_pinhole, by_fisheye, hovers, rotates=rotates)
    assert got.asked[1].K[0, 0] == pytest.approx(np.hypot(640, 360) / np.pi)
    assert got.only == [False, True, False]  # whether it travelled is asked by that lens then
    assert (got.found, got.said) == (hovers, ["3"])
    # what that says is of no concern if it fails
    got = solve(by_pinhole, by_fisheye, None, rotates=rotates)
    assert (got.found, got.said, len(got.notes)) == (by_fisheye, ["2"], 1)
    worse = result_of(FISHEYE, 0.042, ROTATES)
    assert solve(by_pinhole, worse, rotates=rotates).found is by_pinhole


def test_a_wide_view_that_does_not_only_rotate_is_tried_with_its_scene(solve):
    by_fisheye = result_of(FISHEYE, 0.06)
    for by_rotations in (None, result_of(FISHEYE, 0.2, ROTATES)):
        got = solve(result_of(WIDE, 0.12), by_rotations, by_fisheye, rotates=True)
        assert (got.found, got.only, got.said) == (by_fisheye, [False, True, False], ["3"])


def test_an_error_is_one_unless_a_fisheye_can_be_trusted(solve):
    by_fisheye = result_of(FISHEYE, 0.1)
    assert solve(None, by_fisheye).found is by_fisheye
    for other in (None, result_of(FISHEYE, 0.1, shape="doubtful")):
        with pytest.raises(ReconstructionError, match="do not determine their camera"):
            solve(None, other)


def test_a_fisheye_that_a_pinhole_lens_follows_is_one(solve):
    by_tangent, by_pinhole = result_of(camera_of(520, TAN, "fisheye"), 0.1), result_of(NARROW, 0.1)
    got = solve(None, by_tangent, by_pinhole)
    assert got.asked[2] == camera_of(520)
    assert (got.found, got.said, got.notes) == (by_pinhole, ["3"], [])
    got = solve(None, by_tangent, None)
    assert (got.found, got.said, len(got.notes)) == (by_tangent, ["2"], 1)


@pytest.mark.parametrize(("estimate", "follows"), [(camera_of(520, TAN, "fisheye"), True), (FISHEYE, False)])
def test_which_fisheyes_a_pinhole_lens_follows(estimate, follows):
    cameras = PhotoCameras((FISHEYE,), ("clip",), np.zeros(3, int), False, (False,), "the photos")
    other = cameras_as_pinholes(cameras, [estimate])
    assert (other is not None) == follows
    if other is not None:
        assert other.cameras == (camera_of(520),)
        assert cameras_as_pinholes(other, [camera_of(520)]) is None


@pytest.mark.parametrize("travels", [False, True])
def test_corners_of_a_fisheyes_pan_are_rotations_by_it(rng, travels):
    size = np.array([640, 360]) / flow_size(640, 360)
    flows = []
    for _ in range(4):
        xy = rng.uniform([0, 0], [639, 359], (250, 2))
        rays, valid = unproject_points(xy, FISHEYE, RowMotion(), "global")
        X = np.column_stack([rays, np.ones(250)])
        turned = X @ Rotation.from_rotvec([0.01, 0.1, -0.01]).as_matrix().T
        if travels:
            turned = turned + rng.uniform(0.0, 0.2, (250, 1)) * [1.0, 0.3, 0.0]
        after, seen = project_points(turned, FISHEYE, RowMotion(), "global")
        both = valid & seen
        first, second = ((each[both] + rng.normal(0, 0.05, (both.sum(), 2)) + 0.5) / size - 0.5 for each in (xy, after))
        flows.append(SimpleNamespace(first_xy=first, second_xy=second))
    guess = camera_of(np.hypot(640, 360) / np.pi, [], "fisheye")
    assert rotates_by(SimpleNamespace(flows=flows), guess) != travels
    assert not rotates_by(SimpleNamespace(flows=[]), guess)
