"""Images, touches, sweeps, decisions and beliefs of a session, as it records them."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.events import (
    ActionsOffered,
    Believed,
    Decided,
    ListRecorder,
    Logged,
    Probe,
    ProblemPosed,
    SensorImage,
)
from chsel.next_probe.action_lattice import ActionSettings
from chsel.problem.poses import apply, axis_angle, compose, inverse
from tests.chsel.samples import Scripted, box_distance, box_with_knob

SIDES = np.array([0.10, 0.06, 0.16])
TRUTH = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.4)), np.array([0.3, 0.1, 0.08]))
BOUNDS = chsel.Workspace((0.1, -0.1, 0.0), (0.5, 0.3, 0.3))
ALONG_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # the hand's z axis is x
DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def box():
    return trimesh.creation.box(SIDES)


@pytest.fixture
def finger():
    """A hand of 2 x 2 x 6 cm, whose front is at the origin of its frame."""
    return trimesh.creation.box(bounds=[[-0.01, -0.01, -0.06], [0.01, 0.01, 0.0]])


@pytest.fixture
def recorder():
    return ListRecorder()


@pytest.fixture
def contacts(box):
    """Points (20, 3) all over the box at TRUTH."""
    return apply(TRUTH, np.asarray(trimesh.sample.sample_surface(box, 20, seed=0)[0]))


def events_of(recorder, kind):
    return [event for event in recorder.events if isinstance(event, kind)]


def way(start, length):
    """Poses of a hand that goes along x from a place by a length, metres."""
    ends = np.array([start, np.add(start, [length, 0.0, 0.0])])
    return compose(np.stack([ALONG_X] * 2), ends)


@pytest.mark.parametrize(("top", "unit"), [(0.9, 1e-4), (12.9, 2e-4)])
def test_a_recorded_image_has_the_depths_camera_pose_and_rays_that_were_added(
    box, recorder, top, unit
):
    """A wall beyond a step, with four pixels that measure nothing. cx and cy differ, as fx and fy.

    16 bits hold 6.5 m in tenths of a millimetre.
    """
    height, width = 12, 16
    camera = chsel.PinholeCamera(width, height, fx=20.0, fy=22.0, cx=7.3, cy=4.1)
    pose = compose(DOWN, np.array([0.1, 0.2, 13.0]))
    depth = np.random.default_rng(0).uniform(top - 0.004, top, (height, width))
    depth[5:7, 8:10] = 0.0
    place = chsel.Workspace((-1.0, -1.0, 0.0), (1.0, 1.0, 13.0))
    with chsel.Session(box, workspace=place, free_resolution=0.1, record=recorder) as session:
        session.add(depth=depth, camera=camera, world_from_camera=pose)
    (image,) = events_of(recorder, SensorImage)
    (probe,) = events_of(recorder, Probe)
    assert (image.step, image.kind, probe.outcome) == (0, "depth", "points")
    assert image.unit == pytest.approx(unit)
    np.testing.assert_allclose(image.values * image.unit, depth, atol=0.5001 * unit)
    assert image.intrinsics.tolist() == [20.0, 22.0, 7.3, 4.1]
    np.testing.assert_array_equal(image.world_from_camera, pose)
    np.testing.assert_array_equal(image.mask, depth > 0.0)


def test_what_was_swept_is_swept_again_after_a_push_alone(box, finger, recorder):
    """A touch from the side may move the object, one from above does not."""
    swept = way([0.12, -0.05, 0.2], 0.1)
    side = way([0.12, 0.1, 0.1], 0.1)
    above = compose(np.stack([DOWN] * 2), np.array([[0.3, 0.1, 0.25], [0.3, 0.1, 0.161]]))
    touches = {"side": (side, [0.22, 0.1, 0.1]), "above": (above, [0.3, 0.1, 0.16])}
    for moves, touch, again in ((0.01, "side", True), (0.01, "above", False), (0.0, "side", False)):
        recorder.events.clear()
        path, contact = touches[touch]
        with chsel.Session(box, workspace=BOUNDS, moves=moves, record=recorder) as session:
            session.add(hand=finger, path=swept)
            session.add(hand=finger, path=path, contact=contact)
            session.add(hand=finger, path=swept, contact=contact)
        first, _, last = (probe.new_points for probe in events_of(recorder, Probe))
        assert len(first.free) > 20
        assert len(last.free) == (len(first.free) if again else 0)
        assert len(last.contacts) == again  # the same place of an object that stands


def test_a_place_of_the_surface_counts_once_whichever_touch_or_image_showed_it(box, recorder):
    """Images of the box from two sides and again from the first one."""
    camera = chsel.PinholeCamera(40, 30, fx=40.0, fy=40.0, cx=19.5, cy=14.5)
    eyes = {
        "x": compose(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), np.array([0.4, 0.0, 0.0])),
        "y": compose(np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]), np.array([0.0, 0.4, 0.0])),
    }
    shown = {}
    with chsel.Session(box, record=recorder) as session:
        for name in ("x", "y", "x"):
            pose = eyes[name]
            rays = camera.directions().reshape(-1, 3) @ pose[:3, :3].T
            axis = "xy".index(name)
            far = (0.4 - 0.5 * SIDES[axis]) / -rays[:, axis]  # the side nearest to the camera
            at = pose[:3, 3] + far[:, None] * rays
            mask = np.abs(box_distance(at, SIDES)) < 1e-9
            depth = np.where(mask, far, 0.0).reshape(30, 40)
            session.add(
                depth=depth, camera=camera, world_from_camera=pose, mask=mask.reshape(30, 40)
            )
            seen = events_of(recorder, Probe)[-1].new_points.contacts
            if name in shown:
                assert len(seen) == 0
            else:
                assert len(seen) > 5
                np.testing.assert_allclose(box_distance(seen, SIDES), 0.0, atol=1e-12)
            shown[name] = seen
        place = np.array([[0.0, 0.0, 0.08]])
        for shift, counted in ((0.0, 1), (0.0, 0), (5e-4, 0), (0.01, 1)):
            session.add(contacts=place + np.array([shift, 0.0, 0.0]))
            assert len(events_of(recorder, Probe)[-1].new_points.contacts) == counted


def test_actions_are_as_many_and_as_dense_as_is_asked_and_a_probe_is_as_long_as_its_action(
    box, finger, recorder
):
    policy = chsel.build_policy("grid", {"actions": {"most": 30}})
    with chsel.Session(
        box, hand=finger, workspace=BOUNDS, policy=policy, record=recorder
    ) as session:
        assert 10 < len(session.actions()) <= 30
        assert 5 <= len(session.actions(ActionSettings(most=10))) <= 10
        diameter = np.sqrt((SIDES**2).sum())  # that of the grid is up to two nodes larger
        for spacing, expected in ((0.04, 0.04), (None, 0.15 * diameter)):
            dense = session.actions(ActionSettings(spacing=spacing, most=1000))
            poses = dense.world_from_hand
            places = poses[poses[:, 2, 2] == -1.0, :2, 3]  # from above
            steps = np.concatenate([np.diff(np.unique(axis.round(9))) for axis in places.T])
            np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
            np.testing.assert_allclose(steps[0], expected, rtol=0.1 if spacing is None else 1e-6)
        usual = session.actions()
        lengths = np.linspace(0.1, 0.2, len(usual))
        offered = chsel.Actions(usual.world_from_hand, lengths)
        probe = session.next_probe(offered, without=[0, 1])
    (decided,), (recorded,) = events_of(recorder, Decided), events_of(recorder, ActionsOffered)
    assert probe.action == decided.decision.chosen >= 2
    assert (decided.step, recorded.step, probe.length) == (-1, -1, lengths[probe.action])
    assert recorded.actions.digest == offered.digest
    np.testing.assert_array_equal(probe.world_from_hand, usual.world_from_hand[probe.action])
    assert np.flatnonzero(~decided.problem.available).tolist() == [0, 1]


@pytest.mark.parametrize("outcome", ["missed", "elsewhere", "as forecast"])
def test_an_outcome_that_no_pose_forecasts_starts_the_registration_afresh(
    box, finger, recorder, contacts, outcome
):
    """A probe through the middle of the box, whose pose is known."""
    action = chsel.Actions(way([0.1, 0.1, 0.08], 0.3)[:1], [0.3])
    policy = chsel.build_policy("grid", {"stop": {"spread": 0.0, "gain": 0.0}})
    given = {"hand": finger, "workspace": BOUNDS, "policy": policy, "settings": {"size": "small"}}
    with chsel.Session(box, record=recorder, **given) as session:
        session.add(contacts=contacts)
        session.register()
        assert session.next_probe(action).action == 0
        met = events_of(recorder, Decided)[0].decision.contacts
        near = met.mean(axis=0)  # where the true box is met, by slabs
        angle, half = 0.4, 0.5 * SIDES
        slabs = [half[0] / np.cos(angle), half[1] / np.sin(angle)]
        assert abs(near[0] - (0.3 - min(slabs))) < 0.02
        step = {
            "missed": {},
            "elsewhere": {"contact": [0.15, 0.1, 0.08]},
            "as forecast": {"contact": near},
        }[outcome]
        session.add(hand=finger, path=way([0.1, 0.1, 0.08], 0.04), **step)
        session.register()
        first, second = (event.problem for event in events_of(recorder, ProblemPosed))
        factor = 1 if outcome == "as forecast" else policy.settings.surprise.larger
        assert factor in (1, 3)
        assert len(second.initial_set) == factor * len(first.initial_set)
        assert (len(second.low_cost_set) == 0) is (factor > 1)
        session.next_probe(action, without=[0])
    surprise = events_of(recorder, Decided)[1].surprise
    limit = policy.settings.surprise.limit
    assert surprise < 0.5 * limit if factor == 1 else surprise > limit


def test_a_sure_grasp_says_in_the_recording_why_touching_ends(box, finger, recorder, contacts):
    grasp = compose(DOWN, np.array([0.0, 0.0, 0.07]))[None]  # from above, fingers along y
    given = {"hand": finger, "settings": {"size": "small"}}
    with chsel.Session(box, record=recorder, **given) as session:
        session.add(contacts=contacts)
        session.register()
        assert session.next_probe(grasps=(grasp, 0.075), sure=0.6) is None
        chance = session.belief.grasp_chance(session.grasp[None], 0.075).chance[0]
        assert session.stop == "grasp"
        assert session.grasp_chance == chance > 0.6
        on_box = apply(inverse(TRUTH), session.grasp[:3, 3][None])[0]
        np.testing.assert_allclose(np.abs(on_box), [0.0, 0.0, 0.07], atol=0.005)
    texts = [event.text for event in events_of(recorder, Logged)]
    assert f"stop: a grasp works with a chance of {chance:.2f}" in texts


def test_members_of_a_belief_explain_contacts_by_the_noise_of_the_session(box, recorder, contacts):
    """The second pose is 4 mm off every side: too far for an exact sensor, not for an inexact one.

    By one level of noise, 20 residuals of r cost 10 (r / noise)^2 nats; up to 9 are likely.
    """
    off = TRUTH @ compose(np.eye(3), np.full(3, 0.004))
    for noise, members in ((0.006, [0, 1]), (0.0005, [0])):
        method = Scripted([inverse(np.stack([TRUTH, off]))], noise)
        with chsel.Session(box, method=method, record=recorder) as session:
            session.add(contacts=contacts)
            found = session.register()
            expected = found.object_from_world[members]
            np.testing.assert_array_equal(session.belief.object_from_world, expected)


def test_modes_keep_their_numbers_over_the_steps_of_a_session(recorder):
    """No contact has shown the knob of a box; turned by pi about its axis it fits as well."""
    body, known = box_with_knob(SIDES)
    half_turn = compose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    first, second = inverse(np.stack([TRUTH, TRUTH @ half_turn]))
    script = [np.stack([first, second]), np.stack([second, first])]
    with chsel.Session(body, method=Scripted(script), record=recorder) as session:
        numbers = []
        for step, part in enumerate((known[:20], known[20:])):
            session.add(contacts=apply(TRUTH, part))
            assert session.register().trust.verdict == "several modes"
            numbers.append([mode.number for mode in session.belief.modes])
            best = [mode.object_from_world for mode in session.belief.modes]
            np.testing.assert_array_equal(best, script[step])
    assert numbers == [[0, 1], [1, 0]]
    recorded = events_of(recorder, Believed)
    assert [event.step for event in recorded] == [0, 1]
    for event, poses in zip(recorded, script, strict=True):
        np.testing.assert_array_equal(event.object_from_world, poses)
        assert event.weights.tolist() == [0.5, 0.5]
        assert event.covariances.shape == (2, 6, 6)
        centres = apply(inverse(poses), body.centroid[None])[:, 0]
        np.testing.assert_allclose(event.centres, centres, atol=0.01)
    assert [event.numbers.tolist() for event in recorded] == numbers
