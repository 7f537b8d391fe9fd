"""The four cabinet configurations."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.errors import SessionError
from chsel.problem.poses import apply, inverse
from runners.objects.loader import load_model
from runners.simulated_robot import wrist
from runners.simulated_robot.cabinet import (
    CABINET_CONFIGURATIONS,
    REST,
    SHELF,
    stood_on_shelf,
)
from runners.simulated_robot.settings import RobotSettings
from runners.simulated_robot.wrist import CAP, CAP_BASE

GRIDS = {
    "cabinet_drill": ((0.05, -0.08), (0.0, 0.05, 0.12)),
    "cabinet_drill_opposite": ((0.07, -0.11), (-0.03, 0.05, 0.13)),
    "cabinet_mustard": ((0.0, 0.05), (-0.02, 0.04, 0.13)),
    "cabinet_mustard_sideways": ((0.05, 0.12), (-0.02, 0.04, 0.13)),
}


def test_the_probes_are_those_of_the_paper() -> None:
    assert {n: (c.y, c.z) for n, c in CABINET_CONFIGURATIONS.items()} == GRIDS
    assert CABINET_CONFIGURATIONS["cabinet_drill"].grid == [
        (0.05, 0.0), (0.05, 0.05), (0.05, 0.12), (-0.08, 0.0), (-0.08, 0.05), (-0.08, 0.12)
    ]  # fmt: skip


@pytest.mark.parametrize("name", GRIDS)
def test_objects_stand_on_the_shelf_within_the_workspace(name: str) -> None:
    configuration = CABINET_CONFIGURATIONS[name]
    mesh = load_model(configuration.object)
    pose = stood_on_shelf(mesh, configuration)
    placed = apply(pose, mesh.vertices)
    assert placed[:, 2].min() == pytest.approx(SHELF, abs=1e-9)
    assert (placed.max(axis=0) < configuration.workspace.upper).all()
    assert np.allclose(apply(pose, mesh.center_mass[None])[0, :2], configuration.position[:2])
    assert np.allclose(pose[:3, 2], [0.0, 0.0, 1.0], atol=0.02)  # upright


@pytest.mark.parametrize("name", GRIDS)
def test_several_but_not_all_probes_reach_the_object(name: str) -> None:
    configuration, settings = CABINET_CONFIGURATIONS[name], RobotSettings()
    mesh = load_model(configuration.object)
    surface = apply(stood_on_shelf(mesh, configuration), mesh.sample(4000, seed=0))
    way = np.linspace(0.0, settings.push_step * settings.push_steps, 51)
    reached = 0
    for y, z in configuration.grid:
        deepest = 0.0
        for ahead in way:
            pose = wrist.world_from_wrist(np.add(REST, [ahead, y, z]))
            for pad in wrist.PADS:
                camera = pose @ wrist.wrist_from_bubble_camera(pad)
                points = apply(inverse(camera), surface) - [0.0, 0.0, CAP_BASE]
                inside = ((points / np.array(CAP)) ** 2).sum(axis=1) < 0.8
                deepest = max(deepest, float((inside & (points[:, 2] > 0.0)).any()))
        reached += deepest > 0.0
    assert 3 <= reached <= 5


def test_an_object_that_is_too_large_is_refused() -> None:
    configuration = CABINET_CONFIGURATIONS["cabinet_drill"]
    with pytest.raises(SessionError, match="more than the cabinet has"):
        stood_on_shelf(load_model("drill").apply_scale(2.5), configuration)
