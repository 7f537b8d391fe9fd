"""Objects of simulated experiments are enlarged, those that sensors meet are not."""

from __future__ import annotations

import pytest
import trimesh

from chsel.problem.points import Workspace
from runners.objects.loader import ObjectModel, check_size

ROOM = Workspace((0.0, 0.0, 0.0), (0.4, 0.5, 0.3))


@pytest.mark.parametrize(
    ("length", "scale", "count"),
    [(0.04, 1.0, 0), (0.04, 0.001, 0), (0.49, 1.0, 0), (0.04, 2.5, 1), (0.51, 1.0, 1)],
)
def test_enlarged_objects_and_those_longer_than_the_workspace_are_a_warning(
    length: float, scale: float, count: int
) -> None:
    box = trimesh.creation.box((length, 0.02, 0.03))
    found = check_size(ObjectModel("box", box, scale, 0.001, "drill"), ROOM)
    assert [warning.code for warning in found] == ["object_size"] * count
    for warning in found:
        assert str(warning) == (
            f"the object is {length} m long at scale {scale:g}, the workspace 0.5 m; objects of "
            "real size have object.scale=1"
        )
