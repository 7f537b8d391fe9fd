"""Whether hypotheses explain the known points, are alike, and are held by the points."""

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PoseError, SettingError
from chsel.problem.noise import LIMIT, PRIOR_CONTACTS, PRIOR_OUTLIERS, estimate_noise, noise_model
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import VERDICTS, RegistrationProblem
from chsel.problem.streams import StreamKey
from chsel.problem.surface import outline_distances
from chsel.problem.trust import (
    FOREIGN_CONTACT,
    LEAST_GAP,
    LEAST_LEVELS,
    MANY_BEYOND,
    MANY_CONTACTS,
    MOST_LEVELS,
    MOST_LEVELS_OF_MANY,
    MOST_MODES,
    MOST_NOISE,
    MOST_OFF,
    MOST_SYSTEMATIC,
    MOST_WIDTH,
    SENSOR_NOISE,
    _solved,
    check_trust,
    correlation,
    has_pose,
    motion_cost,
    pose_energies,
    trust_in,
    turned,
)
from tests.chsel.samples import bracket, hypotheses_at, plain_energies, plain_energy

SIDES = np.array([0.1, 0.06, 0.16])
BOX = trimesh.creation.box(SIDES)
GRID = chsel.SdfGrid.from_mesh(BOX, 0.004)
CAN = trimesh.creation.cylinder(0.04, 0.12, sections=64)
RADIUS = 0.1
VOXEL = 0.01
NOISE = 0.001
NODES = np.moveaxis(np.indices((121, 121, 121)), 0, -1) * 0.005 - 0.3
FROM_CENTRE = np.linalg.norm(NODES, axis=-1)
GRADIENTS = NODES / np.maximum(FROM_CENTRE, 1e-9)[..., None]
BALL = chsel.SdfGrid(np.full(3, -0.3), 0.005, values=FROM_CENTRE - RADIUS, gradients=GRADIENTS)
NORMALS = trimesh.unitize(np.random.default_rng(0).standard_normal((60, 3)))
CENTRE = np.array([0.3, 0.2, 0.1])
POSE = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.7)), CENTRE)  # world_from_object
BEST = Poses.of(inverse(POSE[None]))
SIDE = np.array([[0.05, y, z] for y in (-0.02, 0.0, 0.02) for z in (-0.04, 0.0, 0.04)])


def problem(sdf=BALL, **points):
    room = chsel.Workspace((-1, -1, -1), (1, 1, 1))
    known = chsel.KnownPoints(**points)
    return RegistrationProblem(
        sdf=sdf,
        points=known,
        initial_set=np.eye(4)[None],
        workspace=room,
        free_resolution=VOXEL,
        key=StreamKey(0, 0),
    )


def judged(found, noise=SENSOR_NOISE, *, sdf=BALL, **points):
    return trust_in(problem(sdf, **points), found, sensor_noise=noise)


def hypotheses(*world_from_object):
    return hypotheses_at(inverse(np.array(world_from_object)))


def moved(x=0.0, y=0.0, *, z=0.0, about_z=0.0):
    """POSE after a motion of the object in its own frame, metres and radians."""
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(about_z))
    return POSE @ compose(turn, np.array([x, y, z]))


def at_height(*heights):
    """Points above and below the surface of the ball at CENTRE, in the world."""
    return CENTRE + (RADIUS + np.resize(heights, len(NORMALS)))[:, None] * NORMALS


TURNS = axis_angle(np.eye(3), np.array([0.5, 1.0, 2.0]))
TURNED_BALL = hypotheses(*compose(TURNS, np.tile(CENTRE, (3, 1))))


def on_box(noise=0.0):
    surface, face = trimesh.sample.sample_surface(BOX, 60, seed=1)
    away = noise * np.random.default_rng(0).standard_normal((60, 1)) * BOX.face_normals[face]
    return apply(POSE, surface + away)


def test_turns_that_a_symmetry_undoes_are_one_mode():
    trust = judged(TURNED_BALL, NOISE, known=at_height(0.0))
    assert (trust.verdict, trust.modes) == ("determined", 1)
    assert trust.spread < 0.0005
    assert trust.misfit < 0.5
    half_turn = hypotheses(POSE, moved(about_z=math.pi))
    assert judged(half_turn, sdf=GRID, known=on_box()).modes == 1


