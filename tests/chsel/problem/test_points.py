from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from chsel import KnownPoints, Workspace
from chsel.errors import PointsError
from chsel.problem.points import FreeVoxels, GrowingPoints, Lattice


def test_points_are_copied_and_can_not_be_changed() -> None:
    mine = np.zeros((2, 3))
    points = KnownPoints(free=mine)
    mine += 1.0
    assert (points.free == 0.0).all()
    with pytest.raises(ValueError, match="read-only"):
        points.free[0] = 1.0


def test_tensors_lists_and_arrays_of_other_types_are_taken() -> None:
    for given in ([[1, 2, 3]], torch.tensor([[1.0, 2.0, 3.0]]), np.array([[1, 2, 3]], np.int8)):
        points = KnownPoints(known=given)  # type: ignore[arg-type]
        assert points.known.dtype == np.float64
        np.testing.assert_array_equal(points.known, [[1.0, 2.0, 3.0]])
        np.testing.assert_array_equal(points.sdf, [0.0])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"free": np.zeros((2, 2))}, r"free has shape \(2, 2\); accepted: \(any, 3\)"),
        ({"occupied": [[0, 0, np.inf]]}, r"occupied\[0\] is not finite"),
        ({"known": [["a", 0, 0]]}, "known is not an array of numbers"),
        ({"known": np.zeros((2, 3)), "known_sdf": [0.0]}, "known_sdf has 1 entries"),
        ({"free": np.zeros(3)}, r"free has shape \(3,\)"),
    ],
)
def test_malformed_points_are_named(arrays: dict[str, object], message: str) -> None:
    with pytest.raises(PointsError, match=message):
        KnownPoints(**arrays)  # type: ignore[arg-type]


def test_merging_appends_class_by_class_and_changes_the_digest() -> None:
    first = KnownPoints(free=[[0, 0, 0]], known=[[1, 1, 1]], known_sdf=[0.1])
    second = KnownPoints(free=[[2, 2, 2]], occupied=[[3, 3, 3]], known=[[4, 4, 4]])
    both = first.merged(second)
    np.testing.assert_array_equal(both.free, [[0, 0, 0], [2, 2, 2]])
    np.testing.assert_array_equal(both.sdf, [0.1, 0.0])
    np.testing.assert_array_equal(both.contacts, [[4, 4, 4]])
    assert both.count == 5
    assert len({first.digest, second.digest, both.digest, second.merged(first).digest}) == 4


def test_digest_tells_classes_apart() -> None:
    assert KnownPoints(free=[[1, 2, 3]]).digest != KnownPoints(occupied=[[1, 2, 3]]).digest


def test_the_same_points_are_those_of_the_same_digest() -> None:
    arrays = ({"free": [[0, 1, 2]]}, {"free": [[-0.0, 1, 2]]}, {"known": [[0, 1, 2]]})
    points = [KnownPoints(**arrays[n]) for n in (0, 0, 1, 2)]
    for a, b in itertools.product(points, points):
        assert GrowingPoints(a).same(b) == (a.digest == b.digest)
        growing = GrowingPoints(a)
        growing.add(b)
        for c, d in itertools.product(points, points):
            assert growing.same(c.merged(d)) == (a.merged(b).digest == c.merged(d).digest)


def test_voxels_keep_one_point_each_at_their_centres() -> None:
    voxels = FreeVoxels(Lattice((0.1, 0.0, 0.0), 0.025))
    new = voxels.add(np.array([[0.101, 0.0, 0.0], [0.11, 0.001, 0.0], [0.15, -0.03, 0.0]]))
    np.testing.assert_allclose(new, [[0.1, 0.0, 0.0], [0.15, -0.025, 0.0]])
    assert len(voxels.add(np.array([[0.099, 0.0, 0.0], [0.15, -0.02, 0.001]]))) == 0
    assert voxels.add(np.zeros((0, 3))).shape == (0, 3)
    assert len(voxels) == 2


def test_workspace_must_have_an_inside() -> None:
    with pytest.raises(PointsError, match="lower bound below its upper"):
        Workspace((0, 0, 0), (1, 0, 1))
    around = Workspace.around(np.array([[0.0, 1.0, 2.0], [0.5, 1.0, 2.0]]), 0.1)
    np.testing.assert_allclose(around.bounds, [[-0.1, 0.9, 1.9], [0.6, 1.1, 2.1]])
