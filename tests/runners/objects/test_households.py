"""The household objects: closed solids of usual sizes, which sessions and evaluations take."""

import numpy as np
import pytest

from runners.evaluation.trial_configurations import household_configurations
from runners.objects.loader import HOUSEHOLDS, OBJECTS, load_object
from runners.sessions.fitted import FITTED_PROBES, fitted_configuration
from runners.sessions.probing_hand import panda_hand

LENGTHS = {  # metres
    "mug": 0.119,
    "bowl": 0.160,
    "plate": 0.264,
    "bottle": 0.300,
    "wine_glass": 0.200,
    "pan": 0.388,
    "spoon": 0.202,
    "screwdriver": 0.225,
    "wrench": 0.212,
    "remote": 0.156,
    "bulb": 0.107,
    "roll": 0.116,
    "iron": 0.237,
}


@pytest.mark.parametrize("name", HOUSEHOLDS)
def test_a_thing_is_one_closed_solid_of_its_size(name, tmp_path):
    model = load_object(OBJECTS[f"household/{name}"], tmp_path)
    mesh = model.mesh
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert 0.0 < mesh.volume < np.prod(mesh.extents)
    assert mesh.extents.max() == pytest.approx(LENGTHS[name], abs=0.001)
    assert not model.of_paper
    assert len(fitted_configuration(mesh, panda_hand()).grid) == FITTED_PROBES


def test_a_mug_is_hollow_and_a_remote_is_not(tmp_path):
    volumes = {
        name: load_object(OBJECTS[f"household/{name}"], tmp_path).mesh
        for name in ("mug", "remote", "roll")
    }
    mug, remote, roll = (volumes[name] for name in ("mug", "remote", "roll"))
    walls = np.pi * (0.041**2 - 0.037**2) * 0.09 + np.pi * 0.041**2 * 0.005
    assert mug.volume == pytest.approx(walls + 2.0e-5, rel=0.3)  # and a handle
    assert remote.volume == pytest.approx(remote.convex_hull.volume)
    assert roll.volume == pytest.approx(np.pi * (0.058**2 - 0.022**2) * 0.098, rel=0.01)


def test_evaluations_have_a_configuration_for_each():
    found = household_configurations()
    assert set(HOUSEHOLDS) <= set(found)
    assert found["mug"].probes == FITTED_PROBES
    assert found["mug+noise_3mm"].clean_name == "mug"
