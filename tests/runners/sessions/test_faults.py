"""Faults on a ball: what is reported against what was met."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from chsel.errors import SettingError
from chsel.problem.points import FreeVoxels, KnownPoints, Lattice, Workspace
from chsel.problem.settings import settings_mapping
from runners.objects.loader import load_model
from runners.sessions.faults import (
    CLEAN,
    LEVELS,
    LEVELS_OF_POINTS,
    Faults,
    FaultSettings,
    level_name,
    probed_mesh,
)
from runners.sessions.probing import open_probing
from runners.sessions.probing_settings import ProbingSettings, without_defaults

RADIUS, SIDE = 0.1, 0.02
CENTRE = np.array([0.3, 0.0, 0.2])
WORKSPACE = Workspace((0.0, -0.3, 0.0), (0.6, 0.3, 0.5))


def directions(count):
    drawn = np.random.default_rng(0).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def of_ball(free=None, seed=0, **settings):
    pose = np.eye(4)
    pose[:3, 3] = CENTRE
    return Faults(
        FaultSettings(**settings),
        trimesh.creation.icosphere(subdivisions=4, radius=RADIUS),
        world_from_object=pose,
        free=free if free is not None else FreeVoxels(Lattice((0.0, 0.0, 0.0), SIDE)),
        workspace=WORKSPACE,
        seed=seed,
    )


def reported(count, faults, *, steps=1):
    """True contacts all over the ball, (C, 3), and those reported of them, (C', 3)."""
    normals = directions(count)
    contacts = CENTRE + RADIUS * normals
    parts = zip(np.split(contacts, steps), np.split(normals, steps), strict=True)
    found = [faults.reported(step, at, normals_out=out) for step, (at, out) in enumerate(parts)]
    for places, normal in found:
        assert len(places) == len(normal)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    return contacts, np.concatenate([places for places, _ in found])


def test_noise_has_its_deviation_along_each_axis_and_along_normals():
    contacts, found = reported(4000, of_ball(contact_noise=0.003))
    off = found - contacts
    np.testing.assert_allclose(off.std(axis=0), 0.003, rtol=0.05)
    assert (off * directions(4000)).sum(axis=1).std() == pytest.approx(0.003, rel=0.05)


def test_rounded_contacts_are_on_the_lattice():
    contacts, found = reported(50, of_ball(quantisation=0.005))
    np.testing.assert_allclose(np.rint(found / 0.005) * 0.005, found, atol=1e-15)
    assert 0.0015 < np.abs(found - contacts).max() <= 0.0025 + 1e-12


def test_a_bias_is_the_same_shift_in_all_steps():
    contacts, found = reported(20, of_ball(camera_bias=0.005), steps=4)
    off = found - contacts
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=1e-12)
    assert np.linalg.norm(off[0]) == pytest.approx(0.005)


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_so_many_contacts_are_foreign_and_off_the_object(share):
    _, found = reported(180, of_ball(foreign_contacts=share), steps=60)
    off = np.linalg.norm(found - CENTRE, axis=1) - RADIUS
    foreign = off > 1e-3
    assert foreign.sum() == pytest.approx(180 * share / (1 - share), abs=1)
    assert off[foreign].min() >= 0.0099  # the ball is a polyhedron
    assert off[foreign].max() <= 0.1
    assert (found[foreign] >= WORKSPACE.lower).all()


def test_foreign_contacts_are_not_in_voxels_told_free():
    free = FreeVoxels(Lattice((0.0, 0.0, 0.0), SIDE))
    axes = np.arange(0, 30) * SIDE
    everywhere = np.stack(np.meshgrid(axes, axes - 0.3, axes), axis=-1).reshape(-1, 3)
    free.add(everywhere[everywhere[:, 2] > 0.2])  # above the ball's centre
    _, found = reported(80, of_ball(free, foreign_contacts=0.2))
    foreign = found[np.linalg.norm(found - CENTRE, axis=1) > RADIUS + 1e-3]
    assert len(foreign) > 10
    assert foreign[:, 2].max() < 0.2 + 1.5 * SIDE
    full = FreeVoxels(free.lattice)
    full.add(everywhere)
    assert len(reported(20, of_ball(full, foreign_contacts=0.2))[1]) == 20  # nowhere to be


@pytest.mark.parametrize("reach", [0.5, 1.0])
def test_wrongly_free_voxels_are_inside_within_reach_and_told_once(reach):
    free = FreeVoxels(Lattice((0.0, 0.0, 0.0), SIDE))
    axes = np.arange(-8, 9) * SIDE
    around = CENTRE + np.stack(np.meshgrid(axes, axes, axes), axis=-1).reshape(-1, 3)
    swept = free.add(around[np.linalg.norm(around - CENTRE, axis=1) > RADIUS])
    every = of_ball(free, free_error=1.0, free_reach=reach).wrongly_free(0, swept)
    depth = RADIUS - np.linalg.norm(every - CENTRE, axis=1)
    assert depth.min() > -1e-3
    assert reach * SIDE - 2e-3 < depth.max() < reach * SIDE + 1e-3
    assert free.holds(every).all()
    some = of_ball(FreeVoxels(free.lattice), free_error=0.5, free_reach=reach)
    told = some.wrongly_free(0, swept)
    assert 0.35 < len(told) / len(every) < 0.65
    assert len(some.wrongly_free(1, swept)) == 0  # each had its chance


