"""What a set of hypotheses means, by sets whose meaning is known."""

import math

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

import chsel
from chsel.belief import Gripper, PoseBelief, wilson
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import Poses, axis_angle, compose, inverse, rotation_vector
from chsel.problem.registration_problem import Hypotheses, Trust
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.surface import outline_distances

SIDES = np.array([0.20, 0.06, 0.08])
BOX = trimesh.creation.box(SIDES)
L_SHAPE = trimesh.boolean.union(
    [BOX, trimesh.creation.box(bounds=[[0.04, -0.03, 0.0], [0.10, 0.03, 0.12]])], engine="manifold"
)
GRID, L_GRID = SdfGrid.from_mesh(BOX, 0.004), SdfGrid.from_mesh(L_SHAPE, 0.004)
Z = np.array([0.0, 0.0, 1.0])
STILL = np.eye(4)
HALF_TURN = compose(axis_angle(Z, np.array(math.pi)), np.zeros(3))


def result(world_from_object, bests=(0,), *, verdict="several modes"):
    """Hypotheses at poses (K, 4, 4), the first of each mode at `bests`."""
    count = len(world_from_object)
    modes = len(bests) if verdict != "wide" else 0
    trust = Trust(
        noise=0.001,
        outliers=0.0,
        misfit=0.5,
        modes=modes,
        spread=0.01,
        verdict=verdict,
        redundancy=6,
        best_of_modes=tuple(bests),
    )
    return Hypotheses(
        inverse(world_from_object),
        np.arange(count) * 1.0,
        duplicate=np.zeros(count, dtype=bool),
        cell=np.full(count, -1),
        elites=np.zeros((0, 4, 4)),
        trust=trust,
    )


def shifted(vectors, turns=None, *, about=STILL):
    """Poses (K, 4, 4): `about`, turned by rotation vectors (K, 3) and shifted, in the world."""
    turns = np.zeros_like(vectors) if turns is None else turns
    rotations = rotation_vector(turns)
    places = about[:3, 3] + vectors
    return compose(rotations @ about[:3, :3], places)