def test_numbers_are_those_of_the_points_at_the_best_hypothesis():
    found = hypotheses(POSE, moved(x=0.0005))
    trust = judged(found, NOISE, sdf=GRID, known=on_box(noise=0.002))
    assert trust.noise == pytest.approx(0.002, rel=0.15)
    assert trust.misfit == pytest.approx(math.sqrt(2.0 / math.pi) * 2.0, rel=0.15)
    assert trust.outliers < 0.01
    for beyond, most in ((MANY_BEYOND - 1, MOST_LEVELS), (MANY_BEYOND, MOST_LEVELS_OF_MANY)):
        for misfit, codes in ((most, []), (1.001 * most, ["above_noise"])):
            judgement = replace(trust, misfit=misfit, redundancy=beyond)
            assert [each.code for each in check_trust(judgement)] == codes
    upright = hypotheses(compose(np.eye(3), CENTRE))  # on its axes the grid is exact
    known = CENTRE[None] + np.array([RADIUS + 0.0005, 0.0, 0.0])
    one = judged(upright, NOISE, known=known, free=CENTRE[None] + 0.9)
    assert one.misfit == pytest.approx(0.5, rel=1e-6)
    assert trust.numbers["verdict"] == VERDICTS.index("determined") == 0


def test_foreign_points_are_counted_and_do_not_change_the_verdict():
    known = on_box(noise=0.0005)
    known[:6] += np.linspace(0.03, 5.0, 6)[:, None]
    trust = judged(hypotheses(POSE), NOISE, sdf=GRID, known=known)
    assert trust.outliers == pytest.approx(6 / 60, abs=0.02)
    assert (trust.verdict, check_trust(trust)) == ("determined", [])
    assert trust.misfit < 1.5
    known[:25] += 0.1
    assert judged(hypotheses(POSE), NOISE, sdf=GRID, known=known).verdict == "nothing fits"


