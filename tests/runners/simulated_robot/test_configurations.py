"""The four cabinet configurations."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.errors import SessionError
from chsel.problem.poses import apply
from runners.objects.loader import load_model
from runners.simulated_robot.cabinet import (
    CABINET_CONFIGURATIONS,
    SHELF,
    stood_on_shelf,
)

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


def test_an_object_that_is_too_large_is_refused() -> None:
    configuration = CABINET_CONFIGURATIONS["cabinet_drill"]
    with pytest.raises(SessionError, match="more than the cabinet has"):
        stood_on_shelf(load_model("drill").apply_scale(2.5), configuration)
