"""Means of the motions of a camera's photos, which are solved for: the linear system, and what they are for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import (
    INFORMATION,
    dense_system,
    gradients,
    make_scene,
    perturbed,
    scaled,
    unit_steps,
    weights_of_motions,
)
from numpy_reference import project
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, bundle_adjust
from rsundistort.bundle import Posterior
from rsundistort.bundle.common_motion import LEAST_PHOTOS, MeansPrior, prior_of_means
from rsundistort.bundle.doubt import Doubt
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.synthetic import look_at

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")

MODEL = "constant-motion"
MEANS = (
    0.2,
    0.1,
    0.05,
    0.1,
    0.2,
    0.05,
    0.15,
    0.1,
)  # of travels along each axis, of such that aim, of any, and from photo to photo
# Freedom of motions whose size is known as well as if so many numbers told it.
KNOWN_SIZE = 1e12


def shared_problem(rng, refine=(), factor_limit=1e10, num_images=9):
    """Photos of a camera that has a mean, and a last one of another, which has none."""
    scene = make_scene(rng, MODEL, num_images=num_images, num_points=30, noise_px=1.0)
    scene = replace(scene, cameras=scene.cameras[:2], camera_idx=np.arange(num_images) // (num_images - 1))
    start = replace(perturbed(scene, rng, 0.01, 0.02), phi=scene.phi, velocity=scene.velocity)
    options = BundleOptions(loss="squared", factor_limit=factor_limit, cg_tolerance=1e-13, refine=refine)
    means = MeansPrior(covariance_of_ways(start.typical_depth), 0.3)
    problem = BundleProblem(start, MODEL, options, 0.5, PriorSigmas(0.03, 0.1, means=means))
    state = problem.initial_state()
    return problem, replace(state, means=state.means + 0.1 * rng.normal(size=state.means.shape))


def on_the_way(rec):
    """(m, 6, 2) motions by a baseline at most from the photo before to the one after: travels, and rotations, too."""
    motions = np.zeros((rec.num_images, 6, 2))
    for i, camera in enumerate(rec.camera_idx):
        same = [k for k in range(rec.num_images) if rec.camera_idx[k] == camera]
        at = same.index(i)
        steps = []
        for before, after in zip(same[max(at - 1, 0) : at + 2], same[max(at - 1, 0) + 1 : at + 2], strict=False):
            rotation = Rotation.from_matrix(rec.R_cw[after] @ rec.R_cw[before].T).as_rotvec()
            steps.append(np.concatenate([rotation, rec.center_w[after] - rec.center_w[before]]))
        if steps:
            motions[i, :, 1] = np.mean(steps, axis=0)
            motions[i, :, 1] /= max(np.linalg.norm(motions[i, 3:, 1]), rec.baseline)
            motions[i, 3:, 0] = motions[i, 3:, 1]
    return motions


def whole_system(problem, state):
    """Hessian and gradient of photos, points, and of the intrinsics and means of each camera, from residuals."""
    H, g, free = dense_system(problem, state)
    m, nb = problem._free.shape
    cameras, nr = len(state.cameras), len(problem._refine)
    nc = nr + 8
    first = m * nb + 3 * problem._start.num_points
    place = np.concatenate([np.arange(first), *(first + c * nc + np.arange(nr) for c in range(cameras))])
    rows_of_priors = 6 * m + 8 * cameras
    J, res = np.zeros((rows_of_priors, first + cameras * nc)), np.zeros(rows_of_priors)
    span, motion = problem._start.frame_span(), np.hstack([state.phi, state.velocity])
    T, own, on_way = np.zeros((m, 6, 8)), motion.copy(), on_the_way(problem._start)
    for i in np.flatnonzero(problem._start.camera_idx == 0):
        T[i, :3, :3], T[i, 3:, 3:6] = np.eye(3) / span[i], problem._start.R_cw[i].T / span[i]
        T[i, :, 6:] = on_way[i] / span[i]
        own[i] -= T[i] @ problem.means.values(state.means)[0]
        T[i] = T[i] @ problem.means.root
    sqrt_weight = np.sqrt(weights_of_motions(problem, own))
    for i in range(m):
        rows = slice(6 * i, 6 * i + 6)
        root = np.sqrt(INFORMATION) * sqrt_weight[i]
        J[rows, i * nb + 6 : i * nb + 12] = np.diag(root)
        if problem._start.camera_idx[i] == 0:
            J[rows, first + nr : first + nc] = -root[:, None] * T[i]
        res[rows] = sqrt_weight[i] * own[i] / np.sqrt(INFORMATION)  # the gradient's weight is the whole one
    for c in range(cameras):
        rows = slice(6 * m + 8 * c, 6 * m + 8 * c + 8)
        J[rows, first + c * nc + nr : first + (c + 1) * nc] = np.eye(8)
        res[rows] = state.means[c]
    wide, gradient = J.T @ J, J.T @ res
    # the dense system has the priors of motions without means already
    weight = np.hstack([np.zeros((m, 6)), weights_of_motions(problem, motion)])
    H[: m * nb, : m * nb] -= np.diag(INFORMATION * weight.ravel())
    g[: m * nb] -= (weight * np.hstack([np.zeros((m, 6)), motion])).ravel()
    wide[np.ix_(place, place)] += H
    gradient[place] += g
    return wide, gradient, np.concatenate([free[:first], np.ones(cameras * nc, bool)])


@pytest.mark.parametrize("refine", [(), ("f", "k1")], ids=["calibrated", "refined"])
@pytest.mark.parametrize("factor_limit", [1e10, -1], ids=["factored", "conjugate gradients"])
@pytest.mark.parametrize("damping", [0.0, 1e-2])
def test_means_join_the_system(damping, factor_limit, refine, rng):
    problem, state = shared_problem(rng, refine, factor_limit)
    H, g, free = whole_system(problem, state)
    seen = np.diag(dense_system(problem, state)[0])
    D = np.zeros(len(H))
    m, nb = problem._free.shape
    first, nc, nr = m * nb + 3 * problem._start.num_points, len(refine) + 8, len(refine)
    D[:first] = np.diag(H)[:first]  # means are not damped: their priors hold them
    for c in range(2):
        D[first + c * nc : first + c * nc + nr] = seen[first + c * nr : first + (c + 1) * nr]
    damped = H + damping * np.diag(D)
    scale = 1 / np.sqrt(np.diag(damped)[free])
    inverse = scale[:, None] * np.linalg.inv(scale[:, None] * damped[np.ix_(free, free)] * scale) * scale
    expected = np.zeros(len(g))
    expected[free] = -inverse @ g[free]
    equations = problem.linearize(state)
    assert equations.cost == pytest.approx(problem.cost(state), rel=1e-12)
    parts, predicted = equations.solve(damping)
    step = np.concatenate([part.ravel() for part in parts])
    np.testing.assert_allclose(step, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert predicted == pytest.approx(-(g @ expected + 0.5 * expected @ H @ expected), rel=1e-7)


def test_the_gradient_of_means_equals_central_differences_of_the_cost(rng):
    problem, state = shared_problem(rng)
    equations, h = problem.linearize(state), 1e-5
    for kind, index, step in unit_steps(problem, state):
        if kind == 2 or (kind == 0 and index[0] in (0, 8)):
            ahead, behind = (problem.cost(problem.retract(state, scaled(step, s))) for s in (h, -h))
            gradient = gradients(equations)[kind]
            assert abs((ahead - behind) / (2 * h) - gradient[index]) <= 1e-6 * np.abs(gradient).max()


def test_covariances_with_means_are_those_of_the_whole_inverse(rng):
    problem, state = shared_problem(rng, ("f",))
    H, _, free = whole_system(problem, state)
    equations = problem.linearize(state)
    scale = 1 / np.sqrt(np.diag(H)[free])
    whole = np.zeros_like(H)
    whole[np.ix_(free, free)] = scale[:, None] * np.linalg.inv(scale[:, None] * H[np.ix_(free, free)] * scale) * scale
    m, nb = problem._free.shape
    marginals = equations.marginal_covariances()
    expected = np.array([whole[nb * i : nb * i + nb, nb * i : nb * i + nb] for i in range(m)])
    size = np.sqrt(np.einsum("iaa,ibb->iab", expected, expected))
    np.testing.assert_array_less(np.abs(marginals.photos - expected), 1e-7 * size + 1e-300)
    k = len(marginals.cameras)
    np.testing.assert_allclose(marginals.cameras, whole[-k:, -k:], rtol=0, atol=1e-7 * np.abs(whole[-k:, -k:]).max())
    vector = rng.normal(size=(1, m, nb))
    reference = (whole[: m * nb, : m * nb] @ vector.ravel()).reshape(m, nb)
    np.testing.assert_allclose(equations.covariance(vector)[0], reference, atol=1e-7 * np.abs(reference).max())
    shared = np.array([whole[nb * i : nb * i + nb, -k + 1 : -k + 9] for i in range(m - 1)])
    np.testing.assert_allclose(equations.photos_by_shared(8)[:-1], shared, atol=1e-7 * np.abs(shared).max())
    # the priors' share, H^-1 P H^-1: P is what is left without measurements
    J = measured_rows(problem, state, len(H), 1)
    P = H - J.T @ J
    share = whole @ P @ whole
    reference = (share[: m * nb, : m * nb] @ vector.ravel()).reshape(m, nb)
    # of deviations twice as large, but for the priors' share, that is four times less three times
    by_priors = (4.0 * equations.covariance(vector) - equations.covariance(vector, 2.0)) / 3.0
    np.testing.assert_allclose(by_priors[0], reference, atol=1e-6 * np.abs(reference).max())
    of_photos = np.array([share[nb * i : nb * i + nb, nb * i : nb * i + nb] for i in range(m)])
    np.testing.assert_allclose(marginals.photos_of_priors, of_photos, atol=2e-4 * np.abs(of_photos).max())
    weights = rng.normal(size=(problem._start.num_points, 3))
    found = equations.function_of_points(problem.in_order(weights))
    b = np.zeros(len(H))
    b[m * nb : m * nb + weights.size] = weights[problem.structure.points].ravel()
    assert found.variance == pytest.approx(b @ whole @ b, rel=1e-7)
    assert found.of_priors == pytest.approx(b @ share @ b, rel=1e-6)


def measured_rows(problem, state, size, nr):
    """Jacobian (2 o, size) of the measurements alone."""
    _, J_frame = problem.blocks(state)
    J_camera = problem._camera_jacobians(state)
    obs = problem._start.observations.select(problem.structure.order)
    m, nb = problem._free.shape
    first = m * nb + 3 * problem._start.num_points
    J = np.zeros((len(obs), 2, size))
    for k in range(len(obs)):
        f, p = nb * obs.frame_idx[k], m * nb + 3 * obs.point_idx[k]
        c = first + (nr + 8) * problem._start.camera_idx[obs.frame_idx[k]]
        J[k, :, f : f + nb], J[k, :, p : p + 3] = J_frame[k], -J_frame[k, :, 3:6]
        J[k, :, c : c + nr] = J_camera[k]
    return J.reshape(-1, size)


def covariance_of_ways(depth, sigmas=MEANS):
    """Covariance of the prior on means, as `MeansPrior.of_ways` says it in words."""
    total = np.diag([0.0] * 6 + [sigmas[5] ** 2, sigmas[6] ** 2])
    total[:6, :6] = sigmas[7] ** 2 * np.diag([depth**-2] * 3 + [1.0] * 3)
    for axis in range(3):
        travel = np.eye(3)[axis]
        total[:6, :6] += sigmas[axis] ** 2 * np.outer(*[np.concatenate([np.zeros(3), travel])] * 2)
        if axis < 2:
            # x_c changes by phi x x_c less the travel: at (0, 0, depth) by nothing
            phi = np.cross([0.0, 0.0, 1.0], travel) / depth
            np.testing.assert_allclose(np.cross(phi, [0.0, 0.0, depth]), travel, atol=1e-15)
            total[:6, :6] += sigmas[3 + axis] ** 2 * np.outer(*[np.concatenate([phi, travel])] * 2)
    return total


def test_at_first_cameras_travel_aim_or_do_as_they_like(rng):
    prior = MeansPrior.of_ways(0.2, 3.0)
    expected = covariance_of_ways(3.0, (0.2 / np.sqrt(8),) * 8)
    np.testing.assert_allclose(prior.covariance, expected, atol=1e-12 * expected.max())
    # lengths in another unit
    again = MeansPrior.of_ways(0.1, 1.5).covariance
    np.testing.assert_allclose(prior.scaled(0.5).covariance, again, atol=1e-12 * again.max())
    assert (prior.probability, prior.odds_against) == (0.0, 0.0)
    assert not prior.differs(MeansPrior(1.3 * expected), 0.2)
    assert prior.differs(MeansPrior(1.7 * expected), 0.2)


def test_unknowns_of_means_have_standard_normal_priors(rng):
    problem, state = shared_problem(rng)
    root, expected = problem.means.root, covariance_of_ways(problem._start.typical_depth)
    np.testing.assert_allclose(root @ root.T, expected, atol=1e-12 * expected.max())
    values = problem.means.values(state.means)
    np.testing.assert_allclose(problem.means.unknowns(values), state.means, atol=1e-10)


def shown(rng, motion, exactness, under):
    """What is found of a mean that is measured with a precision (8, 8), under a prior of covariance (8, 8)."""
    measured = motion + np.linalg.solve(np.linalg.cholesky(exactness).T, rng.normal(size=8))
    root = np.linalg.cholesky(under)
    covariance = np.linalg.inv(root.T @ exactness @ root + np.eye(8))
    return (covariance @ root.T @ exactness @ measured)[None], covariance[None], root


def averaged(depth, velocity, exactness, measured):
    """What the mean of models makes of measured means, as a matrix, and how likely photos share a motion.

    By the densities of what was measured.
    """
    noise = np.linalg.inv(exactness)
    ways = [covariance_of_ways(depth, velocity * np.eye(8)[k]) for k in range(8)]
    log_density = [multivariate_normal.logpdf(measured, cov=noise + way) for way in (np.zeros((8, 8)), *ways)]
    density = np.exp(np.array(log_density) - np.max(log_density)) * [8.0, *[1.0] * 8]
    of_ways = np.maximum((density / density.sum())[1:], 1e-4)  # each can still be asked
    slab = np.einsum("k,kab->ab", of_ways / of_ways.sum(), ways)
    probability = min(of_ways.sum(), 1.0)
    return probability * slab @ np.linalg.inv(slab + noise), probability


@pytest.mark.parametrize("of", [None, *range(8)])
def test_the_prior_of_means_gives_the_mean_of_none_and_of_all_ways_to_move(of, rng):
    depth, velocity, num = 4.0, 0.05, 60
    # a yaw and a travel sideways that show the same are measured five times less exactly than the others
    exactness = np.diag([depth**2] * 3 + [1.0] * 5) / 0.0025**2
    weak = np.array([0.0, 1.0 / depth, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    weak /= np.sqrt(weak @ exactness @ weak)
    exactness -= 0.96 * np.outer(exactness @ weak, exactness @ weak)
    likely = []
    for _ in range(num):
        motion = np.zeros(8)
        if of is not None:
            motion = np.linalg.cholesky(covariance_of_ways(depth, velocity * np.eye(8)[of] + 1e-9)) @ rng.normal(size=8)
        under = covariance_of_ways(depth, velocity * rng.uniform(0.01, 1, 8))
        u, covariance, root = shown(rng, motion, exactness, under)
        measured = np.linalg.solve(exactness, np.linalg.solve(root.T, np.linalg.solve(covariance[0], u[0])))
        found = prior_of_means(u, covariance, root, velocity, depth, KNOWN_SIZE)
        expected, probability = averaged(depth, velocity, exactness, measured)
        assert found.probability == pytest.approx(probability, abs=1e-6)
        W = found.covariance
        by_prior = W @ exactness @ np.linalg.inv(np.eye(8) + W @ exactness) @ measured
        size = np.sqrt(np.diag(np.linalg.inv(exactness)))
        np.testing.assert_allclose(by_prior / size, expected @ measured / size, atol=1e-5)
        likely.append(found.probability)
    mean = np.mean(likely)  # at first one half; which weak yaw or travel it was hardly shows
    assert mean < 0.35 if of is None else mean > 0.5


def test_the_prior_of_means_can_be_factored_however_exact_measurements_are(rng):
    depth, motion = 4.0, np.zeros(8)
    for exactness in (1e16 * np.eye(8), np.diag([1e20] * 3 + [1e-6] * 5), np.diag([1e-6] * 7 + [1e20])):
        under = covariance_of_ways(depth, (0.05,) * 8)
        prior = prior_of_means(*shown(rng, motion, exactness, under), 0.05, depth, KNOWN_SIZE)
        root = np.linalg.cholesky(prior.covariance)
        np.testing.assert_allclose(root @ root.T, prior.covariance, rtol=1e-9, atol=1e-12 * prior.covariance.max())


def test_the_prior_of_means_does_not_depend_on_that_under_which_they_were_found(rng):
    exactness = np.linalg.inv(np.diag([0.01] * 3 + [0.05] * 5) ** 2 * (np.eye(8) + 0.5))
    found = []
    for sigmas in (
        (0.1,) * 8,
        (0.02, 1e-3, 0.3, 0.1, 0.1, 0.01, 0.2, 0.1),
        (0.3, 0.1, 3e-3, 0.01, 0.1, 0.1, 1e-3, 0.2),
    ):
        each = shown(np.random.default_rng(5), np.full(8, 0.01), exactness, covariance_of_ways(4.0, sigmas))
        found.append(prior_of_means(*each, 0.1, 4.0, KNOWN_SIZE))
    for each in found[1:]:
        np.testing.assert_allclose(each.covariance, found[0].covariance, rtol=1e-6, atol=1e-12)
        assert each.probability == pytest.approx(found[0].probability, rel=1e-8)


def test_not_knowing_whether_photos_share_a_motion_is_part_of_their_deviations(rng):
    problem, state = shared_problem(rng, ("f",))
    H, _, free = whole_system(problem, state)
    scale = 1 / np.sqrt(np.diag(H)[free])
    whole = np.zeros_like(H)
    whole[np.ix_(free, free)] = scale[:, None] * np.linalg.inv(scale[:, None] * H[np.ix_(free, free)] * scale) * scale
    rec, (m, nb) = problem._start, problem._free.shape
    off = rng.normal(size=state.means.shape)
    as_likely_as_not = MeansPrior(np.eye(8), 0.5)  # the mean is then off by itself
    doubt = Doubt.of(problem.linearize(state), BundleOptions(refine=("f",)), rec, prior=as_likely_as_not, means=off)
    first = m * nb + 3 * rec.num_points
    last = np.concatenate([first + 9 * c + 1 + np.arange(8) for c in range(2)])
    # all else as it is most likely if the means are off by so much
    expected = whole[:, last] @ np.linalg.solve(whole[np.ix_(last, last)], off.ravel())
    np.testing.assert_allclose(doubt.photos[0], expected[: m * nb].reshape(m, nb), atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(doubt.cameras[0], expected[first:], atol=1e-6 * np.abs(expected).max())
    assert MeansPrior(np.eye(8), 0.2).odds_against == pytest.approx(4.0)


def test_a_motion_in_common_does_not_make_itself_likely(rng):
    # photos that share nothing: if they are believed to, what they move by of their own seems smaller
    photos, depth, travel, likely = 3, 1.0, 0.15, []
    freedom = 6.0 * photos
    for _ in range(200):
        x = 0.05 * rng.normal(size=(photos, 6))
        for believed in (0.0, 1.0):
            sigma = np.sqrt(((x - believed * x.mean(0)) ** 2).sum() / freedom)
            exactness = np.diag([photos / sigma**2] * 6 + [1e-6] * 2)
            root = np.linalg.cholesky(covariance_of_ways(depth, np.full(8, 1e-5 + believed)))
            covariance = np.linalg.inv(root.T @ exactness @ root + np.eye(8))
            unknowns = covariance @ root.T @ exactness @ np.append(x.mean(0), [0.0, 0.0])
            for of in (KNOWN_SIZE, freedom):
                prior = prior_of_means(unknowns[None], covariance[None], root, travel, depth, of)
                likely.append(prior.probability)
    unsure, of_unknown_size, sure, of_unknown_size_believed = np.array(likely).reshape(-1, 4).T
    # 0.045 of them are sure; what belief changes is 0.10 in the mean, 0.024 if their size is unknown
    assert (sure > 0.99).mean() > 0.02
    assert not (of_unknown_size_believed > 0.99).any()
    changes = abs(sure - unsure).mean(), abs(of_unknown_size_believed - of_unknown_size).mean()
    assert changes[1] < 0.4 * changes[0]


def test_cameras_of_few_photos_share_nothing(rng):
    for num_images, shares in ((LEAST_PHOTOS, False), (LEAST_PHOTOS + 1, True)):
        problem, _ = shared_problem(rng, num_images=num_images)
        means = problem.initial_state().means
        assert means.shape == (2, 8 if shares else 0)
        if shares:
            assert problem.shares[:-1].all()
            assert not problem.shares[-1].any()
            assert means.any(1).tolist() == [True, False]


def aimed(rng, turns, photos=14):
    """Photos on an orbit of radius 4 around a thing of 1.3, that travel by 0.05 along it while they are read.

    They rotate with the orbit, so that they stay aimed, or not at all; and a little each for itself.
    """
    camera = Camera(1600, 1200, [[1300, 0, 800], [0, 1300, 600], [0, 0, 1]], [], "top-to-bottom")
    angle = np.linspace(0, 2 * np.pi, photos, endpoint=False) + 0.03 * rng.normal(size=photos)
    center_w = np.column_stack([4 * np.sin(angle), -4 * np.cos(angle), 0.6 + 0.5 * rng.normal(size=photos)])
    points_w = rng.uniform(-1, 1, (300, 3)) * [1.3, 1.3, 0.9]
    R_cw = np.array([look_at(center, np.zeros(3)) for center in center_w])
    phi = -0.0125 * turns * R_cw[:, :, 2] + 0.004 * rng.normal(size=(photos, 3))
    velocity = 0.05 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    velocity += 0.012 * rng.normal(size=(photos, 3))
    point_idx, frame_idx = (a.ravel() for a in np.mgrid[: len(points_w), :photos])
    xy = np.empty((len(points_w), photos, 2))
    span = 1200 / 1300
    for i in range(photos):
        motion = phi[i] / span, MODEL, camera.readout, camera.K, [], velocity[i] / span
        xy[:, i] = project(points_w, R_cw[i], center_w[i], *motion)
    facing = np.einsum("na,na->n", points_w[point_idx], center_w[frame_idx]) > 0.3
    xy = xy.reshape(-1, 2) + 0.2 * rng.normal(size=(len(point_idx), 2))
    inside = facing & ((xy > 0) & (xy < [1600, 1200])).all(1)
    observations = Observations(frame_idx, point_idx, xy).select(inside)
    names, same = [f"{i:02}.jpg" for i in range(photos)], np.zeros(photos, np.int64)
    return Reconstruction(
        [camera], names, same, R_cw, center_w, points_w, observations, phi / span, velocity / span, MODEL
    )


@pytest.mark.parametrize("turns", [1.0, 0.0])
def test_rotation_and_travel_of_an_orbit_are_separated_as_far_as_their_deviations_say(turns, rng):
    square = []
    for _ in range(3):
        truth = aimed(rng, turns)
        start = replace(truth, phi=0 * truth.phi, velocity=0 * truth.velocity)
        options = BundleOptions(deviations="jackknife")
        result = bundle_adjust(start, MODEL, options)
        error = (result.reconstruction.phi - truth.phi).mean(0) * truth.frame_span()[0]
        vectors = np.zeros((3, truth.num_images, 12))
        vectors[np.arange(3), :, 6 + np.arange(3)] = truth.frame_span()[0] / truth.num_images
        posterior = Posterior(result, options)
        sigma = np.sqrt(np.einsum("kma,kma->k", posterior.of_photos(vectors), vectors))
        square.append((error / sigma) ** 2)
        # of what photos share and of what they have of their own
        own = np.sqrt(np.mean((truth.phi * truth.frame_span()[0]) ** 2))
        assert result.phi_rms == pytest.approx(own, rel=0.6)
        # with a mean of zero, the yaw was 12 mrad off at a standard deviation of 0.5
        assert abs(error[1]) < 8e-3
    assert np.sqrt(np.mean(square)) < 2.0
