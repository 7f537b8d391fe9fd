"""Whether hypotheses explain the known points, and whether they are alike."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PoseError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.problem.outline import outline_distances, signed_distances
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import VERDICTS, Hypotheses, RegistrationProblem
from chsel.problem.streams import StreamKey
from chsel.problem.trust import (
    MOST_OFF,
    MOST_SYSTEMATIC,
    _contradictions,
    check_trust,
    correlation,
    has_pose,
    trust_in,
)
from tests.chsel.samples import hypotheses_at

SIDES = np.array([0.1, 0.06, 0.16])
BOX = trimesh.creation.box(SIDES)
GRID = chsel.SdfGrid.from_mesh(BOX, 0.004)
RADIUS, VOXEL, NOISE = 0.1, 0.01, 0.001
BALL = chsel.SdfGrid.from_mesh(trimesh.creation.icosphere(4, RADIUS), 0.005, padding=0.2)
NORMALS = trimesh.sample.sample_surface(trimesh.creation.icosphere(4, 1.0), 60, seed=0)[0]
CENTRE = np.array([0.3, 0.2, 0.1])
POSE = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.7)), CENTRE)  # world_from_object


def problem(points: chsel.KnownPoints, sdf: chsel.SdfGrid = BALL) -> RegistrationProblem:
    workspace = chsel.Workspace((-1, -1, -1), (1, 1, 1))
    return RegistrationProblem(sdf, points, np.eye(4)[None], workspace, VOXEL, StreamKey(0, 0))


def hypotheses(*world_from_object: FloatArray) -> Hypotheses:
    return hypotheses_at(inverse(np.array(world_from_object)))


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0, about_z: float = 0.0) -> FloatArray:
    """POSE after a motion of the object in its own frame, metres and radians."""
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(about_z))
    return np.asarray(POSE @ compose(turn, np.array([x, y, z])))


def at_height(*heights: float) -> FloatArray:
    """Points above and below the surface of the ball at CENTRE, in the world."""
    return CENTRE + (RADIUS + np.resize(heights, len(NORMALS)))[:, None] * NORMALS


def ball() -> Hypotheses:
    """Hypotheses that have the ball at CENTRE, turned; a ball looks the same."""
    turns = axis_angle(np.eye(3), np.array([0.5, 1.0, 2.0]))
    return hypotheses(*compose(turns, np.tile(CENTRE, (3, 1))))


def on_box(noise: float = 0.0) -> FloatArray:
    surface, face = trimesh.sample.sample_surface(BOX, 60, seed=1)
    away = noise * np.random.default_rng(0).standard_normal((60, 1)) * BOX.face_normals[face]
    return apply(POSE, surface + away)


def test_turns_that_a_symmetry_undoes_are_one_mode() -> None:
    trust = trust_in(problem(chsel.KnownPoints(known=at_height(0.0))), ball(), NOISE)
    assert (trust.verdict, trust.modes) == ("determined", 1)
    assert trust.spread < 0.0005
    assert trust.misfit < 0.5
    assert trust.noise == pytest.approx(NOISE, rel=0.8)
    half_turn = hypotheses(POSE, moved(about_z=math.pi))
    assert trust_in(problem(chsel.KnownPoints(known=on_box()), GRID), half_turn).modes == 1


def test_numbers_are_those_of_the_points_at_the_best_hypothesis() -> None:
    points = chsel.KnownPoints(known=on_box(noise=0.002))
    trust = trust_in(problem(points, GRID), hypotheses(POSE, moved(x=0.0005)), NOISE)
    assert trust.noise == pytest.approx(0.002, rel=0.15)
    assert trust.misfit == pytest.approx(math.sqrt(2.0 / math.pi) * 2.0, rel=0.15)
    assert trust.outliers < 0.01
    assert trust.numbers["verdict"] == VERDICTS.index("determined") == 0


def test_foreign_points_are_counted_and_do_not_change_the_verdict() -> None:
    known = on_box(noise=0.0005)
    known[:6] += np.linspace(0.03, 5.0, 6)[:, None]
    trust = trust_in(problem(chsel.KnownPoints(known=known), GRID), hypotheses(POSE), NOISE)
    assert trust.outliers == pytest.approx(6 / 60, abs=0.02)
    assert (trust.verdict, check_trust(trust)) == ("determined", [])
    assert trust.misfit < 1.5
    known[:25] += 0.1
    trust = trust_in(problem(chsel.KnownPoints(known=known), GRID), hypotheses(POSE), NOISE)
    assert trust.verdict == "nothing fits"


@pytest.mark.parametrize(
    ("height", "fits"), [(0.0, True), (0.9, True), (1.1, False), (-1.1, False)]
)
def test_errors_of_noise_may_be_a_share_of_the_diameter(height: float, fits: bool) -> None:
    """Signs at random, so that neighbours have nothing in common."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(NORMALS))
    height = height * MOST_OFF * BALL.diameter
    points = chsel.KnownPoints(known=at_height(*(height * signs)))
    assert (trust_in(problem(points), ball()).verdict != "nothing fits") is fits


