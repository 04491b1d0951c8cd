"""The path of a video's camera, as a prior of the adjustment: derivatives, interpolation, readout time."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from clips import HandHeld, filmed, poses_at, rotation_errors_deg
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Observations, Reconstruction, bundle_adjust
from rsundistort.bundle.own_motions import OwnMotions, own_motions
from rsundistort.bundle.path_prior import FramePath, PathPrior, orthogonal, with_path_motions
from rsundistort.bundle.path_prior import PathState as State
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.errors import InputError
from rsundistort.model.path import CameraPath, inverse_left_jacobians
from rsundistort.solve.clip_verdict import readouts_of_halves
from rsundistort.verdict.judge_path import ReadoutTime, judge_clip, unfollowed_px

FRAME_S = 1 / 30


def adjusted(truth: Reconstruction, times: dict[str, float], **options):  # type: ignore[no-untyped-def]
    """From the global-shutter solution, as a video is solved."""
    plain = bundle_adjust(truth, "global", BundleOptions(outlier_rounds=0, deviations="model")).reconstruction
    how = BundleOptions(path=FramePath(times, FRAME_S, **options))
    return bundle_adjust(plain, "constant-motion", how)


def test_the_inverse_left_jacobian_is_that_of_the_logarithm() -> None:
    xi = np.array([[0.3, -0.2, 0.1], [1e-3, 2e-3, -1e-3], [0.0, 0.0, 0.0]])
    step = 1e-6
    for axis in range(3):
        d = np.eye(3)[axis] * step
        ahead, behind = (
            (Rotation.from_rotvec(sign * d) * Rotation.from_rotvec(xi)).as_rotvec() for sign in (1.0, -1.0)
        )
        expected = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(inverse_left_jacobians(xi)[:, :, axis], expected, atol=1e-8)


def test_the_jacobians_of_the_path_are_those_of_differences() -> None:
    truth, times = filmed(HandHeld(3, swing=2.0), 8)
    prior = PathPrior(FramePath(times, FRAME_S), truth, (0.02, 0.3))
    rng = np.random.default_rng(0)
    start = prior.start(truth)
    state = replace(start, rates=start.rates + rng.normal(0, 0.02, (8, 6)), changes=rng.normal(0, 0.02, (8, 6)))
    res, by_first, by_second = prior.jacobians(truth.R_cw, truth.center_w, state)
    np.testing.assert_allclose(res, prior.residuals(truth.R_cw, truth.center_w, state))
    step, pair = 1e-6, 3
    for of, J in ((prior.first, by_first), (prior.second, by_second)):
        for unknown in range(18):
            moved = []
            for sign in (1.0, -1.0):
                R_cw, center_w, rates, changes = (
                    each.copy() for each in (truth.R_cw, truth.center_w, state.rates, state.changes)
                )
                d = np.zeros(18)
                d[unknown] = sign * step
                image = of[pair]
                R_cw[image] = Rotation.from_rotvec(d[:3]).as_matrix() @ R_cw[image]
                center_w[image] += d[3:6]
                rates[image] += d[6:12]
                changes[image] += d[12:]
                moved.append(prior.residuals(R_cw, center_w, replace(state, rates=rates, changes=changes))[pair])
            np.testing.assert_allclose(J[pair, :, unknown], (moved[0] - moved[1]) / (2 * step), rtol=5e-5, atol=5e-4)


def test_residuals_of_a_path_are_white() -> None:
    """A path that is drawn: acceleration by white noise, in small steps."""
    rng = np.random.default_rng(2)
    fine, frames = 200, 400
    noise, h = rng.normal(0, np.sqrt(1 / fine) * 0.3, (frames * fine, 3)), 1 / fine
    # each kick in the middle of its step, exactly from step to step
    changes = np.cumsum(noise, axis=0) - noise
    rates = np.cumsum(h * changes + h / 2 * noise, axis=0)
    rates -= h * changes + h / 2 * noise
    steps = h * rates + h**2 / 2 * changes + h**2 / 8 * noise
    centers = np.cumsum(steps, axis=0) - steps
    at = np.arange(0, frames * fine, fine)
    truth, _ = filmed(HandHeld(0), 2)
    names = [f"{k}.png" for k in range(frames)]
    rec = replace(
        truth, image_names=names, camera_idx=np.zeros(frames, int), R_cw=np.tile(np.eye(3), (frames, 1, 1)),
        center_w=centers[at], phi=np.zeros(0), velocity=np.zeros(0), variation=np.zeros(0), bend=np.zeros(0),
        bend_clock=np.zeros(0),
    )  # fmt: skip
    prior = PathPrior(FramePath({name: float(k) for k, name in enumerate(names)}, 1.0), rec, (1.0, 0.3))
    state = State(np.hstack([0 * rates[at], rates[at]]), np.hstack([0 * changes[at], changes[at]]), np.ones(1))
    res = prior.residuals(rec.R_cw, rec.center_w, state).reshape(-1, 3, 6)[:, :, 3:]
    covariance = np.cov(res.transpose(1, 0, 2).reshape(3, -1))
    np.testing.assert_allclose(covariance, np.eye(3), atol=0.15)


def true_path(hand: HandHeld, time: np.ndarray) -> CameraPath:
    """The path of a hand with its derivatives by differences."""
    h = 1e-4

    def rate(at: np.ndarray) -> np.ndarray:
        return (
            Rotation.from_matrix(hand.rotations(at + h)) * Rotation.from_matrix(hand.rotations(at - h)).inv()
        ).as_rotvec() / (2 * h)

    def velocity(at: np.ndarray) -> np.ndarray:
        return (hand.centers(at + h) - hand.centers(at - h)) / (2 * h)

    return CameraPath(
        time, hand.rotations(time), hand.centers(time), rate(time), velocity(time),
        (rate(time + h) - rate(time - h)) / (2 * h), (velocity(time + h) - velocity(time - h)) / (2 * h),
    )  # fmt: skip


def test_a_path_passes_through_its_moments_with_their_rates() -> None:
    hand = HandHeld(1)
    time = np.arange(10) * FRAME_S
    path = true_path(hand, time)
    R_cw, _ = poses_at(path, time)
    np.testing.assert_allclose(R_cw, hand.rotations(time), atol=1e-12)
    fine = np.linspace(time[0], time[-1], 200)
    R_cw, center_w = poses_at(path, fine)
    derivatives = np.stack([path.center_w, path.velocity, path.acceleration], axis=1)
    np.testing.assert_allclose(center_w, BPoly.from_derivatives(time, derivatives)(fine), atol=1e-12)
    # a tremor of 11 Hz at 30 frames a second
    apart = Rotation.from_matrix(R_cw @ hand.rotations(fine).transpose(0, 2, 1)).magnitude()
    assert apart.max() < 1e-4


def test_the_motion_of_a_frame_is_that_of_the_path_around_it() -> None:
    truth, times = filmed(HandHeld(2, tremor=0.01), 6)
    path = FramePath(times, FRAME_S, readout=(0.02, 1e-6))
    prior = PathPrior(path, truth, (0.01, 0.1))
    state = replace(prior.start(truth), pace=prior.pace_prior)
    bent = with_path_motions(truth, path, state)
    stated = orthogonal(bent)
    from rsundistort.bundle.path_prior import path_solution

    found = path_solution(truth, path, state, np.zeros(1)).path
    clock_s = 0.02 / truth.cameras[0].frame_span
    for image in (0, 2, 5):
        clock = np.linspace(*truth.cameras[0].clock_range, 9)
        R_cw, center_w = poses_at(found, found.time_s[image] + clock * clock_s)
        for rec in (bent, stated):
            poses = [rec.motion(image).pose_at(r, rec.R_cw[image], rec.center_w[image]) for r in clock]
            np.testing.assert_allclose([each[0] for each in poses], R_cw, atol=2e-6)
            np.testing.assert_allclose([each[1] for each in poses], center_w, atol=2e-6)


@pytest.mark.parametrize(
    ("seed", "readout"),
    [(0, 0.6), (2, -0.4), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((1, 0.25), (3, 0.0)))],
)
def test_the_readout_time_is_measured(seed: int, readout: float) -> None:
    truth, times = filmed(HandHeld(seed), 24, readout)
    result = adjusted(truth, times)
    assert result.path is not None
    share, sigma = result.path.readout_s / FRAME_S, result.path.sigma_readout_s / FRAME_S
    assert abs(share - readout) < 3 * sigma
    assert sigma < 0.02
    assert np.max(rotation_errors_deg(result.path.path.R_cw, truth.R_cw)) < 0.05


def test_a_camera_that_is_held_level_is_no_longer_critical() -> None:
    truth, times = filmed(HandHeld(4, level=True), 24)
    result = adjusted(truth, times)
    moved = result.reconstruction.points_w - result.reconstruction.points_w.mean(0)
    was = truth.points_w - truth.points_w.mean(0)
    # the height of the scene against its width, axis by axis
    stretch = np.linalg.norm(moved, axis=0) / np.linalg.norm(was, axis=0)
    assert len(moved) == len(was)
    assert abs(stretch[1] / stretch[0] - 1) < 0.003


@pytest.mark.slow
def test_the_normalised_error_of_the_readout_is_of_unit_variance() -> None:
    errors = []
    for seed in range(8):
        truth, times = filmed(HandHeld(20 + seed), 12, num_points=120)
        path = adjusted(truth, times).path
        assert path is not None
        errors.append(((path.readout_s - 0.6 * FRAME_S) / path.sigma_readout_s)[0])
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.7


def test_two_frames_suffice() -> None:
    truth, times = filmed(HandHeld(5, swing=3.0), 2, num_points=400, noise_px=0.1)
    result = adjusted(truth, times)
    assert result.path is not None
    assert abs(result.path.readout_s[0] / FRAME_S - 0.6) < 3 * result.path.sigma_readout_s[0] / FRAME_S


def test_a_path_is_not_joined_over_a_cut() -> None:
    truth, times = filmed(HandHeld(6), 12)
    part = {name: 40 * (k >= 6) for k, name in enumerate(truth.image_names)}  # those between have no frame here
    late = {name: time + 2.5 * part[name] for name, time in times.items()}
    result = adjusted(truth, late, part=part)
    assert result.path is not None
    assert abs(result.path.readout_s[0] / FRAME_S - 0.6) < 3 * result.path.sigma_readout_s[0] / FRAME_S
    np.testing.assert_array_equal(result.path.path.part, [0] * 6 + [40] * 6)


def test_a_frame_between_two_cuts_leaves_the_readout_time_to_the_others() -> None:
    """As of a flash, which no flow follows: nothing connects the frame with a path."""
    truth, times = filmed(HandHeld(6), 20)
    part = {name: (k > 8) + (k > 9) for k, name in enumerate(truth.image_names)}
    result, whole = adjusted(truth, times, part=part), adjusted(truth, times)
    assert result.path is not None
    assert whole.path is not None
    assert abs(result.path.readout_s[0] / FRAME_S - 0.6) < 3 * result.path.sigma_readout_s[0] / FRAME_S
    assert result.path.sigma_readout_s[0] < 2 * whole.path.sigma_readout_s[0]


def test_a_known_readout_time_is_believed() -> None:
    truth, times = filmed(HandHeld(7), 10)
    result = adjusted(truth, times, readout=(0.6 * FRAME_S, 1e-7))
    assert result.path is not None
    assert result.path.readout_s[0] == pytest.approx(0.6 * FRAME_S, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frame_s": 0.0}, "frame_s"),
        ({"readout": (0.02, 0.0)}, "readout"),
        ({"time_s": {"000000.png": 0.0}}, "no time of"),
        ({"time_s": {f"{k:06d}.png": 1.0 for k in range(6)}}, "same time"),
    ],
)
def test_a_path_that_cannot_be_is_refused(change: dict[str, object], says: str) -> None:
    truth, times = filmed(HandHeld(8), 6)
    stated = {"time_s": times, "frame_s": FRAME_S, **change}
    with pytest.raises(InputError, match=says):
        bundle_adjust(truth, "constant-motion", BundleOptions(path=FramePath(**stated)))  # type: ignore[arg-type]


def test_frames_on_a_path_move_by_constant_motion() -> None:
    truth, times = filmed(HandHeld(8), 6)
    with pytest.raises(InputError, match="constant-motion"):
        bundle_adjust(truth, "rotation", BundleOptions(path=FramePath(times, FRAME_S)))


def test_a_camera_that_only_rotates_tells_the_readout_time() -> None:
    truth, times = filmed(HandHeld(9, walks=False), 24)
    directions = truth.points_w / np.linalg.norm(truth.points_w, axis=1)[:, None]
    start = replace(truth, points_w=directions)
    result = bundle_adjust(start, "constant-motion", BundleOptions(path=FramePath(times, FRAME_S, rotation_only=True)))
    assert result.path is not None
    assert abs(result.path.readout_s[0] / FRAME_S - 0.6) < 3 * result.path.sigma_readout_s[0] / FRAME_S
    assert result.path.sigma_readout_s[0] / FRAME_S < 0.02
    assert np.max(rotation_errors_deg(result.path.path.R_cw, truth.R_cw)) < 0.05
    assert not result.reconstruction.center_w.any()
    assert not result.reconstruction.velocity.any()


def test_a_gyroscope_says_what_the_rates_are() -> None:
    hand = HandHeld(10)
    truth, times = filmed(hand, 10, num_points=60)
    rate = true_path(hand, np.array([*times.values()])).rate
    known = {name: (rate[k], 1e-4) for k, name in enumerate(times)}
    alone, together = adjusted(truth, times).path, adjusted(truth, times, rates=known).path
    assert alone is not None
    assert together is not None
    np.testing.assert_allclose(together.path.rate, rate, atol=1e-3)
    assert together.sigma_readout_s[0] < alone.sigma_readout_s[0]
    assert abs(together.readout_s[0] / FRAME_S - 0.6) < 3 * together.sigma_readout_s[0] / FRAME_S


def test_each_frame_says_its_own_rotation_and_pose() -> None:
    truth, times = filmed(HandHeld(11), 16, noise_px=0.2)
    on_path = adjusted(truth, times).reconstruction

    def apart(found: OwnMotions) -> tuple[float, float]:
        rotated = Rotation.from_matrix(found.R_cw @ on_path.R_cw.transpose(0, 2, 1)).as_rotvec()
        by_sigma = (found.phi - on_path.phi) / found.sigma_phi, rotated / found.sigma_rotation
        phi, rotation = (float(np.sqrt(np.mean(each**2))) for each in by_sigma)
        return phi, rotation

    phi, rotation = apart(own_motions(on_path))
    # the same measurements make the path
    assert 0.3 < phi < 1.2
    assert 0.3 < rotation < 1.2
    straight = replace(on_path, bend=np.zeros((on_path.num_images, 0, 6)))
    assert apart(own_motions(straight))[0] > 1.5 * phi  # as of frames that rotate steadily while they are read


def test_frames_say_their_rotations_from_a_start_that_knows_none() -> None:
    truth, times = filmed(HandHeld(11), 16, noise_px=0.2)
    result = adjusted(truth, times)
    expected = own_motions(result.reconstruction)
    found = own_motions(truth)  # the true points, but no motions
    assert not truth.phi.any()
    # the shape of the scene is another one, and with it what all have in common
    differences = np.diff(found.phi - expected.phi, axis=0) / np.hypot(found.sigma_phi[1:], found.sigma_phi[:-1])
    assert np.sqrt(np.mean(differences**2)) < 2.0
    assert np.median(np.abs(np.diff(expected.phi, axis=0) / expected.sigma_phi[1:])) > 5


@dataclass(frozen=True)
class Shaken(HandHeld):
    """By a motor as well."""

    hz: float = 70.0

    def rotations(self, time_s):
        angle = 2 * np.pi * self.hz * np.asarray(time_s)[:, None] + [0.0, 1.0, 2.0]
        return Rotation.from_rotvec(0.01 * np.sin(angle)).as_matrix() @ super().rotations(time_s)


def test_a_vibration_beyond_the_frame_rate_is_distinguished_from_a_hand() -> None:
    for hand, least, most in ((HandHeld(0), 0.0, 0.2), (Shaken(1), 1.0, np.inf)):
        truth, times = filmed(hand, 20)
        found = adjusted(truth, times).reconstruction
        assert least <= unfollowed_px(found, own_motions(found)) <= most


@dataclass(frozen=True)
class OnlyShaken(HandHeld):
    """A camera that does not rotate but by a motor, at more than half of the frame rate."""

    def rotations(self, time_s):
        angle = 2 * np.pi * 17.0 * np.asarray(time_s)[:, None] + [0.0, 1.0, 2.0]
        return Rotation.from_rotvec(0.01 * np.sin(angle)).as_matrix()


def test_lines_that_rotate_against_their_frames_are_doubted() -> None:
    for hand, readout in ((OnlyShaken(1), 0.6), (HandHeld(0), -0.6)):
        found = adjusted(*filmed(hand, 30, readout))
        assert found.path is not None
        assert found.path.readout_s[0] < 0
        verdict = judge_clip(found, found, None, FRAME_S)
        assert verdict.shape == "doubtful"
        assert any("the last line is read first" in reason for reason in verdict.reasons)


def test_a_path_is_doubted_that_slow_rotations_or_a_gyroscope_contradict() -> None:
    found = adjusted(*filmed(HandHeld(0), 20))
    assert found.path is not None
    time = ReadoutTime(float(found.path.readout_s[0]), float(found.path.sigma_readout_s[0]))

    def reasons(**evidence: Any) -> tuple[str, ...]:
        return judge_clip(found, found, frame_s=FRAME_S, **{"halves": None} | evidence).reasons

    slow = ReadoutTime(time.seconds - 2 * time.sigma, time.sigma)
    assert reasons() == reasons(speeds=(slow, time)) == reasons(rotation_ratio=0.97)
    slow = ReadoutTime(time.seconds - 5 * time.sigma, time.sigma)
    assert any("by slow rotations alone" in reason for reason in reasons(speeds=(slow, time)))
    late, later = (ReadoutTime(time.seconds + k * time.sigma, time.sigma) for k in (3, 5))
    assert reasons() == reasons(halves=(late, ReadoutTime(time.seconds - 0.5 * time.sigma, time.sigma)))
    assert any("by its halves" in reason for reason in reasons(halves=(late, later)))
    assert reasons() == reasons(share_that_fits=0.95)
    assert any("fit only 75 % of what key frames share" in reason for reason in reasons(share_that_fits=0.75))
    assert any("rotations leave 0.3 px" in reason for reason in reasons(travel_px=0.3))
    f = found.reconstruction.cameras[0].K[0, 0]
    assert any(f"by it the focal length is {0.92 * f:.0f} px" in reason for reason in reasons(rotation_ratio=0.92))


def test_frames_are_not_bent_by_a_readout_that_cannot_be() -> None:
    truth, times = filmed(HandHeld(0), 20)
    found = adjusted(truth, times)  # of 20 ms
    assert judge_clip(found, found, None, FRAME_S).shutter == "found"
    verdict = judge_clip(found, found, None, 0.01)
    assert verdict.shutter == "not-determined"
    assert verdict.lens_only == tuple(truth.image_names)
    assert "longer than the 10.0 ms from frame to frame" in verdict.reasons[0]
    # at its bound and hardly known, it is the bound
    assert found.path is not None
    path = replace(found.path, unbounded_s=np.array([1.2 * FRAME_S]), sigma_readout_s=np.array([0.15 * FRAME_S]))
    assert judge_clip(replace(found, path=path), found, None, FRAME_S).shutter == "not-determined"


@dataclass(frozen=True)
class Steady(HandHeld):
    """A camera on a tripod that pans by a twentieth of a degree from frame to frame."""

    walks: bool = False

    def rotations(self, time_s):
        return Rotation.from_rotvec(0.001 * 30 * np.asarray(time_s)[:, None] * [0.0, 1.0, 0.0]).as_matrix()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_readout_longer_than_the_time_between_frames_is_bounded_and_not_determined(sign: int) -> None:
    truth, times = filmed(Steady(), 20)
    start = replace(truth, points_w=truth.points_w / np.linalg.norm(truth.points_w, axis=1)[:, None])
    obs = truth.observations
    # lines that are shifted as if the camera panned ten times as fast, or the other way, while it is read
    skewed = obs.xy_raw + sign * 0.012 * (obs.xy_raw[:, 1:] - 240) * [1.0, 0.0]
    path = FramePath(times, FRAME_S, rotation_only=True)
    found = bundle_adjust(
        replace(start, observations=replace(obs, xy_raw=skewed)), "constant-motion", BundleOptions(path=path)
    )
    assert found.path is not None
    assert abs(found.path.readout_s[0]) < 1.15 * FRAME_S
    assert abs(found.path.unbounded_s[0]) > abs(found.path.readout_s[0])
    assert found.path.sigma_readout_s[0] > 0.1 * FRAME_S  # the bound says nothing of where within it
    assert found.num_iterations < 60
    assert judge_clip(found, found, None, FRAME_S).shutter == "not-determined"


def test_standard_deviations_of_a_readout_within_its_bound_know_nothing_of_it() -> None:
    truth, times = filmed(HandHeld(3), 20, readout=0.99)
    found = adjusted(truth, times).path
    assert found is not None
    assert abs(found.unbounded_s[0] - 0.99 * FRAME_S) < 3 * found.sigma_readout_s[0]
    # one that is given may be longer
    longer = adjusted(truth, times, readout=(1.5 * FRAME_S, 1e-6)).path
    assert longer is not None
    np.testing.assert_allclose(longer.readout_s, 1.5 * FRAME_S, rtol=1e-3)


@pytest.mark.slow
def test_halves_of_a_video_ask_for_their_own_readout_times_though_they_begin_at_that_of_the_whole() -> None:
    hand = HandHeld(4)
    (first, times), (second, _) = (filmed(hand, 32, readout=share, num_points=150) for share in (0.4, 0.7))
    place = {tuple(point): i for i, point in enumerate(first.points_w)}
    same = np.array([place.get(tuple(point), -1) for point in second.points_w])
    a, b = first.observations, second.observations
    early, late = a.frame_idx < 16, (b.frame_idx >= 16) & (same[b.point_idx] >= 0)
    both = Observations(
        *(
            np.concatenate([of_a[early], of_b[late]])
            for of_a, of_b in (
                (a.frame_idx, b.frame_idx), (a.point_idx, same[b.point_idx]), (a.xy_raw, b.xy_raw),
            )
        )
    )  # fmt: skip
    truth = replace(first, observations=both).with_points(np.ones(len(both), bool))
    found = readouts_of_halves(adjusted(truth, times), BundleOptions(path=FramePath(times, FRAME_S)))
    assert found is not None
    for half, share in zip(found, (0.4, 0.7), strict=True):
        assert abs(half.seconds / FRAME_S - share) < 3 * half.sigma / FRAME_S
        assert half.sigma < 0.03 * FRAME_S


def test_the_state_of_a_path_gives_the_motions() -> None:
    state = State(np.arange(12.0).reshape(2, 6), np.zeros((2, 6)), np.array([0.5, 2.0]))
    cameras, same = np.array([1, 0]), np.zeros((2, 3))
    np.testing.assert_array_equal(state.motions(cameras, same), [np.arange(6) * 2.0, np.arange(6, 12) * 0.5])


def test_covariances_of_a_path_hold_one_factor_at_a_time() -> None:
    """Memory of long clips: the system, a copy with other priors, and a factor with what becomes its inverse."""
    truth, times = filmed(HandHeld(3), 60)
    options = BundleOptions(path=FramePath(times, FRAME_S))
    problem = BundleProblem(truth, "constant-motion", options, 0.2, PriorSigmas(0.03, 0.03, path=(0.02, 0.3)))
    equations = problem.linearize(problem.initial_state())
    equations.marginal_covariances()  # compiles
    equations = problem.linearize(problem.initial_state())
    system = equations._reduced.S.nbytes
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    equations.marginal_covariances()
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    factor = equations.inverse.photos.data.nbytes
    assert "_reduced" not in vars(equations)
    assert peak < 1.2 * (system + 2 * factor)


@pytest.mark.parametrize("amount", [0.01, 0.1])
def test_a_lens_that_focuses_or_zooms_is_no_motion(amount: float) -> None:
    """Lines take the same time whatever the focal length is: the oracle projects each line from its own pose."""
    zoom = 1.0 + amount * np.sin(np.arange(24) / 4.0)
    truth, times = filmed(HandHeld(5), 24, 0.6, zoom=zoom)
    start = replace(truth, variation=np.zeros((24, 3)))
    options = BundleOptions(path=FramePath(times, FRAME_S), varying=True)
    result = bundle_adjust(start, "constant-motion", options)
    assert result.path is not None
    share, sigma = result.path.readout_s / FRAME_S, result.path.sigma_readout_s / FRAME_S
    assert abs(share - 0.6) < 3 * sigma
    assert sigma < 0.02
    off = result.reconstruction.variation[:, 0] - np.log(zoom)
    assert np.std(off) < 0.001
    assert (result.reconstruction.variation[:, 1:] == 0).all()
    assert abs(result.focal_sigma / np.std(np.log(zoom)) - 1.0) < 0.3
    assert result.centre_sigma == 0.0
    assert np.max(rotation_errors_deg(result.path.path.R_cw, truth.R_cw)) < 0.05
    # each frame by itself says the same
    own = own_motions(result.reconstruction)
    turned = own.phi * result.reconstruction.frame_span()[:, None]
    rates = result.path.state.rates[:, :3] * share
    assert np.nanmedian(np.abs(turned - rates) / own.sigma_phi / result.reconstruction.frame_span()[:, None]) < 1.5


def test_the_jacobians_of_a_lens_that_zooms_are_those_of_differences() -> None:
    truth, times = filmed(HandHeld(3), 6, 0.6, noise_px=0.0, zoom=np.linspace(0.9, 1.2, 6))
    options = BundleOptions(path=FramePath(times, FRAME_S), varying=True, loss="squared")
    problem = BundleProblem(truth, "constant-motion", options, 0.3, PriorSigmas(0.1, 0.1, path=(0.01, 0.1)))
    state = problem.initial_state()
    rng, m = np.random.default_rng(1), truth.num_images
    nothing = np.zeros((m, 19)), np.zeros_like(state.points_w), np.zeros((1, 1))
    away = rng.normal(0, 1e-3, (m, 19)), rng.normal(0, 0.01, state.points_w.shape), np.array([[1e-3]])
    state = problem.retract(state, away)
    gradient = problem.linearize(state)._g_frame
    for unknown in (0, 4, 7, 10, 12):
        costs = []
        for sign in (1.0, -1.0):
            frame = nothing[0].copy()
            frame[2, unknown] = sign * 1e-5
            costs.append(problem.cost(problem.retract(state, (frame, *nothing[1:]))))
        np.testing.assert_allclose(gradient[2, unknown], (costs[0] - costs[1]) / 2e-5, rtol=2e-3)
