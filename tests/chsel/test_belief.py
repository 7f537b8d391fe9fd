"""What a set of hypotheses means, by sets whose meaning is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

import chsel
from chsel.belief import Gripper, PoseBelief, wilson
from chsel.events import Believed
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import axis_angle, compose, inverse, rotation_vector
from chsel.problem.registration_problem import Hypotheses, Trust
from chsel.problem.sdf_grid import SdfGrid
from replay.mcap.reader import read_recording

SIDES = np.array([0.20, 0.06, 0.08])
BOX = trimesh.creation.box(SIDES)
L_SHAPE = trimesh.boolean.union(
    [BOX, trimesh.creation.box(bounds=[[0.04, -0.03, 0.0], [0.10, 0.03, 0.12]])], engine="manifold"
)
GRID, L_GRID = SdfGrid.from_mesh(BOX, 0.004), SdfGrid.from_mesh(L_SHAPE, 0.004)
Z, STILL = np.array([0.0, 0.0, 1.0]), np.eye(4)
NEITHER = np.zeros(2, dtype=bool)
HALF_TURN = compose(axis_angle(Z, np.array(math.pi)), np.zeros(3))


def result(world_from_object, bests=(0,), verdict="several modes"):
    """Hypotheses at poses (K, 4, 4), the first of each mode at `bests`."""
    count = len(world_from_object)
    none = np.zeros(count, dtype=bool), np.full(count, -1), np.zeros((0, 4, 4))
    modes = len(bests) if verdict != "wide" else 0
    trust = Trust(0.001, 0.0, 0.5, modes, 0.01, verdict, 6, tuple(bests))
    return Hypotheses(inverse(world_from_object), np.arange(count) * 1.0, *none, trust=trust)


def shifted(vectors, turns=None, about=STILL):
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
    first = shifted(steps[:, :3], steps[:, 3:], here)[:30]
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


@pytest.mark.parametrize("mesh", [BOX, trimesh.creation.cylinder(0.03, 0.1)])
def test_members_that_look_alike_have_no_covariance(mesh):
    symmetry, sdf = object_symmetry(mesh), SdfGrid.from_mesh(mesh, 0.004)
    poses = np.stack([np.eye(4), HALF_TURN, compose(axis_angle(Z, np.array(math.pi)), np.zeros(3))])
    if symmetry.axis is not None:
        angles = np.linspace(0.0, 6.0, 5)
        poses = compose(axis_angle(np.repeat(Z[None], 5, axis=0), angles), np.zeros((5, 3)))
    (mode,) = PoseBelief(sdf, result(poses, verdict="determined"), symmetry).modes
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


def works(grip, width, boxes, gripper):
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
    gripper, boxes = Gripper(), (0.0, 0.1, 0.3)
    belief = PoseBelief(GRID, result(shifted(np.array([[box, 0.0, 0.0] for box in boxes]))))
    random = np.random.default_rng(0)
    grips = random.uniform([-0.3, -0.008, 0.02], [0.5, 0.008, 0.06], (300, 3))
    widths = random.uniform(0.05, 0.09, 300)
    # Away from where a point of a finger decides, by half of a point's distance.
    x, z, side = grips[:, 0], grips[:, 2], 0.5 * widths - np.abs(grips[:, 1]) - 0.5 * SIDES[1]
    ends = np.abs(np.abs(x[:, None] - boxes) - 0.5 * SIDES[0]).min(axis=1)
    clear = (np.abs(z - 0.04) > 0.002) & (ends > 0.012) & (np.abs(side) > 0.002)
    down = compose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    poses = shifted(grips) @ down
    chance, lower, upper = belief.grasp_chance(poses, widths, gripper)
    expected = [works(g, w, boxes, gripper) for g, w in zip(grips, widths, strict=True)]
    np.testing.assert_allclose(chance[clear], np.array(expected)[clear])
    assert {0.0, 1 / 3, 2 / 3} <= set(np.round(chance[clear], 12)) | {1 / 3, 2 / 3}
    assert ((lower <= chance) & (chance <= upper)).all()
    on_object = shifted(np.array([[0.05, 0.0, 0.02], [0.0, 0.0, 0.3]])) @ down
    world, best = belief.best_grasp(on_object, 0.07)
    assert best == pytest.approx(2 / 3)  # between the middles of the first two boxes
    assert world[2, 3] == pytest.approx(0.02)


def test_an_interval_is_wilsons():
    share, count, normal = np.array([0.8, 0.3, 0.0]), 30, norm.ppf(0.95)
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


def test_a_belief_that_is_asked_for_is_recorded_and_a_sure_grasp_ends_touching(tmp_path):
    contacts = trimesh.sample.sample_surface(L_SHAPE, 12, seed=1)[0]
    hand = trimesh.creation.box([0.02, 0.02, 0.1])
    above = compose(np.diag([1.0, -1.0, -1.0]), np.array([-0.05, 0.0, 0.03]))
    with chsel.Session(L_SHAPE, record=tmp_path / "a.mcap", hand=hand) as session:
        session.add(contacts=contacts)
        found = session.register()
        (mode,) = session.belief.modes
        off = shifted(np.array([[0.01, 0.0, 0.0]]), about=inverse(found.object_from_world[0]))
        poses = np.concatenate([found.object_from_world[:1], inverse(off)])
        two = replace(found, object_from_world=poses, cost=np.arange(2.0), duplicate=NEITHER)
        assert len(PoseBelief(session.started.sdf, two)) == 2
        assert len(PoseBelief(session.started.sdf, two, problem=session.problem)) == 1
        assert session.next_probe(grasps=(above[None], 0.07), sure=0.9) is None
        assert session.stop == "grasp"
    (told,) = [e for e in read_recording(tmp_path / "a.mcap").events() if isinstance(e, Believed)]
    np.testing.assert_array_equal(told.object_from_world, mode.object_from_world[None])
    np.testing.assert_array_equal(told.covariances, mode.covariance[None])
    np.testing.assert_allclose(told.centres[0], L_SHAPE.centroid, atol=0.01)
    assert (told.numbers.tolist(), told.weights.tolist()) == ([0], [1.0])
    np.testing.assert_allclose(session.grasp[:3, 3], above[:3, 3], atol=0.005)