@pytest.mark.parametrize(("height", "fits"), [(0.9, True), (1.1, False), (-1.1, False)])
def test_errors_of_whole_sides_may_be_less(height: float, fits: bool) -> None:
    points = chsel.KnownPoints(known=at_height(height * MOST_SYSTEMATIC * BALL.diameter))
    assert (trust_in(problem(points), ball()).verdict != "nothing fits") is fits
    told = trust_in(problem(points), ball(), 0.01)  # a sensor as bad as that explains all of them
    assert told.verdict != "nothing fits"


@pytest.mark.parametrize("scale", [1.2, 1.0 / 1.2])
def test_a_wrong_scale_fits_nothing(scale: float) -> None:
    sdf = chsel.SdfGrid.from_mesh(BOX.copy().apply_scale(scale), 0.004)
    trust = trust_in(problem(chsel.KnownPoints(known=on_box()), sdf), hypotheses(POSE))
    (warning,) = check_trust(trust)
    assert warning.code == "no_fit"
    assert "no hypothesis explains the points" in warning.text
    shifted = trust_in(problem(chsel.KnownPoints(known=on_box()), sdf), hypotheses(moved(x=0.03)))
    assert shifted.misfit != trust.misfit
    assert check_trust(shifted)[0].text == warning.text


def test_a_sensor_less_exact_than_stated_is_a_warning() -> None:
    points = problem(chsel.KnownPoints(known=on_box(noise=0.002)), GRID)
    trust = trust_in(points, hypotheses(POSE), 0.0001)
    assert trust.verdict == "determined"
    (warning,) = check_trust(trust, 0.0001)
    assert warning.code == "above_noise"
    assert "the sensor is less exact than 0.0001 m" in warning.text
    other = trust_in(points, hypotheses(moved(x=0.0005)), 0.0001)
    assert other.misfit != trust.misfit
    assert check_trust(other, 0.0001)[0].text == warning.text  # which Python shows once
    assert check_trust(trust_in(points, hypotheses(POSE))) == []


def test_known_distances_count_and_not_the_surface_alone() -> None:
    points = at_height(0.05)
    right = chsel.KnownPoints(known=points, known_sdf=np.full(len(points), 0.05))
    assert trust_in(problem(right), ball()).verdict == "determined"
    wrong = chsel.KnownPoints(known=points)
    assert trust_in(problem(wrong), ball()).verdict == "nothing fits"


def test_free_points_within_a_voxel_and_a_few_deeper_ones_contradict_nothing() -> None:
    contacts = at_height(0.0)
    for depth, count, fits in ((0.9, 60, True), (6.0, 3, True), (6.0, 60, False)):
        free = np.concatenate([at_height(0.05), at_height(-depth * VOXEL)[:count]])
        points = chsel.KnownPoints(free=free, known=contacts)
        assert (trust_in(problem(points), ball()).verdict != "nothing fits") is fits


def test_occupied_points_must_not_be_far_outside() -> None:
    for height, fits in ((-0.05, True), (0.9 * VOXEL, True), (0.05, False)):
        points = chsel.KnownPoints(occupied=at_height(height))
        assert (trust_in(problem(points), ball()).verdict != "nothing fits") is fits