def normals_reported(count, faults, *, steps=1):
    """True normals (C, 3), those reported of them (C, 3), and those of foreign contacts (K, 3)."""
    true = directions(count)
    found, foreign = [], []
    for step, out in enumerate(np.split(true, steps)):
        _, normals = faults.reported(step, CENTRE + RADIUS * out, normals_out=out)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
        found.append(normals[: len(out)])
        foreign.append(normals[len(out) :])
    return true, np.concatenate(found), np.concatenate(foreign)


def angles(one, other):
    """Angles (N,) between unit vectors (N, 3), also small ones."""
    cosine = (one * other).sum(axis=1)
    return np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), cosine)


@pytest.mark.parametrize("noise", [0.05, 0.35])
def test_normals_are_off_by_the_noise_whatever_is_stated(noise):
    true, found, _ = normals_reported(6000, of_ball(normals=0.1, normal_noise=noise))
    off = angles(true, found)
    assert np.sqrt((off**2).mean()) == pytest.approx(noise, rel=0.03)
    # Half the lengths of two independent Gaussians are below sqrt(ln 2) of their root mean square.
    assert (off < noise * math.sqrt(math.log(2.0))).mean() == pytest.approx(0.5, abs=0.02)
    sideways = np.cross(true, [0.0, 0.0, 1.0])
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    along = off / np.sin(off) * (found * sideways).sum(axis=1)  # of the turn, radians
    assert abs(along.mean()) < 4.0 * along.std() / math.sqrt(6000)
    assert along.std() == pytest.approx(noise / math.sqrt(2.0), rel=0.05)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_so_many_normals_have_any_direction(share):
    true, found, _ = normals_reported(600, of_ball(normals=0.1, normal_wrong=share), steps=200)
    wrong = angles(true, found) > 1e-9
    assert wrong.sum() == pytest.approx(share * 600, abs=1)
    cosines = (true * found)[wrong].sum(axis=1)  # uniform from -1 to 1 if directions are
    assert abs(cosines.mean()) < 4.0 / math.sqrt(3.0 * wrong.sum())
    assert cosines.std() == pytest.approx(1.0 / math.sqrt(3.0), rel=0.1)
    ends = np.cumsum(wrong)  # the share is kept all along
    assert np.abs(ends - share * np.arange(1, 601)).max() <= 1.0


def test_a_tilt_is_one_turn_of_all_normals_of_a_session():
    turns = []
    for seed in (0, 1):
        faults = of_ball(normals=0.1, normal_tilt=0.26, seed=seed)
        true, found, _ = normals_reported(40, faults, steps=8)
        turn, residual = Rotation.align_vectors(found, true)
        assert residual < 1e-6
        assert turn.magnitude() == pytest.approx(0.26, abs=1e-9)
        turns.append(turn)
    assert (turns[0].inv() * turns[1]).magnitude() > 0.01  # another seed, another axis


def test_faults_of_normals_change_neither_contacts_nor_each_other():
    plain = {"contact_noise": 0.003, "foreign_contacts": 0.2, "camera_bias": 0.002}
    contacts = reported(60, of_ball(**plain), steps=10)[1]
    worse = {"normals": 0.1, "normal_noise": 0.2, "normal_wrong": 0.3, "normal_tilt": 0.2}
    np.testing.assert_array_equal(contacts, reported(60, of_ball(**plain, **worse), steps=10)[1])
    noisy = {"normals": 0.1, "normal_noise": 0.2}
    _, alone, _ = normals_reported(60, of_ball(**noisy), steps=10)
    _, beside, others = normals_reported(60, of_ball(**noisy, **plain), steps=10)
    np.testing.assert_array_equal(alone, beside)
    _, some, _ = normals_reported(60, of_ball(**noisy, normal_wrong=0.3), steps=10)
    assert (some == alone).all(axis=1).sum() == pytest.approx(42, abs=1)
    _, exact, foreign = normals_reported(60, of_ball(normals=0.1, **plain), steps=10)
    np.testing.assert_array_equal(exact, directions(60))
    np.testing.assert_array_equal(foreign, others)
    unused = of_ball(**plain)  # as they were before sessions could report normals
    np.testing.assert_array_equal(foreign, normals_reported(60, unused, steps=10)[2])


