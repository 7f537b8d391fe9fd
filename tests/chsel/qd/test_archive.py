"""The archive, also against a plain loop, and the measures of its cells."""

import math

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from chsel.errors import ChselError, SettingError
from chsel.problem.poses import Poses, compose, inverse
from chsel.problem.search_space import PlaneSettings, SE2Space, SE3Space
from chsel.qd.archive import GridArchive, rank, sampled_cell
from chsel.qd.measures import MEASURES, VECTOR, Measure, MeasureCode, measure_named
from tests.chsel.samples import ball_grid, random_poses

XY = Measure(("x", "y"), MeasureCode(VECTOR, 2))


@numba.njit
def sampled(objectives, uniform):
    return sampled_cell(objectives, uniform)


@pytest.fixture
def archive():
    return GridArchive(XY, np.array([0.0, -1.0]), upper=np.array([1.0, 1.0]), bins=4, dimension=2)


def cells_of(archive, measures):
    return archive.add(measures, np.zeros(len(measures)), measures=measures).cells


def add(archive, measures, *, objectives):
    archive.add(np.array(measures), np.array(objectives), measures=np.array(measures))


def test_cells_are_row_major_with_the_last_measure_fastest(archive):
    cells = cells_of(archive, np.array([[0.1, -0.9], [0.1, 0.9], [0.9, -0.9], [0.3, 0.1]]))
    np.testing.assert_array_equal(cells, [0, 3, 12, 6])


def test_elites_are_sampled_from_occupied_cells_alone(archive):
    add(archive, [[0.1, -0.9], [0.9, 0.9], [0.3, 0.1]], objectives=[-1.0, -2.0, -3.0])
    uniform = np.linspace(0.0, 1.0, 300, endpoint=False)
    drawn = np.array([sampled(archive.cells.objectives, u) for u in uniform])
    found, counts = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(found, [0, 6, 15])
    np.testing.assert_array_equal(counts, [100, 100, 100])


def test_an_empty_archive_has_no_elite_to_sample(archive):
    assert sampled(archive.cells.objectives, 0.5) == -1
    with pytest.raises(ChselError, match="no pose"):
        _ = archive.best_solution


def test_a_solution_that_is_not_finite_never_enters(archive):
    measures = np.array([[0.1, -0.9], [0.9, 0.9]])
    solutions = np.array([[0.1, -0.9], [0.9, np.nan]])
    assert archive.add(solutions, np.array([-1.0, -2.0]), measures=measures).cells.tolist() == [
        0,
        -1,
    ]
    np.testing.assert_array_equal(archive.occupied, [0])


def test_snapshot_is_a_copy_with_its_statistics(archive):
    add(archive, [[0.1, -0.9], [0.9, 0.9]], objectives=[-1.0, -2.0])
    snapshot = archive.snapshot(iteration=7, refinement=1)
    add(archive, [[0.1, -0.9], [0.3, 0.1]], objectives=[-0.5, -2.0])
    np.testing.assert_array_equal(snapshot.objectives, [-1.0, -2.0])
    assert snapshot.coverage == 2 / 16
    assert snapshot.qd_score == pytest.approx((99.0 + 98.0) / 16)
    assert (snapshot.iteration, snapshot.refinement) == (7, 1)


def test_angles_across_half_a_turn_stay_neighbours():
    angle = MEASURES["plane_angle"]
    values = np.array([[np.pi - 0.02], [-np.pi + 0.02], [np.pi - 0.01], [-np.pi + 0.01]])
    mean, deviation = angle.moments(values)
    assert abs(abs(mean[0]) - np.pi) < 1e-12
    assert deviation[0] == pytest.approx(np.sqrt((0.02**2 + 0.01**2) / 2), rel=1e-3)
    archive = GridArchive(angle, mean - 0.04, upper=mean + 0.04, bins=8, dimension=1)
    order = np.argsort([-0.02, 0.02, -0.01, 0.01])
    cells = cells_of(archive, values)[order]
    np.testing.assert_array_equal(cells, [2, 3, 5, 6])


BINS = 4
LOWER = -1.0
UPPER = 1.0


class PlainArchive:
    """The definition: dictionaries and loops."""

    def __init__(self, circular):
        self.circular = circular
        self.best: dict[int, tuple[float, tuple[float, ...]]] = {}

    def cell(self, measures):
        cell = 0
        for x in measures:
            if self.circular:
                x = x - 2.0 * math.pi * round(x / (2.0 * math.pi))
            place = math.floor((BINS * (x - LOWER) + 1e-6) / (UPPER - LOWER))
            cell = cell * BINS + min(max(place, 0), BINS - 1)
        return cell

    def add(self, batch):
        before = dict(self.best)
        results = []
        for measures, objective in batch:
            if not all(map(math.isfinite, (*measures, objective))):
                results.append((0, -math.inf))
                continue
            cell = self.cell(measures)
            if cell not in before:
                results.append((2, objective))
            else:
                gain = objective - before[cell][0]
                results.append((int(gain > 0.0), gain))
            if cell not in self.best or objective > self.best[cell][0]:
                self.best[cell] = (objective, measures)
        return results


# Borders of cells, and values beyond the range; few objectives, so that many tie.
NUMBERS = [LOWER + 0.25 * i for i in range(-2, 11)] + [-50.0, 0.1, -0.6, 50.0, math.nan, math.inf]
OBJECTIVES = [-3.0, -2.0, -1.0, -1.0 + 1e-12, 0.0, math.nan, math.inf, -math.inf]
SOLUTIONS = st.tuples(
    st.tuples(st.sampled_from(NUMBERS), st.sampled_from(NUMBERS)), st.sampled_from(OBJECTIVES)
)


