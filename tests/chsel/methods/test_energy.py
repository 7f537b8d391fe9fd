"""The energy of poses against its plain formula, and what lowers it or walks below a limit."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.methods.anchored.anchor_sampling import most_informative_first
from chsel.methods.anchored.energy import Energy, NoiseLevel
from chsel.methods.anchored.fine_cells import fine_cells_below
from chsel.methods.anchored.fit_kernels import Loss
from chsel.methods.anchored.walk_kernels import Chains, energies_below
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse, random_rotations
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.search_space import PlaneSettings, origin_bounds, search_space
from chsel.problem.streams import StreamKey
from tests.chsel.methods.scene import BOX, BOX_GRID, TRUTH, WORKSPACE, contacts_on

RANDOM = np.random.default_rng(8)
CONTACTS = contacts_on(BOX, 30)
LATTICE = np.stack(np.meshgrid(*[np.arange(-0.1, 0.6, 0.04)] * 3, indexing="ij"), -1).reshape(-1, 3)
FREE = LATTICE[BOX_GRID.at(apply(inverse(TRUTH), LATTICE))[0] > 0.005]
POINTS = KnownPoints(
    free=np.concatenate([FREE, [[5.0, 0.0, -3.0]]]),
    occupied=apply(TRUTH, 0.03 * RANDOM.standard_normal((5, 3))),
    known=np.concatenate([CONTACTS, [[2.0, -1.0, 0.5]]]),  # the last is outside of the grid
    known_sdf=np.append(0.02 * RANDOM.standard_normal(len(CONTACTS)), 2.0),
)
TOUCHED = KnownPoints(free=FREE, known=CONTACTS)
MARGIN = 0.15
SIGMA, CAP = 0.003, 0.05  # the last known point is farther off
FINE = Loss(0.002, 0.03, 0.0)


def energy_of(
    points: KnownPoints, tolerance: float = 0.0, plane: PlaneSettings | None = None
) -> tuple[Energy, tuple[FloatArray, FloatArray]]:
    """The energy for points, and the bounds of its walks."""
    problem = RegistrationProblem(
        BOX_GRID, points, np.eye(4)[None], WORKSPACE, 0.03, StreamKey(5, 2)
    )
    space = search_space(plane, BOX_GRID)
    bounds = origin_bounds(problem.workspace, space, MARGIN)
    level = NoiseLevel(SIGMA, tolerance, CAP)
    return Energy(problem, most_informative_first(points), space, bounds, level), bounds


def around(count: int, shift: float, turn: float) -> Poses:
    """Poses around the truth."""
    random = np.random.default_rng(count)
    axes = random.standard_normal((count, 3))
    axes /= np.sqrt((axes**2).sum(axis=1, keepdims=True))
    moves = compose(axis_angle(axes, turn), shift * random.standard_normal((count, 3)))
    return Poses.of(inverse(np.stack([TRUTH @ move for move in moves])))


def losses(residuals: FloatArray, knee: float, cap: float) -> FloatArray:
    """Quadratic up to the knee, then linear with the same slope, then constant."""
    sizes = np.minimum(np.abs(residuals), cap)
    return np.where(sizes <= knee, sizes**2 / (2.0 * knee), sizes - knee / 2.0)


def plainly(points: KnownPoints, poses: Poses, tau: float) -> FloatArray:
    most = 20.0 * SIGMA / max(len(points.known), 1)
    energies = []
    for transform in poses.matrices:
        known, free, occupied = (
            BOX_GRID.at(apply(transform, part), lookup="trilinear")[0]
            for part in (points.known, points.free, points.occupied)
        )
        mean = losses(known - points.sdf, SIGMA, CAP).mean() if len(known) else 0.0
        wrong = np.concatenate([-tau - free, occupied - tau])
        energies.append(mean + np.clip(wrong, 0.0, most).sum())
    return np.array(energies)


def fit_losses(points: KnownPoints, poses: Poses, loss: Loss) -> FloatArray:
    """What a fit lowers, without free points."""
    sums = []
    for transform in poses.matrices:
        known = BOX_GRID.at(apply(transform, points.known), lookup="trilinear")[0]
        sums.append(losses(known - points.sdf, loss.knee, loss.cap).sum())
    return np.array(sums)


def far_poses() -> Poses:
    turns = random_rotations(np.random.default_rng(1), 40)
    places = np.random.default_rng(2).uniform(-0.1, 0.5, (40, 3))
    return Poses.of(inverse(compose(turns, places)))


@pytest.mark.parametrize("tau", [0.0, 0.004])
@pytest.mark.parametrize(
    "points", [POINTS, TOUCHED, KnownPoints(free=FREE), KnownPoints(occupied=POINTS.occupied)]
)
def test_energy_is_the_plain_formula(points: KnownPoints, tau: float) -> None:
    poses = Poses.joined([around(12, 0.02, 0.3), far_poses()[:12]])
    energies = energy_of(points, tau)[0].of(poses)
    np.testing.assert_allclose(energies, plainly(points, poses, tau), rtol=1e-12, atol=1e-9)


def test_energies_that_a_walk_carries_along_are_the_plain_formula() -> None:
    """Walks gather free points once for many moves."""
    energy, _ = energy_of(POINTS, 0.002)
    chains = walked(energy, around(12, 0.01, 0.1), 0.0, 120)
    assert chains.moved.min() > 0
    expected = plainly(POINTS, Poses(chains.poses), 0.002)
    np.testing.assert_allclose(chains.energies, expected, rtol=1e-12, atol=1e-9)


def test_energies_above_a_limit_are_infinite_and_others_as_they_are() -> None:
    energy, _ = energy_of(POINTS)
    model, poses = energy._model, Poses.joined([around(40, 0.02, 0.3), far_poses()])
    energies, limited = energy.of(poses), np.empty(len(poses))
    limit = float(np.sort(energies)[30])
    scratch = energy.walk()
    energies_below(model, energy.loss, poses.numbers, limit, limited, 0, len(poses), scratch)
    np.testing.assert_array_equal(limited, np.where(energies <= limit, energies, np.inf))


def test_a_fit_recovers_a_pose_that_was_moved_a_little() -> None:
    energy, _ = energy_of(TOUCHED)
    poses = around(20, 0.01, 0.15)
    fitted = energy.fitted(poses, 30, FINE)
    assert (energy.of(fitted) < 0.0005).all()
    assert (energy.of(poses) > 0.002).all()
    truth = inverse(TRUTH)
    np.testing.assert_allclose(fitted.translations, np.tile(truth[:3, 3], (20, 1)), atol=0.004)
    np.testing.assert_allclose(fitted.rotations, np.tile(truth[:3, :3], (20, 1, 1)), atol=0.03)


@pytest.mark.parametrize("loss", [FINE, Loss(0.01, 0.06, 0.0), Loss(1.0, 2.0, 0.0)])
def test_no_fit_raises_its_loss(loss: Loss) -> None:
    points = KnownPoints(known=CONTACTS)
    energy, _ = energy_of(points)
    poses = far_poses() if loss.cap > 1.0 else around(40, 0.01, 0.1)
    fitted = energy.fitted(poses, 10, loss)
    before, after = fit_losses(points, poses, loss), fit_losses(points, fitted, loss)
    assert (after <= before * (1.0 + 1e-9)).all()
    assert np.median(after / before) < 0.1
    np.testing.assert_array_equal(energy.fitted(poses, 0, loss).numbers, poses.numbers)


def test_points_far_off_the_object_do_not_move_a_fit() -> None:
    """A tenth of the contacts is on something behind the object."""
    foreign = np.tile([0.2, 0.1, 0.5], (4, 1)) + 0.02 * RANDOM.standard_normal((4, 3))
    poses = around(20, 0.005, 0.1)
    alone, _ = energy_of(KnownPoints(known=CONTACTS))
    both, _ = energy_of(KnownPoints(known=np.concatenate([CONTACTS, foreign])))
    fitted = both.fitted(poses, 40, FINE)
    assert (alone.of(fitted) < 2e-4).mean() > 0.9
    noise = both.noise(fitted[:1], 0.0005)
    assert noise.sigma < 0.001
    assert noise.outliers == pytest.approx((4.0 + 0.08) / (34.0 + 4.0))


def walked(energy: Energy, poses: Poses, floor: float, moves: int, kept: int = 4) -> Chains:
    return energy.walked(poses, energy.of(poses), floor, moves, kept=kept, index=3)


def test_walks_stay_below_the_limit_and_within_bounds() -> None:
    energy, (lower, upper) = energy_of(TOUCHED)
    starts = energy.fitted(around(12, 0.01, 0.1), 30, FINE)
    chains = walked(energy, starts, 0.01, 200)
    kept = Poses(chains.kept.reshape(-1, 12))
    assert np.isfinite(chains.kept_energies).all()
    np.testing.assert_allclose(energy.of(kept), chains.kept_energies.reshape(-1), atol=1e-9)
    assert chains.energies.max() <= 0.01
    assert chains.kept_energies.max() <= 0.01
    assert np.abs(kept.translations - np.repeat(starts.translations, 4, axis=0)).max() > 0.002
    products = np.einsum("nij,nkj->nik", kept.rotations, kept.rotations)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (len(kept), 1, 1)), atol=1e-10)
    free = walked(energy_of(KnownPoints(known=CONTACTS[:1]))[0], starts, 10.0, 400)
    reached = Poses(free.poses)
    origins = -np.einsum("nij,ni->nj", reached.rotations, reached.translations)
    assert (origins >= lower).all()
    assert (origins <= upper).all()


def test_walks_from_above_come_down_and_keep_nothing_on_the_way() -> None:
    energy, _ = energy_of(TOUCHED)
    poses = around(12, 0.02, 0.2)
    chains = walked(energy, poses, 0.0, 200)
    assert (chains.energies < 0.8 * energy.of(poses)).all()
    assert np.isinf(chains.kept_energies).all()


def test_neither_fits_nor_walks_depend_on_threads() -> None:
    energy, _ = energy_of(POINTS)
    poses = around(60, 0.02, 0.2)
    results = []
    for count in (1, 2):
        with threads(count):
            fitted = energy.fitted(poses, 4, FINE)
            chains = walked(energy, fitted, 0.02, 40)
            results.append([fitted.numbers, energy.of(fitted), *chains])
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)


def test_on_a_plane_fits_and_walks_stay_on_it() -> None:
    plane = PlaneSettings(plane_height=0.3)
    energy, _ = energy_of(TOUCHED, plane=plane)
    space = search_space(plane, BOX_GRID)
    near = around(6, 0.01, 0.1)
    poses = space.poses(space.encode(near))
    chains = walked(energy, energy.fitted(poses, 10, FINE), 0.0, 60)
    again = space.poses(space.encode(Poses(chains.poses)))
    np.testing.assert_allclose(again.numbers, chains.poses, atol=1e-9)
    assert np.abs(chains.poses - poses.numbers).max() > 1e-3


@pytest.mark.parametrize("level", [0.0, -0.003])
def test_the_fine_cells_hold_all_points_below_a_level_and_few_others(level: float) -> None:
    fine = fine_cells_below(BOX_GRID, level)
    lower, upper = BOX_GRID.bounds
    points = lower + np.random.default_rng(3).random((40_000, 3)) * (upper - lower)
    values = BOX_GRID.at(points, lookup="trilinear")[0]
    index = np.floor((points - lower) * fine.box.inverse)
    at = (index @ [fine.box.across, fine.box.along, 1.0]).astype(np.int64)
    held = (fine.bits[at // 32] >> (at % 32).astype(np.uint32)) & 1 == 1
    assert held[values < level].all()
    side = 1.0 / fine.box.inverse
    assert 100 < held.sum() < len(held) / 2
    assert values[held].max() < level + np.sqrt(3.0) * side
    assert fine.bits[-1] >> np.uint32(fine.unsure % 32) == 1  # that of unsure points
