"""Parts of a scene that come out at another scale than the rest."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matched_scene import matched_scene

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, bundle_adjust
from rsundistort.sfm import firmly_connected, photos_beside_breaks, retriangulate
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
    return matched_scene(walk, rng, tmp_path / "database.db", share_wrong=0.1)


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
    rec = registrar.all_registered(start, again=False)[0].reconstruction
    assert rec.num_images == COUNT
    assert not registrar.suspects(rec)
    steps = np.linalg.norm(np.diff(rec.center_w, axis=0), axis=1)
    true = np.linalg.norm(np.diff(walk.center_w, axis=0), axis=1)
    np.testing.assert_allclose(steps / steps.mean(), true / true.mean(), atol=0.03)


def in_two_parts(walk):
    """Photos to 5 show other points than those from 5 on."""
    frame, point = walk.observations.frame_idx, walk.observations.point_idx
    return walk.with_points(np.where(point % 2 == 0, frame <= 5, frame >= 5), min_track=3)


def test_parts_that_have_no_point_in_common_are_not_beside_a_break(walk, rng, tmp_path):
    parts = in_two_parts(walk)
    matched = matched_scene(parts, rng, tmp_path / "database.db", share_wrong=0.1)
    assert not photos_beside_breaks(matched, parts).any()


def test_parts_that_share_one_photo_have_no_common_scale(walk):
    covariances = np.zeros((COUNT, 12, 12))
    parts = SimpleNamespace(reconstruction=in_two_parts(walk), covariances=covariances)
    (reason,) = loose_reasons(parts)
    assert "scaled against each other, since 5 of 12 photos" in reason
    assert loose_reasons(parts, scaled=True) == []
    assert loose_reasons(SimpleNamespace(reconstruction=walk, covariances=covariances)) == []


def test_photos_that_all_contradict_each_other_come_to_an_end(walk, matched, rng):
    tracks = retriangulate(matched, walk)
    # what a photo shows is not what it matches
    point_idx = rng.permutation(tracks.observations.point_idx)
    mixed = replace(tracks, observations=replace(tracks.observations, point_idx=point_idx))
    assert photos_beside_breaks(matched, mixed).sum() < COUNT
