"""Motions of photos that match nothing as they were taken."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from plane_photos import CAMERA, SIZE, texture, views, write

from rsundistort import Camera, Observations, Reconstruction, RowMotion, undistort_points
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import FileError
from rsundistort.input import motion_search
from rsundistort.input.load import load_photos
from rsundistort.input.motion_search import search_motions, tried_motions
from rsundistort.sfm import MatchedPhotos
from rsundistort.sfm.descriptor_matches import DescriptorIndex, match_descriptors
from rsundistort.solve import track_sources
from rsundistort.solve.track_sources import TrackSources
from rsundistort.synthetic import warp_photo

SHIFT_PX, F_PX = 40, 800.0
PINHOLE = Camera(*SIZE, [[F_PX, 0, SIZE[0] / 2], [0, F_PX, SIZE[1] / 2], [0, 0, 1]])
# rows that run over three tenths of what a still camera shows, and are sheared by as much
PHI = np.array([-0.7, 0.3, 0.1])


@pytest.mark.parametrize("readout", ["top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left"])
def test_rows_are_stretched_and_sheared(readout):
    camera = replace(PINHOLE, readout=readout)
    along = camera.clock_axis
    center = camera.K[:2, 2]
    xy = np.array([center, center + np.eye(2)[along]])
    seen = []
    for phi in tried_motions(camera):
        for each in phi:
            ideal = undistort_points(xy, camera, RowMotion(each), P=camera.K)
            seen.append((ideal[1] - ideal[0])[[along, 1 - along]])
    stretch, shear = np.array(seen).T
    assert np.allclose(np.exp(np.round(2 * np.log(stretch)) / 2), stretch, rtol=2e-3)
    for each in np.unique(np.round(2 * np.log(stretch))):
        mine = np.sort(shear[np.round(2 * np.log(stretch)) == each])
        np.testing.assert_allclose(mine, -mine[::-1], atol=2e-3)
        np.testing.assert_allclose(np.diff(mine), 0.5 * np.exp(each / 2), rtol=0.02)
        assert 0.5 < mine.max() < 1.001
    assert (np.abs(stretch - 1.0) + np.abs(shear) < 2e-3).sum() == 1


def test_likely_motions_are_tried():
    for fastest, expected in ((0.0, 1), (0.2, 1), (0.3, 7), (10.0, 72)):
        tried = np.concatenate(tried_motions(PINHOLE, fastest))
        assert len(tried) == expected
        assert not tried.any(1).all()  # none is among them
        # half of a step may be missing: of the stretch by 1.65 from 1.28 on
        assert np.linalg.norm(tried, axis=1).max() < fastest + 0.4


@pytest.fixture
def plane(tmp_path):
    """Two photos of a plane at the distance 1 in a scene, and a third one that a strong shutter read."""
    still = views(texture(0, 3.0), shift=SHIFT_PX)
    folder = write(tmp_path / "in", [*still[:2], warp_photo(still[2], PINHOLE, RowMotion(PHI))[0]])
    photos = load_photos(folder, CAMERA, "top-to-bottom", 4000, Workers(2), StageLog(None))
    features = photos.features
    found = match_descriptors(*(DescriptorIndex.of(each.descriptors) for each in features[:2]))
    xy = [each.xy_raw[mine] for each, mine in zip(features[:2], found.T, strict=True)]
    points_w = np.column_stack([(xy[0] - PINHOLE.K[:2, 2]) / F_PX, np.ones(len(found))])
    center_w = np.array([[0, 0, 0], [SHIFT_PX / F_PX, SHIFT_PX / F_PX, 0]])
    observations = Observations(
        np.repeat([0, 1], len(found)), np.tile(np.arange(len(found)), 2), np.concatenate(xy)
    )  # fmt: skip
    scene = Reconstruction(
        [PINHOLE], photos.names[:2], np.zeros(2, int), np.tile(np.eye(3), (2, 1, 1)), center_w, points_w, observations,
        shutter_model="rotation",
    )  # fmt: skip
    matched = MatchedPhotos(tmp_path / "none.db", photos.names, features, [PINHOLE], np.zeros(3, int), True, 0)
    return photos, matched, scene


def test_a_motion_is_found_by_what_a_photo_shows_without_it(plane):
    said = []
    found = search_motions(*plane, 1.0, Workers(2), StageLog(lambda *each: said.append(each)))
    assert list(found) == ["2.png"]
    np.testing.assert_allclose(found["2.png"], PHI, atol=0.02)
    assert said[0] == ("search for motions", 0, 6)
    assert said[-1] == ("search for motions", 6, 6)


@pytest.fixture
def few_trials(monkeypatch):
    """Only what leads to the motion is tried."""
    tried = [np.zeros((0, 3)), np.zeros((0, 3)), PHI[None] + 0.05, *[np.zeros((0, 3))] * 3]
    monkeypatch.setattr(motion_search, "tried_motions", lambda *_: tried)


@pytest.mark.usefixtures("few_trials")
def test_the_number_of_threads_changes_nothing(plane):
    one, two = (search_motions(*plane, 1.0, Workers(jobs), StageLog(None)) for jobs in (1, 2))
    np.testing.assert_array_equal(one["2.png"], two["2.png"])
    np.testing.assert_allclose(one["2.png"], PHI, atol=0.02)


def test_nothing_is_searched_where_no_likely_motion_hides_a_photo(plane):
    said = []
    search = partial(search_motions, *plane, 1.0, Workers(1), StageLog(lambda *each: said.append(each)))
    span = PINHOLE.frame_span
    assert search(phi_sigma=0.05 * span) == search(passed_over=["2.png"]) == {}
    assert not said
    np.testing.assert_allclose(search(phi_sigma=0.3 * span)["2.png"], PHI, atol=0.02)


def test_a_search_in_vain_is_not_repeated_in_no_larger_a_scene(plane, monkeypatch):
    photos, matched, scene = plane

    def search(*_, phi_sigma, passed_over):
        assert phi_sigma == 0.1
        searched.append(set(photos.names).difference(known.image_names, passed_over))
        return {}

    searched = []
    monkeypatch.setattr(track_sources, "search_motions", search)
    other = SimpleNamespace(megapixels=1.0, workers=Workers(1))
    sources = TrackSources(photos, None, 0, StageLog(None), "all", None, None, other)
    alone = scene.take_photos(np.arange(2) < 1)
    for known in (alone, alone, scene, alone):
        assert sources._with_found_motions(matched, known, 0.1) is None
    assert searched == [{"1.png", "2.png"}, set(), {"2.png"}, set()]
    assert sources._unfound == {"1.png": 1, "2.png": 2}


def test_photos_of_a_fisheye_are_passed_over(plane):
    photos, matched, scene = plane
    fisheye = replace(scene, cameras=[Camera(*SIZE, PINHOLE.K, np.zeros(4), lens="fisheye")])
    assert search_motions(photos, matched, fisheye, 1.0, Workers(1), StageLog(None)) == {}


@pytest.mark.usefixtures("few_trials")
@pytest.mark.parametrize("first", ["2.png", "3.png"])
def test_the_search_ends_where_photos_show_another_scene(plane, monkeypatch, first):
    photos, matched, scene = plane
    monkeypatch.setattr(motion_search, "_PHOTOS_AT_ONCE", 1)
    cv2.imwrite(str(photos.folder / "3.png"), texture(9, 3.0)[: SIZE[1], : SIZE[0]])
    names = [*photos.names[:2], first, "2.png" if first == "3.png" else "3.png"]
    more = replace(photos, names=names)
    idx, features = np.zeros(4, int), [*matched.features, matched.features[2]]
    asked = replace(matched, names=names, camera_idx=idx, features=features)
    said = []
    found = search_motions(more, asked, scene, 1.0, Workers(1), StageLog(lambda *each: said.append(each)))
    assert list(found) == (["2.png"] if first == "2.png" else [])
    assert said[-1][1:] == ((12, 12) if first == "2.png" else (6, 12))


@pytest.mark.usefixtures("few_trials")
def test_a_photo_that_went_away_is_named(plane):
    photos, matched, scene = plane
    (photos.folder / "2.png").unlink()
    with pytest.raises(FileError, match=r"2\.png"):
        search_motions(photos, matched, scene, 1.0, Workers(1), StageLog(None))
