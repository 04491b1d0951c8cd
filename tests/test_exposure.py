"""What the exposure time says of the motion."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from test_bundle import make_scene

from rsundistort.bundle import BundleOptions, bundle_adjust
from rsundistort.io.photos.exif_facts import ExifFacts, _facts
from rsundistort.pipeline.cameras import PhotoCameras
from rsundistort.pipeline.exposure import bounded_by_exposure
from rsundistort.pipeline.load import LoadedPhotos
from rsundistort.sfm import edge_width_px


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


def loaded(rec, exposure_s, edge_px):
    facts = [ExifFacts(exposure_s=exposure_s) for _ in rec.image_names]
    cameras = PhotoCameras(rec.cameras, ["camera"], rec.camera_idx, True, (True,), "")
    edges = [edge_px] * rec.num_images
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