def test_poses_that_fit_one_corner_are_modes_and_far_ones_do_not_count() -> None:
    """A corner is touched, near it alone: the three sides of a box can lie along it in six ways."""
    corner = np.array([[x, y, 0.0] for x in (0.005, 0.02, 0.035) for y in (0.005, 0.02, 0.035)])
    known = apply(POSE, np.concatenate([np.roll(corner, n, axis=1) for n in range(3)]))
    posed = problem(chsel.KnownPoints(known=known), GRID)
    ways = []
    for axes in permutations(range(3)):
        turn = np.eye(3)[list(axes)]  # side n of the box lies along axis axes[n] of the corner
        turn *= np.linalg.det(turn)  # no reflection; the box is the same from behind
        ways.append(POSE @ compose(turn.T, 0.5 * SIDES[np.argsort(axes)]))
    off = np.asarray(ways[0] @ compose(np.eye(3), np.array([0.03, 0.0, 0.0])))
    for count, verdict in ((1, "determined"), (2, "several modes"), (6, "several modes")):
        trust = trust_in(posed, hypotheses(*ways[:count], off))
        assert (trust.verdict, trust.modes) == (verdict, count)
    near = np.asarray(ways[1] @ compose(np.eye(3), np.array([0.0005, 0.0, 0.0])))
    poses = np.array([ways[0], ways[0], off, ways[1], near, ways[2]])
    found = hypotheses_at(inverse(poses), [False, True, False, False, False, False])
    trust = trust_in(posed, found)
    assert (trust.modes, trust.best_of_modes) == (3, (0, 3, 5))  # indices of all hypotheses


@pytest.mark.parametrize("shifts", [[0.0], [0.0, 0.001, 0.03, 0.031], np.linspace(0.0, 0.04, 12)])
def test_samples_of_a_continuum_are_no_modes(shifts: list[float]) -> None:
    """One flat side is touched: the box may stand anywhere along it."""
    side = np.array([[0.05, y, z] for y in (-0.02, 0.0, 0.02) for z in (-0.04, 0.0, 0.04)])
    posed = problem(chsel.KnownPoints(known=apply(POSE, side)), GRID)
    trust = trust_in(posed, hypotheses(*(moved(z=shift) for shift in shifts), moved(x=-0.03)))
    assert (trust.verdict, trust.modes) == ("wide", 0)
    assert str(trust).startswith("wide (spread ")


def test_the_spread_is_the_root_mean_square_of_surfaces_of_all_pairs() -> None:
    """Of balls d apart, each point of a surface is d |cos| off the other, d / sqrt(3) on average.

    Three balls in a row have four of nine pairs d apart, and two of them 2 d."""
    shift = 0.002
    row = [compose(np.eye(3), moved(x=n * shift)[:3, 3]) for n in range(3)]
    trust = trust_in(problem(chsel.KnownPoints(known=at_height(0.0))), hypotheses(*row), 0.01)
    expected = shift / math.sqrt(3.0) * math.sqrt((4 * 1.0 + 2 * 4.0) / 9.0)
    assert trust.spread == pytest.approx(expected, rel=0.1)  # of 100 points


def test_points_that_a_pose_can_fit_exactly_are_no_evidence() -> None:
    """Six contacts of a ball, which no motion leaves, and the same with one more or free points."""
    contacts = at_height(0.0)
    for count, free, verdict in ((6, 0, "wide"), (7, 0, "determined"), (6, 60, "determined")):
        points = chsel.KnownPoints(free=at_height(0.05)[:free], known=contacts[:count])
        trust = trust_in(problem(points), ball(), NOISE)
        assert (trust.verdict, trust.redundancy) == (verdict, count - 6)
        assert ("no evidence" in str(trust)) is (count == 6)
    inside = chsel.KnownPoints(free=at_height(-0.05), known=contacts[:6])  # which is evidence
    trust = trust_in(problem(inside), ball(), NOISE)
    assert trust.verdict == "nothing fits"
    assert "no evidence" not in str(trust)


