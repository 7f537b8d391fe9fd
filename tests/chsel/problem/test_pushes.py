"""Points that move with a pushed object, and problems with pushes."""

from dataclasses import replace

import numpy as np
import pytest

import chsel
from chsel import KnownPoints, OnlineRegistration, Pushes, trust_in
from chsel.errors import PointsError, SettingError
from chsel.events import Probe
from chsel.methods import trust_by
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses, inverse
from chsel.problem.surface import outline_distances_to
from tests.chsel.methods.scene import GRID, MESH, SIDE, STANDING, WORKSPACE, known_points

X, Y, DIAGONAL = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.8, 0.0]
SETTINGS = OnlineSettings(hypotheses=4, update="own")
MOVES = 0.006  # m a push


def test_points_move_by_the_sum_of_the_pushes_after_them():
    pushes = Pushes([X, Y, DIAGONAL], [[1, 0, 1], [1, 1, 2], [2, 1, 2]], 0.02)
    points = KnownPoints(free=np.zeros((3, 3)), occupied=np.ones((1, 3)), known=np.zeros((3, 3)))
    now = pushes.carried(points, 0.01, 1e-4)
    np.testing.assert_allclose(now.free, [[0.016, 0.018, 0.0], [0.006, 0.008, 0.0], [0, 0, 0]])
    np.testing.assert_allclose(now.occupied, [[1.006, 1.018, 1.0]])
    np.testing.assert_allclose(now.known, [[0.016, 0.018, 0.0], [0.006, 0.018, 0.0], [0, 0, 0]])
    standing = pushes.carried(points, 0.0, 1e-4)  # the free point three times
    assert standing.digest == replace(points, free=np.zeros((1, 3))).digest


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"directions": [[1.0, 1.0, 0.0]]}, PointsError, "accepted: unit vectors"),
        ({"before": [[-1, 0, 0]]}, PointsError, "accepted: counts"),
        ({"before": [[0, 0, 2]]}, PointsError, "2 known points .* accepted: at most 1"),
        ({"largest": 0.0}, SettingError, "largest distance of a push is 0.0"),
    ],
)
def test_pushes_that_cannot_be_are_an_error(changes, error, text):
    loop, _ = online(0.01)
    given = {"directions": [X], "before": [[0, 0, 1]], "largest": 0.01} | changes
    with pytest.raises(error, match=text):
        replace(loop.pose(0), points=KnownPoints(known=[X]), pushes=Pushes(**given))


def online(push_distance):
    """What is known after 12 pushes, each of which moves the L by MOVES, and where it is then."""
    loop = OnlineRegistration(GRID, WORKSPACE, SIDE, SETTINGS, push_distance=push_distance)
    contacts = known_points(STANDING, 12).known
    random, pose = np.random.default_rng(3), STANDING.copy()
    for contact in contacts:
        angle = random.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        since = pose[:3, 3] - STANDING[:3, 3]
        loop.perceive(KnownPoints(known=[contact + since]), direction)
        pose[:3, 3] += MOVES * direction
    loop.perceive(KnownPoints(free=known_points(pose, 1).free))
    return loop, pose


def distance_to(truth, hypotheses):
    poses = Poses.of(hypotheses.object_from_world[:1])
    return float(outline_distances_to(GRID, poses, Poses.of(inverse(truth[None])))[0])


def test_the_distance_of_pushes_is_found_and_the_pose_is_that_of_the_end():
    loop, truth = online(0.01)
    method, problem = Anchored(AnchoredSettings(size="small")), loop.pose(0)
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
def test_a_session_that_was_not_told_notices_that_touches_move_the_object(moves):
    contacts, random = known_points(STANDING, 12).known, np.random.default_rng(3)
    if moves == 0.0:  # contacts that are off otherwise
        contacts = contacts + random.normal(0.0, 0.003, contacts.shape)
    settings = AnchoredSettings(size="small")
    with chsel.Session(
        MESH, resolution=0.01, workspace=WORKSPACE, method=Anchored(settings)
    ) as session:
        since = np.zeros(3)
        for step, contact in enumerate(contacts):
            angle = random.uniform(-np.pi, np.pi)
            pose = np.eye(4)
            pose[:3, 2] = np.cos(angle), np.sin(angle), 0.0  # the hand's way
            new = KnownPoints(known=[contact + since])
            session.observe(Probe(step, "contact", new, pose[None], new.known, np.zeros((1, 3))))
            since += moves * pose[:3, 2]
        session.register_step()
        assert session.trust.misfit > 2.0
        assert session.check_moved() == pytest.approx(moves, abs=0.001)
        codes = {warning.code: warning.text for warning in session.warnings}
        assert ("moved" in codes) is (moves > 0.0)
        assert f"by {session.check_moved():.3f} m" in codes.get("moved", "by 0.000 m")


def test_after_a_push_of_unknown_distance_no_pose_is_determined():
    points, method = known_points(STANDING, 12), Anchored(AnchoredSettings(size="small"))
    loop = OnlineRegistration(GRID, WORKSPACE, SIDE, SETTINGS, points=points)
    problem = loop.pose(0)
    found, before = method.register(problem), [[len(points.free), 0, len(points.known)]]
    for largest, verdict in ((0.001, "determined"), (0.03, "wide")):
        pushed = replace(problem, pushes=Pushes([DIAGONAL], before, largest))
        assert method.register(pushed).digest == found.digest
        assert trust_by(method, pushed, found).verdict == verdict


def test_an_object_that_stands_has_the_same_result_as_if_nobody_spoke_of_pushes():
    loop, _ = online(0.01)
    problem = loop.pose(0)
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
        chsel.register(GRID, surface=[X], pushes=[X])


def test_pushes_count_where_the_object_may_move():
    told, silent = online(0.0)[0], OnlineRegistration(GRID, WORKSPACE, SIDE, SETTINGS)
    silent.perceive(told.points)
    assert told.pose(3).pushes is None
    assert told.pose(3).digest == silent.pose(3).digest
