import numpy as np
import pytest
import trimesh

from chsel import SdfGrid
from chsel.errors import SdfError
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points
from tests.chsel.samples import ball_grid, box_distance

RADIUS, RESOLUTION = 0.05, 0.01
SIDES = np.array([0.163, 0.107, 0.089])
COUNT = 4000


def stream():
    return StreamKey(0, 0).stream(Purpose.ICP_SURFACE)


def chi_square(counts, shares):
    """How unlike counts are to shares: mean 1 per degree of freedom, here in deviations off it."""
    expected = counts.sum() * shares / shares.sum()
    total, freedom = (((counts - expected) ** 2) / expected).sum(), len(counts) - 1
    return float((total - freedom) / np.sqrt(2.0 * freedom))


def test_points_are_on_a_sphere_and_uniform_there():
    points = surface_points(ball_grid(RADIUS, RESOLUTION, 10), COUNT, stream())
    distance = np.sqrt((points**2).sum(axis=1)) - RADIUS
    assert np.abs(distance).max() < 0.02 * RESOLUTION
    # Bands of equal height have equal areas.
    band = np.floor((points[:, 2] / RADIUS + 1.0) / 2.0 * 8).clip(0, 7)
    sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) % 1.0) * 12)
    counts = np.bincount((12 * band + sector).astype(int), minlength=96)
    assert abs(chi_square(counts, np.ones(96))) < 3.0


def test_points_are_on_a_box_and_uniform_there():
    grid = SdfGrid.from_mesh(trimesh.creation.box(SIDES), RESOLUTION)
    points = surface_points(grid, COUNT, stream())
    distance = np.abs(box_distance(points, SIDES))
    assert distance.max() < 0.5 * RESOLUTION  # at corners, which a grid cannot show
    assert distance.mean() < 0.02 * RESOLUTION
    # Of faces a centimetre off the edges, where the grid's surface is that of the box.
    counts, areas = [], []
    for axis in range(3):
        u, v = (other for other in range(3) if other != axis)
        half = SIDES[[u, v]] / 2.0 - 0.01
        for side in (-1.0, 1.0):
            on = np.abs(points[:, axis] - side * SIDES[axis] / 2.0) < 1e-6
            counts.append((on & (np.abs(points[:, [u, v]]) < half).all(axis=1)).sum())
            areas.append(half[0] * half[1])
    assert abs(chi_square(np.array(counts), np.array(areas))) < 3.0
    assert sum(counts) > 0.5 * COUNT


@pytest.mark.parametrize("depth", [0.004, 1e-320])
def test_a_single_node_inside_has_a_surface(depth):
    values = np.full((4, 4, 4), 0.01)
    values[1, 1, 1] = -depth
    grid = SdfGrid(np.zeros(3), 0.01, values, np.zeros((4, 4, 4, 3)))
    points = surface_points(grid, 200, stream())
    assert np.abs(points - 0.01).max() < max(2.0 * depth, 1e-12)


def test_an_object_between_the_nodes_is_refused():
    grid = SdfGrid(np.zeros(3), 0.01, np.full((4, 4, 4), 0.01), np.zeros((4, 4, 4, 3)))
    with pytest.raises(SdfError, match="no node of the SDF grid is inside"):
        surface_points(grid, 3, stream())