@pytest.mark.parametrize("share", [0.9, 1.1, -1.1])
def test_errors_may_be_a_share_of_the_diameter_and_those_of_whole_sides_less(share):
    """Signs at random, so that neighbours have nothing in common, and all the same."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(NORMALS))
    for heights in (MOST_OFF * signs, np.array([MOST_SYSTEMATIC])):
        known = at_height(*(share * BALL.diameter * heights))
        assert (judged(TURNED_BALL, known=known).verdict != "nothing fits") is (abs(share) < 1.0)
    assert judged(TURNED_BALL, 0.01, known=known).verdict != "nothing fits"  # by a sensor so bad


@pytest.mark.parametrize(("levels", "fits"), [(0.9, True), (1.1, False)])
def test_contacts_may_not_be_off_by_more_than_any_sensor_is(levels, fits):
    sizes = np.random.default_rng(0).standard_normal(len(NORMALS))
    known = at_height(*(levels * MOST_NOISE / np.sqrt((sizes**2).mean()) * sizes))
    trust = judged(TURNED_BALL, NOISE, known=known)
    assert trust.noise == pytest.approx(levels * MOST_NOISE, rel=0.03)
    assert (trust.verdict != "nothing fits") is fits
    stated = 1.2 * levels * MOST_NOISE / LEAST_LEVELS
    assert judged(TURNED_BALL, stated, known=known).verdict != "nothing fits"


@pytest.mark.parametrize("scale", [1.2, 1.0 / 1.2])
def test_a_wrong_scale_fits_nothing(scale):
    sdf = chsel.SdfGrid.from_mesh(BOX.copy().apply_scale(scale), 0.004)
    trust = judged(hypotheses(POSE), sdf=sdf, known=on_box())
    (warning,) = check_trust(trust)
    assert (warning.code, warning.text[:38]) == ("no_fit", "no hypothesis explains the points, see")


def test_free_and_occupied_points_may_be_wrong_by_a_voxel_and_a_few_by_more():
    for depth, count, fits in ((0.9, 60, True), (6.0, 3, True), (6.0, 60, False)):
        free = np.concatenate([at_height(0.05), at_height(-depth * VOXEL)[:count]])
        trust = judged(TURNED_BALL, free=free, known=at_height(0.0))
        assert (trust.verdict != "nothing fits") is fits
    for height, fits in ((-0.05, True), (0.9 * VOXEL, True), (0.05, False)):
        trust = judged(TURNED_BALL, occupied=at_height(height))
        assert (trust.verdict != "nothing fits") is fits


def test_poses_that_fit_one_corner_are_modes_and_far_ones_do_not_count():
    """A corner is touched, near it alone: the three sides of a box can lie along it in six ways."""
    corner = np.array([[x, y, 0.0] for x in (0.005, 0.02, 0.035) for y in (0.005, 0.02, 0.035)])
    known = apply(POSE, np.concatenate([np.roll(corner, n, axis=1) for n in range(3)]))
    ways = []
    for axes in permutations(range(3)):
        turn = np.eye(3)[list(axes)]  # side n of the box lies along axis axes[n] of the corner
        turn *= np.linalg.det(turn)  # no reflection; the box is the same from behind
        ways.append(POSE @ compose(turn.T, 0.5 * SIDES[np.argsort(axes)]))
    off = ways[0] @ compose(np.eye(3), np.array([0.03, 0.0, 0.0]))
    for count, verdict in ((1, "determined"), (2, "several modes"), (6, "several modes")):
        trust = judged(hypotheses(*ways[:count], off), sdf=GRID, known=known)
        assert (trust.verdict, trust.modes) == (verdict, count)
    near = ways[1] @ compose(np.eye(3), np.array([0.0005, 0.0, 0.0]))
    poses = np.array([ways[0], ways[0], off, ways[1], near, ways[2]])
    found = hypotheses_at(inverse(poses), [False, True, False, False, False, False])
    trust = judged(found, sdf=GRID, known=known)
    assert (trust.modes, trust.best_of_modes) == (3, (0, 3, 5))  # indices of all hypotheses


@pytest.mark.parametrize("shifts", [[0.0], np.linspace(0.0, 0.04, 12)])
def test_samples_of_a_continuum_are_no_modes(shifts):
    """One flat side is touched: the box may stand anywhere along it."""
    found = hypotheses(*(moved(z=shift) for shift in shifts), moved(x=-0.03))
    trust = judged(found, sdf=GRID, known=apply(POSE, SIDE))
    assert (trust.verdict, trust.modes) == ("wide", 0)


@pytest.fixture
def held(monkeypatch):
    """No pose can be moved, so that the verdict depends on the poses of the set."""
    monkeypatch.setattr("chsel.problem.trust.motion_cost", lambda *_, **__: math.inf)


def lying(z=0.0):
    """The box with its side across y where that across x is at POSE, shifted along it."""
    quarter = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(-0.5 * np.pi))
    return POSE @ compose(quarter, np.array([0.02, 0.0, z]))


@pytest.mark.usefixtures("held")
def test_a_set_is_wide_where_any_mode_is():
    steps = np.arange(0.0, 0.041, 0.01)
    known = apply(POSE, SIDE)
    narrow = [POSE, moved(z=0.01)]
    wide = [moved(z=step) for step in steps]
    others = [lying(), lying(0.01)]
    for poses, verdict in (
        ([*narrow, *others], "several modes"),
        (wide, "wide"),
        ([*wide, *others], "wide"),
        ([*narrow, *(lying(step) for step in steps)], "wide"),
    ):
        assert judged(hypotheses(*poses), sdf=GRID, known=known).verdict == verdict


@pytest.mark.usefixtures("held")
@pytest.mark.parametrize(("count", "verdict"), [(MOST_MODES, "several modes"), (9, "wide")])
def test_a_set_of_very_many_modes_is_wide(count, verdict):
    """Balls all around one contact, each a mode; a free point far away is the only evidence."""
    sides = trimesh.creation.icosahedron().vertices[:count]
    centres = CENTRE + RADIUS * sides / np.linalg.norm(sides, axis=1, keepdims=True)
    found = hypotheses(*compose(np.tile(np.eye(3), (count, 1, 1)), centres))
    assert judged(found, free=CENTRE[None] + 0.9, known=CENTRE[None]).verdict == verdict


@pytest.mark.parametrize("movable", [0, 1])
def test_a_set_is_wide_where_any_mode_can_be_moved(monkeypatch, movable):
    found = hypotheses(POSE, lying())
    one = found.object_from_world[movable]
    monkeypatch.setattr(
        "chsel.problem.trust.motion_cost",
        lambda _, pose, *__, **___: LIMIT if np.array_equal(pose.matrices[0], one) else math.inf,
    )
    assert judged(found, sdf=GRID, known=apply(POSE, SIDE)).verdict == "wide"


@pytest.mark.parametrize(
    ("cost", "verdict", "said"),
    [(8.7, "wide", "8.7 nats"), (9.4, "determined", "9.4 nats"), (13.6, "determined", None)],
)
def test_a_verdict_says_how_near_to_its_limit_it_is(monkeypatch, cost, verdict, said):
    monkeypatch.setattr("chsel.problem.trust.motion_cost", lambda *_, **__: cost)
    trust = judged(hypotheses(POSE, moved(z=0.002)), sdf=GRID, known=on_box())
    limit = MOST_WIDTH * GRID.diameter
    assert (trust.verdict, trust.limit) == (verdict, limit)
    assert f" of {1000.0 * limit:.1f} mm" in str(trust)
    assert ("nats, wide up to 9" in str(trust)) is (said is not None)
    assert said is None or said in str(trust)


def test_the_text_has_no_number_that_few_contacts_cannot_show():
    """Before any distance is known, noise and outliers are those of a prior."""
    points = at_height(0.0)
    off = CENTRE + 0.5 * RADIUS * NORMALS[:1]
    texts = [
        str(judged(TURNED_BALL, NOISE, known=known))
        for known in (points[:6], points[:8], np.concatenate([points[:8], off]))
    ]
    assert ["noise 1.0 mm" in text for text in texts] == [False, True, True]
    assert ["outlier" in text for text in texts] == [False, False, True]
    assert ", 1 outlier, " in texts[2]


def test_the_text_ends_with_how_far_the_pose_may_be_off():
    known = on_box()
    trust = judged(hypotheses(POSE), sdf=GRID, known=known)
    assert trust.centre_within is None
    bound = {"centre_within": 0.00281, "turn_within": math.radians(3.2)}
    text = str(replace(trust, **bound))
    assert text.endswith("), centre within 2.9 mm, 4°")  # rounded up
    wide = str(replace(trust, verdict="wide", **bound))
    assert wide.endswith("), centre off by up to 2.9 mm and 4° or more")
    assert str(replace(trust, verdict="nothing fits", **bound)).endswith(")")
    assert replace(trust, **bound).numbers["turn_within"] == bound["turn_within"]
    assert "turn_within" not in trust.numbers


def test_errors_that_the_stated_noise_does_not_explain_make_a_result_wide():
    """Of 0.5 mm where 1 mm is stated, and of 8 mm: far above that, though the pose is right."""
    for noise, verdict in ((0.0005, "determined"), (0.008, "wide")):
        trust = judged(hypotheses(POSE), NOISE, sdf=GRID, known=on_box(noise=noise))
        assert trust.verdict == verdict
        warned = [each.code for each in check_trust(trust, NOISE)]
        assert warned == (["above_noise"] if verdict == "wide" else [])
    assert trust.reason == "errors far above the noise of 1 mm that is stated"
    stated = judged(hypotheses(POSE), 8.0 * NOISE, sdf=GRID, known=on_box(noise=0.008))
    assert (stated.verdict, check_trust(stated, 8.0 * NOISE)) == ("determined", [])


@pytest.mark.usefixtures("held")
def test_poses_within_the_noise_are_one_mode():
    """A ball whose distances are known to points on a ring is on one side of the ring or another.

    The noise is the same on both sides.
    """
    half, count = 0.01, 30  # of the way between the two places, across the ring
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    ring = 0.014 * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    distances = np.sqrt((ring**2).sum(axis=1) + half**2) - RADIUS
    places = [compose(np.eye(3), CENTRE + np.array([0.0, 0.0, z])) for z in (half, -half)]
    apart = outline_distances(BALL, Poses.of(inverse(np.array(places))))[0, 1]
    assert MOST_WIDTH * BALL.diameter < apart < 1.2 * MOST_WIDTH * BALL.diameter
    signs = np.random.default_rng(0).choice([-1.0, 1.0], count)
    for noise, modes in ((0.8 * apart / LEAST_GAP, 2), (1.2 * apart / LEAST_GAP, 1)):
        points = {"known": CENTRE + ring, "known_sdf": distances + noise * signs}
        trust = judged(hypotheses(*places), 3.0 * NOISE, **points)
        assert trust.noise == pytest.approx(noise, rel=0.1)
        assert trust.modes == modes


@pytest.mark.usefixtures("held")
def test_poses_that_leave_out_one_of_few_contacts_are_rivals():
    """A box slid until one contact is in the air, and off the others by as much as is allowed."""
    side = [[0.05, y, z] for y in np.linspace(-0.02, 0.02, 4) for z in np.linspace(-0.04, 0.04, 4)]
    known = np.array([*side, [0.02, 0.03, -0.03], [0.0, 0.0, 0.08], [-0.02, 0.03, 0.03]])
    assert len(known) == MANY_CONTACTS - 1
    slid = np.array([moved(x=x, z=0.03) for x in np.arange(0.0, 0.005, 0.0001)])
    rivals = Poses.of(inverse(slid))
    noise = noise_model(NOISE)
    for contacts, few in ((known, True), (np.concatenate([known, [[0.05, 0.01, 0.02]]]), False)):
        posed = problem(GRID, known=apply(POSE, contacts))
        energies = pose_energies(posed, Poses.joined([BEST, rivals]), noise=noise)
        above = energies[1:] - energies[0]
        n = int(np.argmin(np.abs(above - LIMIT - 0.5 * FOREIGN_CONTACT)))
        assert LIMIT < above[n] < LIMIT + FOREIGN_CONTACT
        alone = hypotheses(POSE)
        found = hypotheses(POSE, slid[n])
        assert trust_in(posed, alone, sensor_noise=NOISE).verdict == "determined"
        assert (
            trust_in(posed, found, sensor_noise=NOISE).verdict == "determined"
        )  # it is too unlikely itself
        beside = trust_in(posed, alone, sensor_noise=NOISE, rivals=rivals[n : n + 1])
        assert beside.verdict == ("several modes" if few else "determined")
        assert beside.best_of_modes == (0,)  # rivals have no index
        apart = Poses.of(inverse(moved(x=0.03)[None]))
        assert trust_in(posed, alone, sensor_noise=NOISE, rivals=apart).verdict == "determined"


def test_twins_are_told_apart_and_true_symmetries_are_not():
    """A quarter turn of a box moves its sides by 3 mm; contacts lie half of that off in both."""
    sdf = chsel.SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.106, 0.16)), 0.004)
    corners = [[y, z] for y in (-0.03, 0.03) for z in (-0.06, 0.06)]
    sides = np.array([[x, y, z] for x in (-0.0515, 0.0515) for y, z in corners])
    ends = [[x, y, z] for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.08, 0.08)]
    posed = problem(sdf, known=apply(POSE, np.concatenate([sides, sides[:, [1, 0, 2]], ends])))
    quarter = moved(about_z=0.5 * math.pi)
    half = moved(about_z=math.pi)
    alike = trust_in(posed, hypotheses(POSE, half), sensor_noise=NOISE)
    assert (alike.verdict, alike.modes, alike.twins) == ("determined", 1, None)
    quarters = Poses.of(inverse(quarter[None]))
    for trust, best in (
        (trust_in(posed, hypotheses(POSE, half, quarter), sensor_noise=NOISE), (0, 2)),
        (trust_in(posed, hypotheses(POSE), sensor_noise=NOISE, rivals=quarters), (0,)),
    ):
        assert (trust.verdict, trust.modes, trust.best_of_modes) == ("several modes", 2, best)
        expected = 0.5 * math.pi, pytest.approx(0.003 * math.sqrt(0.066 / 0.087), rel=0.15)
        assert trust.twins == (pytest.approx(expected[0]), expected[1])
        assert str(trust).startswith("determined up to a turn of 90 degrees, ")


def test_the_spread_is_the_root_mean_square_of_surfaces_of_all_pairs():
    """Of balls d apart, each point of a surface is d |cos| off the other, d / sqrt(3) on average.

    Three balls in a row have four of nine pairs d apart, and two of them 2 d.
    """
    shift = 0.002
    row = [compose(np.eye(3), moved(x=n * shift)[:3, 3]) for n in range(3)]
    trust = judged(hypotheses(*row), 0.01, known=at_height(0.0))
    expected = shift / math.sqrt(3.0) * math.sqrt((4 * 1.0 + 2 * 4.0) / 9.0)
    assert trust.spread == pytest.approx(expected, rel=0.1)  # of 100 points


def test_points_that_a_pose_can_fit_exactly_are_no_evidence():
    """Six contacts of a ball, which no motion leaves, and the same with one more or free points."""
    contacts = at_height(0.0)
    for count, free, verdict in ((6, 0, "wide"), (7, 0, "determined"), (6, 60, "determined")):
        points = {"free": at_height(0.05)[:free], "known": contacts[:count]}
        trust = judged(TURNED_BALL, NOISE, **points)
        assert (trust.verdict, trust.redundancy) == (verdict, count - 6)
        assert ("no evidence" in str(trust)) is (count == 6)
    filled = judged(TURNED_BALL, NOISE, occupied=at_height(-0.05), known=contacts[:6])
    assert (filled.verdict, filled.redundancy) == ("determined", 0)
    inside = judged(TURNED_BALL, NOISE, free=at_height(-0.05), known=contacts[:6])
    assert inside.verdict == "nothing fits"  # by evidence of the free points
    assert "no evidence" not in str(inside)


def test_poses_that_are_not_finite_or_repeated_are_left_out():
    posed = problem(known=at_height(0.0))
    poses = TURNED_BALL.object_from_world.copy()
    poses[1, 0, 3], poses[2, 1, 1] = np.inf, np.nan
    assert trust_in(posed, hypotheses_at(poses)) == trust_in(posed, hypotheses_at(poses[:1]))
    for bad in (hypotheses_at(poses[[1, 0]]), hypotheses_at(poses[:0])):
        assert not has_pose(bad)
        with pytest.raises(PoseError, match="accepted: at least one pose"):
            trust_in(posed, bad)
    with pytest.raises(SettingError, match=r"sensor_noise is 0\.0"):
        trust_in(posed, TURNED_BALL, sensor_noise=0.0)


def test_an_object_thinner_than_its_grid_is_judged_too():
    """No node is inside, and no point of the surface known exactly."""
    plate = trimesh.creation.box((0.1, 0.1, 0.001))
    sdf = chsel.SdfGrid.from_mesh(plate, 0.0085)
    assert sdf.values.min() > 0.0
    known = apply(POSE, trimesh.sample.sample_surface(plate, 20, seed=0)[0])
    middle = known[np.abs(apply(inverse(POSE), known)[:, 0]) < 0.03]
    slid = hypotheses(POSE, moved(x=0.02))  # along itself
    assert judged(slid, sdf=sdf, known=middle).spread > 0.002


def movable(mesh, noise=NOISE, **points):
    """Whether the mesh at POSE can be moved by 6 mm; points in the object's frame."""
    sdf = chsel.SdfGrid.from_mesh(mesh, 0.004)
    known = {name: apply(POSE, group) for name, group in points.items()}
    return motion_cost(problem(sdf, **known), BEST, sensor_noise=noise, distance=0.006) <= LIMIT


