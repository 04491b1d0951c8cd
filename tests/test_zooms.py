"""Photos of another zoom, or of another camera, that their files do not tell apart."""

from __future__ import annotations

import importlib
import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsundistort import Camera, RsUndistortWarning
from rsundistort.errors import ReconstructionError
from rsundistort.input.photo_cameras import GUESS_SIGMA, PhotoCameras
from rsundistort.input.zooms import cameras_by_zoom
from rsundistort.io.kept import Kept
from rsundistort.solve.run import _by_cameras

K = np.array([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]])
NAMES = [f"{i}.jpg" for i in range(8)]


def cameras(calibrated: bool = False) -> PhotoCameras:
    """Two bodies: photos 0 to 5 of one, 6 and 7 of the other."""
    bodies = Camera(640, 480, K), Camera(480, 640, K, readout="left-to-right")
    idx = np.array([0] * 6 + [1] * 2)
    return PhotoCameras(bodies, ("a", "b"), idx, calibrated, (True, False), "EXIF", without_focal=[1])


def by_name(*focal_px: float) -> dict[str, float]:
    return {name: each for name, each in zip(NAMES, focal_px, strict=True) if np.isfinite(each)}


@pytest.mark.parametrize("calibrated", [False, True])
def test_photos_of_another_focal_length_get_a_camera_of_their_own(calibrated):
    found = cameras_by_zoom(cameras(calibrated), NAMES, by_name(690, 900, 695, 700, np.nan, 910, 700, 705))
    assert found is not None
    divided, (note,) = found
    # the one that was not registered stays with the most
    assert divided.camera_idx.tolist() == [0, 2, 0, 0, 0, 2, 1, 1]
    assert [each.K[0, 0] for each in divided.cameras] == [695.0, 700.0, 905.0]
    assert divided.labels == ("a", "b", "a-f905")
    assert divided.readout_specified == (True, False, True)
    assert divided.without_focal == [1]
    assert [*divided.sigma] == [{}, {}, GUESS_SIGMA if calibrated else {}]
    assert "2 of 5 photos of a" in note
    assert "905 px in place of 695 (1.jpg, 5.jpg)" in note


def test_a_camera_that_is_divided_keeps_what_was_said_of_it():
    divided, _ = cameras_by_zoom(cameras(), NAMES, by_name(*[700] * 6, 600, 650)) or (None, None)
    assert divided is None
    more = [*NAMES, "8.jpg", "9.jpg"]
    given = PhotoCameras(
        cameras().cameras, ("a", "b"), np.array([0] * 4 + [1] * 6), False, (True, False), "EXIF", without_focal=[1]
    )
    values = dict(zip(more, [700.0] * 4 + [600, 600, 600, 600, 660, 661], strict=True))
    found = cameras_by_zoom(given, more, values)
    assert found is not None
    assert found[0].cameras[2].readout == "left-to-right"
    assert found[0].readout_specified == (True, False, False)
    assert found[0].without_focal == [1, 2]


def test_a_single_photo_goes_to_the_camera_that_was_divided_off_before():
    divided, _ = cameras_by_zoom(cameras(), NAMES, by_name(690, 900, 695, 700, 700, 910, 700, 705)) or (None, None)
    assert divided is not None
    again = cameras_by_zoom(divided, NAMES, by_name(690, 900, 695, 700, 980, 910, 700, 705))
    assert again is not None
    assert again[0].camera_idx.tolist() == [0, 2, 0, 0, 2, 2, 1, 1]
    assert again[0].labels == divided.labels
    assert "1 of 4 photos of a has another focal length" in again[1][0]


@pytest.mark.parametrize(
    "focal_px",
    [
        (),
        # a lens that focuses: nothing lies between, but not far apart; and far apart, with others between
        (690, 690, 700, 712, 714, 716, 700, 700),
        (690, 700, 720, 740, 760, 780, 700, 700),
        # one photo may as well be misplaced
        (690, 900, 695, 700, 702, 699, 700, 700),
    ],
)
def test_others_stay_those_of_one_camera(focal_px):
    assert cameras_by_zoom(cameras(), NAMES, by_name(*focal_px) if focal_px else {}) is None


@dataclass(frozen=True)
class Loaded:
    names: list[str]
    cameras: PhotoCameras


def solved_by(*outcomes: tuple[tuple[float, ...], float] | None) -> Any:
    """A solver that comes to these focal lengths and residuals by turns, saying which; None: to an error."""
    turn = iter(enumerate(outcomes))

    def solve(loaded: Loaded, kept: Kept) -> tuple[Any, str]:
        k, outcome = next(turn)
        warnings.warn(f"solution {k}", RsUndistortWarning, stacklevel=2)
        if outcome is None:
            raise ReconstructionError("no")
        focal_px, sigma_px = outcome
        choice = SimpleNamespace(focal_px=by_name(*focal_px), varying=False)
        shared = SimpleNamespace(image_names=NAMES, camera=lambda i: Camera(640, 480, K))
        return SimpleNamespace(choice=choice, shared=shared, result=SimpleNamespace(sigma_px=sigma_px)), f"{k}"

    return solve


APART, ONE_MORE = (690, 900, 695, 700, 700, 910, 700, 705), (690, 900, 695, 700, 980, 910, 700, 705)


@pytest.mark.parametrize(
    ("outcomes", "taken", "notes"),
    [
        # each division that leaves less is taken, and all are told
        (((APART, 0.3), (ONE_MORE, 0.2), ((700.0,) * 8, 0.1)), 2, 2),
        # one that leaves more, or comes to nothing, leaves no word of it
        (((APART, 0.3), ((700.0,) * 8, 0.4)), 0, 0),
        (((APART, 0.3), None), 0, 0),
        (((APART, 0.3), (ONE_MORE, 0.2), None), 1, 1),
    ],
)
def test_what_is_said_is_of_the_solution_that_is_taken(outcomes, taken, notes, monkeypatch):
    module = importlib.import_module("rsundistort.solve.run")
    monkeypatch.setattr(module, "_OTHER_CAMERAS", ((module._by_zoom, module._is_better),))
    loaded = Loaded(NAMES, replace(cameras()))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        _, solving, loaded = _by_cameras(solved_by(*outcomes), loaded, Kept())
    assert solving == f"{taken}"
    assert len(loaded.cameras.cameras) == (3 if taken else 2)
    told = [str(each.message) for each in said]
    assert told[0] == f"solution {taken}"
    assert ["another focal length" in each for each in told[1:]] == [True] * notes
