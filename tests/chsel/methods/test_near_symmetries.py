"""Near symmetries of boxes: half turns, and quarter turns where two sides are nearly as long."""

import numpy as np
import pytest
import trimesh

from chsel.methods.anchored.near_symmetries import near_symmetries
from chsel.problem.poses import rotation_angle
from chsel.problem.sdf_grid import SdfGrid
from tests.chsel.methods.scene import GRID


@pytest.mark.parametrize(
    ("sides", "halves", "quarters"),
    [((0.1, 0.06, 0.16), 3, 0), ((0.1, 0.102, 0.16), 5, 2)],
)
def test_near_symmetries_of_a_box(sides, halves, quarters):
    """Of two sides 2 mm apart also half turns about their diagonals, and quarter turns."""
    sdf = SdfGrid.from_mesh(trimesh.creation.box(sides), 0.005)
    found = near_symmetries(sdf)
    angles = rotation_angle(found[:, :3, :3])
    assert (np.abs(angles - np.pi) < 0.02).sum() == halves
    assert (np.abs(angles - 0.5 * np.pi) < 0.02).sum() == quarters
    assert len(found) == halves + quarters
    np.testing.assert_allclose(np.sort(np.abs(found[:, :3, :3]), axis=2)[..., :2], 0.0, atol=0.02)
    np.testing.assert_allclose(found[:, :3, 3], 0.0, atol=0.001)


def test_an_object_without_symmetry_has_none():
    assert near_symmetries(GRID).shape == (0, 4, 4)
    nowhere = SdfGrid(
        GRID.origin, 0.01, values=np.abs(GRID.values) + 0.01, gradients=GRID.gradients
    )
    assert near_symmetries(nowhere).shape == (0, 4, 4)
