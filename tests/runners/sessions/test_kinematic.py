"""The kinematic session: contacts, free space, seeds and boundaries."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.errors import SettingError
from chsel.events import Probe
from chsel.problem.points import Lattice
from chsel.problem.poses import apply, axis_angle, compose, inverse, rotation_angle
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import in_preset
from runners.objects.loader import MODELS, load_model
from runners.sessions.configurations import CONFIGURATIONS, find_configuration
from runners.sessions.gripper import X_REST
from runners.sessions.kinematic import KinematicEngine
from runners.sessions.placement import laid_down, lowest, roll_to_rest
from runners.sessions.probing import ProbingSource, box_shell, choose_workspace, open_probing
from runners.sessions.probing_hand import ROTATION, panda_hand
from runners.sessions.probing_settings import ProbingSettings

Run = tuple[trimesh.Trimesh, ProbingSource, list[Probe]]
DEFAULT = ProbingSettings()
TIP = 0.1123  # m: from the hand's origin to the end of its fingers


def _run(name, settings=DEFAULT, *, seed=0):
    scales = {"cracker_box": 1.5, "clamp": 5.0}
    of = CONFIGURATIONS[name].object
    mesh = load_model(of).apply_scale(scales.get(of, 2.5))
    session = open_probing("kinematic", mesh, configuration_name=name, settings=settings, seed=seed)
    return mesh, session, list(session.probes())


@pytest.fixture(scope="module")
def drill():
    return _run("drill_slanted")


def test_the_hand_has_the_outer_size_of_a_franka_hand():
    solids = panda_hand().solids
    bounds = np.array([solid.bounds for solid in solids])
    lower, upper = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    np.testing.assert_allclose(lower, [-0.026, -0.102, -0.0316], atol=1e-6)
    np.testing.assert_allclose(upper, [TIP, 0.102, 0.0316], atol=1e-6)
    assert all(solid.is_convex and solid.is_watertight for solid in solids)
    points = panda_hand().interior_points(0.005, 0.010)
    depth = -np.min([mesh_sdf(solid, points)[0] for solid in solids], axis=0)
    assert depth.min() > 0.010
    assert len(points) > 1000


def test_a_wall_stops_the_finger_tip_to_a_micrometre_and_lets_it_go():
    wall = trimesh.creation.box((0.1, 2.0, 2.0))
    pose = np.eye(4)
    pose[0, 3] = 0.15
    engine = KinematicEngine(wall, pose, settings=DEFAULT, hand=panda_hand())
    for step in range(60):
        touch = engine.advance(np.array([X_REST + 0.002 * step, 0.0, 0.2]))
    assert touch.position[0] == pytest.approx(0.1 - TIP, abs=2e-6)
    np.testing.assert_allclose(touch.contact, [0.1, 0.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(touch.normal, [-1.0, 0.0, 0.0], atol=1e-9)
    back = engine.advance(touch.position - [0.002, 0.0, 0.0])
    assert back.contact is None
    assert back.position[0] == pytest.approx(touch.position[0] - 0.002)


def test_contacts_lie_on_the_surface_with_normals_out_of_it(drill):
    mesh, session, probes = drill
    contacts = np.concatenate([probe.contacts for probe in probes])
    normals = np.concatenate([probe.contact_normals for probe in probes])
    object_from_world = inverse(session.world_from_object)
    assert len(contacts) >= 4
    assert np.abs(mesh_sdf(mesh, apply(object_from_world, contacts))[0]).max() < 1e-5
    outside = mesh_sdf(mesh, apply(object_from_world, contacts + 1e-4 * normals))[0]
    assert outside.min() > 0.5e-4


def test_the_hand_is_never_in_the_object(drill):
    mesh, session, probes = drill
    surface = panda_hand().surface_points(0.004)
    for probe in probes[:8]:
        ends = probe.gripper_path[:, :3, 3]
        furthest = ends[np.argmax(ends[:, 0])]
        points = apply(inverse(session.world_from_object), surface + furthest)
        assert mesh_sdf(mesh, points)[0].min() > -1e-5


def test_free_voxels_are_new_each_time_and_not_deep_in_the_object(drill):
    mesh, session, probes = drill
    free = [session.initial_points.free, *(probe.new_points.free for probe in probes)]
    points = np.concatenate(free)
    assert len(np.unique(np.rint(points / 0.0125), axis=0)) == len(points)
    # Half the diagonal of a voxel less the depth of the hand's interior points.
    tolerance = 0.5 * np.sqrt(3.0) * 0.025 - 0.010
    inside = mesh_sdf(mesh, apply(inverse(session.world_from_object), points))[0]
    assert inside.min() > -tolerance
    assert len(points) - len(free[0]) > 2000


def test_each_probe_returns_before_the_object_at_its_place_in_the_grid(drill):
    _, session, probes = drill
    assert [probe.step for probe in probes] == list(range(session.count))
    for probe, (y, z) in zip(probes, session.configuration.grid, strict=True):
        x_end, y_end, z_end = probe.gripper_path[-1, :3, 3]
        assert x_end == pytest.approx(X_REST, abs=3e-4)
        assert (y_end, z_end) == pytest.approx((y, z), abs=5e-3)
        assert probe.outcome == ("contact" if len(probe.contacts) else "free")
        np.testing.assert_array_equal(probe.new_points.contacts, probe.contacts)
        np.testing.assert_array_equal(probe.gripper_path[0, :3, :3], ROTATION)


def test_a_seed_fixes_every_bit_and_another_one_does_not():
    first, again, other = (_run("box", seed=seed)[2] for seed in (3, 3, 4))
    for one, two in zip(first, again, strict=True):
        assert one.new_points.digest == two.new_points.digest
        np.testing.assert_array_equal(one.gripper_path, two.gripper_path)
    assert first[0].new_points.digest != other[0].new_points.digest


def test_boundaries_are_a_slab_below_the_floor_and_a_shell_of_the_workspace():
    free = {}
    mesh = load_model("spam_can").apply_scale(2.5)
    for boundary in ("floor_slab", "box_shell", "both"):
        session = open_probing(
            "kinematic",
            mesh,
            configuration_name="can",
            settings=replace(DEFAULT, boundary=boundary),
            seed=0,
        )
        free[boundary] = session.initial_points.free
    np.testing.assert_allclose(np.unique(free["floor_slab"][:, 2]), [-0.075, -0.05], atol=1e-12)
    # The can is 0.14 m x 0.25 m wide; the slab reaches 0.15 m further on each side.
    np.testing.assert_allclose(np.ptp(free["floor_slab"], axis=0)[:2], [0.44, 0.55], atol=0.026)
    assert len(free["box_shell"]) == 25 * 25 * 29 - 23 * 23 * 27
    assert len(free["both"]) < len(free["box_shell"]) + len(free["floor_slab"])


def test_no_free_voxel_of_the_shell_is_in_an_object_that_reaches_out_of_its_workspace():
    mesh = load_model("hammer").apply_scale(2.5)
    shell = replace(DEFAULT, boundary="box_shell")
    session = open_probing(
        "kinematic", mesh, configuration_name="hammer_straight", settings=shell, seed=0
    )
    assert apply(session.world_from_object, np.asarray(mesh.vertices))[:, 0].max() > 0.5
    every = box_shell(Lattice(session.workspace.lower, session.free_resolution), session.workspace)
    distance, _ = mesh_sdf(mesh, apply(inverse(session.world_from_object), every))
    assert (distance <= 0.0).any()
    np.testing.assert_array_equal(session.initial_points.free, every[distance > 0.0])


# Positions of the experiments where ours differ. Theirs are of the frame of their URDF, ours of the
# centre of mass: with theirs the probes miss our models, or the hand starts inside them.
THEIRS = {
    "drill": (0.25, 0.0, 0.2),
    "drill_opposite": (0.42, 0.0, 0.2),
    "mustard_sideways": (0.25, 0.0, 0.2),
    "hammer": (0.25, -0.18, 0.42),
    "hammer_fallen": (0.3, -0.1, 0.3),
    "clamp_sideways": (0.27, 0.0, 0.2),
}
PROBES = {"drill": 30, "drill_opposite": 25, "drill_slanted": 25, "drill_fallen": 20}
PROBES |= {"mustard": 16, "hammer": 16, "mustard_fallen_sideways": 15}  # all others: 12


def test_every_object_has_its_configurations_and_these_their_numbers_of_probes():
    assert len(CONFIGURATIONS) == 17
    assert {one.object for one in CONFIGURATIONS.values()} == set(MODELS)
    for name, found in CONFIGURATIONS.items():
        assert len(found.grid) == PROBES.get(name, 12), name
        first = [(found.y[0], height) for height in found.z]
        assert found.grid[: len(found.z) + 1] == [*first, (found.y[1], found.z[0])]


def test_the_placements_that_differ_from_the_experiments_are_named_on_their_page():
    page = (Path(__file__).resolve().parents[3] / "docs" / "probing.md").read_text()
    passage = page.partition("**Simulated sessions.**")[2].partition("**Scans.**")[0]
    assert set(re.findall(r"`([a-z_]+)`", passage)) & set(CONFIGURATIONS) == set(THEIRS)
    assert all(CONFIGURATIONS[name].position != there for name, there in THEIRS.items())


def test_a_configuration_that_is_not_accepted_is_an_error_that_lists_those_that_are():
    with pytest.raises(SettingError) as error:
        find_configuration("dril")
    assert all(name in str(error.value) for name in CONFIGURATIONS)
    with pytest.raises(SettingError, match="'drill'; accepted: can, can_fallen"):
        find_configuration("drill", "spam_can")
    assert find_configuration("clamp", "mesh").object == "clamp"


def test_the_hammer_has_a_larger_workspace_but_in_the_paper():
    hammer = find_configuration("hammer")
    settings = ProbingSettings()
    assert choose_workspace(hammer, in_preset(settings, "reference")).upper == (0.5, 0.5, 0.4)
    assert choose_workspace(hammer, in_preset(settings, "paper")).upper == (0.5, 0.3, 0.625)


@pytest.mark.parametrize(("tilt", "turned", "height"), [(0.3, 0.0, 0.15), (0.8, np.pi / 2, 0.1)])
def test_a_tilted_box_rolls_onto_the_face_that_balances(tilt, turned, height):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    tilted = compose(axis_angle(np.array([1.0, 0.0, 0.0]), tilt), np.array([0.0, 0.0, 1.0]))
    resting = roll_to_rest(box, tilted)
    assert rotation_angle(resting[:3, :3]) == pytest.approx(turned, abs=1e-9)
    assert resting[2, 3] == pytest.approx(height, abs=1e-9)
    if not turned:  # back over the edge that the tilt had lowered: half a width beside its middle
        edge = abs(0.15 * np.sin(tilt) - 0.1 * np.cos(tilt))
        assert abs(resting[1, 3]) == pytest.approx(0.1 - edge, abs=1e-9)


@pytest.mark.parametrize("name", ["drill_fallen", "mustard_fallen", "hammer_straight", "clamp"])
def test_objects_rest_on_the_floor_above_what_they_stand_on(name):
    configuration = CONFIGURATIONS[name]
    mesh = load_model(configuration.object).apply_scale(2.5)
    resting = laid_down(mesh, configuration)
    assert lowest(mesh, resting) == pytest.approx(0.0, abs=1e-6)
    centre = apply(resting, np.asarray(mesh.center_mass)[None])[0]
    np.testing.assert_allclose(centre[:2], configuration.position[:2], atol=1e-9)
    vertices = apply(resting, np.asarray(mesh.vertices))
    standing = vertices[vertices[:, 2] < 1e-5, :2]
    assert (standing.min(axis=0) <= centre[:2]).all()
    assert (standing.max(axis=0) >= centre[:2]).all()
