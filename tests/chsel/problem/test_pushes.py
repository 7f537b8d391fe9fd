"""Points that move with a pushed object, and problems with pushes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import chsel
from chsel import KnownPoints, Loop, Probe, Pushes, trust_in
from chsel.belief import PoseBelief
from chsel.errors import PointsError, SettingError
from chsel.events import ListRecorder, Logged
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses, compose, inverse
from chsel.problem.surface import outline_distances_to
from chsel.problem.trust import fits_elsewhere
from chsel.session.judging import trust_by
from tests.chsel.methods.scene import GRID, MESH, SIDE, STANDING, WORKSPACE, known_points
from tests.chsel.samples import hypotheses_at

X = [1.0, 0.0, 0.0]
Y = [0.0, 1.0, 0.0]
DIAGONAL = [0.6, 0.8, 0.0]
SETTINGS = OnlineSettings(hypotheses=4, update="own")
MOVES = 0.006  # m a push


def test_points_move_by_the_sum_of_the_pushes_after_them():
    pushes = Pushes([X, Y, DIAGONAL], [[1, 0, 1], [1, 1, 2], [2, 1, 2]], largest=0.02)
    points = KnownPoints(free=np.zeros((3, 3)), occupied=np.ones((1, 3)), known=np.zeros((3, 3)))
    now = pushes.carried(points, 0.01, resolution=1e-4)
    np.testing.assert_allclose(now.free, [[0.016, 0.018, 0.0], [0.006, 0.008, 0.0], [0, 0, 0]])
    np.testing.assert_allclose(now.occupied, [[1.006, 1.018, 1.0]])
    np.testing.assert_allclose(now.known, [[0.016, 0.018, 0.0], [0.006, 0.018, 0.0], [0, 0, 0]])
    standing = pushes.carried(points, 0.0, resolution=1e-4)  # the free point three times
    assert standing.digest == replace(points, free=np.zeros((1, 3))).digest


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"directions": [[1.0, 1.0, 0.0]]}, PointsError, "accepted: unit vectors"),
        ({"before": [[-1, 0, 0]]}, PointsError, "accepted: counts"),
        (
            {"directions": [X, X], "before": [[0, 0, 1], [1, 0, 0]]},
            PointsError,
            "decrease; accepted",
        ),
        ({"before": [[0, 0, 2]]}, PointsError, "2 known points .* accepted: at most 1"),
        ({"largest": 0.0}, SettingError, "largest distance of a push is 0.0"),
    ],
)
def test_pushes_that_cannot_be_are_an_error(changes, error, text):
    loop, _ = pushed(0.01)
    given = {"directions": [X], "before": [[0, 0, 1]], "largest": 0.01} | changes
    with pytest.raises(error, match=text):
        replace(loop.problem(), points=KnownPoints(known=[X]), pushes=Pushes(**given))


def loop_of(**options):
    return Loop(GRID, WORKSPACE, free_resolution=SIDE, settings=SETTINGS, **options)


def touch(step, points, *, direction):
    """A touch of a hand on its way in a horizontal direction."""
    pose = np.eye(4)
    pose[:3, 2] = direction
    return Probe(
        step=step,
        outcome="contact",
        new_points=points,
        gripper_path=pose[None],
        contacts=points.known,
        contact_normals=np.zeros((len(points.known), 3)),
    )


def pushed(moves):
    """What is known after 12 pushes, each of which moves the L by MOVES, and where it is then."""
    loop = loop_of(moves=moves)
    contacts = known_points(STANDING, 12).known
    random = np.random.default_rng(3)
    pose = STANDING.copy()
    for step, contact in enumerate(contacts):
        angle = random.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        since = pose[:3, 3] - STANDING[:3, 3]
        loop.perceive(touch(step, KnownPoints(known=[contact + since]), direction=direction))
        pose[:3, 3] += MOVES * direction
    free = KnownPoints(free=known_points(pose, 1).free)
    loop.perceive(Probe(step=0, outcome="free", new_points=free))
    return loop, pose


def distance_to(truth, hypotheses):
    poses = Poses.of(hypotheses.object_from_world[:1])
    return float(outline_distances_to(GRID, poses, other=Poses.of(inverse(truth[None])))[0])


def test_the_distance_of_pushes_is_found_and_the_pose_is_that_of_the_end():
    loop, truth = pushed(0.01)
    method = Anchored(AnchoredSettings(size="small"))
    problem = loop.problem()
    found = method.register(problem)
    assert found.push_distance == pytest.approx(MOVES, abs=0.001)
    assert distance_to(truth, found) < 0.002
    assert method.holds(problem, found, inverse(truth[None]))[0]
    standing = replace(problem, pushes=None)
    still = method.register(standing)
    assert still.push_distance == 0.0
    assert distance_to(truth, still) > 0.005
    assert trust_in(problem, found).misfit < 0.5 * trust_in(standing, still).misfit


@pytest.mark.parametrize("moves", [MOVES, 0.0])
def test_a_session_that_expects_no_moves_notices_that_touches_move_the_object(moves):
    contacts = known_points(STANDING, 12).known
    random = np.random.default_rng(3)
    if moves == 0.0:  # contacts that are off otherwise
        contacts = contacts + random.normal(0.0, 0.003, contacts.shape)
    handle = trimesh.creation.box((0.02, 0.02, 0.02))
    method = Anchored(AnchoredSettings(size="small"))
    recorder = ListRecorder()
    given = {"resolution": 0.01, "workspace": WORKSPACE, "method": method, "record": recorder}
    with chsel.Session(MESH, **given) as session:
        since = np.zeros(3)
        for contact in contacts:
            angle = random.uniform(-np.pi, np.pi)
            along = np.array([np.cos(angle), np.sin(angle), 0.0])
            across = np.cross([0.0, 0.0, 1.0], along)
            turn = np.stack([np.cross(across, along), across, along], axis=1)
            end = compose(turn, contact + since - 0.8 * along)  # the handle of a long stick
            session.add(hand=handle, path=end[None], contact=contact + since)
            since += moves * along
        session.register()
        assert session.trust.misfit > 2.0
        found = session.check_moved()
        if moves > 0.0:
            assert session.check_moved(most=0.004) <= 0.004
    assert found == pytest.approx(moves, abs=0.001)
    texts = [event.text for event in recorder.events if isinstance(event, Logged)]
    moved = [text for text in texts if "each touch has moved the object by" in text]
    assert len(moved) == (moves > 0.0)
    assert f"by {found:.3f} m" in (moved or ["by 0.000 m"])[0]


def test_after_a_push_of_unknown_distance_no_pose_is_determined():
    points = known_points(STANDING, 12)
    method = Anchored(AnchoredSettings(size="small"))
    loop = loop_of()
    loop.perceive(Probe(step=0, outcome="points", new_points=points))
    problem = loop.problem()
    found = method.register(problem)
    before = [[len(points.free), 0, len(points.known)]]
    for largest, verdict in ((0.001, "determined"), (0.03, "wide")):
        pushed = replace(problem, pushes=Pushes([DIAGONAL], before, largest=largest))
        assert method.register(pushed).digest == found.digest
        assert trust_by(method, pushed, hypotheses=found).verdict == verdict


def test_an_object_that_stands_has_the_same_result_as_if_nobody_spoke_of_pushes():
    loop, _ = pushed(0.01)
    problem = loop.problem()
    where = KnownPoints(known=known_points(STANDING, 12).known)
    told = replace(
        problem,
        points=where,
        pushes=replace(problem.pushes, before=problem.pushes.before * [0, 0, 1]),
    )
    method = Anchored(AnchoredSettings(size="small"))
    found = method.register(told)
    assert found.digest == method.register(replace(told, pushes=None)).digest
    assert found.push_distance == 0.0
    assert told.digest != replace(told, pushes=None).digest


def test_something_else_than_pushes_is_an_error():
    with pytest.raises(
        SettingError, match=r"accepted: chsel.Pushes\(directions, before, largest\)"
    ):
        chsel.register(GRID, contacts=[X], pushes=[X])


def test_pushes_count_where_the_object_may_move():
    stated, _ = pushed(0.0)
    silent = loop_of()
    silent.perceive(Probe(step=0, outcome="points", new_points=stated.state.points))
    assert stated.problem().pushes is None
    assert stated.problem().digest == silent.problem().digest


def test_the_largest_distance_is_tried_and_found():
    loop, _ = pushed(MOVES)
    problem = loop.problem()
    tried = np.array(problem.pushes.distances)
    assert tried[[0, -1]].tolist() == [0.0, MOVES]
    np.testing.assert_allclose(np.diff(tried), tried[1])
    found = Anchored(AnchoredSettings(size="small")).register(problem)
    assert found.push_distance == pytest.approx(MOVES, rel=1e-9)


def test_noisy_contacts_of_an_object_that_stands_are_no_pushes():
    """They are off by 3 mm, which pushes of 3 mm explain a bit better: by chance."""
    contacts = known_points(STANDING, 12).known
    random = np.random.default_rng(7)
    contacts = contacts + random.normal(0.0, 0.003, contacts.shape)
    loop = loop_of(moves=0.0125)
    for contact, angle in zip(contacts, random.uniform(-np.pi, np.pi, 12), strict=True):
        direction = [np.cos(angle), np.sin(angle), 0.0]
        loop.perceive(touch(0, KnownPoints(known=[contact]), direction=direction))
    free = KnownPoints(free=known_points(STANDING, 1).free)
    loop.perceive(Probe(step=0, outcome="free", new_points=free))
    found = Anchored(AnchoredSettings(size="small")).register(loop.problem())
    assert found.push_distance == 0.0


def test_members_of_a_belief_explain_the_points_where_they_are_now():
    """The true pose explains contacts that were carried along, and that of the start does not."""
    loop, truth = pushed(0.01)
    problem = loop.problem()
    poses = inverse(np.stack([truth, STANDING]))
    found = replace(hypotheses_at(poses), push_distance=MOVES)
    found = replace(found, trust=trust_in(problem, found))
    carried = replace(
        problem, points=problem.pushes.carried(problem.points, MOVES, resolution=SIDE)
    )
    for given in (problem, replace(carried, pushes=None)):
        members = PoseBelief(GRID, found, problem=given).object_from_world
        np.testing.assert_array_equal(members, poses[:1])


def test_of_free_points_that_meet_in_a_voxel_the_first_stays():
    pushes = Pushes([X], [[1, 0, 0]], largest=0.02)
    points = KnownPoints(free=[[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.03, 0.0, 0.0]])
    now = pushes.carried(points, 0.0101, resolution=0.01).free
    np.testing.assert_allclose(now, [[0.0101, 0.0, 0.0], [0.03, 0.0, 0.0]])


def test_another_problem_is_fitted_elsewhere_by_its_own_points():
    """Contacts all over the L where it stands, and the same 5 cm farther along x."""
    loop = loop_of()
    contacts = KnownPoints(known=known_points(STANDING, 24).known)
    loop.perceive(Probe(step=0, outcome="points", new_points=contacts))
    here = loop.problem()
    there = replace(here, points=KnownPoints(known=here.points.known + np.array([0.05, 0, 0])))
    far = STANDING.copy()
    far[0, 3] += 0.05
    best = hypotheses_at(inverse(STANDING[None]))
    moved = Poses.of(inverse(far[None]))
    assert fits_elsewhere(here, best, other=there, poses=moved, sensor_noise=0.0005)
    assert not fits_elsewhere(here, best, other=here, poses=moved, sensor_noise=0.0005)
    assert not fits_elsewhere(
        here, best, other=here, poses=Poses.of(best.object_from_world), sensor_noise=0.0005
    )
