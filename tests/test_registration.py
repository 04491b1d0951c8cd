"""Photos placed in a known scene with strong shutters, against the motions that made them."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from matched_scene import matched_scene
from scipy.spatial.transform import Rotation

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, bundle_adjust
from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.model.similarity import Similarity
from rsundistort.sfm import map_photos, map_without_motions, read_num_verified, register_photos, verification
from rsundistort.sfm.contradiction import contradicting_photos, parts_that_agree, share_that_fits
from rsundistort.sfm.epipolar import agreeing_photos, read_matches
from rsundistort.sfm.motion_averaging import averaged_motions
from rsundistort.sfm.registration import place_photo
from rsundistort.sfm.relative_pose import Pair
from rsundistort.sfm.sides import carried_along
from rsundistort.sfm.verification import pair_of
from rsundistort.solve import registering
from rsundistort.solve.registering import Registrar
from rsundistort.solve.solutions import agree, consistent, num_explained, num_of_one_scale, photos_apart
from rsundistort.solve.tracks import TrackSource, rough_options

CAMERA = Camera(1200, 900, [[1000, 0, 600], [0, 1000, 450], [0, 0, 1]])
NAMES = [f"{k}.jpg" for k in range(6)]


def look_at(center, target):
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.1, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def rotated_deg(R_a, R_b):
    return np.degrees(Rotation.from_matrix(R_a @ R_b.T).magnitude())


@pytest.fixture
def rad():
    """Of the motions, a frame."""
    return 0.25


@pytest.fixture
def scene(rng, rad):
    """Points, poses and motions, and what the photos show of them with noise."""
    points_w = rng.uniform([-3, -2, 5], [3, 2, 9], (500, 3))
    centers = np.column_stack([np.linspace(-2, 2, 6), rng.normal(0, 0.3, 6), rng.normal(0, 0.3, 6)])
    R_cw = np.array([look_at(center, np.array([0, 0, 7.0])) for center in centers])
    phi = rng.normal(0, rad, (6, 3)) / CAMERA.frame_span
    frame, point, xy = [], [], []
    for i in range(6):
        uv, valid = project_points((points_w - centers[i]) @ R_cw[i].T, CAMERA, RowMotion(phi[i]))
        seen = np.flatnonzero(valid & (np.abs(uv - [600, 450]) < [600, 450]).all(1))
        frame.append(np.full(len(seen), i))
        point.append(seen)
        xy.append(uv[seen] + rng.normal(0, 0.5, (len(seen), 2)))
    observations = Observations(np.concatenate(frame), np.concatenate(point), np.concatenate(xy))
    return Reconstruction(
        [CAMERA], NAMES, np.zeros(6, int), R_cw, centers, points_w, observations, phi, shutter_model="rotation"
    )


@pytest.fixture
def matched(scene, rng, tmp_path):
    """Its measurements as keypoints, all photos matched with each other, every fifth match wrong."""
    return matched_scene(scene, rng, tmp_path / "database.db", share_wrong=0.2)


def test_pairs_that_pycolmap_found_no_geometry_for_are_verified_with_a_shutter(matched, monkeypatch):
    def find_none(_):
        pycolmap = quiet_pycolmap()
        with pycolmap.Database.open(matched.database) as db:
            for first, second in read_matches(matched):
                db.delete_two_view_geometry(first + 1, second + 1)
                db.write_two_view_geometry(first + 1, second + 1, pycolmap.TwoViewGeometry())

    monkeypatch.setattr(verification, "verify_loosely", find_none)
    verification.verify_with_shutter(matched, is_strong=True)
    assert {*read_num_verified(matched)} == {*read_matches(matched)}


def one_photo(scene, photo):
    rows = scene.observations.by_photo(6)[photo]
    return scene.points_w[scene.observations.point_idx[rows]], np.array(scene.observations.xy_raw[rows])


def test_a_photo_is_placed_from_a_rough_motion(rng):
    # rows that run over a quarter of what a still camera shows; four of five measurements are wrong
    R_cw, phi = look_at(np.array([-2.0, 0, 0]), np.array([0, 0, 7.0])), np.array([-0.75, 0.3, 0.1])
    points_w = rng.uniform([-3, -2, 5], [3, 2, 9], (3000, 3))
    xy, valid = project_points((points_w - [-2, 0, 0]) @ R_cw.T, CAMERA, RowMotion(phi))
    inside = valid & (np.abs(xy - [600, 450]) < [600, 450]).all(1)
    points_w, xy = points_w[inside], xy[inside] + rng.normal(0, 0.5, (inside.sum(), 2))
    wrong = rng.uniform(size=len(xy)) < 0.8
    xy[wrong] = rng.uniform([0, 0], [1200, 900], (wrong.sum(), 2))
    blind, placed = place_photo(points_w, xy, CAMERA), place_photo(points_w, xy, CAMERA, phi=phi + 0.1)
    assert placed.fits[~wrong].all()
    assert blind.fits.sum() < 0.1 * placed.fits.sum()
    assert rotated_deg(placed.R_cw, R_cw) < 0.1
    np.testing.assert_allclose(placed.phi, phi, atol=0.01)


@pytest.mark.parametrize("share_wrong", [0.0, 0.4, 0.6])
def test_a_photo_is_placed_with_its_motion(scene, rng, share_wrong):
    for photo in range(3):
        points_w, xy = one_photo(scene, photo)
        wrong = rng.uniform(size=len(xy)) < share_wrong
        xy[wrong] = rng.uniform([0, 0], [1200, 900], (wrong.sum(), 2))
        placed = place_photo(points_w, xy, CAMERA)
        assert rotated_deg(placed.R_cw, scene.R_cw[photo]) < 0.05
        assert np.linalg.norm(placed.center_w - scene.center_w[photo]) < 0.01
        np.testing.assert_allclose(placed.phi, scene.phi[photo], atol=3e-3)
        assert placed.fits[~wrong].mean() > 0.99
        assert placed.fits[wrong].mean() < 0.05 if wrong.any() else True


def test_points_seen_by_chance_fit_no_place(scene, rng):
    points_w, xy = one_photo(scene, 0)
    placed = place_photo(points_w, rng.uniform([0, 0], [1200, 900], xy.shape), CAMERA)
    assert placed is None or placed.fits.mean() < 0.1


def test_too_few_points_place_nothing(scene):
    points_w, xy = one_photo(scene, 0)
    for count in (0, 3):
        assert place_photo(points_w[:count], xy[:count], CAMERA) is None


def test_left_out_photos_are_added_and_wrong_places_mended(scene, matched):
    spoilt = np.array(scene.R_cw)
    spoilt[4] = Rotation.from_rotvec([0.1, -0.2, 0.1]).as_matrix() @ spoilt[4]
    wrong = replace(scene, R_cw=spoilt, phi=scene.phi * (np.arange(6) != 4)[:, None])
    wrong = wrong.take_photos(np.arange(6) != 5)
    found = register_photos(matched, read_num_verified(matched), wrong)
    assert (found.added, found.moved, found.dropped) == (("5.jpg",), ("4.jpg",), ())
    assert found.reconstruction.image_names == tuple(NAMES)
    for photo in (4, 5):
        assert rotated_deg(found.reconstruction.R_cw[photo], scene.R_cw[photo]) < 0.05
        np.testing.assert_allclose(found.reconstruction.phi[photo], scene.phi[photo], atol=3e-3)
    np.testing.assert_array_equal(found.reconstruction.R_cw[:4], scene.R_cw[:4])
    only_new = register_photos(matched, read_num_verified(matched), wrong, strong=False)
    assert (only_new.added, only_new.moved, only_new.dropped) == (("5.jpg",), (), ())


def test_right_places_stay(scene, matched):
    found = register_photos(matched, read_num_verified(matched), scene)
    assert not found.changes
    assert found.reconstruction.image_names == scene.image_names


def with_a_side_turned(scene, first, scale=1.0):
    """The photos from one on agree with each other, about copies of the points, and with no other."""
    obs, turn = scene.observations, Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    turned = np.arange(6) >= first
    return replace(
        scene,
        R_cw=np.where(turned[:, None, None], scene.R_cw @ turn.T, scene.R_cw),
        center_w=np.where(turned[:, None], scale * scene.center_w @ turn.T, scene.center_w),
        points_w=np.concatenate([scene.points_w, scale * scene.points_w @ turn.T]),
        observations=replace(obs, point_idx=obs.point_idx + len(scene.points_w) * turned[obs.frame_idx]),
    )


def test_a_set_that_is_turned_as_a_whole_is_placed_by_the_points_of_the_rest(scene, matched):
    # what it shows of itself says nothing
    found = register_photos(matched, read_num_verified(matched), with_a_side_turned(scene, 3))
    assert len(found.moved) == 3
    between = found.reconstruction.R_cw[0] @ found.reconstruction.R_cw[5].T
    assert rotated_deg(between, scene.R_cw[0] @ scene.R_cw[5].T) < 0.05


def test_a_photo_that_fits_nowhere_loses_its_place(scene, matched, rng):
    # all that the last photo shows is false: its keypoints lie where chance has put them
    features = list(matched.features)
    features[5] = replace(features[5], xy_raw=rng.uniform([0, 0], [1200, 900], features[5].xy_raw.shape))
    mixed = replace(matched, features=features)
    found = register_photos(mixed, read_num_verified(matched), scene)
    assert found.dropped == ("5.jpg",)
    assert "5.jpg" not in found.reconstruction.image_names


def test_pairs_that_were_verified_without_matches_are_passed_over(scene, matched):
    matches = read_matches(matched)
    del matches[0, 1]
    assert agreeing_photos(matched, matches, read_num_verified(matched), scene).all()


def test_photos_that_the_poses_do_not_explain_are_distinguished(scene, matched):
    R_cw = np.array(scene.R_cw)
    R_cw[:2] = Rotation.from_rotvec([0.2, 0.3, 0.1]).as_matrix() @ R_cw[:2]
    agreeing = agreeing_photos(matched, read_matches(matched), read_num_verified(matched), replace(scene, R_cw=R_cw))
    np.testing.assert_array_equal(agreeing, np.arange(6) >= 2)


@pytest.mark.parametrize("suspects", [False, True])
def test_a_side_that_is_turned_as_a_whole_contradicts_the_rest(scene, matched, suspects):
    verified = read_num_verified(matched)
    assert not contradicting_photos(matched, verified, scene, suspects=suspects).any()
    turned = contradicting_photos(matched, verified, with_a_side_turned(scene, 4), suspects=suspects)
    np.testing.assert_array_equal(turned, np.arange(6) >= 4)
    few = dict.fromkeys(verified, 29)
    assert not contradicting_photos(matched, few, with_a_side_turned(scene, 4), suspects=suspects).any()


def test_parts_are_joined_by_what_is_between_them():
    # 3 is tied to 2, but more to what contradicts 1
    weight = {(0, 1): 5.0, (1, 2): 5.0, (2, 3): 1.0, (1, 3): -4.0, (3, 4): 3.0}
    part = parts_that_agree({pair: (30, each) for pair, each in weight.items()}, 6)
    assert part[0] == part[1] == part[2]
    assert part[3] == part[4]
    assert len(set(part.tolist())) == 3


def test_neighbours_decide_and_not_what_looks_alike():
    """Two sides of four photos, joined at a corner; most photos of one side look like those of the other."""
    sides = {(i, j): (500, 100.0) for side in (range(4), range(4, 8)) for i in side for j in side if i < j}
    alike = {(i, j): (60, -45.0) for i in range(4) for j in range(4, 8)}
    corner = {(3, 4): (300, 50.0), (2, 4): (200, 30.0)}
    assert len(set(parts_that_agree(sides | alike | corner, 8).tolist())) == 1
    turned = {pair: (count, -0.2 * count) for pair, (count, _) in corner.items()}
    assert len(set(parts_that_agree(sides | alike | turned, 8).tolist())) == 2


@pytest.mark.parametrize("rad", [0.02])
def test_a_side_in_a_wrong_place_is_registered_again_with_a_weak_shutter(scene, matched):
    wrong = with_a_side_turned(scene, 4)
    registrar = Registrar(TrackSource(matched, mapped_here=True), BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(wrong, "rotation", rough_options(BundleOptions()))
    assert registrar.suspects(start.reconstruction) == ["4.jpg", "5.jpg"]
    found = registrar.all_registered(start, again=True)[0].reconstruction
    assert registrar.suspects(found) == []
    assert found.image_names == tuple(NAMES)
    assert apart_deg(found, scene).max() < 0.1
    assert apart_deg(start.reconstruction, scene).max() > 10.0


@pytest.mark.parametrize("rad", [0.02])
def test_places_that_no_match_agrees_with_are_all_suspect(scene, matched):
    registrar = Registrar(TrackSource(matched, mapped_here=True), BundleOptions(), StageLog(lambda *_: None))
    away = replace(scene, R_cw=Rotation.random(scene.num_images, random_state=1).as_matrix())
    assert registrar.suspects(away) == NAMES


@pytest.mark.parametrize("rad", [0.02])
@pytest.mark.parametrize("matches_agree", [True, False])
def test_where_tracks_connect_no_photo_the_solution_stays(scene, matched, matches_agree, monkeypatch):
    registrar = Registrar(TrackSource(matched, mapped_here=True), BundleOptions(), StageLog(lambda *_: None))
    away = replace(scene, R_cw=Rotation.random(scene.num_images, random_state=1).as_matrix())
    if matches_agree:  # but no photo with two others
        monkeypatch.setattr(registering, "firmly_connected", lambda rec: rec.take_photos(np.zeros(6, bool)))
        away = scene
    start = bundle_adjust(scene, "rotation", rough_options(BundleOptions()))
    found, left_out = registrar._registered(replace(start, reconstruction=away))
    assert found.reconstruction.image_names == tuple(NAMES)
    assert not left_out


@pytest.mark.parametrize("rad", [0.02])
def test_a_second_mapping_need_not_agree_with_places_that_no_match_agrees_with(scene, matched, monkeypatch):
    registrar = Registrar(TrackSource(matched, mapped_here=True), BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(scene, "rotation", rough_options(BundleOptions()))
    away = replace(scene, R_cw=Rotation.random(scene.num_images, random_state=1).as_matrix())
    monkeypatch.setattr(registering, "map_without_motions", lambda *_: scene)
    away = away.take_photos(np.arange(6) < 5)
    found = registrar._mapped_again(replace(start, reconstruction=away), set())[0].reconstruction
    assert found.image_names == tuple(NAMES)
    assert apart_deg(found, scene).max() < 0.5


@pytest.mark.parametrize("rad", [0.02])
def test_what_a_rejected_mapping_confirms_says_nothing_of_the_solution(scene, matched, monkeypatch):
    registrar = Registrar(TrackSource(matched, mapped_here=True), BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(with_a_side_turned(scene, 4), "rotation", rough_options(BundleOptions()))

    def confirming(self, result):
        self._confirmed.add("4.jpg")
        return result, set()

    monkeypatch.setattr(Registrar, "_registered", confirming)
    monkeypatch.setattr(registering, "map_without_motions", lambda *_: scene)
    monkeypatch.setattr(registering, "photos_apart", lambda *_: NAMES)
    assert registrar._mapped_again(start, set())[0] is start
    assert registrar.suspects(start.reconstruction) == ["4.jpg", "5.jpg"]


@pytest.mark.parametrize("lost", [set(), {"5.jpg"}])
def test_a_place_is_confirmed_unless_the_photo_lost_it_before(scene, matched, monkeypatch, lost):
    monkeypatch.setattr(registering, "contradicting_photos", lambda *_, **__: np.arange(6) == 5)
    registrar = Registrar(TrackSource(matched), BundleOptions(), StageLog(None))
    assert registrar._confirms(scene, True, lost) == (not lost)
    assert registrar._confirmed == {"5.jpg"} - lost


def test_a_side_is_carried_along_by_a_photo_that_was_placed_again(scene):
    former, placed = with_a_side_turned(scene, 3, scale=1.7), scene.take_photos(np.arange(6) <= 3)
    found = carried_along(placed, former, NAMES[3:])
    assert found.image_names == tuple(NAMES)
    np.testing.assert_allclose(found.R_cw, scene.R_cw, atol=1e-9)
    np.testing.assert_allclose(found.center_w, scene.center_w, atol=1e-9)
    np.testing.assert_array_equal(found.phi, scene.phi)


def test_a_side_without_a_photo_in_the_scene_or_a_scale_stays_out(scene):
    former = with_a_side_turned(scene, 3)
    rest = scene.take_photos(np.arange(6) <= 2)
    assert carried_along(rest, former, NAMES[3:]) is rest
    assert carried_along(rest, former, ()) is rest
    # of the photo that is placed again, the scene shows four points
    placed = scene.take_photos(np.arange(6) <= 3)
    rows = placed.observations.by_photo(4)[3]
    few = np.setdiff1d(np.arange(len(placed.observations)), rows[4:])
    placed = replace(placed, observations=placed.observations.select(few))
    assert carried_along(placed, former, NAMES[3:]) is placed


@pytest.mark.parametrize("rad", [0.02])
def test_a_side_of_which_one_photo_alone_can_be_registered_follows_it(scene, matched, monkeypatch):
    def but_for_the_last(matched, num_verified, scene, **options):
        found = register_photos(matched, num_verified, scene, **options)
        new = np.isin(found.reconstruction.image_names, scene.image_names)
        new |= np.array(found.reconstruction.image_names) != "5.jpg"
        return replace(
            found,
            reconstruction=found.reconstruction.take_photos(new),
            added=tuple(name for name in found.added if name != "5.jpg"),
        )

    registrar = Registrar(TrackSource(matched, mapped_here=False), BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(with_a_side_turned(scene, 4), "rotation", rough_options(BundleOptions()))
    monkeypatch.setattr(registering, "register_photos", but_for_the_last)
    found = registrar.all_registered(start, again=False)[0].reconstruction
    assert sorted(found.image_names) == NAMES
    order = np.argsort(found.image_names)
    assert apart_deg(replace(found, image_names=NAMES, R_cw=found.R_cw[order]), scene).max() < 0.1


def pairs_of(matched):
    return {key: pair_of(matched, key, found) for key, found in read_matches(matched).items()}


def test_photos_without_a_pair_have_no_motion(matched):
    pairs = {key: pair for key, pair in pairs_of(matched).items() if 4 not in key}
    phi = averaged_motions(6, pairs, 0.25)
    assert (phi[4] == 0).all()
    assert (phi[[0, 1, 2, 3, 5]] != 0).all()
    assert (averaged_motions(6, {}, 0.25) == 0).all()


def test_a_false_pair_is_outvoted(matched, rng):
    pairs = pairs_of(matched)
    before = averaged_motions(6, pairs, 0.25)
    other = pairs[0, 3]
    view, order = other.second, rng.permutation(len(other.second.clock))
    shuffled = replace(view, rays=view.rays[order], slopes=view.slopes[order], clock=view.clock[order])
    pairs[0, 3] = Pair(other.first, shuffled)
    assert np.abs(averaged_motions(6, pairs, 0.25) - before).max() < 0.05


def apart_deg(mapped, scene):
    """Rotations against the true ones, by the rotation that most of them have in common."""
    of = [NAMES.index(name) for name in mapped.image_names]
    steps = Rotation.from_matrix(np.einsum("mji,mjk->mik", scene.R_cw[of], mapped.R_cw))
    return np.degrees((steps * steps.mean().inv()).magnitude())


def test_photos_are_mapped_right_without_their_motions(scene, matched):
    mapped, plain = map_without_motions(matched, 0.25), map_photos(matched)
    assert mapped.num_images >= 5
    assert apart_deg(mapped, scene).max() < 3.0
    assert apart_deg(plain, scene).max() > 10.0
    # the measurements are those of the photos as they are
    shown = {tuple(xy) for found in matched.features for xy in found.xy_raw.tolist()}
    assert {tuple(xy) for xy in mapped.observations.xy_raw.tolist()} <= shown
    assert mapped.shutter_model == "global"


def test_solutions_agree_in_any_frame_and_on_the_photos_of_both(scene):
    frame = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    assert agree(scene, replace(scene, R_cw=scene.R_cw @ frame))
    off = scene.R_cw.copy()
    off[2] = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix() @ off[2]
    assert not agree(scene, replace(scene, R_cw=off))
    assert photos_apart(scene, replace(scene, R_cw=off)) == [NAMES[2]]
    of_each = [num_explained(scene, without={*NAMES} - {name}) for name in NAMES]
    assert sum(of_each) == num_explained(scene)
    assert all(of_each)
    assert not agree(scene, replace(scene, image_names=[f"other-{name}" for name in NAMES]))
    names = [*NAMES[:2], "other.jpg", *NAMES[3:]]
    assert agree(scene, replace(scene, R_cw=off, image_names=names))


def test_solutions_are_consistent_in_any_frame_and_scale_but_not_with_a_side_of_another_scale(scene):
    frame = Similarity(3.0, Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([5.0, -2.0, 1.0]))
    assert consistent(scene, frame.of_reconstruction(scene))
    assert consistent(scene.take_photos(np.arange(6) < 5), frame.of_reconstruction(scene))
    # the photos of the side look where they should
    center_w = scene.center_w.copy()
    center_w[4:] = center_w[3] + 3.0 * (center_w[4:] - center_w[3])
    assert agree(scene, replace(scene, center_w=center_w))
    assert not consistent(scene, frame.of_reconstruction(replace(scene, center_w=center_w)))
    off = scene.R_cw.copy()
    off[2] = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix() @ off[2]
    assert not consistent(scene, replace(scene, R_cw=off))
    assert not consistent(scene, replace(scene, image_names=[f"other-{name}" for name in NAMES]))


def test_parts_that_share_one_photo_have_no_common_scale(scene):
    assert num_of_one_scale(scene) == 6
    # some points only the first four photos show, the others only the last three
    frame, point = scene.observations.frame_idx, scene.observations.point_idx
    shown = np.where(point % 2 == 0, frame <= 3, frame >= 3)
    assert num_of_one_scale(replace(scene, observations=scene.observations.select(shown))) == 4


@pytest.mark.parametrize("rad", [0.02])
def test_other_features_are_taken_if_they_explain_more(scene, matched, rng, tmp_path):
    (tmp_path / "few").mkdir()
    some = scene.observations.select(np.arange(len(scene.observations)) % 3 > 0)
    fewer = matched_scene(replace(scene, observations=some), rng, tmp_path / "few" / "database.db", share_wrong=0.2)
    few, many = (
        Registrar(TrackSource(each, mapped_here=True), BundleOptions(), StageLog(lambda *_: None))
        for each in (fewer, matched)
    )
    start = bundle_adjust(scene, "rotation", rough_options(BundleOptions()))
    taken, found, left_out = few.with_features(many.track_source, start, {"9.jpg"})
    assert taken.track_source is many.track_source
    assert apart_deg(found.reconstruction, scene).max() < 0.1
    assert not left_out
    assert many.with_features(few.track_source, start, {"9.jpg"}) == (many, start, {"9.jpg"})


def test_a_photo_whose_motion_is_found_is_registered(scene, matched):
    """One that matches nothing as it was taken, but everything without the motion that a search found."""
    asked = []

    def find(before, known, phi_sigma):
        asked.append((before, known.image_names, phi_sigma))
        return TrackSource(matched, rough_phi={"5.jpg": scene.phi[5] + 0.05})

    pycolmap, nothing = quiet_pycolmap(), matched.database.with_name("nothing.db")
    shutil.copy(matched.database, nothing)
    with pycolmap.Database.open(nothing) as db:
        for first in range(5):
            db.delete_matches(first + 1, 6)
            db.delete_two_view_geometry(first + 1, 6)
    source = TrackSource(replace(matched, database=nothing), with_found_motions=find)
    registrar = Registrar(source, BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(scene.take_photos(np.arange(6) < 5), "rotation", rough_options(BundleOptions()))
    best, found, left_out = registrar.without_motions(start, set())
    assert asked == [(source.matched, tuple(NAMES[:5]), start.phi_rms)]
    assert found.reconstruction.image_names == tuple(NAMES)
    assert apart_deg(found.reconstruction, scene).max() < 0.1
    assert best.track_source.matched is matched
    assert not left_out


def test_a_photo_whose_motion_nobody_finds_stays_left_out(scene, matched):
    source = TrackSource(matched, with_found_motions=lambda *_: None)
    registrar = Registrar(source, BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(scene.take_photos(np.arange(6) < 5), "rotation", rough_options(BundleOptions()))
    assert registrar.without_motions(start, {"5.jpg"}) == (registrar, start, {"5.jpg"})


@pytest.mark.parametrize("rad", [0.02])
def test_motions_of_weak_shutters_are_not_searched(scene, matched):
    def find(*_):
        raise AssertionError

    registrar = Registrar(TrackSource(matched, with_found_motions=find), BundleOptions(), StageLog(lambda *_: None))
    start = bundle_adjust(scene.take_photos(np.arange(6) < 5), "rotation", rough_options(BundleOptions()))
    assert registrar.without_motions(start, {"5.jpg"}) == (registrar, start, {"5.jpg"})


def test_poses_fit_the_matches_of_what_they_are_relative_to(scene, matched):
    verified = read_num_verified(matched)
    assert share_that_fits(matched, verified, scene) > 0.95
    assert share_that_fits(matched, verified, with_a_side_turned(scene, 3)) < 0.7
    assert share_that_fits(matched, dict.fromkeys(verified, 29), scene) == 1.0
