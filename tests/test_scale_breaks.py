"""Parts of a scene that come out at another scale than the rest."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, bundle_adjust
from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.sfm import Features, MatchedPhotos, firmly_connected, photos_beside_breaks, retriangulate
from rsundistort.sfm.database import write_photos
from rsundistort.solve.registering import Registrar
from rsundistort.solve.tracks import TrackSource, rough_options
from rsundistort.verdict.judge import loose_reasons

CAMERA = Camera(1200, 900, [[1000, 0, 600], [0, 1000, 450], [0, 0, 1]])
COUNT = 12


@pytest.fixture
def walk(rng):
    """Photos along a street, to its right: neighbours show the same, and the first nothing of the last."""
    points_w = rng.uniform([-6, -2, 5], [18, 2, 9], (2400, 3))
    centers = np.column_stack([np.arange(COUNT) * 1.0, rng.normal(0, 0.2, (COUNT, 2))])
    phi = rng.normal(0, 0.01, (COUNT, 3)) / CAMERA.frame_span
    frame, point, xy = [], [], []
    for i in range(COUNT):
        uv, valid = project_points(points_w - centers[i], CAMERA, RowMotion(phi[i]))
        seen = np.flatnonzero(valid & (np.abs(uv - [600, 450]) < [600, 450]).all(1))
        frame.append(np.full(len(seen), i))
        point.append(seen)
        xy.append(uv[seen] + rng.normal(0, 0.3, (len(seen), 2)))
    observations = Observations(np.concatenate(frame), np.concatenate(point), np.concatenate(xy))
    R_cw = np.broadcast_to(np.eye(3), (COUNT, 3, 3))
    names = [f"{k:02}.jpg" for k in range(COUNT)]
    return Reconstruction(
        [CAMERA], names, np.zeros(COUNT, int), R_cw, centers, points_w, observations, phi, shutter_model="rotation"
    )


@pytest.fixture
def matched(walk, rng, tmp_path):
    """Its keypoints; a tenth of all matches is wrong."""
    rows = walk.observations.by_photo(COUNT)
    features = [
        Features(walk.observations.xy_raw[each], np.ones(len(each)), np.zeros((len(each), 128), np.uint8))
        for each in rows
    ]
    matched = MatchedPhotos(
        tmp_path / "database.db", walk.image_names, features, [CAMERA], np.zeros(COUNT, int), True, 0
    )
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(matched.database) as db:
        write_photos(db, matched)
        for i in range(COUNT):
            for j in range(i + 1, COUNT):
                points = [walk.observations.point_idx[rows[k]] for k in (i, j)]
                both = np.intersect1d(*points)
                if len(both) < 30:
                    continue
                first, second = (np.searchsorted(each, both) for each in points)
                wrong = np.flatnonzero(rng.uniform(size=len(both)) < 0.1)
                second[wrong] = rng.permutation(second[wrong])
                pairs = np.column_stack([first, second]).astype(np.uint32)
                db.write_matches(i + 1, j + 1, pairs)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = np.delete(pairs, wrong, axis=0)
                db.write_two_view_geometry(i + 1, j + 1, geometry)
    return matched


def broken(walk, first, scale):
    """From this photo on everything is so many times as large."""
    center_w = np.array(walk.center_w)
    center_w[first:] = center_w[first - 1] + scale * (center_w[first:] - center_w[first - 1])
    return replace(walk, center_w=center_w)


def test_right_photos_are_beside_no_break(walk, matched):
    assert not photos_beside_breaks(matched, walk).any()
    assert not photos_beside_breaks(matched, retriangulate(matched, walk)).any()


@pytest.mark.parametrize("scale", [0.3, 0.6, 2.0])
@pytest.mark.parametrize("first", [4, 8])
def test_a_part_of_another_scale_is_found(walk, matched, first, scale):
    tracks = firmly_connected(retriangulate(matched, broken(walk, first, scale)))
    # matches of two photos fit on either side, and residuals show nothing: all have enough of them
    assert tracks.num_images == COUNT
    found = photos_beside_breaks(matched, tracks)
    smaller = np.arange(COUNT) < first if first < COUNT / 2 else np.arange(COUNT) >= first
    # photos at the break itself belong to both
    assert found[smaller].sum() >= smaller.sum() - 2
    assert found[~smaller].sum() <= 1


def test_it_is_mended(walk, matched):
    registrar = Registrar(TrackSource(matched), rough_options(BundleOptions()), StageLog(None))
    tracks = retriangulate(matched, broken(walk, 8, 0.3))
    start = bundle_adjust(tracks, "rotation", rough_options(BundleOptions()))
    assert registrar.suspects(start.reconstruction)
    rec = registrar.all_registered(start, again=False).reconstruction
    assert rec.num_images == COUNT
    assert not registrar.suspects(rec)
    steps = np.linalg.norm(np.diff(rec.center_w, axis=0), axis=1)
    true = np.linalg.norm(np.diff(walk.center_w, axis=0), axis=1)
    np.testing.assert_allclose(steps / steps.mean(), true / true.mean(), atol=0.03)


def test_parts_that_have_no_point_in_common_are_not_known_to_be_beside_a_break(walk, matched):
    point = walk.observations.point_idx
    # photos to 5 show other points than those from 5 on
    left = (walk.observations.frame_idx <= 5) == (point % 2 == 0)
    left |= walk.observations.frame_idx == 5
    tracks = walk.with_points(left, min_track=3)
    assert not photos_beside_breaks(matched, tracks).all()


def test_parts_that_share_one_photo_have_no_common_scale(walk):
    frame, point = walk.observations.frame_idx, walk.observations.point_idx
    kept = np.where(point % 2 == 0, frame <= 5, frame >= 5)
    covariances = SimpleNamespace(
        reconstruction=walk.with_points(kept, min_track=3), covariances=np.zeros((COUNT, 12, 12))
    )
    (reason,) = loose_reasons(covariances)
    assert "scaled against each other, since 5 of 12 photos" in reason or "since 6 of 12" in reason
    assert loose_reasons(covariances, scaled=True) == []
    assert loose_reasons(SimpleNamespace(reconstruction=walk, covariances=covariances.covariances)) == []


def test_photos_that_all_contradict_each_other_come_to_an_end(walk, matched, rng):
    tracks = retriangulate(matched, walk)
    # what a photo shows is not what it matches
    point_idx = rng.permutation(tracks.observations.point_idx)
    mixed = replace(tracks, observations=replace(tracks.observations, point_idx=point_idx))
    assert photos_beside_breaks(matched, mixed).sum() < COUNT