def on(mesh, count):
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])


LONG_SIDES = on(BOX, 80)[np.abs(on(BOX, 80)[:, 2]) < 0.06]  # contacts not near the ends of the box


@pytest.mark.parametrize("mesh", [BOX, CAN])
def test_contacts_all_around_hold_an_object_and_a_turn_of_a_can_is_no_motion(mesh):
    assert not movable(mesh, known=on(mesh, 40))
    assert movable(mesh, known=on(mesh, 4))
    assert movable(mesh, noise=0.03, known=on(mesh, 40))  # far more than the distance


def test_an_object_slides_along_the_sides_that_were_touched_unless_its_ends_are_known():
    """By 14 mm, which moves the two ends by it and all else within itself: 6 mm on average."""
    assert movable(BOX, known=LONG_SIDES)
    ends = np.array([[0.0, 0.0, 0.08], [0.02, 0.01, 0.08], [0.0, 0.0, -0.08]])
    assert not movable(BOX, known=np.concatenate([LONG_SIDES, ends]))
    x, y = np.meshgrid(np.arange(-0.05, 0.051, 0.01), np.arange(-0.03, 0.031, 0.01))
    beyond = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.083)], axis=1)
    assert movable(BOX, known=LONG_SIDES, free=beyond)  # the other way
    assert not movable(BOX, known=LONG_SIDES, free=np.concatenate([beyond, -beyond]))
    assert movable(BOX, free=np.full((3, 3), 0.5))  # by which nothing is known