def test_modes_have_weights_covariances_and_numbers_that_stay():
    random = np.random.default_rng(3)
    steps = random.multivariate_normal(np.zeros(6), np.diag([1, 4, 9, 1, 2, 3]) * 1e-6, 8000)
    steps[0] = 0.0
    here = compose(axis_angle(Z, np.array(0.4)), np.array([0.3, -0.1, 0.2]))
    first = shifted(steps[:, :3], steps[:, 3:], about=here)[:30]
    second = (here @ HALF_TURN) @ np.eye(4)
    poses = np.concatenate([first, np.repeat(second[None], 10, axis=0)])
    belief = PoseBelief(L_GRID, result(poses, (0, 30)))
    assert [mode.weight for mode in belief.modes] == [0.75, 0.25]
    assert [mode.number for mode in belief.modes] == [0, 1]
    expected = (steps[:30, :, None] * steps[:30, None]).mean(axis=0)
    # The centre of the grid's surface is not the origin: a turn moves it by less than 0.1 mm here.
    np.testing.assert_allclose(belief.modes[0].covariance[3:, 3:], expected[3:, 3:], atol=1e-9)
    np.testing.assert_allclose(belief.modes[0].covariance[:3, :3], expected[:3, :3], atol=1e-7)
    assert not belief.modes[1].covariance.any()
    roots = np.sqrt((steps[:30].reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    assert belief.modes[0].deviations == pytest.approx(roots, rel=0.01)
    # Best first the other one, and a third place: numbers stay with their places.
    far = shifted(np.array([[0.0, 0.5, 0.0]]), about=here)
    later = np.concatenate([second[None], first[:1], far])
    again = PoseBelief(L_GRID, result(later, (0, 1, 2)), previous=belief)
    assert [mode.number for mode in again.modes] == [1, 0, 2]
    wide = PoseBelief(L_GRID, result(poses, verdict="wide"), previous=again)
    assert wide.modes == []
    after = PoseBelief(L_GRID, result(later, (0, 1, 2)), previous=wide)
    assert [mode.number for mode in after.modes] == [1, 0, 2]


def test_the_ball_is_about_the_member_in_the_middle():
    """Places 0, 2, 5 and 11 mm along z: from the third the others are at most 6 mm away."""
    shifts = np.array([0.0, 0.002, 0.005, 0.011])[:, None] * Z
    poses = shifted(shifts, about=np.eye(4))
    ball = PoseBelief(L_GRID, result(poses, verdict="wide")).ball
    np.testing.assert_allclose(ball.world_from_object, poses[2], atol=1e-12)
    assert ball.centre == pytest.approx(0.006)
    assert ball.turn == pytest.approx(0.0, abs=1e-9)
    both = Poses.of(inverse(poses[[2, 3]]))
    assert ball.radius == pytest.approx(outline_distances(L_GRID, both)[0, 1])
    turned = np.stack([np.eye(4), compose(axis_angle(Z, np.array(0.3)), np.zeros(3)), np.eye(4)])
    ball = PoseBelief(L_GRID, result(turned, verdict="wide")).ball
    assert ball.turn == pytest.approx(0.3)


@pytest.mark.parametrize("mesh", [BOX, trimesh.creation.cylinder(0.03, 0.1)])
def test_members_that_look_alike_have_no_covariance(mesh):
    symmetry = object_symmetry(mesh)
    sdf = SdfGrid.from_mesh(mesh, 0.004)
    poses = np.stack([np.eye(4), HALF_TURN, compose(axis_angle(Z, np.array(math.pi)), np.zeros(3))])
    if symmetry.axis is not None:
        angles = np.linspace(0.0, 6.0, 5)
        poses = compose(axis_angle(np.repeat(Z[None], 5, axis=0), angles), np.zeros((5, 3)))
    (mode,) = PoseBelief(sdf, result(poses, verdict="determined"), symmetry=symmetry).modes
    assert np.abs(mode.covariance).max() < 1e-8


def test_chances_are_shares_of_the_members():
    belief = PoseBelief(GRID, result(shifted(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]]))))
    points = np.array([[0.05, 0, 0], [0.25, 0, 0.03], [0.15, 0.0, 0.0], [0.02, 0.0, 0.039]])
    np.testing.assert_allclose(belief.occupancy(points), np.array([2, 1, 1, 2]) / 3)
    top = np.array([[0.05, 0.0, 0.041], [0.05, 0.0, 0.045]])
    np.testing.assert_allclose(belief.contact_chance(top, within=0.002), [2 / 3, 0.0])
    # A ball of 20 mm, 25 mm above the first two boxes, then 15 mm above the first one's end.
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    path = shifted(np.array([[0.05, 0.0, 0.065], [-0.09, 0.0, 0.055]]))
    assert belief.collision_chance(ball, path[:1]).chance == [0.0]
    assert belief.collision_chance(ball, path).chance == [pytest.approx(1 / 3)]
    drawn = (belief.sample(600)[:, None] == belief.object_from_world).all(axis=(2, 3))
    assert (np.abs(drawn.sum(axis=0) - 200) < 60).all()


def works(grip, width, *, boxes, gripper):
    """Whether a grasp from above along the box's short side works, by intervals alone."""
    x, y, z = grip
    found = []
    for box in boxes:
        near = abs(x - box) < 0.5 * SIDES[0] + 0.5 * gripper.width
        above = z > 0.5 * SIDES[2]
        fingers_free = above or not near or 0.5 * width - abs(y) >= 0.5 * SIDES[1]
        held = abs(x - box) < 0.5 * SIDES[0] + 0.25 * gripper.width and z < 0.5 * SIDES[2]
        found.append(fingers_free and held and width <= gripper.opening)
    return np.mean(found)


