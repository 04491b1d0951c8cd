"""Photos whose pixels are not square: what one adjustment says of them, and whom it asks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bundle_scenes import make_scene, perturbed

from rsundistort import Camera, Reconstruction, SolveOptions, bundle_adjust
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.model.projection import project_points
from rsundistort.solve.solutions import explains_most, explains_variation
from rsundistort.solve.stretched import cameras_if_stretched

pytestmark = pytest.mark.usefixtures("one_thread")

GUESS = Camera(800, 600, [[700.0, 0, 399.5], [0, 700.0, 299.5], [0, 0, 1]])
OPTIONS = SolveOptions()


def cameras(**changes) -> PhotoCameras:
    return replace(PhotoCameras((GUESS,), ("phone",), np.zeros(9, int), False, (False,), "EXIF"), **changes)


def photographed(rng, width: float, varies: float = 0.0) -> Reconstruction:
    """Photos of pixels so many times as wide as high, by a lens that varies by so much, started near the truth."""
    scene = make_scene(rng, "global", num_images=9, num_points=150)
    camera = replace(GUESS, K=np.diag([700 / width, 700, 1]) + np.array([[0, 0, 403], [0, 0, 296], [0, 0, 0]]))
    obs, xy = scene.observations, np.empty((9, 150, 2))
    variation = varies * rng.normal(size=(9, 3))
    for i, own in enumerate(variation):
        X_c = (scene.points_w - scene.center_w[i]) @ scene.R_cw[i].T
        xy[i] = project_points(X_c, camera.varied(*own), None, "global")[0]
    measured = replace(obs, xy_raw=xy[obs.frame_idx, obs.point_idx] + 0.1 * rng.normal(size=(len(obs), 2)))
    scene = replace(scene, cameras=[GUESS], camera_idx=np.zeros(9, int), observations=measured)
    return perturbed(scene, rng, 0.002, 0.005)


def solved_by(start: Reconstruction, *, varying: bool):
    """The photos solved by square pixels."""
    options = replace(OPTIONS.options_for(cameras()), varying=varying)
    return SimpleNamespace(
        result=(result := bundle_adjust(start, "global", options)), shared=result.reconstruction, choice=None
    )


@pytest.mark.parametrize("varying", [True, False])
@pytest.mark.parametrize("width", [0.97, 1.33])
def test_a_stretch_is_found_from_what_square_pixels_make_of_it(rng, width, varying):
    solved = solved_by(photographed(rng, width), varying=varying)
    found = cameras_if_stretched(cameras(), solved, OPTIONS, is_unexplained=not varying)
    assert found is not None
    (camera,), (note,) = found[0].cameras, found[1]
    assert camera.K[1, 1] / camera.K[0, 0] == pytest.approx(width, rel=2e-3)
    assert {"fx", "fy"} <= {*found[0].intrinsics}
    assert note.startswith(f"pixels of phone are {camera.K[1, 1] / camera.K[0, 0]:.4f} times as wide as they are high")
    assert cameras_if_stretched(*(found[0], solved, OPTIONS), is_unexplained=True) is None  # it has them already
    # one that is given is not asked, nor one whose focal lengths are not refined
    assert cameras_if_stretched(cameras(calibrated=True), solved, OPTIONS, is_unexplained=True) is None
    assert cameras_if_stretched(cameras(), solved, SolveOptions(refine=("f", "k1")), is_unexplained=True) is None


def test_square_pixels_and_a_lens_that_varies_stay(rng):
    square = solved_by(photographed(rng, 1.0), varying=False)
    assert cameras_if_stretched(cameras(), square, OPTIONS, is_unexplained=True) is None
    varied = solved_by(photographed(rng, 1.0, varies=0.01), varying=True)
    assert varied.shared.varies
    assert cameras_if_stretched(cameras(), varied, OPTIONS, is_unexplained=False) is None


def test_photos_that_are_explained_take_what_leaves_less(rng):
    for width, is_stretched in ((0.97, True), (1.0, False)):
        found = cameras_if_stretched(
            cameras(), solved_by(photographed(rng, width), varying=False), OPTIONS, is_unexplained=False
        )
        assert (found is not None) == is_stretched


@pytest.mark.parametrize(
    ("sigma_px", "varied", "varies", "most", "as_much"),
    [(0.7, False, False, True, False), (0.72, True, False, False, True), (1.005, True, False, False, True),
     (1.02, True, False, False, False), (1.0, True, True, False, False), (1.0, False, False, False, False)],
)  # fmt: skip
def test_a_result_explains_another(sigma_px, varied, varies, most, as_much):
    def of(sigma_px, varies):
        return SimpleNamespace(sigma_px=sigma_px, reconstruction=SimpleNamespace(varies=varies))

    assert explains_most(of(sigma_px, varies), of(1.0, varied)) == most
    assert explains_variation(of(sigma_px, varies), of(1.0, varied)) == as_much