@pytest.mark.parametrize("contacts", [5, 40])
def test_energies_of_poses_are_the_plain_formula(contacts):
    random = np.random.default_rng(contacts)
    free = on(BOX, 30) * random.uniform(0.8, 1.2, (30, 1))
    occupied = on(BOX, 9) * random.uniform(0.9, 1.1, (9, 1))
    points = {"known": on(BOX, contacts), "free": free, "occupied": occupied}
    posed = problem(GRID, **{name: apply(POSE, group) for name, group in points.items()})
    turns = axis_angle(np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.05, 0.5]))
    poses = Poses.of(inverse(POSE @ compose(turns, random.normal(0.0, 0.01, (3, 3)))))
    noise = noise_model(NOISE)
    expected = plain_energies(noise, posed.sdf, points=posed.points, poses=poses)
    np.testing.assert_allclose(pose_energies(posed, poses, noise=noise), expected, rtol=1e-9)


def test_the_correlation_is_of_errors_with_those_of_the_three_nearest():
    random = np.random.default_rng(2)
    points = random.uniform(-1.0, 1.0, (20, 3)) * (1.0, 2.0, 3.0)
    errors = random.normal(size=20)
    near = np.linalg.norm(points[:, None] - points, axis=-1).argsort(axis=1)[:, 1:4]
    expected = (errors[:, None] * errors[near]).sum() / (3.0 * (errors**2).sum())
    assert correlation(points, errors) == pytest.approx(expected)