def test_grasps_of_boxes_are_right_by_intervals():
    gripper = Gripper()
    boxes = (0.0, 0.1, 0.3)
    belief = PoseBelief(GRID, result(shifted(np.array([[box, 0.0, 0.0] for box in boxes]))))
    random = np.random.default_rng(0)
    grips = random.uniform([-0.3, -0.008, 0.02], [0.5, 0.008, 0.06], (300, 3))
    widths = random.uniform(0.05, 0.09, 300)
    # Away from where a point of a finger decides, by half of a point's distance.
    x = grips[:, 0]
    z = grips[:, 2]
    side = 0.5 * widths - np.abs(grips[:, 1]) - 0.5 * SIDES[1]
    ends = np.abs(np.abs(x[:, None] - boxes) - 0.5 * SIDES[0]).min(axis=1)
    clear = (np.abs(z - 0.04) > 0.002) & (ends > 0.012) & (np.abs(side) > 0.002)
    down = compose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    poses = shifted(grips) @ down
    chance, lower, upper = belief.grasp_chance(poses, widths, gripper=gripper)
    expected = [
        works(g, w, boxes=boxes, gripper=gripper) for g, w in zip(grips, widths, strict=True)
    ]
    np.testing.assert_allclose(chance[clear], np.array(expected)[clear])
    assert {0.0, 1 / 3, 2 / 3} <= set(np.round(chance[clear], 12)) | {1 / 3, 2 / 3}
    assert ((lower <= chance) & (chance <= upper)).all()
    on_object = shifted(np.array([[0.05, 0.0, 0.02], [0.0, 0.0, 0.3]])) @ down
    world, best = belief.best_grasp(on_object, 0.07)
    assert best == pytest.approx(2 / 3)  # between the middles of the first two boxes
    assert world[2, 3] == pytest.approx(0.02)


def test_an_interval_is_wilsons():
    share = np.array([0.8, 0.3, 0.0])
    count = 30
    normal = norm.ppf(0.95)
    for end in wilson(share, count)[1:]:  # where the share is as many deviations away
        away = (share - end) ** 2
        np.testing.assert_allclose(away, normal**2 * end * (1.0 - end) / count, atol=1e-12)


def test_what_a_belief_does_not_accept():
    belief = PoseBelief(GRID, result(np.eye(4)[None], verdict="determined"))
    for call, message in (
        (lambda: belief.occupancy([[np.nan, 0, 0]]), "points"),
        (lambda: belief.grasp_chance(np.eye(4)[None], -1.0), "width is not above 0"),
        (lambda: belief.best_grasp(np.zeros((0, 4, 4)), 0.05), "there is no grasp"),
        (lambda: Gripper(opening=0.0), "opening is 0.0; accepted"),
    ):
        with pytest.raises(chsel.ChselError, match=message):
            call()
    assert belief._repr_png_().startswith(b"\x89PNG")
    assert len(repr(belief).splitlines()) <= 5


TILTED = compose(axis_angle(np.array([0.48, 0.6, 0.64]), np.array(0.9)), np.array([0.3, -0.1, 0.2]))


def boxes_along_x(*places, verdict="several modes"):
    """A belief of boxes at places, each turned as TILTED and shifted along its own x axis."""
    shifts = np.array([[place, 0.0, 0.0] for place in places])
    return PoseBelief(GRID, result(TILTED @ shifted(shifts), verdict=verdict))


def test_a_member_counts_for_the_mode_that_it_is_not_turned_against():
    """Two places of the L, turned by pi against each other; its arm is all that tells them apart.

    The third pose is the first one, moved by as much as the second is: it covers nearly the same
    space as the second one, but is turned as the first one.
    """
    knob = trimesh.creation.box(bounds=[[0.06, -0.03, 0.03], [0.10, 0.03, 0.06]])
    grid = SdfGrid.from_mesh(trimesh.boolean.union([BOX, knob], engine="manifold"), 0.004)
    shift = compose(np.eye(3), np.array([0.0, 0.03, 0.0]))
    first = np.eye(4)
    second = shift @ HALF_TURN
    third = shift
    modes = PoseBelief(grid, result(np.stack([first, second, third]), (0, 1))).modes
    assert [mode.members.tolist() for mode in modes] == [[0, 2], [1]]
    assert modes[0].deviations == pytest.approx((0.03 / np.sqrt(2.0), 0.0), abs=1e-6)
    assert modes[1].deviations == pytest.approx((0.0, 0.0), abs=1e-6)


