"""Which photos of a large set are matched: by order of capture, by GPS, by looks."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from large_sets import COMMON, make_street

from rsundistort import Camera, RunOptions
from rsundistort.errors import InputError
from rsundistort.input.load import LoadedPhotos
from rsundistort.input.pairing import capture_sequences, pairs_of_clip, pairs_to_match, places_of
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.io import ExifFacts, GpsFix
from rsundistort.sfm import Features, choose_pairs, global_descriptors, match_photos


@pytest.fixture(scope="module")
def street():
    return make_street(80, 200)


@pytest.fixture(scope="module")
def looks(street):
    return global_descriptors([each.descriptors for each in street.features])


def as_set(pairs):
    return {tuple(pair) for pair in np.asarray(pairs).tolist()}


# ---------------------------------------------------------------- the choice


def test_nothing_known_pairs_nothing():
    assert choose_pairs(5).shape == (0, 2)
    assert choose_pairs(3, [[]], np.full((3, 2), np.nan), np.zeros((3, 8), np.int16)).shape == (0, 2)


def test_pairs_are_in_order_and_each_is_there_once(street, looks):
    pairs = choose_pairs(80, [np.arange(80)[::-1]], street.gps, looks)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(as_set(pairs)) == len(pairs)
    assert pairs.tolist() == sorted(pairs.tolist())


def test_a_sequence_pairs_those_that_follow_each_other():
    order = np.array([3, 0, 9, 1, 7, 5, 2, 8, 4, 6])
    pairs = as_set(choose_pairs(10, [order]))
    rank = np.argsort(order)
    assert pairs == {(i, j) for i in range(10) for j in range(i + 1, 10) if abs(rank[i] - rank[j]) <= 6}


def test_sequences_do_not_touch_each_other():
    pairs = choose_pairs(9, [[0, 2, 4, 6, 8], [1, 3, 5], [7]])
    assert (pairs.sum(1) % 2 == 0).all()
    assert len(pairs) == math.comb(5, 2) + math.comb(3, 2)


def test_places_pair_the_nearest_ones_by_plain_distances(rng):
    places = rng.uniform(0, 100, (40, 2))
    places[[4, 17]] = np.nan
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    np.fill_diagonal(distance, np.nan)
    nearest = {tuple(sorted((i, int(j)))) for i in range(40) if i not in (4, 17) for j in np.argsort(distance[i])[:6]}
    assert as_set(choose_pairs(40, positions=places)) == nearest


def test_many_photos_at_one_place_are_not_all_paired():
    pairs = choose_pairs(100, positions=np.zeros((100, 2)))
    assert 0 < len(pairs) <= 700


def test_looks_pair_the_most_alike_beyond_the_chosen_ones(rng):
    descriptors = rng.integers(-50, 50, (30, 64)).astype(np.int16)
    descriptors[11] = 0  # a photo without features
    alike = descriptors.astype(int) @ descriptors.T.astype(int)
    order = np.array([k for k in range(30) if k != 11])
    taken = choose_pairs(30, [order])
    alike[taken[:, 0], taken[:, 1]] = alike[taken[:, 1], taken[:, 0]] = -(10**9)
    np.fill_diagonal(alike, -(10**9))
    alike[:, 11] = -(10**9)
    best = {tuple(sorted((int(i), int(j)))) for i in order for j in np.argsort(-alike[i], kind="stable")[:10]}
    assert as_set(choose_pairs(30, [order], None, descriptors)) == as_set(taken) | best


def test_a_street_walked_twice_closes_its_loops(street, looks):
    """No place is known: what connects the two walks was found by appearance."""
    share = np.triu(street.common() >= COMMON // 3, 1)  # a third of the benchmark's features
    pairs = choose_pairs(80, [np.arange(80)], None, looks)
    found = np.zeros_like(share)
    found[tuple(pairs.T)] = True
    assert (found & share).sum() >= 0.95 * share.sum()
    across = share & (np.subtract.outer(np.arange(80), np.arange(80)) < -20)
    assert across.sum() > 200
    assert (found & across).sum() >= 0.9 * across.sum()
    partners = np.bincount(pairs.ravel(), minlength=80)
    assert partners.mean() <= 2 * (6 + 10)
    assert partners.max() <= 60


# ---------------------------------------------------------------- what photos look like


def test_alike_are_those_with_common_points(street, looks):
    alike = looks.astype(float) @ looks.T.astype(float)
    np.fill_diagonal(alike, 0)
    most = alike.argmax(1)
    assert (street.common()[np.arange(80), most] >= COMMON // 3).mean() >= 0.95


def test_descriptors_are_of_one_length_and_zero_without_features():
    rng = np.random.default_rng(1)
    sets = [rng.integers(0, 90, (n, 128), dtype=np.uint8) for n in (0, 1, 3, 400)]
    vlad = global_descriptors(sets).astype(float)
    assert not vlad[0].any()
    np.testing.assert_allclose(np.linalg.norm(vlad[2:], axis=1), 4000, rtol=0.02)
    assert not global_descriptors([np.zeros((0, 128), np.uint8)] * 3).any()


def test_products_are_exact_in_single_precision(looks):
    """What makes them the same on any number of threads: every sum stays a whole number below 2^24."""
    exact = looks.astype(np.int64) @ looks.T.astype(np.int64)
    assert np.abs(exact).max() < 2**24
    np.testing.assert_array_equal(looks.astype(np.float32) @ looks.T.astype(np.float32), exact)


@pytest.mark.slow
def test_the_choice_does_not_depend_on_threads():
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from large_sets import make_street\n"
        "import hashlib; from rsundistort.sfm import choose_pairs, global_descriptors\n"
        "looks = global_descriptors([each.descriptors for each in make_street(16, 100).features])\n"
        "print(hashlib.sha256(looks.tobytes() + choose_pairs(16, [], None, looks).tobytes()).hexdigest())"
    )
    benchmarks = str(Path(__file__).parent.parent / "benchmarks")
    said = [
        subprocess.run(
            [sys.executable, "-c", code, benchmarks], check=True, capture_output=True, text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
        ).stdout
        for threads in ("1", "4")
    ]  # fmt: skip
    assert said[0] == said[1]


# ---------------------------------------------------------------- of the photos of a run


def test_order_of_capture_by_clock_then_by_numbers_in_names():
    names = ["a10.jpg", "a9.jpg", "b1.jpg", "c.jpg"]
    facts = [ExifFacts(taken_s=t) for t in (5.0, 5.0, 4.5, 9.0)]
    one = np.zeros(4, int)
    assert [k.tolist() for k in capture_sequences(names, one, facts)] == [[2, 1, 0, 3]]
    # one photo without a time: names alone
    assert [k.tolist() for k in capture_sequences(names, one, [*facts[:3], ExifFacts()])] == [[1, 0, 2, 3]]
    # a sequence for each camera
    assert [k.tolist() for k in capture_sequences(names, np.array([0, 1, 0, 1]), facts)] == [[2, 0], [1, 3]]


def test_places_are_metres_apart():
    facts = [ExifFacts(fix=GpsFix(55.7, 13.19)), ExifFacts(), ExifFacts(fix=GpsFix(55.7 + 1 / 60, 13.19))]
    places = places_of(facts)
    assert np.isnan(places[1]).all()
    # a minute of latitude is a nautical mile
    assert np.linalg.norm(places[2] - places[0]) == pytest.approx(1852, rel=2e-3)


def photos_of(num):
    rng = np.random.default_rng(0)
    found = [Features(np.zeros((20, 2)), np.ones(20), rng.integers(0, 90, (20, 128), dtype=np.uint8))] * num
    cameras = PhotoCameras([], [], np.zeros(num, int), True, (), "")
    return LoadedPhotos(
        [f"{k}.jpg" for k in range(num)], found, [ExifFacts()] * num, {}, cameras, {}, Path(), {}, 100.0
    )


def test_small_sets_are_matched_exhaustively_unless_specified():
    assert pairs_to_match(photos_of(60), "auto", 0) is None
    assert pairs_to_match(photos_of(200), "exhaustive", 0) is None
    assert len(pairs_to_match(photos_of(20), "neighbours", 0)) < math.comb(20, 2)
    pairs = pairs_to_match(photos_of(70), "auto", 0)
    assert {(1, 2), (9, 10), (69 - 6, 69)} <= as_set(pairs)
    assert len(pairs) <= 70 * (6 + 10)


def test_key_frames_are_matched_with_those_in_steps_of_powers_of_two_and_with_what_they_show_again(street):
    found = as_set(pairs_of_clip(photos_of(20), "auto", 0))
    assert found == {(i, j) for i in range(20) for j in range(i + 1, 20) if j - i in (1, 2, 4, 8, 16)}
    assert pairs_of_clip(photos_of(20), "exhaustive", 0) is None
    again = pairs_of_clip(replace(photos_of(80), features=street.features), "auto", 0)
    assert as_set(again) > {(i, i + step) for step in (1, 2, 4, 8, 16, 32, 64) for i in range(80 - step)}
    returns = again[~np.isin(again[:, 1] - again[:, 0], 2 ** np.arange(7))]
    assert len(returns) <= 3 * 80
    common = street.common()
    assert np.mean(common[tuple(returns.T)] > 0) > 0.9


def test_options_refuse_unknown_matchings():
    with pytest.raises(InputError, match="matching='some'"):
        RunOptions(matching="some")


def test_only_the_given_pairs_are_matched(tmp_path):
    """Names with spaces or a hash do not disturb the list of pairs."""
    import pycolmap

    street = make_street(6, 200)
    camera = Camera(1000, 750, [[500, 0, 500], [0, 500, 375], [0, 0, 1]])
    names = ["# a.jpg", "b c.jpg", "b.jpg", "ö ö.jpg", "e", "f g h.jpg"]
    pairs = np.array([[0, 1], [1, 2], [3, 5]])
    matched = match_photos(tmp_path / "a.db", names, street.features, [camera], np.zeros(6, int), pairs=pairs)
    with pycolmap.Database.open(matched.database) as db:
        ids = db.read_two_view_geometry_num_inliers()[0]
        done = {tuple(k - 1 for k in pycolmap.pair_id_to_image_pair(each)) for each in ids}
    assert done == as_set(pairs)