def test_equations_are_solved_as_by_lapack():
    random = np.random.default_rng(3)
    root, right = random.normal(size=(6, 6)), random.normal(size=(4, 6))
    matrix = root @ root.T + np.eye(6)
    np.testing.assert_allclose(_solved(matrix, right), np.linalg.solve(matrix, right.T).T)


def test_a_box_beside_its_origin_is_as_symmetric():
    sdf = chsel.SdfGrid.from_mesh(BOX.copy().apply_translation((0.05, -0.03, 0.02)), 0.004)
    turns = axis_angle(np.array([0.0, 0.0, 1.0]), np.array([0.0, math.pi, 0.5 * math.pi]))
    poses = Poses.of(compose(turns, np.array([CENTRE, -CENTRE, CENTRE])))
    quarter = turned(sdf, poses, pairs=np.ones((3, 3), dtype=bool))
    assert quarter.tolist() == [[False, False, True], [False, False, True], [True, True, False]]


SENSOR = 0.0005


@pytest.mark.parametrize(("sigma", "foreign"), [(0.001, 0), (0.006, 60)])
def test_many_distances_tell_the_noise_and_the_share_of_outliers(sigma, foreign):
    random = np.random.default_rng(3)
    distances = np.concatenate([random.normal(0.0, sigma, 600), random.uniform(0.05, 0.2, foreign)])
    noise = estimate_noise(random.permutation(distances), SENSOR)
    assert noise.sigma == pytest.approx(sigma, rel=0.06)
    assert noise.outliers == pytest.approx(foreign / len(distances), abs=0.003)
    assert estimate_noise(-distances[::-1], SENSOR) == noise  # neither order nor sign matters


