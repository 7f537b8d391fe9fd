"""Whether the best hypothesis explains the known points."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.input_checks import check_fit
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose, inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey

RADIUS, SIDE = 0.1, 0.01
GRID = SdfGrid.from_mesh(trimesh.creation.icosphere(4, RADIUS), 0.005, padding=0.2)
TOLERANCE = 0.04 * GRID.diameter  # 14 mm
NORMALS = trimesh.sample.sample_surface(trimesh.creation.icosphere(4, 1.0), 50, seed=0)[0]
CENTRE = np.array([0.3, 0.2, 0.1])


def problem(points: KnownPoints) -> RegistrationProblem:
    workspace = Workspace((-1, -1, -1), (1, 1, 1))
    return RegistrationProblem(GRID, points, np.eye(4)[None], workspace, SIDE, StreamKey(0, 0))


def found(cost: float = 0.0, at: FloatArray = CENTRE) -> Hypotheses:
    """Hypotheses whose best has the sphere at its place; the others are far off."""
    poses = inverse(compose(np.tile(np.eye(3), (3, 1, 1)), np.array([at, at + 5.0, at - 5.0])))
    cost_of_all = cost + np.arange(3.0)
    return Hypotheses(poses, cost_of_all, cost_of_all < 0, np.full(3, -1), poses[:0])


def at_height(*heights: float) -> FloatArray:
    """Points above and below the sphere's surface, in the world."""
    each = np.resize(heights, len(NORMALS))
    return CENTRE + (RADIUS + each)[:, None] * NORMALS


@pytest.mark.parametrize(
    ("height", "fits"),
    [(0.0, True), (0.9 * TOLERANCE, True), (1.1 * TOLERANCE, False), (-1.1 * TOLERANCE, False)],
)
def test_contacts_may_be_off_by_a_share_of_the_diameter_on_average(
    height: float, fits: bool
) -> None:
    contacts = KnownPoints(known=at_height(0.0, 2.0 * height))
    assert [w.code for w in check_fit(problem(contacts), found())] == ["no_fit"] * (not fits)


def test_known_distances_count_and_not_the_surface_alone() -> None:
    points = at_height(0.05)
    right = KnownPoints(known=points, known_sdf=np.full(50, 0.05))
    assert check_fit(problem(right), found()) == []
    (warning,) = check_fit(problem(KnownPoints(known=points)), found())
    assert "known points are 50 mm off on average (up to 50 mm)" in warning.text


def test_a_single_free_point_may_be_less_than_a_voxel_deeper() -> None:
    deep = -(TOLERANCE + SIDE)
    for height, fits in ((0.9 * deep, True), (1.1 * deep, False)):
        free = np.concatenate([at_height(0.05), at_height(height)[:1]])
        points = KnownPoints(free=free, known=at_height(0.0))
        assert (check_fit(problem(points), found()) == []) is fits
    assert "free points are up to" in check_fit(problem(points), found())[0].text


def test_occupied_points_must_not_be_far_outside() -> None:
    for height, fits in ((-0.05, True), (0.9 * TOLERANCE, True), (0.05, False)):
        points = KnownPoints(occupied=at_height(-0.05, height))
        assert (check_fit(problem(points), found()) == []) is fits


def test_what_is_no_hypothesis_does_not_matter() -> None:
    """The first is the best; the others may be anywhere."""
    points = KnownPoints(known=at_height(0.0))
    assert check_fit(problem(points), found()) == []
    assert [w.code for w in check_fit(problem(points), found(at=CENTRE + 0.1))] == ["no_fit"]


@pytest.mark.parametrize(("levels", "count"), [(9.9, 0), (13.0, 1)])
def test_an_energy_of_many_noise_levels_is_a_warning(levels: float, count: int) -> None:
    points = KnownPoints(known=at_height(0.005))
    warnings = check_fit(problem(points), found(levels * 0.0005), 0.0005)
    assert [warning.code for warning in warnings] == ["above_noise"] * count
    if count:
        assert "lowest energy is 6.5 mm, 13 noise levels" in warnings[0].text
    assert check_fit(problem(points), found(levels * 0.0005)) == []  # other costs have no level