def test_distances_of_outlines_are_those_of_shifts_and_turns() -> None:
    """A shift along x moves the two sides across x by it, and the others within themselves."""
    shift = 0.01
    poses = Poses.of(inverse(np.array([POSE, moved(x=shift), moved(about_z=math.pi)])))
    apart = outline_distances(GRID, poses)
    across = 2 * SIDES[1] * SIDES[2] / BOX.area  # share of the surface
    assert apart[0, 1] == pytest.approx(shift * math.sqrt(across), rel=0.25)
    assert apart[0, 2] < 0.001
    np.testing.assert_array_equal(apart, apart.T)


def test_errors_are_alike_on_sides_and_not_in_noise() -> None:
    signs = np.where(NORMALS[:, 0] > 0.0, 1.0, -1.0)
    assert correlation(NORMALS, signs) > 0.7
    assert abs(correlation(NORMALS, np.random.default_rng(0).standard_normal(60))) < 0.3
    assert correlation(NORMALS[:7], signs[:7]) == 0.0
    assert correlation(NORMALS, np.zeros(60)) == 0.0


def test_poses_that_are_not_finite_or_repeated_are_left_out() -> None:
    posed = problem(chsel.KnownPoints(known=at_height(0.0)))
    found = ball()
    poses = found.object_from_world.copy()
    poses[1, 0, 3], poses[2, 1, 1] = np.inf, np.nan
    assert trust_in(posed, hypotheses_at(poses)) == trust_in(posed, hypotheses_at(poses[:1]))
    for bad in (hypotheses_at(poses[[1, 0]]), hypotheses_at(poses[:0])):
        assert not has_pose(bad)
        with pytest.raises(PoseError, match="accepted: at least one pose"):
            trust_in(posed, bad)
    with pytest.raises(SettingError, match=r"sensor_noise is 0\.0"):
        trust_in(posed, found, 0.0)


def test_many_points_and_hypotheses_take_a_moment() -> None:
    rng = np.random.default_rng(0)
    known = np.tile(at_height(0.0), (1000, 1)) + 0.001 * rng.standard_normal((60_000, 3))
    points = chsel.KnownPoints(free=rng.uniform(0.5, 2.0, (200_000, 3)), known=known)
    shifts = compose(np.tile(np.eye(3), (3000, 1, 1)), CENTRE + 0.001 * rng.random((3000, 3)))
    trust = trust_in(problem(points), hypotheses(*shifts), NOISE)
    assert (trust.verdict, trust.modes) == ("determined", 1)


def test_an_object_thinner_than_its_grid_is_judged_too() -> None:
    """No node is inside, and no point of the surface known exactly."""
    plate = trimesh.creation.box((0.1, 0.1, 0.001))
    sdf = chsel.SdfGrid.from_mesh(plate, 0.0085)
    assert sdf.values.min() > 0.0
    known = apply(POSE, trimesh.sample.sample_surface(plate, 20, seed=0)[0])
    trust = trust_in(problem(chsel.KnownPoints(known=known), sdf), hypotheses(POSE, moved(x=0.05)))
    assert trust.spread > 0.005
    nowhere = chsel.SdfGrid(np.zeros(3), 0.01, np.ones((4, 4, 4)), np.ones((4, 4, 4, 3)))
    trust = trust_in(problem(chsel.KnownPoints(known=known), nowhere), hypotheses(POSE))
    assert (trust.verdict, trust.modes) == ("nothing fits", 0)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_contradictions_are_by_the_distances_that_the_grid_gives(sign: float, count: int) -> None:
    random = np.random.default_rng(1)
    world_from_object = [moved(*random.uniform(-0.05, 0.05, 4)) for _ in range(7)]
    poses, tolerance = Poses.of(inverse(np.array(world_from_object))), 0.003
    points = CENTRE + random.uniform(-0.15, 0.15, (5000, 3))  # the grid's box ends among them
    places = [apply(pose, points) for pose in poses.matrices]
    expected = np.array([GRID.at(place, lookup="trilinear")[0] for place in places])
    with threads(count):
        found = signed_distances(GRID, poses, points)
        depths, counts = _contradictions(GRID, poses, points, sign, tolerance)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    wrong = sign * expected > tolerance
    assert (wrong.sum(axis=1) > 100).all()
    assert counts.tolist() == wrong.sum(axis=1).tolist()
    np.testing.assert_allclose(depths, (sign * expected * wrong).sum(axis=1), rtol=1e-9)
