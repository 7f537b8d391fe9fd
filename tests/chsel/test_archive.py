from __future__ import annotations

import numpy as np
import pytest

from chsel.archive import GridArchive
from chsel.measures import MEASURES, Measure

XY = Measure(("x", "y"), lambda vectors, rotation, translation: vectors[:, :2])


@pytest.fixture
def archive() -> GridArchive:
    return GridArchive(XY, np.array([0.0, -1.0]), np.array([1.0, 1.0]), bins=4, dimension=2)


def add(archive: GridArchive, measures: list[list[float]], objectives: list[float]):  # type: ignore[no-untyped-def]
    return archive.add(np.array(measures), np.array(objectives), np.array(measures))


def test_cells_are_row_major_with_the_last_measure_fastest(archive: GridArchive) -> None:
    cells = archive.cells_of(np.array([[0.1, -0.9], [0.1, 0.9], [0.9, -0.9], [0.3, 0.1]]))
    np.testing.assert_array_equal(cells, [0, 3, 12, 6])


def test_measures_outside_of_the_range_go_to_the_cells_at_its_edge(archive: GridArchive) -> None:
    cells = archive.cells_of(np.array([[-9.0, -9.0], [9.0, 9.0], [-9.0, 0.1], [1.0, 1.0]]))
    np.testing.assert_array_equal(cells, [0, 15, 2, 15])


def test_a_measure_on_a_border_belongs_to_the_cell_above(archive: GridArchive) -> None:
    np.testing.assert_array_equal(archive.cells_of(np.array([[0.25, 0.0]])), [6])


def test_status_and_value_are_against_the_archive_before_the_batch(archive: GridArchive) -> None:
    add(archive, [[0.1, -0.9]], [-5.0])
    status, value = add(
        archive,
        [[0.1, -0.9], [0.1, -0.9], [0.1, -0.9], [0.9, 0.9], [0.9, 0.9]],
        [-4.0, -5.0, -7.0, -3.0, -2.0],
    )
    np.testing.assert_array_equal(status, [1, 0, 0, 2, 2])  # an equal objective is no improvement
    np.testing.assert_array_equal(value, [1.0, 0.0, -2.0, -3.0, -2.0])
    np.testing.assert_array_equal(archive.occupied, [0, 15])
    np.testing.assert_array_equal(archive.costs, [4.0, 2.0])


def test_of_equals_in_a_batch_the_first_stays(archive: GridArchive) -> None:
    solutions = np.array([[0.1, -0.9], [0.12, -0.9], [0.14, -0.9]])
    archive.add(solutions, np.array([-2.0, -1.0, -1.0]), solutions)
    np.testing.assert_array_equal(archive.solutions, solutions[1:2])


def test_elites_are_sampled_from_occupied_cells_alone(archive: GridArchive) -> None:
    add(archive, [[0.1, -0.9], [0.9, 0.9], [0.3, 0.1]], [-1.0, -2.0, -3.0])
    uniform = np.linspace(0.0, 1.0, 300, endpoint=False)
    drawn = np.array([archive.sample_elite(u) for u in uniform])
    found, counts = np.unique(drawn, axis=0, return_counts=True)
    np.testing.assert_array_equal(found, [[0.1, -0.9], [0.3, 0.1], [0.9, 0.9]])
    np.testing.assert_array_equal(counts, [100, 100, 100])


def test_snapshot_is_a_copy_with_its_statistics(archive: GridArchive) -> None:
    add(archive, [[0.1, -0.9], [0.9, 0.9]], [-1.0, -2.0])
    snapshot = archive.snapshot(iteration=7, refinement=1)
    add(archive, [[0.1, -0.9], [0.3, 0.1]], [-0.5, -2.0])
    np.testing.assert_array_equal(snapshot.objectives, [-1.0, -2.0])
    assert snapshot.coverage == 2 / 16
    assert snapshot.qd_score == pytest.approx((99.0 + 98.0) / 16)
    assert (snapshot.iteration, snapshot.refinement) == (7, 1)


def test_angles_across_half_a_turn_stay_neighbours() -> None:
    angle = MEASURES["plane_angle"]
    values = np.array([[np.pi - 0.02], [-np.pi + 0.02], [np.pi - 0.01], [-np.pi + 0.01]])
    mean, deviation = angle.moments(values)
    assert abs(abs(mean[0]) - np.pi) < 1e-12
    assert deviation[0] == pytest.approx(np.sqrt((0.02**2 + 0.01**2) / 2), rel=1e-3)
    archive = GridArchive(angle, mean - 0.04, mean + 0.04, bins=8, dimension=1)
    order = np.argsort([-0.02, 0.02, -0.01, 0.01])
    cells = archive.cells_of(values)[order]
    np.testing.assert_array_equal(cells, [2, 3, 5, 6])
