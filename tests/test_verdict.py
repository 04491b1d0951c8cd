"""The verdict on solutions whose truth is known, from measurements by the NumPy projection."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy_reference import measure
from scipy.spatial.transform import Rotation

from rsundistort import (
    BundleOptions,
    Camera,
    Observations,
    Reconstruction,
    RowMotion,
    bundle_adjust,
)
from rsundistort.bundle import GuessedCameras, KnownMotions, ModelChoice, choose_model
from rsundistort.bundle.common_motion import CommonMotion
from rsundistort.critical import heal
from rsundistort.rectify import largest_shift_px
from rsundistort.solve.model_sequence import _lens_instead
from rsundistort.verdict import Verdict, judge
from rsundistort.verdict.judge import _no_parallax, _repeated, _zoomed
from rsundistort.verdict.photos import photo_motions
from rsundistort.verdict.residuals import left_along_readout, left_over_frame

LENS = (-0.1, 0.03, 0.0, 0.0)
CAMERA = Camera(800, 600, [[700, 0, 402], [0, 700, 297], [0, 0, 1]], LENS)
NOISE_PX = 0.3
ROLL = np.array([0, 0, 0.006])

# problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


def measured(rng, phi, *, num_points=250, noise_px=NOISE_PX, velocity=None):
    """Photos around a cloud, rolled at will, that rotated by phi (m, 3) radians a frame; at the true poses."""
    m = len(phi)
    center_w = rng.normal(size=(m, 3))
    center_w *= 3.5 / np.linalg.norm(center_w, axis=1, keepdims=True)
    ahead = -center_w / np.linalg.norm(center_w, axis=1, keepdims=True)
    right = np.cross(ahead, rng.normal(size=(m, 3)))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R_cw = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    # fills the frame
    points_w = rng.uniform(-1.3, 1.3, (num_points, 3))
    phi = np.asarray(phi) / CAMERA.frame_span
    motions = [RowMotion(*each) for each in zip(phi, np.zeros((m, 3)) if velocity is None else velocity, strict=True)]
    point_idx, frame_idx = (each.ravel() for each in np.mgrid[:num_points, :m])
    exact = measure(points_w, R_cw, center_w, motions, [CAMERA] * m, frame_idx, point_idx)
    noise = np.random.default_rng(int(rng.integers(1 << 30))).normal(0.0, noise_px, exact.shape)
    seen = Observations(frame_idx, point_idx, exact + noise)
    inside = ((seen.xy_raw >= 0) & (seen.xy_raw <= [799, 599])).all(1)
    rec = Reconstruction(
        [CAMERA], [f"{i}.jpg" for i in range(m)], np.zeros(m, int), R_cw, center_w, points_w, seen.select(inside)
    )
    return rec.with_points(np.ones(len(rec.observations), bool), min_track=3)


def swung(rng, sigma=0.04, m=8):
    """Motions of a hand, radians a frame."""
    return sigma * rng.normal(size=(m, 3))


def named(rec, model="rotation", options=None):
    """The verdict where a model is named."""
    options = options or BundleOptions()
    result, remedy = heal(bundle_adjust(rec, model, options), options)
    plain = bundle_adjust(result.reconstruction, "global", replace(options, outlier_rounds=0, sigma_px=result.sigma_px))
    return result, judge(result, plain, None, remedy)


def chosen(rec, options=None):
    """The verdict where evidence chooses the model, as a run does it."""
    options = options or BundleOptions()
    tried = bundle_adjust(rec, "rotation", options)
    choice = choose_model(tried.reconstruction, ("global", "two-step", "rotation"), options, sigma_px=tried.sigma_px)
    result, remedy = tried, None
    if choice.shutter_model != "rotation":
        result = bundle_adjust(tried.reconstruction, choice.shutter_model, options)
    if choice.shutter_model != "global":
        result, remedy = heal(result, options)
    return judge(result, None, choice, remedy)


def moved(rec, shift_px, some=None):
    """The same with measurements that are shifted by (o, 2) pixels, or some of them."""
    obs = rec.observations
    some = np.ones(len(obs), bool) if some is None else some
    return replace(rec, observations=replace(obs, xy_raw=obs.xy_raw + some[:, None] * shift_px))


def thinned(rec, photo, keep):
    """Without measurements of a photo but those of a mask (o,)."""
    keep = keep | (rec.observations.frame_idx != photo)
    return replace(rec, observations=rec.observations.select(keep))


def choice_of(model="global", error=1.0, gain=0.0, num_held_out=500, against=()):
    errors = {"global": error, "rotation": error}
    shutter = "not-determined" if against else "not-found" if model == "global" else "found"
    return ModelChoice(
        model, model, False, shutter, errors, errors, {"rotation": gain}, {}, (model,), None, against, num_held_out
    )


def held(names):
    """Options of photos whose motion is known."""
    return BundleOptions(known_phi={name: (np.zeros(3), np.full(3, 1e-4)) for name in names})


# ---------------------------------------------------------------- shutter and shape


def test_motions_of_a_hand_are_found_and_trusted(rng):
    verdict = chosen(measured(rng, swung(rng), num_points=400))
    assert verdict == Verdict("found", "trusted")
    assert named(measured(rng, swung(rng)))[1] == Verdict("found", "trusted")


def test_noise_alone_is_no_shutter(rng):
    rec = measured(rng, np.zeros((8, 3)))
    assert chosen(rec) == named(rec)[1] == Verdict("not-found", "trusted")


@pytest.mark.parametrize(("num_points", "shutter"), [(250, "not-found"), (10, "not-determined")])
def test_no_shutter_is_found_only_where_photos_would_show_one(num_points, shutter, rng):
    """Few photos, and few points: their motions are then estimated to be small because nothing shows them."""
    plain = bundle_adjust(measured(rng, np.zeros((4, 3)), num_points=num_points), "global")
    assert judge(plain, None, choice_of()).shutter == "not-found"
    verdict = judge(plain, None, choice_of(), options=BundleOptions())
    assert (verdict.shutter, verdict.shape == "trusted") == (shutter, shutter == "not-found")
    assert any("would not show a rolling shutter" in reason for reason in verdict.reasons) == (num_points == 10)


@pytest.mark.parametrize("sigma", [0.0, 0.04])
def test_a_wrong_lens_is_no_trusted_shape(sigma, rng):
    rec = measured(rng, swung(rng, sigma), num_points=400)
    wrong = replace(rec, cameras=[replace(CAMERA, dist=(LENS[0] + 0.06, *LENS[1:]))])
    for verdict in (chosen(wrong), named(wrong)[1]):
        assert verdict.shape == "doubtful"
        assert "the lens model does not fit the lens" in verdict.reasons[0]
    # and one that is solved for is right again
    assert named(wrong, options=BundleOptions(refine=("k1",)))[1].shape == "trusted"


def with_few_of(rec, photo, share):
    """Some of the measurements of a photo only."""
    frame = rec.observations.frame_idx
    return rec.with_points((frame != photo) | (np.cumsum(frame == photo) <= share * (frame == photo).sum()))


def test_one_photo_that_contradicts_the_others_shows_no_shutter(rng):
    phi = np.zeros((8, 3))
    phi[3] = [0.05, 0.02, 0.0]
    rec = measured(rng, phi)
    few = with_few_of(rec, 3, 0.3)
    for tracks, shutter in ((few, "found"), (rec, "not-determined")):
        verdict = judge(bundle_adjust(few, "rotation"), None, choice_of("rotation", gain=9.0), tracks=tracks)
        assert verdict.shutter == shutter
    assert verdict.reasons == (
        f"Only {rec.image_names[3]} would show a shutter, and most of what that shows contradicts the rest or itself.",
    )
    assert verdict.lens_only == tuple(rec.image_names)


@pytest.mark.parametrize(
    ("share", "said"), [(0.5, "50 % of its measurements"), (0.1, " measurements; 90 % of its measurements")]
)
def test_photos_of_few_measurements_are_named_without_a_shutter_too(rng, share, said):
    rec = measured(rng, np.zeros((8, 3)))
    result = bundle_adjust(with_few_of(rec, 3, share), "global")
    verdict = judge(result, None, choice_of(), tracks=rec)
    assert [*verdict.doubtful] == [rec.image_names[3]]
    assert said in verdict.doubtful[rec.image_names[3]]


def test_what_a_lens_of_another_model_bends_is_no_shutter(rng, monkeypatch):
    result = bundle_adjust(measured(rng, swung(rng)), "rotation")
    assert judge(result, None, choice_of("rotation", gain=9.0)).shutter == "found"
    monkeypatch.setitem(judge.__globals__, "excess_px", lambda _: 0.6)
    verdict = judge(result, None, choice_of("rotation", gain=9.0))
    assert verdict.shutter == "not-determined"
    advice = 'of a fisheye, say "lens": "fisheye" in camera.json'
    assert advice not in verdict.reasons[0]  # a fisheye of so narrow a view is a pinhole lens
    monkeypatch.setitem(judge.__globals__, "fisheye_apart_px", lambda _: 0.6)
    assert advice in judge(result, None, choice_of("rotation", gain=9.0)).reasons[0]
    # a gyroscope may say so, too
    known = KnownMotions(gain=5.0, is_better=True, free_gain=0.0, miss=1.0, size=20.0)
    assert judge(result, None, replace(choice_of("rotation", gain=9.0), known_motions=known)).shutter == "found"


def test_motions_that_repeat_themselves_are_no_hands(rng):
    alike = named(measured(rng, swung(rng, 0.001) + ROLL))[1]
    assert alike.shutter == "not-determined"
    assert alike.shape == "doubtful"
    assert "rotated alike, by 0." in alike.reasons[0]
    assert "about z" in alike.reasons[0]
    # a camera that pans rotates on between its photos
    rec = measured(rng, swung(rng, 0.001) + ROLL)
    pan = np.array([Rotation.from_rotvec([0, 0, 0.3 * i]).as_matrix() for i in range(8)])
    order = replace(
        rec, R_cw=pan @ rec.R_cw[0], phi=np.tile(ROLL, (8, 1)) / CAMERA.frame_span, shutter_model="rotation"
    )
    assert _repeated(order) is None
    axis, rotation = _repeated(replace(order, R_cw=order.R_cw[::-1]))
    assert (axis, rotation) == (2, pytest.approx(ROLL[2]))
    # what is each photo's own may be a vibration; what they share is a lens, however it bends
    waves = ROLL[2] * np.sin(np.linspace(0, 6, 7) + np.arange(8)[:, None])[:, :, None] * np.repeat([1.0, 0.0], 3)
    alike = replace(order, R_cw=order.R_cw[::-1], bend_clock=np.tile([-0.5, 0.5], (8, 1)))
    assert _repeated(replace(alike, bend=waves)) is None
    assert _repeated(replace(alike, bend=waves[:1].repeat(8, 0)))[0] == 2
    # photos that came out wrong do not hide it
    phi = np.array(order.phi)
    phi[2] *= -40.0
    assert _repeated(replace(order, R_cw=order.R_cw[::-1], phi=phi))[0] == 2
    # nor does another camera, that did not move at all
    phi = np.array(order.phi)
    phi[5:] = 0.0
    of_two = np.array([0] * 5 + [1] * 3)
    assert _repeated(replace(order, R_cw=order.R_cw[::-1], phi=phi)) is None
    of_two = replace(order, cameras=[CAMERA] * 2, camera_idx=of_two, R_cw=order.R_cw[::-1], phi=phi)
    assert _repeated(of_two)[0] == 2
    # a gyroscope may say so, too
    result = bundle_adjust(rec, "rotation")
    assert judge(result, None, choice_of("rotation", gain=9.0)).lens_only == tuple(rec.image_names)
    by_gyro = judge(result, None, choice_of("rotation", gain=9.0), options=held(rec.image_names))
    assert (by_gyro.shutter, by_gyro.shape, by_gyro.lens_only) == ("found", "trusted", ())
    # no lens bends photos like this
    result = bundle_adjust(measured(rng, swung(rng, 0.001) + 5 * ROLL), "rotation")
    assert judge(result, None, choice_of("rotation", gain=9.0)).shutter == "found"
    # but one whose focal length is off by a fifth may bend them by as much
    expected = GuessedCameras([replace(CAMERA, K=CAMERA.K * [[0.8], [0.8], [1.0]])], {"f": 0.05})
    options = BundleOptions(guessed=expected)
    assert judge(result, None, choice_of("rotation", gain=9.0), options=options).shutter == "not-determined"
    # of a few photos chance may do the same
    assert "alike" not in " ".join(named(measured(rng, swung(rng, 0.001, 4) + ROLL))[1].reasons)


def test_a_model_that_was_named_must_explain_something(rng):
    result, verdict = named(measured(rng, swung(rng)))
    assert verdict.shutter == "found"
    assert verdict.lens_only == ()
    nothing_gained = judge(result, replace(result))
    assert nothing_gained.shutter == judge(result).shutter == "not-determined"
    assert "rotation model, which you named, explains no more" in nothing_gained.reasons[0]


def test_a_global_model_that_was_named_was_not_looked_at(rng):
    rec = measured(rng, swung(rng))
    verdict = judge(bundle_adjust(rec, "global"))
    assert verdict.shutter == "not-determined"
    assert verdict.shape == "doubtful"
    assert "--model global" in verdict.reasons[-1]


def test_a_shutter_that_gained_but_was_not_kept_is_not_determined(rng):
    still = bundle_adjust(measured(rng, np.zeros((8, 3))), "global")
    for choice, shutter, said in (
        (
            choice_of(gain=5.0, against=("two halves differ",)),
            "not-determined",
            "was not corrected: two halves differ.",
        ),
        (choice_of(gain=1.0), "not-found", ""),
        (choice_of(num_held_out=12), "not-determined", "only 12 could be held out"),
    ):
        verdict = judge(still, None, choice)
        assert verdict.shutter == shutter
        assert verdict.shape == ("doubtful" if said else "trusted")
        assert said in " ".join(verdict.reasons)


def test_held_out_measurements_that_are_far_off_speak_against_a_solution(rng):
    result = bundle_adjust(measured(rng, swung(rng)), "rotation")
    assert judge(result, None, choice_of("rotation", 3.0, 9.0)).shape == "trusted"  # 0.4 px
    far_off = judge(result, None, choice_of("rotation", 10.0, 9.0))
    assert far_off.shutter == "found"
    beyond = f"{3 * result.sigma_px:.1f}"  # sqrt(10 - 1) times the noise
    assert far_off.reasons == (
        f"Held-out measurements are off by {beyond} px more than their noise explains; "
        "exclude what moves, if it is large (--masks).",
    )


def test_a_scene_that_nothing_holds_together_is_not_trusted(rng):
    result = bundle_adjust(measured(rng, swung(rng)), "rotation")
    torn = replace(result, covariances=np.full_like(result.covariances, np.nan))
    for each in (torn, replace(torn, reconstruction=replace(torn.reconstruction, shutter_model="global"))):
        verdict = judge(each, None, choice_of("rotation", 1.0, 9.0))
        assert verdict.shape == "doubtful"
        assert "scaled against each other" in " ".join(verdict.reasons)


def test_an_unknown_height_is_not_trusted(rng):
    options = BundleOptions()
    result, remedy = heal(bundle_adjust(measured(rng, swung(rng)), "rotation", options), options)
    for sigma, shape in ((0.004, "trusted"), (0.006, "doubtful"), (np.nan, "doubtful")):
        unsure = replace(remedy, after=replace(remedy.after, sigma_log_k=sigma))
        verdict = judge(result, None, choice_of("rotation", gain=9.0), unsure)
        assert verdict.shape == shape
        assert shape == "trusted" or verdict.reasons[0].startswith("The height of the scene is ")


# ---------------------------------------------------------------- photos


def test_a_photo_whose_halves_disagree_is_doubtful(rng):
    rec = measured(rng, swung(rng, 0.02))
    obs = rec.observations
    # what was read last was bent further, which outliers are not: each measurement moved little from its neighbours
    late = (obs.frame_idx == 3) & (obs.xy_raw[:, 1] > 300)
    bent = moved(rec, np.stack([(obs.xy_raw[:, 1] - 300) / 40, np.zeros(len(obs))], axis=1), late)
    result, verdict = named(bent)
    assert verdict.doubtful["3.jpg"].startswith("its halves contradict each other by ")
    assert np.argmax(photo_motions(result).difference_px) == 3
    assert not photo_motions(named(rec)[0]).difference_px.any()


def test_a_photo_of_few_measurements_is_doubtful(rng):
    rec = measured(rng, swung(rng))
    mine = rec.observations.frame_idx == 2
    few = thinned(rec, 2, mine & (np.cumsum(mine) <= 25))
    assert named(few)[1].doubtful["2.jpg"].startswith("only 25 measurements")
    corner = thinned(rec, 2, (rec.observations.xy_raw < [250, 220]).all(1))
    assert "of its frame" in named(corner)[1].doubtful["2.jpg"]


def test_a_photo_that_moved_far_more_is_doubtful(rng):
    phi = swung(rng, 0.005, 12)
    phi[4] = [0.05, 0.0, 0.05]
    verdict = named(measured(rng, phi))[1]
    assert verdict.doubtful.keys() == {"4.jpg"}
    assert "times as much as the other photos do" in verdict.doubtful["4.jpg"]


def test_photos_of_a_camera_that_rests_make_no_photo_of_another_doubtful(rng):
    phi = swung(rng, 0.03, 12)
    phi[6:] = rng.normal(0, 1e-5, (6, 3))
    rec = measured(rng, phi)
    other = replace(rec, cameras=[*rec.cameras, *rec.cameras], camera_idx=np.repeat([0, 1], 6))
    assert not named(other)[1].doubtful
    # nor do photos of the same one that were taken from a tripod
    phi[6:8] = swung(rng, 0.03, 2)
    assert not named(measured(rng, phi))[1].doubtful


def test_a_photo_that_its_exposure_contradicts_is_doubtful(rng):
    result, _ = named(measured(rng, swung(rng)))
    turned = np.linalg.norm(result.reconstruction.phi[1]) * CAMERA.frame_span
    for bound, doubtful in ((1.1 * turned, False), (0.5 * turned, True)):
        verdict = judge(result, options=BundleOptions(phi_limits={"1.jpg": bound / 2}))
        assert ("1.jpg" in verdict.doubtful) == doubtful
    assert f"{np.degrees(turned):.2f} degrees, but would be blurred" in verdict.doubtful["1.jpg"]


def test_a_motion_that_nothing_supports_is_not_taken_out(rng):
    rec = measured(rng, swung(rng))
    mine = rec.observations.frame_idx == 2
    result = bundle_adjust(thinned(rec, 2, mine & (np.cumsum(mine) <= 25)), "rotation")
    assert judge(result).lens_only == ()
    # the same measurements with a hundred times the noise
    covariances = np.array(result.covariances)
    covariances[2] *= 1e4
    weak = judge(replace(result, covariances=covariances))
    assert weak.lens_only == ("2.jpg",)
    assert "only known to" in weak.doubtful["2.jpg"]


def test_motions_within_their_standard_deviations_are_not_taken_out(rng):
    result, choice = bundle_adjust(measured(rng, swung(rng)), "rotation"), choice_of("rotation", gain=9.0)
    supported = judge(result, None, choice)
    assert (supported.shutter, supported.lens_only) == ("found", ())
    names = result.reconstruction.image_names
    # of all photos but one, as another model that explains them as well may cause; a model that is named is applied
    doubt = np.array(result.covariances)
    doubt[:, 6:, 6:] *= (1.1 / photo_motions(result).relative_sigma ** 2)[:, None, None]
    all_but_one = np.where(np.arange(len(names))[:, None, None] == 3, result.covariances, doubt)
    verdict = judge(replace(result, covariances=all_but_one), None, choice)
    assert (verdict.shutter, [*verdict.lens_only]) == ("found", [*names[:3], *names[4:]])
    assert judge(replace(result, covariances=all_but_one)).lens_only == ()
    # of all photos: then no motion is found that could be taken out
    verdict = judge(replace(result, covariances=doubt), None, choice)
    assert (verdict.shutter, verdict.shape, verdict.lens_only) == ("not-determined", "doubtful", tuple(names))
    assert verdict.reasons[-1] == "No photo's motion is larger than its standard deviation."
    assert judge(replace(result, covariances=doubt), None, choice, options=held(names)).shutter == "found"
    # errors alone may be larger than one deviation, but hardly than two
    doubt[:, 6:, 6:] *= 0.5
    verdict = judge(replace(result, covariances=doubt), None, choice)
    assert (verdict.shutter, verdict.lens_only) == ("not-determined", tuple(names))
    assert verdict.reasons[-1] == "No photo's motion is larger than 2 standard deviations."
    # what all share may be certain nevertheless
    nothing = np.zeros((len(names), 6))
    for probability, found in ((0.9, "not-determined"), (0.999, "found")):
        common = CommonMotion(np.zeros((1, 8)), (0.01,) * 8, nothing, nothing, probability)
        assert judge(replace(result, covariances=doubt, common=common), None, choice).shutter == found
    doubt[:, 6:, 6:] *= 0.4
    assert judge(replace(result, covariances=doubt), None, choice).shutter == "found"


def test_a_motion_that_may_be_all_error_is_named_and_says_nothing_about_the_shape(rng):
    result = bundle_adjust(measured(rng, swung(rng, 0.01)), "rotation")
    choice = choice_of("rotation", gain=9.0)
    found, sigma = photo_motions(result).shift_px, photo_motions(result).sigma_px
    # of the photo that moved least, an error of two standard deviations then is half, and of the others less
    least = int(np.argmin(found))
    times = (found.min() / 3.9 / sigma[least]) ** 2
    verdict = judge(replace(result, covariances=np.array(result.covariances) * times), None, choice)
    assert verdict.doubtful[result.reconstruction.image_names[least]].startswith(f"its motion of {found.min():.1f} px")
    assert verdict.shape == judge(result, None, choice).shape == "trusted"


def test_a_motion_about_the_axis_hides_no_error_about_another(rng):
    """Corners move by far more than that error, at two standard deviations; in the mean over the frame, less."""
    result = bundle_adjust(measured(rng, swung(rng, 0.002) + np.array([0, 0, 0.086])), "rotation")
    covariances = np.zeros_like(result.covariances)
    covariances[:, 6, 6] = 1e-4
    motions = photo_motions(replace(result, covariances=covariances))
    covariances *= float((motions.shift_px / motions.sigma_px).min() / 4.1) ** 2
    motions = photo_motions(replace(result, covariances=covariances))
    assert (motions.sigma_px < motions.shift_px / 4).all()
    assert (motions.relative_sigma > 1 / 4).all()
    assert all(judge(replace(result, covariances=covariances), None, choice_of("rotation", gain=9.0)).doubtful.values())


def test_places_that_only_the_solution_tells_are_named_where_it_does_not_tell_them(rng):
    result, choice = bundle_adjust(measured(rng, swung(rng)), "rotation"), choice_of("rotation", gain=9.0)
    assert not judge(result, None, choice, strong=True).doubtful
    # directions known to 0.57 and 5.7 degrees; against the photo that is held the others are uncertain
    covariances = np.array(result.covariances)
    covariances[1:, :3, :3] = 0.01**2 * np.eye(3)
    covariances[3, :3, :3] = 0.1**2 * np.eye(3)
    loose = replace(result, covariances=covariances)
    assert not judge(loose, None, choice).doubtful
    assert judge(loose, None, choice, strong=True).doubtful == {"3.jpg": "its direction is only known to +-5.7 degrees"}


@pytest.mark.parametrize("shutter_model", ["global", "rotation"])
def test_photos_in_a_place_that_matches_contradict_are_named(rng, shutter_model):
    result, choice = bundle_adjust(measured(rng, swung(rng)), shutter_model), choice_of(shutter_model, gain=9.0)
    said = judge(result, None, choice, suspects=["2.jpg"])
    assert said.shape == "doubtful"
    assert any("(2.jpg)" in reason for reason in said.reasons)
    assert "contradict its place" in said.doubtful["2.jpg"]
    # its motion came from the same estimate as its pose
    assert said.lens_only == (("2.jpg",) if shutter_model == "rotation" else ())


def test_all_places_are_named_where_a_strong_shutter_was_not_found(rng):
    rec = measured(rng, swung(rng))
    against = choice_of(against=("the motions of two halves do not agree",))
    still = bundle_adjust(rec, "global")
    assert not judge(still, None, against).doubtful
    doubtful = judge(still, None, against, strong=True).doubtful
    assert sorted(doubtful) == sorted(rec.image_names)
    assert all("its pose may be wrong" in said for said in doubtful.values())
    turned = bundle_adjust(rec, "rotation")
    off = judge(turned, None, choice_of("rotation", error=50.0, gain=9.0), strong=True).doubtful
    assert all("its pose may be wrong" in off[name] for name in rec.image_names)


def test_motions_that_most_photos_contradict_are_not_taken_out_if_evidence_chose_them(rng):
    rec = measured(rng, 0 * swung(rng))
    obs = rec.observations
    # all left halves were sheared one way, all right halves the other
    way = np.where(obs.xy_raw[:, :1] > 400, 1, -0.5) * (obs.xy_raw[:, 1:] - 297) / 297 * [8.0, 0.0]
    # as noise that goes together this would leave no motion
    result = bundle_adjust(
        moved(rec, way), "rotation", BundleOptions(outlier_rounds=0, sigma_px=NOISE_PX, deviations="model")
    )
    torn = judge(result, None, choice_of("rotation", gain=9.0))
    assert torn.shutter == "not-determined"
    # unless a gyroscope measured them
    known = KnownMotions(gain=5.0, is_better=True, free_gain=0.0, miss=1.0, size=20.0)
    assert judge(result, None, replace(choice_of("rotation", gain=9.0), known_motions=known)).shutter == "found"
    assert "halves of the measurements do not agree" in " ".join(torn.reasons)
    assert torn.lens_only == tuple(rec.image_names)
    # who knows a motion from elsewhere knows better
    assert "2.jpg" not in judge(result, None, choice_of("rotation", gain=9.0), options=held(["2.jpg"])).lens_only


def test_a_photo_that_moved_two_ways_is_left_alone(rng):
    phi = swung(rng)
    phi[5] = 0
    rec = measured(rng, phi)
    obs = rec.observations
    # its left half was sheared one way, its right half the other
    way = np.where(obs.xy_raw[:, :1] > 400, 1.5, -0.5) * (obs.xy_raw[:, 1:] - 297) / 297 * [8.0, 0.0]
    torn = moved(rec, way, obs.frame_idx == 5)
    verdict = judge(bundle_adjust(torn, "rotation", BundleOptions(outlier_rounds=0, sigma_px=NOISE_PX)))
    assert "its halves contradict each other" in verdict.doubtful["5.jpg"]
    assert verdict.lens_only == ("5.jpg",)
    # where outliers are dropped, they say the same
    way = rng.normal(size=(len(obs), 2)) * 30
    clean = bundle_adjust(moved(rec, way, (obs.frame_idx == 4) & (rng.random(len(obs)) < 0.7)), "rotation")
    verdict = judge(clean, tracks=torn)
    assert re.match("(6|7).* % of its measurements contradict the others", verdict.doubtful["4.jpg"])
    assert verdict.lens_only == ("4.jpg",)
    assert judge(clean).lens_only == ()


# ---------------------------------------------------------------- residuals


def test_what_remains_is_distinguished_from_noise(rng):
    rec = measured(rng, np.zeros((10, 3)))
    assert left_over_frame(rec) == left_along_readout(rec) == 0
    xy = rec.observations.xy_raw
    ring = np.linalg.norm((xy - [402, 297]) / 400, axis=1, keepdims=True)
    bent = 0.3 * np.cos(4 * ring) * (xy - [402, 297]) / 400 / ring
    expected = np.sqrt((bent**2).sum(1).mean())
    np.testing.assert_allclose(left_over_frame(moved(rec, bent)), expected, rtol=0.25)
    late = np.stack([np.zeros(len(xy)), 0.3 * np.cos(np.pi * xy[:, 1] / 150)], axis=1)
    np.testing.assert_allclose(left_along_readout(moved(rec, late)), 0.3 / np.sqrt(2), rtol=0.25)
    # what is in one photo is not in all
    assert left_over_frame(moved(rec, 4 * bent, rec.observations.frame_idx == 3)) == 0
    # rows are no columns
    across = replace(rec, cameras=[replace(CAMERA, readout="left-to-right")])
    assert left_along_readout(moved(across, late)) == 0


@pytest.mark.parametrize("model", ["rotation", "constant-motion"])
def test_displacements_of_photos_are_those_of_their_motions(model, rng):
    velocity = np.zeros((8, 3)) if model == "rotation" else 0.05 * rng.normal(size=(8, 3))
    rec = measured(rng, swung(rng), velocity=velocity)
    result = bundle_adjust(rec, model)
    found = photo_motions(result)
    exact = [largest_shift_px(CAMERA, result.reconstruction.motion(i), "rotation") for i in range(8)]
    if model == "rotation":
        np.testing.assert_allclose(found.shift_px, exact, rtol=0.2)  # of first order
    else:
        assert (np.abs(found.shift_px - exact) > 1).any()
    assert ((found.covered > 0.5) & (found.covered < 1.2)).all()
    # deviations are those of the errors
    assert ((found.sigma_px > 0.05) & (found.sigma_px < 2)).all()


# ---------------------------------------------------------------- a lens that is none


@pytest.mark.parametrize(
    ("model", "error", "focal", "shift_px", "says"),
    [
        # what moves, or is misplaced, bends the lens
        ("global", 9.0, 0.6, 0.0, "contradict each other"),
        # a camera that is another one explains its photos
        ("global", 1.1, 0.6, 0.0, ""),
        ("global", 9.0, 1.0, 0.0, ""),
        ("rotation", 9.0, 0.6, 0.0, ""),
        # without its shutter
        ("global", 1.1, 1.0, 200.0, "the model with a shutter found"),
        ("global", 9.0, 0.6, 200.0, "the model with a shutter found"),
    ],
)
def test_a_lens_that_photos_in_contradiction_need_is_not_corrected(model, error, focal, shift_px, says):
    K = CAMERA.K * [[focal, 1, 1], [1, focal, 1], [1, 1, 1]] + [[0, 0, shift_px], [0, 0, 0], [0, 0, 0]]
    found = SimpleNamespace(reconstruction=SimpleNamespace(cameras=[replace(CAMERA, K=K)]), sigma_px=0.5)
    start = SimpleNamespace(cameras=[replace(CAMERA, dist=(0.01, 0, 0, 0))])
    guessed = GuessedCameras((CAMERA,), {"f": 0.05, "cx": 0.01})
    cameras, why = _lens_instead(choice_of(model, error), found, start, guessed)
    assert (says in why) if says else why == ""
    if "contradict" in says:
        assert cameras == [CAMERA]
    elif says:
        assert cameras == start.cameras
        # which is none either
        odd = SimpleNamespace(cameras=[replace(CAMERA, K=CAMERA.K * [[2, 1, 1], [1, 2, 1], [1, 1, 1]])])
        why = _lens_instead(choice_of(model, 9.0), found, odd, guessed)[1]
        assert "contradict each other" in why


def test_photos_from_one_spot_that_may_be_misplaced_are_told_to_walk(rng):
    rec = measured(rng, swung(rng), noise_px=0.1)
    assert not _no_parallax(rec)
    near = replace(rec, center_w=rec.center_w[0] + 0.005 * rng.normal(size=rec.center_w.shape))
    (said,) = _no_parallax(near)
    assert "walk between photos" in said


def test_a_lens_that_zoomed_is_no_lens_that_focuses(rng):
    rec = measured(rng, swung(rng), noise_px=0.1)
    focused, zoomed = np.zeros((8, 3)), np.zeros((8, 3))
    focused[:, 0], zoomed[2:4, 0] = rng.normal(0, 0.005, 8), 0.1
    assert not _zoomed(replace(rec, variation=focused))
    assert _zoomed(replace(rec, variation=zoomed)) == "from 700 to 774 px"