def test_no_fault_reports_what_was_met_and_each_depends_on_seed_and_step():
    contacts, found = reported(20, of_ball())
    np.testing.assert_array_equal(contacts, found)
    assert len(of_ball().wrongly_free(0, contacts)) == 0
    first, again = (reported(8, of_ball(contact_noise=0.003))[1] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not (first == reported(8, of_ball(seed=1, contact_noise=0.003))[1]).any()
    late = reported(8, of_ball(contact_noise=0.003), steps=2)[1]
    assert not (first[4:] == late[4:]).any()


def test_the_probed_mesh_is_smaller_about_the_same_centre():
    mesh = trimesh.creation.box((0.1, 0.2, 0.3)).apply_translation([1.0, 2.0, 3.0])
    probed = probed_mesh(mesh, FaultSettings(mesh_scale=1.02))
    np.testing.assert_allclose(probed.extents, mesh.extents / 1.02)
    np.testing.assert_allclose(probed.bounds.mean(axis=0), [1.0, 2.0, 3.0])
    assert probed_mesh(mesh, FaultSettings()) is mesh


def kinematic(**faults):
    settings = ProbingSettings(faults=FaultSettings(**faults))
    session = open_probing(
        "kinematic",
        load_model("cracker_box", 1.5),
        configuration_name="box",
        settings=settings,
        seed=0,
    )
    return session, list(session.probes())


def test_a_session_with_faults_is_the_same_session():
    clean, before = kinematic()
    faulty, after = kinematic(contact_noise=0.003, foreign_contacts=0.2, free_error=0.2)
    np.testing.assert_array_equal(clean.world_from_object, faulty.world_from_object)
    wrong = 0
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one.gripper_path, other.gripper_path)
        count = len(one.contacts)
        assert (np.abs(other.contacts[:count] - one.contacts) < 0.02).all()
        np.testing.assert_array_equal(other.contacts, other.new_points.known)
        wrong += len(other.new_points.free) - len(one.new_points.free)
    assert sum(len(probe.contacts) for probe in after) > sum(len(p.contacts) for p in before)
    assert wrong > 0
    smaller, after = kinematic(mesh_scale=1.1)  # is met later, at the same pose
    np.testing.assert_array_equal(clean.world_from_object, smaller.world_from_object)
    assert after[0].contacts[0, 0] > before[0].contacts[0, 0] + 0.002


def test_contacts_have_normals_where_settings_state_their_noise():
    known = {}
    for name in ("clean", "noise_3mm", "normals_10deg", "normals_20deg_as_5deg"):
        session, probes = kinematic(**settings_mapping(LEVELS[name]))
        known[name] = session.initial_points.merged(
            KnownPoints.joined([p.new_points for p in probes])
        )
        for probe in probes:
            if LEVELS[name].normals is not None:
                np.testing.assert_array_equal(probe.new_points.normals, probe.contact_normals)
    assert not known["clean"].has_normals
    assert not known["noise_3mm"].has_normals
    clean, right, worse = (
        known[name] for name in ("clean", "normals_10deg", "normals_20deg_as_5deg")
    )
    np.testing.assert_array_equal(clean.known, right.known)
    np.testing.assert_array_equal(clean.free, right.free)
    assert clean.digest != right.digest
    assert set(right.normal_noise) == {math.radians(10.0)}
    assert set(worse.normal_noise) == {math.radians(5.0)}
    exact = KnownPoints.joined([p.new_points for p in kinematic(normals=0.3)[1]])
    np.testing.assert_allclose(
        angles(worse.normals, exact.normals) / angles(right.normals, exact.normals), 2.0
    )  # the same turns, twice as large


def test_levels_have_names_and_are_recorded_unless_clean():
    assert [level_name(level) for level in LEVELS.values()] == list(LEVELS)
    assert level_name(replace(LEVELS["mixed"], contact_noise=0.004)) == "own"
    session = {"kind": "kinematic", "faults": settings_mapping(LEVELS[CLEAN])}
    session["hand"] = {"urdf": None, "root": None, "boxes": []}
    assert without_defaults(session) == {"kind": "kinematic"}
    session["faults"] = settings_mapping(LEVELS["mixed"])
    session["hand"] = {"urdf": "gripper.urdf"}
    recorded = without_defaults(session)
    later = {"normals", "normal_noise", "normal_wrong", "normal_tilt"}  # than other faults
    assert later.isdisjoint(recorded["faults"])
    assert FaultSettings(**recorded.pop("faults")) == FaultSettings(**session.pop("faults"))
    assert recorded == session
    session["faults"] = settings_mapping(LEVELS["normals_wrong_30"])
    recorded = without_defaults(session)["faults"]
    assert later & set(recorded) == {"normals", "normal_noise", "normal_wrong"}
    assert FaultSettings(**recorded) == LEVELS["normals_wrong_30"]
    names = list(LEVELS)
    assert list(LEVELS_OF_POINTS) == names[: names.index("mixed") + 1]


def test_faults_that_cannot_be_are_errors():
    for name, value, accepted in (
        ("contact_noise", -0.001, "0 to 0.1 (m)"),
        ("foreign_contacts", 0.6, "0 to 0.5"),
        ("mesh_scale", 0.0, "0.5 to 2"),
        ("normal_noise", 10.0, "0 to 1 radians"),
        ("normals", 0.0, "0.001 to 3.14159 radians"),
    ):
        with pytest.raises(
            SettingError, match=re.escape(f"{name} is {value}; accepted: {accepted}")
        ):
            FaultSettings(**{name: value})
    message = "normal_tilt is 0.1, and contacts have no normals; accepted with it: normals"
    with pytest.raises(SettingError, match=message):
        FaultSettings(normal_tilt=0.1)
