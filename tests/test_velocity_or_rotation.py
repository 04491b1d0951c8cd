"""Photos that a travelling camera explains as well as one that rotates: which one is chosen, and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rsundistort_cli.closing import _held_out
from scipy.spatial.transform import Rotation

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, GuessedCameras, Posterior, bundle_adjust, choose_model
from rsundistort.bundle.choice import _rival, _Selection
from rsundistort.bundle.doubt import steps_after, steps_to
from rsundistort.bundle.held_out import ModelFits
from rsundistort.bundle.model_choice import LEAST_RIVAL
from rsundistort.model.focal_lengths import zooms
from rsundistort.model.reprojection import shutter_displacements
from rsundistort.solve.model_sequence import _is_common
from rsundistort.verdict.judge import _rival_reasons

CAMERA = Camera(768, 512, [[640, 0, 388], [0, 640, 251], [0, 0, 1]])
NOISE_PX = 0.05


def flight(rng, count, drift, rotation=0.003, relief=5.0):
    """Nadir photos over ground of some relief in m, 40 below, of a camera that drifts across its readout and shakes."""
    points_w = np.column_stack([rng.uniform(-35, 35, (1500, 2)), rng.uniform(0, relief, 1500)])
    frames, points, xy, R_cw, center_w, phi, velocity = [], [], [], [], [], [], []
    for i in range(count):
        way = 1.0 if i % 2 else -1.0
        R = np.diag([way, -way, -1.0]) @ Rotation.from_rotvec(rng.normal(0, [0.04, 0.04, 0.1])).as_matrix()
        center = np.array([*rng.uniform(-8, 8, 2), 40 + rng.normal(0, 0.5)])
        travel = np.array([drift, 0.02, 0.0]) / CAMERA.frame_span
        motion = RowMotion(rng.normal(0, rotation, 3) / CAMERA.frame_span, travel)
        uv, valid = project_points((points_w - center) @ R.T, CAMERA, motion, "constant-motion")
        seen = np.flatnonzero(valid & (np.abs(uv - [384, 256]) < [384, 256]).all(1))
        frames.append(np.full(len(seen), i))
        points.append(seen)
        xy.append(uv[seen] + rng.normal(0, NOISE_PX, (len(seen), 2)))
        R_cw.append(R)
        center_w.append(center)
        phi.append(motion.phi)
        velocity.append(R.T @ travel)
    observed = Observations(np.concatenate(frames), np.concatenate(points), np.concatenate(xy))
    rec = Reconstruction(
        [CAMERA], [f"{i}.jpg" for i in range(count)], np.zeros(count, int), np.array(R_cw), np.array(center_w),
        points_w, observed, np.array(phi), np.array(velocity), shutter_model="constant-motion",
    )  # fmt: skip
    return rec.with_points(np.ones(len(observed), bool), min_track=3)


def focused(rng, rec, share):
    """The same photos, each with a focal length of its own."""
    obs, (center,) = rec.observations, [each.K[:2, 2] for each in rec.cameras]
    scale = (1 + rng.normal(0, share, rec.num_images))[obs.frame_idx, None]
    return replace(rec, observations=replace(obs, xy_raw=center + scale * (obs.xy_raw - center)))


def choose_lens(rec):
    """The choice where the focal length is in the estimate, and may vary."""
    guessed = GuessedCameras(tuple(rec.cameras), {"f": 1e-3})
    return choose_model(at_rest(rec), options=BundleOptions(refine=("f",), guessed=guessed), sigma_px=NOISE_PX)


def at_rest(rec):
    return replace(rec, phi=np.zeros_like(rec.phi), velocity=np.zeros_like(rec.velocity), shutter_model="global")


def choose(rec):
    return choose_model(at_rest(rec), options=BundleOptions(), sigma_px=NOISE_PX)


def test_displacements_are_those_of_the_motions(rng):
    rec = flight(rng, 4, drift=0.5)
    moved, valid = shutter_displacements(rec)
    assert valid.all()
    # within half a frame 0.25 m at 35 to 40 m, that is 4 px and a little rotation
    assert 1.0 < np.median(np.linalg.norm(moved, axis=1)) < 4.0
    assert (shutter_displacements(at_rest(rec))[0] == 0).all()


@pytest.mark.parametrize("count", [4, 5, 8])
def test_a_drift_over_flat_ground_is_not_taken_for_rotations_in_silence(rng, count):
    choice = choose(flight(rng, count, drift=0.5))
    assert choice.shutter == "found"
    assert choice.shutter_model == "constant-motion" or _rival_reasons(choice)


@pytest.mark.parametrize("share", [0.0, 0.001])
def test_a_lens_that_focuses_is_seen_beside_a_camera_that_travels(rng, share):
    choice = choose_lens(focused(rng, flight(rng, 8, drift=0.5, rotation=0.01, relief=20.0), share))
    assert choice.label == "constant-motion" + ", varying lens" * (share > 0)


def test_photos_of_another_zoom_are_noticed(rng):
    rec = flight(rng, 8, drift=0.0, rotation=0.01, relief=20.0)
    obs, center = rec.observations, rec.cameras[0].K[:2, 2]
    scale = np.where(np.arange(8) % 3 == 2, 1.1, 1.0)[obs.frame_idx, None]
    choice = choose_lens(replace(rec, observations=replace(obs, xy_raw=center + scale * (obs.xy_raw - center))))
    assert choice.varying
    focal_px = [choice.focal_px[name] for name in rec.image_names]
    assert [sorted(part.tolist()) for part in zooms(focal_px)] == [[0, 1, 3, 4, 6, 7], [2, 5]]


def test_a_velocity_and_a_lens_that_varies_are_both_kept_where_neither_predicts_better(rng):
    rec = at_rest(flight(rng, 8, drift=0.1, rotation=0.01, relief=20.0))
    fits = ModelFits(rec, BundleOptions(), NOISE_PX, 0, None)
    steady = fits.fit("rotation", False, [fits.given])
    selection = _Selection(fits, steady, ["global"], {}, refines=True, varying=False)
    travels, varies = (fits.fit("constant-motion", False, [fits.given]), fits.fit("rotation", True, [fits.given]))
    for ahead, taken in ((travels, travels), (varies, varies), (None, None)):

        def is_better(before, after, ahead=ahead):
            return before is steady or after is ahead

        fits.is_better = is_better
        chosen = selection._or_varying_lens(steady, travels)
        assert chosen is taken if taken else chosen.label == "constant-motion, varying lens"


def test_rotations_of_a_camera_that_stays_have_no_rival(rng):
    choice = choose(flight(rng, 8, drift=0.0, rotation=0.03))
    assert choice.shutter_model == "rotation"
    assert choice.rival < 0.2
    assert not _rival_reasons(choice)


def test_a_rival_of_another_lens_is_tried_with_the_same_one(rng):
    rec = at_rest(flight(rng, 5, drift=0.5))
    fits, gain = ModelFits(rec, BundleOptions(), NOISE_PX, 0, None), dict[str, float]()
    best = fits.fit("rotation", False, [fits.given])
    # no velocity was tried, so nothing is a rival
    assert _rival(fits, best, gain) == (0.0, 0.0)
    assert list(fits.done) == ["rotation"]
    fits.fit("constant-motion", True, [best.reconstruction])
    assert _rival(fits, best, gain)[0] > LEAST_RIVAL
    assert list(fits.done) == ["rotation", "constant-motion, varying lens", "constant-motion"]
    assert gain == {"constant-motion": fits.gain(best, fits.done["constant-motion"])}


def test_a_rival_is_a_reason_that_says_what_to_give(rng):
    choice = replace(choose(flight(rng, 5, drift=0.0, rotation=0.03)), rival=1.9, rival_px=0.6)
    (said,) = _rival_reasons(choice)
    assert "1.9 times" in said
    assert "--model constant-motion" in said
    # the evidence decides about what nobody would see, without a word
    assert replace(choice, rival_px=0.4).has_rival
    assert not _rival_reasons(replace(choice, rival_px=0.4))


@pytest.mark.parametrize(("drift", "rotation"), [(0.5, 0.003), (0.0, 0.03)])
def test_a_travel_that_photos_share_decides_where_held_out_measurements_do_not(rng, drift, rotation):
    rec = flight(rng, 5, drift, rotation)
    choice = replace(choose(rec), shutter_model="rotation", label="rotation", rival=1.9)
    assert choice.has_rival
    options = BundleOptions(deviations="jackknife")
    result = bundle_adjust(at_rest(rec), "rotation", options)
    assert _is_common(result, choice, options, StageLog(None)) == bool(drift)
    travelling = choice.with_velocity()
    assert (travelling.shutter_model, travelling.label) == ("constant-motion", "constant-motion")
    assert travelling.is_shared
    assert not travelling.has_rival
    error = {"rotation": 4.19, "constant-motion": 4.10}
    quality = {"held_out_error": error, "held_out_gain": {"constant-motion": 0.9}, "held_out_kept": travelling.kept}
    quality |= {"held_out_chosen": travelling.label, "shared_travel": travelling.is_shared}
    assert "better by 0.9 standard errors: kept, since the photos share a travel" in _held_out(quality)
    # what looks like a rotation that changes may be a travel, too
    label = "rotation, accelerating"
    changing = replace(choice, label=label, bends=1, held_out_error={label: 4.1, **error}).with_velocity()
    assert (changing.shutter_model, changing.label, changing.bends) == ("constant-motion", "constant-motion", 0)
    # what was not tried says nothing
    untried = replace(choice, held_out_error={"rotation": 1.0})
    assert not _is_common(result, untried, options, StageLog(None))


def test_a_model_that_may_be_right_too_widens_the_deviations(rng):
    rec = flight(rng, 5, drift=0.0, rotation=0.03)
    choice = choose(rec)
    options = BundleOptions(outlier_rounds=0, sigma_px=NOISE_PX, deviations="model")
    alone = bundle_adjust(at_rest(rec), "rotation", options)
    both = bundle_adjust(at_rest(rec), "rotation", replace(options, rival=choice.steps))
    assert_array_equal(both.reconstruction.phi, alone.reconstruction.phi)
    steps = np.array([choice.steps[name][:9] for name in alone.reconstruction.image_names])
    assert np.abs(steps[:, 6:]).max() > 0
    assert_allclose(both.covariances - alone.covariances, np.einsum("ma,mb->mab", steps, steps), atol=1e-12)
    # of all photos together, too: what the mean rotation may be off by
    mean = np.zeros((1, 5, 9))
    mean[:, :, 8] = 0.2
    with_rival = Posterior(both, replace(options, rival=choice.steps)).of_photos(mean)
    added = (with_rival - Posterior(alone, options).of_photos(mean))[0]
    assert_allclose(np.sum(mean[0] * added), steps[:, 8].mean() ** 2, atol=1e-12)


def test_steps_from_one_solution_to_another_do_not_depend_on_the_frames(rng):
    rec = flight(rng, 6, drift=0.5)
    phi, velocity = (rng.normal(size=(6, 3)) * size for size in (1e-4, 1e-3))
    other = replace(rec, phi=rec.phi + phi, velocity=rec.velocity + velocity)
    moved = other.moved(Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([3.0, 1.0, -2.0]), 1.7)
    expected = np.hstack([np.zeros((6, 6)), phi, velocity])
    assert_allclose(steps_to(moved, rec), expected, atol=1e-9)


def test_steps_go_along_with_a_frame_that_moves(rng):
    rec = flight(rng, 6, drift=0.5)
    other = replace(
        rec, center_w=rec.center_w + rng.normal(0, 0.01, (6, 3)), phi=rec.phi + 1e-4,
        velocity=rec.velocity + rng.normal(0, 1e-3, (6, 3)),
    )  # fmt: skip
    steps = dict(zip(rec.image_names, map(tuple, steps_to(other, rec).tolist()), strict=True))
    moved = rec.moved(Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([3.0, 1.0, -2.0]), 1.7)
    found = steps_after(steps, rec, moved)
    assert_allclose([found[name] for name in rec.image_names], steps_to(other, moved), atol=1e-9)
