"""The reduced system: factored, or solved by conjugate gradients on two levels, against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import bundle as benchmark
import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions
from rsundistort._kernels import blocks
from rsundistort.bundle import envelope, reduced, sparse_blocks
from rsundistort.bundle.coarse_space import CoarseSpace
from rsundistort.bundle.conjugate_gradients import solve_iteratively
from rsundistort.bundle.elimination import Elimination
from rsundistort.bundle.envelope import Envelope
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.bundle.reduced import Reduced, factor
from rsundistort.bundle.solver import minimize
from rsundistort.bundle.sparse_blocks import Chain, SparseBlocks
from rsundistort.bundle.structure import BlockPattern, Structure

pytestmark = pytest.mark.usefixtures("one_thread")


class Grid:
    """Photos over a plane that share points with their neighbours, and any positive reduced system of theirs.

    `parts` grids lie over one another and share nothing.
    """

    def __init__(self, rng, long=9, wide=5, nb=9, cameras=2, parts=1):
        x, y, part = (a.ravel() for a in np.mgrid[:long, :wide, :parts])
        m = len(x)
        self.center_w = np.column_stack([x, y, np.zeros(m)]) + rng.normal(0, 0.1, (m, 3))
        self.R_cw = Rotation.random(m, random_state=rng).as_matrix()
        self.part = part
        near = (abs(x[:, None] - x) <= 2) & (abs(y[:, None] - y) <= 1) & (part[:, None] == part)
        frame_idx, point_idx = np.nonzero(near)  # a point below each photo
        self.structure = Structure.from_observations(frame_idx, point_idx, m, m)
        self.pattern = self.structure.pattern
        self.free = rng.random((m, nb)) > 0.05
        self.free[0, :6] = self.free[1, 6:] = False
        # rows that each touch the unknowns of one point's photos, and those of the cameras
        self.n = m * nb
        J = np.zeros((m, 3 * nb, self.n + cameras))
        for p in range(m):
            seen = (nb * np.flatnonzero(near[:, p])[:, None] + np.arange(nb)).ravel()
            J[p][:, seen] = rng.normal(size=(3 * nb, len(seen)))
            J[p][:, self.n :] = rng.normal(size=(3 * nb, cameras))
        # unknowns of different sizes, as angles and lengths have
        J *= np.concatenate([np.tile(10.0 ** rng.uniform(-2, 2, nb), m), np.full(cameras, 100.0)])
        J = J.reshape(-1, J.shape[2])
        self.H = J.T @ J + 1e-3 * np.diag((J * J).sum(0))
        self.g = self.H @ rng.normal(size=len(self.H))
        S = self.H[: self.n, : self.n].reshape(m, nb, m, nb).transpose(0, 2, 1, 3)
        self.reduced = Reduced(
            np.ascontiguousarray(S[self.pattern.rows, self.pattern.cols]), self.g[: self.n].reshape(m, nb),
            np.where(self.free, self.H[self.n :, : self.n].reshape(cameras, m, nb), 0.0),
            self.H[self.n :, self.n :], self.g[self.n :],
        )  # fmt: skip
        self.unheld = np.concatenate([self.free.ravel(), np.ones(cameras, bool)])

    def space(self, max_photos=12):
        return CoarseSpace.of(self.pattern, self.free, self.R_cw, self.center_w, max_photos)

    def solution(self):
        """Dense, with a unit diagonal: photos and cameras."""
        scale = 1 / np.sqrt(np.diag(self.H)[self.unheld])
        x = np.zeros(len(self.H))
        H = scale[:, None] * self.H[np.ix_(self.unheld, self.unheld)] * scale
        x[self.unheld] = scale * np.linalg.solve(H, scale * self.g[self.unheld])
        return x[: self.n].reshape(self.free.shape), x[self.n :]


def columns(space):
    """The dense basis Z of a coarse space: what its changes do to the photos."""
    shape = len(space.start), space.envelope.place.shape[1]
    return np.array([space.prolong(unit.reshape(shape)).ravel() for unit in np.eye(np.prod(shape))]).T


@pytest.mark.parametrize("nb", [6, 9, 12])
def test_product_is_that_of_the_whole_matrix(nb, rng):
    grid = Grid(rng, nb=nb)
    x, y = rng.normal(size=grid.free.shape), np.empty(grid.free.shape)
    for ranges in (1, 3, 8):
        blocks.multiply(
            grid.pattern.row_start, grid.pattern.cols, grid.reduced.S, x,
            np.empty((ranges, *x.shape)), y,
        )  # fmt: skip
        expected = grid.H[: grid.n, : grid.n] @ x.ravel()
        np.testing.assert_allclose(y.ravel(), expected, rtol=0, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize("nb", [6, 12])
def test_coarse_system_is_the_projection(nb, rng):
    grid = Grid(rng, nb=nb)
    space = grid.space()
    Z = columns(space)
    assert (Z[~grid.free.ravel()] == 0).all()
    x = rng.normal(size=grid.free.shape)
    np.testing.assert_allclose(space.restrict(x).ravel(), Z.T @ x.ravel(), rtol=0, atol=1e-12)
    coarse = space.project(grid.reduced)
    E = Z.T @ grid.H[: grid.n, : grid.n] @ Z
    pattern, k = space.envelope.pattern, Z.shape[1] // len(space.start)
    found = np.zeros((len(space.start), len(space.start), k, k))
    found[pattern.rows, pattern.cols] = coarse.S
    found[pattern.cols, pattern.rows] = coarse.S.transpose(0, 2, 1)
    found = found.transpose(0, 2, 1, 3).reshape(E.shape)
    np.testing.assert_allclose(found, E, rtol=0, atol=1e-11 * np.abs(E).max())
    np.testing.assert_allclose(coarse.b.ravel(), Z.T @ grid.reduced.b.ravel(), rtol=1e-9, atol=1e-9 * np.abs(E).max())
    B = grid.reduced.border.reshape(len(grid.reduced.c), -1)
    np.testing.assert_allclose(coarse.border.reshape(len(B), -1), B @ Z, rtol=0, atol=1e-11 * np.abs(B).max())


def test_coarse_space_holds_what_moves_rotates_grows_and_bends_a_cluster(rng):
    grid = Grid(rng, nb=12)
    grid.free[:] = True
    # flat: the height of the photos is not among the functions
    grid.center_w[:, 2] = 0.3 * grid.center_w[:, 0] - 0.1 * grid.center_w[:, 1]
    space = grid.space(max_photos=len(grid.free))
    Z = columns(space)
    offset = grid.center_w - grid.center_w.mean(0)
    w = rng.normal(size=3)
    turn, grow, bend, motion = np.zeros((4, *grid.free.shape))
    turn[:, :3] = -grid.R_cw @ w  # R_cw Exp(-w): the world rotates by w
    turn[:, 3:6] = np.cross(w, offset)
    grow[:, 3:6] = offset
    bend[:, 5] = offset[:, 0] ** 2
    motion[:, 6:] = rng.normal(size=6)
    for change in (turn, grow, bend, motion):
        rest = change.ravel() - Z @ np.linalg.lstsq(Z, change.ravel(), rcond=None)[0]
        assert np.abs(rest).max() < 1e-10 * np.abs(change).max()


@pytest.mark.parametrize("cameras", [0, 2])
@pytest.mark.parametrize(("nb", "parts"), [(6, 1), (9, 2), (12, 1)])
def test_conjugate_gradients_give_the_solution_of_the_whole_system(nb, parts, cameras, rng):
    grid = Grid(rng, nb=nb, cameras=cameras, parts=parts)
    found = solve_iteratively(grid.reduced, grid.space(), grid.pattern, 1e-12, 500)
    x, y = grid.solution()
    assert found.converged
    assert (found.x[~grid.free] == 0).all()
    size = np.sqrt(np.diag(grid.H))[: grid.n].reshape(x.shape)  # of an unknown: the others drown in the largest
    np.testing.assert_allclose(size * found.x, size * x, rtol=0, atol=1e-8 * np.abs(size * x).max())
    np.testing.assert_allclose(found.y, y, rtol=0, atol=1e-8 * np.abs(y).max(initial=0))
    # the residual that is returned is that of the solution
    early = solve_iteratively(grid.reduced, grid.space(), grid.pattern, 1e-12, 2)
    assert not early.converged
    rest = grid.g - grid.H @ np.concatenate([early.x.ravel(), early.y])
    stated = np.concatenate([early.residual.ravel(), early.camera_residual])
    np.testing.assert_allclose(stated[grid.unheld], rest[grid.unheld], rtol=0, atol=1e-12 * np.abs(grid.g).max())


@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_tolerance_is_the_square_root_of_the_missing_decrease(tolerance, rng):
    grid = Grid(rng, long=20)
    found = solve_iteratively(grid.reduced, grid.space(), grid.pattern, tolerance, 500)
    x, y = grid.solution()
    error = np.concatenate([(found.x - x).ravel(), found.y - y])
    whole = np.concatenate([x.ravel(), y])
    missing = (error @ grid.H @ error) / (whole @ grid.H @ whole)
    assert 0 < missing < 10 * tolerance**2  # the preconditioner is not the inverse


def test_clusters_are_joined_by_points_and_no_larger_than_asked(rng):
    grid = Grid(rng, parts=2)
    space = grid.space(max_photos=7)
    for cluster in range(len(space.start)):
        photos = np.flatnonzero(space.cluster == cluster)
        assert 0 < len(photos) <= 7
        assert len(np.unique(grid.part[photos])) == 1


def test_photos_at_one_place_and_held_ones_leave_the_coarse_system_positive(rng):
    grid = Grid(rng)
    grid.center_w[:20] = grid.center_w[0]
    grid.free[20:30] = False
    grid.unheld[: grid.n] = grid.free.ravel()
    grid.reduced = replace(grid.reduced, border=np.where(grid.free, grid.reduced.border, 0.0))
    found = solve_iteratively(grid.reduced, grid.space(max_photos=5), grid.pattern, 1e-12, 500)
    x, _ = grid.solution()
    size = np.sqrt(np.diag(grid.H))[: grid.n].reshape(x.shape)
    np.testing.assert_allclose(size * found.x, size * x, rtol=0, atol=1e-8 * np.abs(size * x).max())


def test_a_matrix_that_is_not_positive_is_refused(rng):
    grid = Grid(rng)
    S = grid.reduced.S.copy()
    S[grid.pattern.diagonal[7]] *= 0.01
    reduced = replace(grid.reduced, S=S)
    assert solve_iteratively(reduced, grid.space(), grid.pattern, 1e-12, 500) is None
    assert Envelope.smallest(grid.pattern, grid.free).factor(S) is None


def test_conjugate_gradients_do_not_depend_on_the_number_of_threads(rng):
    grid = Grid(rng)
    results = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        results.append(solve_iteratively(grid.reduced, grid.space(), grid.pattern, 1e-6, 500))
    np.testing.assert_array_equal(results[0].x, results[1].x)
    np.testing.assert_array_equal(results[0].y, results[1].y)


def test_what_conjugate_gradients_have_not_solved_is_factored(rng):
    grid = Grid(rng)
    elimination = Elimination.of(grid.structure, grid.free, (grid.R_cw, grid.center_w), -1, 1e-6)
    x, y, *_ = replace(elimination, max_cg=1).solve(grid.reduced)
    exact = elimination.solve(grid.reduced, exact=True)
    np.testing.assert_array_equal(x, exact[0])
    np.testing.assert_array_equal(y, exact[1])


def test_panels_of_the_factor_give_what_one_panel_gives(rng, monkeypatch):
    grid = Grid(rng, long=30)
    shape = Envelope.smallest(grid.pattern, grid.free)
    B = shape.gather(rng.normal(size=(2, *grid.free.shape)))
    one, many = B.copy(), B.copy()
    shape.factor(grid.reduced.S).solve(one)
    monkeypatch.setattr(envelope, "_WORTH_THREADS", 0.0)
    monkeypatch.setattr(envelope, "_PANEL", 20)
    shape.factor(grid.reduced.S).solve(many)
    np.testing.assert_array_equal(many, one)


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("order", ["rising", "falling", "drawn"])
def test_inverse_inside_the_envelope_is_that_of_dense_algebra(rng, monkeypatch, parts, order):
    grid = Grid(rng, long=7)
    m = len(grid.free)
    shape = Envelope.of(
        grid.pattern,
        grid.free,
        {"rising": np.arange(m), "falling": np.arange(m)[::-1], "drawn": rng.permutation(m)}[order],
    )
    monkeypatch.setattr(envelope, "_WORTH_THREADS", 0.0)
    monkeypatch.setattr(envelope, "_PARTS", parts)
    blocks = shape.factor(grid.reduced.S).inverse_blocks(np.arange(m), np.arange(m))
    everything = shape.gather(np.eye(grid.free.size).reshape(-1, *grid.free.shape))
    shape.factor(grid.reduced.S).solve(everything)
    expected = shape.scatter(everything).reshape(*grid.free.shape, *grid.free.shape)
    held = ~(grid.free[:, :, None] & grid.free[:, None])
    for i in range(m):
        own = np.where(held[i], 0.0, expected[i, :, i])
        np.testing.assert_allclose(blocks[i], own, rtol=1e-9, atol=1e-12 * np.abs(own).max())


@pytest.mark.parametrize("nb", [1, 5, 9, 18, 19])  # kernels take six, three and two at a time
def test_sparse_blocks_solve_and_invert_as_dense_algebra_does(rng, nb):
    grid = Grid(rng, long=7, nb=nb)
    shape = SparseBlocks.of(grid.pattern, grid.free)
    factor = shape.factor(grid.reduced.S)
    scale = 1 / np.sqrt(np.diag(grid.H))[: grid.n]
    held = ~grid.free.ravel()
    H = scale[:, None] * grid.H[: grid.n, : grid.n] * scale
    H[held], H[:, held] = 0.0, 0.0
    H[held, held] = 1.0
    expected = scale[:, None] * np.linalg.inv(H) * scale
    expected[held], expected[:, held] = 0.0, 0.0
    b = rng.normal(size=(6, *grid.free.shape))
    found = shape.gather(b)
    factor.solve(found)
    x = (b.reshape(6, -1) @ expected).reshape(b.shape)
    np.testing.assert_allclose(shape.scatter(found), x, rtol=1e-7, atol=1e-9 * np.abs(x).max())
    dense = expected.reshape(*grid.free.shape, *grid.free.shape)
    first, second = grid.pattern.cols, grid.pattern.rows  # also those below the diagonal
    own = np.arange(len(grid.free))
    for f, g in ((own, own), (first, second)):
        inverse = factor.inverse_blocks(f, g)
        wanted = dense[f, :, g]
        size = np.maximum(np.abs(wanted).max(axis=(1, 2), keepdims=True), 1e-300)  # a photo may be held
        np.testing.assert_allclose(inverse / size, wanted / size, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("num", [1, 3, 6])
def test_unknowns_of_a_chain_are_eliminated_apart_with_the_same_result(rng, num):
    m, nb = 30, 11
    chain = np.arange(m - 1), np.arange(1, m)
    keys = np.arange(0, m, 4)
    far = [(a, b) for a in keys for b in keys if a < b]
    pairs = np.unique(np.concatenate([np.transpose(chain), np.array(far), [(k, k) for k in range(m)]]), axis=0)
    pattern = BlockPattern(np.searchsorted(pairs[:, 0], np.arange(m + 1)), pairs[:, 1])
    S = rng.normal(size=(len(pairs), nb, nb))
    S[pattern.diagonal] = 40 * np.eye(nb) + S[pattern.diagonal] + S[pattern.diagonal].transpose(0, 2, 1)
    # only neighbours know of each other's last unknowns
    alone = pairs[:, 1] - pairs[:, 0] > 1
    S[alone, nb - num :], S[alone, :, nb - num :] = 0.0, 0.0
    free = rng.random((m, nb)) > 0.1
    whole, parted = (SparseBlocks.of(pattern, free, each) for each in (None, Chain(*chain, num)))
    assert parted.num_values < whole.num_values
    assert parted.multiply_adds < whole.multiply_adds
    b = rng.normal(size=(5, m, nb))
    results = []
    for shape in (whole, parted):
        factor, found = shape.factor(S), shape.gather(b)
        factor.solve(found)
        own = factor.inverse_blocks(np.arange(m), np.arange(m))
        results.append((shape.scatter(found), own, factor.inverse_blocks(*chain)))
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_sparse_blocks_fill_no_more_than_the_order_of_a_chain_needs(rng):
    """Frames of a path that see their neighbours, and every tenth of them all others of these."""
    m = 60
    keys = np.arange(0, m, 10)
    pairs = np.array([(k, k + 1) for k in range(m - 1)] + [(a, b) for a in keys for b in keys if a < b])
    frame_idx, point_idx = pairs.ravel(), np.repeat(np.arange(len(pairs)), 2)
    pattern = Structure.from_observations(frame_idx, point_idx, m, len(pairs)).pattern
    shape = SparseBlocks.of(pattern, rng.random((m, 4)) > 0.1)
    # each frame between keys leaves a block with its next one and one with a key
    assert len(shape.filled.cols) <= 3 * m + len(keys) ** 2 / 2


def test_a_sparse_matrix_that_is_not_positive_is_refused(rng):
    grid = Grid(rng)
    S = grid.reduced.S.copy()
    S[grid.pattern.diagonal[7]] *= 0.01
    assert SparseBlocks.of(grid.pattern, grid.free).factor(S) is None


def test_one_thread_does_little_work(rng, monkeypatch):
    grid, woken = Grid(rng), numba.get_num_threads()
    shape = SparseBlocks.of(grid.pattern, grid.free)
    with shape.threads():
        assert numba.get_num_threads() == 1
    assert numba.get_num_threads() == woken
    monkeypatch.setattr(sparse_blocks, "_WORTH_THREADS", 0.0)
    with shape.threads():
        assert numba.get_num_threads() == woken


def test_a_sparse_factor_does_not_depend_on_the_number_of_threads(rng, monkeypatch):
    monkeypatch.setattr(sparse_blocks, "_WORTH_THREADS", 0.0)  # else one thread does
    grid = Grid(rng)
    shape = SparseBlocks.of(grid.pattern, grid.free)
    found = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        factor = shape.factor(grid.reduced.S)
        found.append((factor.data, factor.inverse_blocks(*[np.arange(len(grid.free))] * 2)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])


def block(photos, monkeypatch):
    """A block of aerial photos as in benchmarks/bundle.py, with few measurements."""
    monkeypatch.setattr(benchmark, "PER_PHOTO", 100)
    return benchmark.make_problem("block", 100 * photos)


@pytest.mark.parametrize("model", ["rotation", "constant-motion"])
def test_iterations_do_not_grow_with_the_block(model, monkeypatch):
    counts = []
    for photos in (100, 400):
        problem = BundleProblem(
            block(photos, monkeypatch),
            model,
            BundleOptions(loss="squared", factor_limit=-1),
            0.5,
            PriorSigmas(0.03, 0.3),
        )
        e = problem._elimination
        reduced, _ = problem.linearize(problem.initial_state()).reduce(1e-7)
        counts.append(solve_iteratively(reduced, e.space, e.structure.pattern, 0.01, 500).num_iterations)
    # one level (the photos, or clusters of 32) takes hundreds, and twice as many for four times the photos
    assert max(counts) <= 40
    assert counts[1] <= 1.5 * counts[0]


def test_steps_by_conjugate_gradients_end_where_factored_ones_do(monkeypatch):
    rec = block(150, monkeypatch)
    ends = []
    for factor_limit in (-1, 1e15):
        options = BundleOptions(loss="squared", factor_limit=factor_limit)
        problem = BundleProblem(rec, "rotation", options, 0.5, PriorSigmas(0.03, 0.3))
        ends.append(
            minimize(
                problem, problem.initial_state(), max_iterations=30, cost_tolerance=1e-7, step_tolerance=1e-10,
                initial_damping=1e-4, max_damping=1e12,
            )
        )  # fmt: skip
    iterated, factored = ends
    assert iterated.stop_reason == factored.stop_reason == "cost"
    assert iterated.num_iterations <= factored.num_iterations + 2
    # each stops when a step gains less than 1e-7 of the cost
    assert iterated.cost_history[-1] == pytest.approx(factored.cost_history[-1], rel=1e-6)


@pytest.mark.parametrize(("photos", "iterated"), [(20, False), (200, False), (800, True)])
def test_large_systems_are_iterated_and_small_ones_factored(photos, iterated, monkeypatch):
    problem = BundleProblem(block(photos, monkeypatch), "rotation", BundleOptions(), 0.5, PriorSigmas(0.03, 0.3))
    assert (problem._elimination.space is not None) == iterated


def test_many_right_hand_sides_are_solved_as_each_is(rng, monkeypatch):
    grid = Grid(rng)
    factored = factor(grid.reduced, SparseBlocks.of(grid.pattern, grid.free))
    b, c = rng.normal(size=(7, *grid.free.shape)), rng.normal(size=(7, 2))
    at_once = factored.times(b, c)
    monkeypatch.setattr(reduced, "_STACK", 3)
    for found, expected in zip(factored.times(b, c), at_once, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
