"""What the exposure time says of the motion."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from bundle_scenes import make_scene
from make_photos import camera_exif, texture
from solved_scene import cameras_of

from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, bundle_adjust
from rsundistort.errors import InputError
from rsundistort.input.exposure import bounded_by_exposure
from rsundistort.input.load import LoadedPhotos
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.io import Metadata, write_image
from rsundistort.io.photos.exif_facts import ExifFacts, _facts, read_exif
from rsundistort.sfm import edge_width_px
from rsundistort.simulate import WarpOptions, simulate_warp
from rsundistort.solve import model_sequence
from rsundistort.verdict import judge


def squares(blur_px):
    photo = np.kron(np.indices((8, 10)).sum(0) % 2, np.ones((60, 60))).astype(np.uint8) * 180 + 30
    return cv2.blur(photo, (blur_px, 1))


@pytest.mark.parametrize("blur_px", [9, 17, 25])
def test_edges_are_as_wide_as_the_motion_was_long(blur_px):
    assert blur_px * 0.7 < edge_width_px(squares(blur_px)) < blur_px * 1.3
    # whichever way it went
    assert edge_width_px(np.ascontiguousarray(squares(blur_px).T)) == edge_width_px(squares(blur_px))


def test_sharp_edges_are_narrow():
    assert edge_width_px(squares(1)) < 4


@pytest.mark.parametrize("photo", [np.full((50, 60), 9, np.uint8), np.zeros((1, 40), np.uint8)])
def test_photos_without_edges_tell_nothing(photo):
    assert edge_width_px(photo) is None


@pytest.mark.parametrize(("stored", "found"), [(1 / 17, 1 / 17), (0.0, None), (1e9, None), (None, None)])
def test_exposures_that_cannot_be_are_missing(stored, found):
    assert _facts({0x829A: stored}).exposure_s == found


@pytest.mark.parametrize(("stored", "found"), [(0.0, False), (1.0, True), (16.0, False), (25.0, True), (None, None)])
def test_a_flash_that_fired_is_reported(stored, found):
    assert _facts({0x9209: stored}).flash is found


def loaded(rec, exposure_s, edge_px, flash=None):
    """Photos with an exposure and edges, the same of all, or a list."""
    m = rec.num_images
    exposures = exposure_s if isinstance(exposure_s, list) else [exposure_s] * m
    facts = [ExifFacts(exposure_s=each, flash=flash) for each in exposures]
    cameras = PhotoCameras(rec.cameras, ["camera"], rec.camera_idx, True, (True,), "")
    edges = edge_px if isinstance(edge_px, list) else [edge_px] * m
    return LoadedPhotos(list(rec.image_names), [], facts, {}, cameras, {}, Path(), {}, 100.0, edges)


def test_long_sharp_exposures_bound_the_motion(rng):
    rec = make_scene(rng, "rotation", noise_px=0.3)
    bounded = bounded_by_exposure(BundleOptions(), rec, loaded(rec, 0.1, 3.0), dict.fromkeys(range(9), 0.02))
    most = 3.0 / min(camera.K[0, 0] for camera in rec.cameras) * 0.2
    assert bounded.phi_sigma_most == pytest.approx(most)
    assert bundle_adjust(rec, "rotation", bounded).phi_sigma <= most
    assert bundle_adjust(rec, "rotation").phi_sigma > 5 * most


@pytest.mark.parametrize(("exposure_s", "edge_px"), [(None, 3.0), (0.001, None)])
def test_short_or_unknown_exposures_bound_nothing(exposure_s, edge_px, rng):
    rec = make_scene(rng, "rotation")
    assert bounded_by_exposure(BundleOptions(), rec, loaded(rec, exposure_s, edge_px), {}) == BundleOptions()


def test_a_flash_bounds_nothing(rng):
    rec = make_scene(rng, "rotation", noise_px=0.3)
    bounded = bounded_by_exposure(BundleOptions(), rec, loaded(rec, 0.1, 3.0, flash=True), {})
    assert bounded.phi_limits == {}
    assert bounded.phi_sigma_most is None


def test_a_simulated_photo_does_not_say_that_it_was_exposed_for_long(tmp_path):
    (tmp_path / "photos").mkdir()
    write_image(tmp_path / "photos" / "a.jpg", texture(64, 48), Metadata(exif=camera_exif("<")))
    assert read_exif(tmp_path / "photos" / "a.jpg").exposure_s == pytest.approx(1 / 250)
    simulate_warp(tmp_path / "photos", tmp_path / "out", WarpOptions(camera="60,60,31.5,23.5"))
    facts = read_exif(tmp_path / "out" / "photos" / "a.jpg")
    assert facts.exposure_s is None
    assert facts.make == read_exif(tmp_path / "photos" / "a.jpg").make


def test_each_photo_is_bounded_by_its_own_exposure(rng):
    rec = make_scene(rng, "rotation", noise_px=0.3)
    # the first was exposed for long; of the others nothing is known
    m = rec.num_images
    photos = loaded(rec, [0.1] + [None] * (m - 1), [3.0] + [None] * (m - 1))
    bounded = bounded_by_exposure(BundleOptions(), rec, photos, dict.fromkeys(range(9), 0.02))
    limit = 3.0 / rec.cameras[0].K[0, 0] * 0.2
    assert bounded.phi_limits == {rec.image_names[0]: pytest.approx(limit)}
    assert bounded.phi_sigma_most is None


@pytest.mark.parametrize("model", ["rotation", "constant-motion"])
def test_a_limit_holds_one_photo_and_leaves_the_others(model, rng):
    limit, ratios = 1e-6, []
    for _ in range(5):
        rec = make_scene(rng, model, noise_px=0.3)
        free = bundle_adjust(rec, model)
        held = bundle_adjust(rec, model, BundleOptions(phi_limits={"1.jpg": limit}))
        # measurements pull with thousands of such deviations
        assert np.linalg.norm(held.reconstruction.phi[1]) < 0.1 * np.linalg.norm(free.reconstruction.phi[1])
        way = limit * held.reconstruction.median_depth(1)
        assert (held.sigma_velocity[1] * rec.frame_span()[1] <= 1.01 * way).all()
        ratios.append(held.phi_sigma / free.phi_sigma)
        same = bundle_adjust(rec, model, BundleOptions(phi_limits={"1.jpg": 10.0, "not there.jpg": 1.0}))
        # such a limit tells 1e-5 of what the prior does
        np.testing.assert_allclose(same.reconstruction.phi, free.reconstruction.phi, rtol=0, atol=1e-6)
    # what is held means nothing for how far hands move; but a photo that did move, by dozens of pixels, bends the scene
    assert np.median(ratios) == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_limits_that_are_none_are_refused(limit):
    with pytest.raises(InputError, match=r"limit of the motion of 'a\.jpg'"):
        BundleOptions(phi_limits={"a.jpg": limit})


def test_motions_against_the_exposure_are_looked_for(rng, monkeypatch):
    rec = make_scene(rng, "rotation", noise_px=0.3)
    stated = []

    def judged(*args):
        stated.append(args[5].phi_limits)
        return judge(*args)

    monkeypatch.setattr(model_sequence, "judge", judged)
    options = BundleOptions(phi_limits={"1.jpg": 1e-5})
    solved = model_sequence.solve_tracks(rec, cameras_of(rec), "rotation", 0, lambda _: options, StageLog(None), "none")
    assert stated == [{"1.jpg": 1e-5}]
    assert solved.verdict is not None
