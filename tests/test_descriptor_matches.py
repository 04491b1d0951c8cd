"""Matches of descriptors: those of pycolmap's brute-force matcher, the same whatever the number of threads."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from sift_like import sift_like

from rsundistort import Camera
from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.sfm import Features, MatchedPhotos
from rsundistort.sfm.codebook import make_codebook
from rsundistort.sfm.database import write_photos
from rsundistort.sfm.descriptor_matches import DescriptorIndex, match_descriptors

CAMERA = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])


def brute_force(descriptors, path):
    """What pycolmap finds when it compares all with all."""
    pycolmap = quiet_pycolmap()
    features = [Features(np.zeros((len(each), 2)), np.ones(len(each)), each) for each in descriptors]
    photos = MatchedPhotos(path, ("a", "b"), features, (CAMERA,), np.zeros(2, int), calibrated=True, seed=0)
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, options.skip_geometric_verification, options.sift.cpu_brute_force_matcher = False, True, True
    verification.min_num_inliers = 1
    with pycolmap.Database.open(path) as db:
        write_photos(db, photos)
        for index, each in enumerate(descriptors):
            sift = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(index + 1, pycolmap.FeatureDescriptors(type=sift, data=each))
    pycolmap.match_exhaustive(path, options, verification_options=verification, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(path) as db:
        return {*map(tuple, np.asarray(db.read_matches(1, 2)).tolist())}


@pytest.fixture
def photos(rng):
    """Descriptors of two photos: some of the same things, more or less alike, some that come twice, and clutter."""
    things = rng.normal(0, 1, (300, 128)) ** 2
    noise = rng.uniform(0.0, 4.0, (300, 1)) * rng.normal(0, 1, (300, 128))
    clutter = [rng.normal(0, 1, (count, 128)) ** 2 for count in (200, 100)]
    again = [np.maximum(things + noise, 0.0), things[:40] + 0.5 * rng.random((40, 128)), clutter[1]]
    first, second = np.concatenate([things, clutter[0]]), np.concatenate(again)
    return sift_like(first), sift_like(second)[rng.permutation(len(second))]


def matches(first, second, words=None):
    return match_descriptors(DescriptorIndex.of(first, words), DescriptorIndex.of(second, words))


def test_they_are_those_of_the_brute_force_matcher(photos, tmp_path):
    expected = brute_force(photos, tmp_path / "database.db")
    assert 50 < len(expected) < 250
    assert {*map(tuple, matches(*photos).tolist())} == expected


def test_words_find_the_same(photos):
    # 0.1 % are missed in real photos (benchmarks/matching.py), none here
    words = make_codebook(photos, 0)
    np.testing.assert_array_equal(matches(*photos, words), matches(*photos))


def test_they_are_the_same_whatever_the_number_of_threads(photos):
    before, found, words = numba.get_num_threads(), [], make_codebook(photos, 0)
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            found.append(matches(*photos, words))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(*found)


def test_what_looks_alike_twice_is_not_matched(rng):
    first = sift_like(rng.normal(0, 1, (20, 128)) ** 2)
    first[19] = first[18]
    found = matches(first, first[::-1].copy())
    np.testing.assert_array_equal(found, np.column_stack([np.arange(18), 19 - np.arange(18)]))


def test_of_none_or_one_descriptor(rng):
    one = sift_like(rng.normal(0, 1, (1, 128)) ** 2)
    for words in (None, make_codebook([one, one[:0]], 0), make_codebook([one[:0]], 0)):
        assert matches(one, one[:0], words).shape == matches(one[:0], one, words).shape == (0, 2)
        assert matches(one, one, words).tolist() == [[0, 0]]
