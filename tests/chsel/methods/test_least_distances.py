"""Lower bounds of the distance, in a grid and around it, against what is read there."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.methods.medial_constraint import least_distances as bounds
from chsel.methods.medial_constraint.least_distances import LeastDistances, least_distances
from chsel.numerics.arrays import FloatArray
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE, SdfGrid
from tests.chsel.samples import ball_grid

BALL = ball_grid(0.05, 0.01, 8)
REACH = 0.1


def rugged() -> SdfGrid:
    """A grid of any values and directions, as far as a grid accepts them."""
    random = np.random.default_rng(4)
    values = random.uniform(-0.05, 0.05, (8, 9, 10))
    values[0], values[-1], values[:, 0], values[:, -1] = (abs(values).max() for _ in range(4))
    values[..., 0], values[..., -1] = np.abs(values[..., 1]), 1e-6
    gradients = random.normal(size=(8, 9, 10, 3))
    gradients[: 8 // 2] += 2.0  # others may cancel out between nodes
    gradients /= np.sqrt((gradients**2).sum(axis=-1, keepdims=True))
    return SdfGrid(np.array([0.1, -0.2, 0.3]), 0.01, values, gradients)


def around(sdf: SdfGrid, least: LeastDistances) -> FloatArray:
    """Points in the box of the bounds and beyond, many of them next to the borders of cells."""
    random = np.random.default_rng(5)
    most = np.array(least.most) + 1.0
    cells = random.uniform(-0.1, 1.1, (200_000, 3)) * most
    cells[::2] = np.rint(cells[::2]) + random.uniform(-1e-4, 1e-4, cells[::2].shape)
    return np.array(least.first) + cells / least.inverse


def looked_up(least: LeastDistances, points: FloatArray) -> FloatArray:
    cells = np.floor((points - least.first) * least.inverse)
    i, j, k = np.clip(cells, 0.0, least.most).astype(int).T
    found: FloatArray = least.step * least.steps[i * least.across + j * least.along + k]
    return found


@pytest.mark.parametrize("most_cells", [bounds._MOST_CELLS, 30_000])
@pytest.mark.parametrize("outside", OUTSIDE)
@pytest.mark.parametrize("lookup", LOOKUPS)
def test_no_distance_is_less(
    lookup: str, outside: str, most_cells: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounds, "_MOST_CELLS", most_cells)  # the fewer, the larger
    for sdf in (ball_grid(0.05, 0.01, 8), rugged()):
        least = least_distances(sdf, outside, REACH)
        points = around(sdf, least)
        distance = sdf.at(points, lookup=lookup, outside=outside)[0]
        away = np.sqrt(((points - np.clip(points, *sdf.bounds)) ** 2).sum(axis=1))
        found = looked_up(least, points)
        assert (found < np.maximum(distance, away))[found > 0.0].all()  # no radius is below 0
        assert (found[away > REACH + 0.1] > REACH).all()


def test_bounds_of_a_ball_are_about_half_a_cell_too_low() -> None:
    least = least_distances(BALL, "surface_point", REACH)
    points = around(BALL, least)
    distance = np.sqrt((points**2).sum(axis=1)) - 0.05
    found = looked_up(least, points)
    slack = (distance - found)[(distance < REACH) & (found > 0.0)]
    assert 0.0 < slack.mean() < 0.8 * BALL.resolution