@settings(deadline=None, max_examples=200)
@given(st.booleans(), st.lists(st.lists(SOLUTIONS, min_size=1, max_size=9), max_size=4))
@example(True, [[((math.pi + 0.1, 3.0 * math.pi), -1.0), ((0.1 - math.pi, -math.pi), 0.0)]])
def test_insertion_is_that_of_a_plain_loop(circular, batches):
    measure = Measure(("x", "y"), MeasureCode(VECTOR, 2), circular=circular)
    lower, upper = np.full(2, LOWER), np.full(2, UPPER)
    archive = GridArchive(measure, lower, upper=upper, bins=BINS, dimension=3)
    plain = PlainArchive(circular)
    for batch in batches:
        measures = np.array([solution[0] for solution in batch])
        objectives = np.array([solution[1] for solution in batch])
        serial = np.arange(len(batch))[:, None]  # tells equal solutions apart
        offers = archive.add(np.hstack([serial, measures]), objectives, measures=measures)
        found = zip(offers.status.tolist(), offers.value.tolist(), strict=True)
        assert list(found) == plain.add(batch)
    assert archive.occupied.tolist() == sorted(plain.best)
    snapshot = archive.snapshot(0, 0)
    for i, cell in enumerate(sorted(plain.best)):
        objective, measures_there = plain.best[cell]
        assert snapshot.objectives[i] == objective
        assert tuple(snapshot.measures[i]) == measures_there
        assert tuple(snapshot.solutions[i, 1:]) == measures_there


@numba.njit
def ranked(status, value, order):
    return rank(status, value, order)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from([-np.inf, -1.0, -0.0, 0.0, 2.5])),
        min_size=1,
        max_size=70,
    )
)
def test_ranking_is_by_status_then_value_then_the_later(pairs):
    status, value = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    order = np.zeros(len(pairs), dtype=np.int64)
    improved = ranked(status, value, order)
    np.testing.assert_array_equal(order, np.lexsort((value, status))[::-1])
    assert improved == (status > 0).sum()


TILTED = SE2Space(PlaneSettings(axis=(0.0, 0.6, 0.8), offset=0.1), ball_grid(0.05, 0.02, half=5))
ON_PLANES = [name for name in MEASURES if name.startswith("plane")]
CASES = [(name, TILTED if name in ON_PLANES else SE3Space()) for name in sorted(MEASURES)]
CASES += [(name, TILTED) for name in ("position_3", "object_xy", "object_yaw")]


@pytest.mark.parametrize(("name", "space"), CASES)
def test_measures_have_the_gradients_of_their_values(name, space):
    """Central differences, at vectors that are not orthonormal."""
    measure = measure_named(name, planar=space is TILTED)
    assert measure.code.size == measure.count
    steps = 1e-6 * np.eye(space.dimension)
    for vector in np.random.default_rng(1).uniform(-1.0, 1.0, (5, space.dimension)):
        rise = measure.values(space, vector + steps) - measure.values(space, vector - steps)
        gradients = measure.gradients(space, vector)
        assert gradients.shape == (measure.count, space.dimension)
        np.testing.assert_allclose(gradients, rise.T / 2e-6, rtol=1e-6, atol=1e-7)
        assert (np.abs(gradients).max(axis=1) > 0.01).all()


def test_measures_of_vectors_and_translations_are_their_entries():
    vectors, poses = (np.random.default_rng(2).uniform(-1.0, 1.0, (10, d)) for d in (9, 3))
    expected = {f"rotation_{count}": vectors[:, :count] for count in range(1, 7)}
    expected |= {f"position_{count}": vectors[:, 6 : 6 + count] for count in (2, 3)}
    for name, values in expected.items():
        np.testing.assert_array_equal(MEASURES[name].values(SE3Space(), vectors), values)
    expected = {"plane_position": poses[:, 1:], "plane_angle": poses[:, :1]}
    expected["position_3"] = TILTED.poses(poses).matrices[:, :3, 3]
    for name, values in expected.items():
        np.testing.assert_array_equal(MEASURES[name].values(TILTED, poses), values)


def test_object_measures_are_of_world_from_object():
    transforms = random_poses(np.random.default_rng(3), 10, reach=0.3)
    world = inverse(transforms)
    vectors = SE3Space().encode(Poses.of(transforms))
    xy, yaw = (MEASURES[name].values(SE3Space(), vectors) for name in ("object_xy", "object_yaw"))
    np.testing.assert_allclose(xy, world[:, :2, 3], atol=1e-14)
    np.testing.assert_allclose(yaw[:, 0], np.arctan2(world[:, 1, 0], world[:, 0, 0]), atol=1e-12)


def test_an_object_that_points_straight_up_has_a_yaw_and_no_gradient_of_it():
    """The object's x axis along the world's z: the heading is not defined."""
    rotation = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    vector = SE3Space().encode(Poses.of(compose(rotation[None], np.zeros((1, 3)))))
    space = SE3Space()
    yaw = MEASURES["object_yaw"]
    assert np.isfinite(yaw.values(space, vector)).all()
    np.testing.assert_array_equal(yaw.gradients(space, vector[0]), np.zeros((1, 9)))


def test_a_measure_of_the_other_space_names_those_that_fit():
    with pytest.raises(SettingError, match="only with plane; accepted: object_xy"):
        measure_named("plane_angle", planar=False)
    with pytest.raises(SettingError, match=r"only without plane; accepted: .*plane_position"):
        measure_named("rotation_3", planar=True)