@pytest.mark.parametrize("count", [0, 1, 6, 100])
def test_distances_that_a_fit_makes_small_leave_the_noise_of_the_sensor(count):
    noise = estimate_noise(np.full(count, 1e-5), SENSOR)
    assert SENSOR <= noise.sigma < 1.001 * SENSOR
    expected = PRIOR_CONTACTS * PRIOR_OUTLIERS / (PRIOR_CONTACTS + count)
    assert noise.outliers == pytest.approx(expected)


def test_one_contact_counts_beside_those_of_the_sensor():
    sigma = math.sqrt((PRIOR_CONTACTS * SENSOR**2 + 0.001**2) / PRIOR_CONTACTS)
    assert estimate_noise([0.001], SENSOR).sigma == pytest.approx(sigma)


def test_one_contact_far_off_among_five_is_an_outlier():
    distances = np.array([0.0003, -0.0004, 0.05, 0.0002, -0.0001])
    noise = estimate_noise(distances, SENSOR)
    assert noise.sigma < 2.0 * SENSOR
    assert noise.outliers == pytest.approx((1.0 + PRIOR_CONTACTS * PRIOR_OUTLIERS) / 9.0)


@pytest.mark.parametrize(("known", "shared"), [(0, 0.0), (3, 0.0), (12, 0.004), (50, 0.0)])
def test_energies_are_the_formula(known, shared):
    """Of contacts, one of which is 30 cm off, and of 40 voxels: none, some or most are wrong."""
    random = np.random.default_rng(known)
    noise = noise_model(SENSOR, shared)
    residuals = random.normal(0.0, 0.004, (9, known))
    residuals[4:, :1] = 0.3
    depths = random.normal(np.repeat([-0.03, -0.003, 0.01], 3)[:, None], 0.004, (9, 40))
    expected = [
        plain_energy(noise, row[0], depths=row[1]) for row in zip(residuals, depths, strict=True)
    ]
    np.testing.assert_allclose(noise.energies(residuals, depths), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("sensor", [0.0, 0.003])
def test_levels_of_noise_are_those_of_the_sensor_and_of_all_else(sensor):
    noise = noise_model(sensor)
    errors = np.geomspace(0.0006, 0.008, 8)
    weights = np.exp(-0.5 * (np.log(errors / 0.002) / 0.6) ** 2)
    np.testing.assert_allclose(noise.sigmas, np.sqrt(sensor**2 + errors**2))
    np.testing.assert_allclose(noise.weights, weights / weights.sum())


@pytest.mark.parametrize(
    ("mesh", "coarse", "fine"),
    [
        (bracket(), 0.005, 0.002),  # less than three nodes in a wall, and three
        (trimesh.creation.box((0.03, 0.02, 0.04)), 0.0083, 0.002),  # rounded by millimetres
    ],
)
def test_a_grid_that_is_too_coarse_for_the_object_determines_nothing(mesh, coarse, fine):
    """At the true pose, with exact points all around."""
    known = apply(POSE, trimesh.sample.sample_surface(mesh, 60, seed=0)[0])
    lower, upper = mesh.bounds
    free = np.random.default_rng(0).uniform(lower - 0.03, upper + 0.03, (4000, 3))
    free = apply(POSE, free[chsel.problem.sdf_grid.mesh_sdf(mesh, free)[0] > 0.0])
    found = hypotheses_at(inverse(POSE[None]))
    for resolution, verdict in ((coarse, "wide"), (fine, "determined")):
        sdf = chsel.SdfGrid.from_mesh(mesh, resolution)
        trust = judged(found, NOISE, sdf=sdf, known=known, free=free)
        assert trust.verdict == verdict, resolution
