import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.errors import SettingError
from chsel.problem.poses import apply, axis_angle, compose, rotation_angle
from chsel.problem.settings import in_preset
from runners.objects.loader import MODELS, load_model
from runners.sessions.configurations import CONFIGURATIONS, find_configuration
from runners.sessions.placement import laid_down, lowest, roll_to_rest
from runners.sessions.probing import choose_workspace
from runners.sessions.probing_settings import ProbingSettings

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


def test_the_placements_that_differ_from_the_experiments_are_named_in_the_readme():
    readme = (Path(__file__).resolve().parents[3] / "README.md").read_text()
    passage = readme.partition("**Simulated sessions.**")[2].partition("**Scans.**")[0]
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
    hammer, settings = find_configuration("hammer"), ProbingSettings()
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
