"""Which of several objects it is: energies, what all of them share, and the next probe."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.problem.noise import noise_model
from chsel.problem.poses import apply, compose, inverse
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from tests.chsel.methods.scene import (
    BOX,
    BOX_SIDES,
    STANDING,
    TRUTH,
    WORKSPACE,
    on_faces,
)
from tests.chsel.samples import Scripted, box_distance, plain_energy


def test_the_true_object_comes_first(tmp_path):
    slim = trimesh.creation.box(BOX_SIDES * [1.0, 0.5, 1.0])
    contacts = apply(TRUTH, on_faces(12))
    around = contacts.mean(axis=0) + np.random.default_rng(0).uniform(-0.3, 0.3, (400, 3))
    in_box = apply(np.linalg.inv(TRUTH), around)
    free = around[(np.abs(in_box) > 0.5 * BOX_SIDES + 0.02).any(axis=1)]
    meshes = {"slim": slim, "box": BOX}
    with chsel.WhichObject(meshes, record=tmp_path / "touches.mcap") as which:
        which.add(contacts=contacts[:1], normals=[[0, 0, 1]])
        which.add(contacts=contacts[1:], free=free)
        shared = [session.points.normals for session in which.sessions.values()]
        np.testing.assert_array_equal(shared, [[[0, 0, 1], *np.zeros((11, 3))]] * 2)
        first, second = which.register()
    assert (first.name, second.name) == ("box", "slim")
    assert first.alive
    assert not second.alive
    # Four contacts are on the wide sides, which the slim box cannot reach, 30 mm off for two.
    assert second.energy - first.energy > 9.0
    verdicts = list(verify(read_recording(tmp_path / "touches_slim.mcap")))
    assert [verdict.outcome for verdict in verdicts] == [EQUAL]
    with pytest.raises(chsel.ChselError, match="accepted: two or more, of different names"):
        chsel.WhichObject(["a.obj", "other/a.obj"])
    (tmp_path / "again_box.mcap").touch()
    with pytest.raises(chsel.ChselError, match=r"again_box\.mcap"):
        chsel.WhichObject(meshes, record=tmp_path / "again.mcap", workspace=WORKSPACE)
    assert read_recording(tmp_path / "again_slim.mcap").ended.outcome.startswith("failed")


def test_the_object_whose_normals_fit_comes_first():
    """Contacts are on sides 8 cm apart: the other box has the places if tilted, no such sides."""
    meshes = {"wide": trimesh.creation.box((0.08, 0.12, 0.12))}
    meshes["slim"] = trimesh.creation.box((0.06, 0.1, 0.1))
    places = np.array([[0.04, 0.02, 0.03], [0.04, -0.02, -0.02], [-0.04, 0.02, -0.03]])
    places = np.concatenate([places, [[-0.04, -0.03, 0.02]]])
    normals = np.sign(places) * [1.0, 0.0, 0.0] @ TRUTH[:3, :3].T
    energies = []
    for given in ({}, {"normals": normals, "normal_noise": 0.1}):
        with chsel.WhichObject(meshes) as which:
            which.add(contacts=apply(TRUTH, places), **given)
            energies.append({one.name: one.energy for one in which.register()})
    assert abs(energies[0]["slim"] - energies[0]["wide"]) < 0.5
    assert energies[1]["slim"] - energies[1]["wide"] > 9.0


def test_a_prior_on_a_single_object_is_refused():
    meshes = {"large": BOX, "small": BOX.copy().apply_scale(0.5)}
    centre = {"centre": TRUTH[:3, 3], "centre_noise": 0.02}
    poses = {"object_from_world": inverse(TRUTH)[None], "covariances": np.eye(6)}
    for part, name in ((centre | {"point": [0.0, 0.0, 0.1]}, "point"), (poses, "object_from_wo")):
        with pytest.raises(chsel.ChselError, match=f"^prior has {name}"):
            chsel.WhichObject(meshes, prior=chsel.PosePrior(**part))
    prior = chsel.PosePrior(**centre)
    with chsel.WhichObject(meshes, prior=prior) as which:
        assert [one.started.prior for one in which.sessions.values()] == [prior, prior]


def test_what_one_object_cannot_have_is_added_to_none():
    """Contacts 21 m apart, which are never those of the smaller object: its diameter is 0.2 m."""
    small = BOX.copy()
    large = BOX.copy().apply_scale(2.0)
    size = float(np.linalg.norm(small.extents))
    with chsel.WhichObject({"large": large, "small": small}, workspace=WORKSPACE) as which:
        which.add(contacts=apply(TRUTH, on_faces(12)))
        spread = np.array([[0.0, 0.0, 0.0], [110.0 * size, 0.0, 0.0]]).repeat(30, axis=0)
        jitter = np.random.default_rng(0).uniform(0.0, 0.2, spread.shape)
        with pytest.raises(chsel.ChselError, match="millimetres"):
            which.add(contacts=spread + jitter)
        counts = [len(session.points.known) for session in which.sessions.values()]
        assert counts == [12, 12]
        assert {session.step for session in which.sessions.values()} == {0}


def test_objects_of_other_sizes_are_compared_by_the_same_points():
    """Touches 2.9 mm apart are one place of an object of 0.25 m, and two of one of 0.05 m."""
    small = BOX.copy().apply_scale(0.2)
    contacts = apply(TRUTH, on_faces(12))
    near = np.concatenate([contacts, contacts + np.array([0.0, 0.0, 0.0029])])
    with chsel.WhichObject({"large": BOX, "small": small}, resolution=0.004) as which:
        which.add(contacts=near)
        counts = {len(session.points.known) for session in which.sessions.values()}
        look = compose(TRUTH[:3, :3], TRUTH[:3, 3] - 0.3 * TRUTH[:3, 2])
        seen = {"depth": np.full((30, 40), 0.26), "mask": np.ones((30, 40))}
        camera = chsel.PinholeCamera(40, 30, fx=200.0, fy=200.0, cx=19.5, cy=14.5)
        which.add(**seen, camera=camera, world_from_camera=look)
        places = {s.points.known.tobytes() for s in which.sessions.values()}
    assert counts == {24}
    assert len(places) == 1
    with chsel.Session(BOX, resolution=0.01) as alone:
        alone.add(contacts=near)
        assert len(alone.points.known) == 12


def test_no_action_is_chosen_by_two_objects():
    meshes = {"slim": trimesh.creation.box(BOX_SIDES * [1.0, 0.5, 1.0]), "box": BOX}
    contacts = apply(TRUTH, on_faces(12))
    finger = trimesh.creation.cylinder(0.01, 0.1)
    with chsel.WhichObject(meshes, workspace=WORKSPACE, hand=finger) as which:
        which.add(contacts=contacts[:3])
        names = [one.name for one in which.register()]
        every = which.sessions["box"].actions(chsel.ActionSettings(spacing=0.05, most=200))
        chosen = which.next_probe(every).action
        one = chsel.Actions(every.world_from_hand[[chosen]], every.length[[chosen]])
        for contact, name, action in ((3, names[0], 0), (4, names[1], None)):
            which.add(contacts=contacts[contact : contact + 1])
            which.candidates = [one for one in which.register() if one.name == name]
            probe = which.next_probe(one)
            assert (None if probe is None else probe.action) == action
        assert which.sessions[names[1]].stop == "actions"
        with pytest.raises(chsel.ChselError, match=r"without is \[2\]; accepted: indices below 1"):
            which.sessions[names[0]].next_probe(one, without=[2])


SLIM = BOX_SIDES * [1.0, 0.8, 1.0]  # 12 mm off on both wide sides


@pytest.mark.parametrize("moves", [0.01, 0.0])
def test_energies_are_those_of_the_points_where_the_object_is_now(moves):
    """Each of eight touches of a side moves the box by 5 mm, straight away from the hand."""
    distance = 0.5 * moves
    pin = trimesh.creation.box(bounds=[[-2e-3, -2e-3, -0.02], [2e-3, 2e-3, 0.0]])
    local = on_faces(12)[np.arange(12) % 3 < 2]
    axis = np.tile([0, 1], 4)
    now = STANDING.copy()
    noise = 0.002
    method = Scripted([inverse(STANDING[None])], 0.002, push_distance=distance)
    meshes = {"slim": trimesh.creation.box(SLIM), "box": BOX}
    given = {"workspace": WORKSPACE, "moves": moves, "method": method, "noise": noise}
    ways = -np.sign(local[np.arange(8), axis])[:, None] * STANDING[:3, axis].T
    now[:3, 3] -= distance * ways.sum(axis=0)  # at STANDING after the last touch
    with chsel.WhichObject(meshes, **given) as which:
        for touched, way in zip(local, ways, strict=True):
            contact = apply(now, touched[None])[0]
            turn = np.stack([np.cross([0.0, 0.0, 1.0], way), [0.0, 0.0, 1.0], way], axis=1)
            turn[:, 0] = np.cross(turn[:, 1], way)
            end = compose(turn, contact - 1e-3 * way)
            which.add(hand=pin, path=end[None], contact=contact)
            now[:3, 3] += distance * way
        found = which.register()
    assert [one.name for one in found] == ["box", "slim"]
    for one, sides in zip(found, (BOX_SIDES, SLIM), strict=True):
        residuals = box_distance(local, sides)
        expected = plain_energy(noise_model(noise), residuals.tolist(), depths=[])
        assert one.energy == pytest.approx(expected, abs=0.02)


def test_the_next_probe_forecasts_contacts_on_the_likeliest_object():
    meshes = {"slim": trimesh.creation.box(SLIM), "box": BOX}
    finger = trimesh.creation.box(bounds=[[-0.01, -0.01, -0.1], [0.01, 0.01, 0.0]])
    method = Scripted([inverse(TRUTH[None])])
    policy = chsel.build_policy("hit_chance", {"stop": {"spread": 0.0, "gain": 0.0}})
    given = {"hand": finger, "workspace": WORKSPACE, "method": method, "policy": policy}
    for sides in (BOX_SIDES, SLIM):
        local = on_faces(24)
        local[1::3, 1] *= sides[1] / BOX_SIDES[1]
        with chsel.WhichObject(meshes, **given) as which:
            which.add(contacts=apply(TRUTH, local))
            which.register()
            # Across the middles of the wide sides, where both objects are met, 12 mm apart.
            along = TRUTH[:3, 1]
            across = TRUTH[:3, 0]
            turn = np.stack([across, np.cross(along, across), along], axis=1)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, TRUTH[:3, 3] - 0.2 * along
            probe = which.next_probe(chsel.Actions(pose[None], [0.4]))
        met = apply(inverse(TRUTH), probe.decision.contacts)
        assert len(met) > 0
        np.testing.assert_allclose(met[:, 1], -0.5 * sides[1], atol=0.002)