def test_a_hand_that_encloses_or_passes_through_the_object_meets_it():
    """All its corners are outside: of a box of 0.5 m around the second of three places, and of a
    plate that passes across the first one alone, at a height above the middle.
    """
    belief = boxes_along_x(-0.6, 0.0, 0.6)
    around, plate = (trimesh.creation.box(sides) for sides in ((0.5, 0.5, 0.5), (0.02, 0.3, 0.3)))
    at = TILTED @ shifted(np.array([[-0.65, 0.0, 0.02], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]))
    assert belief.collision_chance(around, at[1:2]).chance == [pytest.approx(1 / 3)]
    assert belief.collision_chance(plate, at[:1]).chance == [pytest.approx(1 / 3)]
    assert belief.collision_chance(plate, at[2:]).chance == [0.0]
    assert belief.collision_chance(plate, at).chance == [pytest.approx(2 / 3)]


def test_the_best_grasp_is_that_of_any_member_and_moves_with_the_object():
    """Without modes, between the places at 0.25 and 0.30 m a grasp holds two boxes of three."""
    belief = boxes_along_x(0.0, 0.25, 0.30, verdict="wide")
    down = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.02, 0.0, 0.01]))
    world, chance = belief.best_grasp(down[None], 0.07)
    assert chance == pytest.approx(2 / 3)
    expected = TILTED @ shifted(np.array([[0.25, 0.0, 0.0], [0.30, 0.0, 0.0]])) @ down
    assert np.abs(expected - world).max(axis=(1, 2)).min() < 1e-9
    assert belief.grasp_chance(world[None], 0.07).chance == [pytest.approx(2 / 3)]


def test_fingers_reach_back_from_their_tips():
    """Around a post on a plate, tips just above the plate are free, and those within it are not."""
    post = trimesh.creation.box(bounds=[[-0.02, -0.02, 0.0], [0.02, 0.02, 0.08]])
    plate = trimesh.creation.box(bounds=[[-0.08, -0.08, -0.02], [0.08, 0.08, 0.0]])
    grid = SdfGrid.from_mesh(trimesh.boolean.union([post, plate], engine="manifold"), 0.005)
    belief = PoseBelief(grid, result(TILTED[None]))
    tips = shifted(np.array([[0.0, 0.0, 0.004], [0.0, 0.0, -0.004]]))
    poses = TILTED @ tips @ compose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    assert belief.grasp_chance(poses, 0.06).chance.tolist() == [1.0, 0.0]


def test_shifts_and_turns_of_one_sign_have_a_covariance_above_zero():
    """Members that are farther along x are turned more about z, in world axes."""
    steps = np.zeros((21, 6))
    steps[:, 0] = np.linspace(-0.01, 0.01, 21)
    steps[:, 5] = np.linspace(-0.1, 0.1, 21)
    order = np.argsort(np.abs(steps[:, 0]), kind="stable")
    steps = steps[order]  # the middle one is the best
    symmetry = object_symmetry(L_SHAPE)
    about = TILTED @ compose(np.eye(3), -symmetry.centre)
    # Turned about the centre, which then moves by the shift alone.
    turns = rotation_vector(steps[:, 3:]) @ about[:3, :3]
    centre = about[:3, :3] @ symmetry.centre + about[:3, 3]
    poses = compose(turns, centre + steps[:, :3] - turns @ symmetry.centre)
    (mode,) = PoseBelief(L_GRID, result(poses, verdict="determined"), symmetry=symmetry).modes
    expected = (steps[:, :, None] * steps[:, None]).mean(axis=0)
    np.testing.assert_allclose(mode.covariance, expected, atol=1e-9)
    assert mode.covariance[0, 5] > 1e-4


def test_a_half_turn_about_an_axis_of_the_object_is_none_of_a_tilted_box():
    symmetry = object_symmetry(BOX)
    turns = compose(axis_angle(np.eye(3), np.full(3, math.pi)), np.zeros((3, 3)))
    poses = TILTED @ np.concatenate([np.eye(4)[None], turns])
    (mode,) = PoseBelief(GRID, result(poses, verdict="determined"), symmetry=symmetry).modes
    assert np.abs(mode.covariance).max() < 1e-8
