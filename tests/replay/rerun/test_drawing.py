"""What drawings are made of: costs as colours, meshes for the eye."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from replay.colors import CostScale, cost_colors, number
from replay.rerun.scene import LEVELS, coarsened, cost_levels


def test_places_on_the_scale_are_logarithmic() -> None:
    scale = CostScale.of([100.0, 1.0, 7.0, np.nan])
    np.testing.assert_allclose(scale.fraction([1.0, 10.0, 100.0, 500.0]), [0.0, 0.5, 1.0, 1.0])


@pytest.mark.parametrize("costs", [[], [3.0], [0.0, 0.0]])
def test_without_a_range_every_cost_is_the_lowest(costs: list[float]) -> None:
    scale = CostScale.of(costs)
    assert scale.fraction([0.0, 3.0, 9.0]).tolist() == [0.0, 0.0, 0.0]


def test_a_cost_of_zero_does_not_swallow_the_scale() -> None:
    scale = CostScale.of([0.0, 1.0])
    np.testing.assert_allclose(scale.fraction([0.0, 0.01, 1.0]), [0.0, 0.5, 1.0])


def test_lower_costs_are_brighter() -> None:
    colors = cost_colors(np.linspace(0.0, 1.0, 20)).astype(np.float64)
    brightness = colors @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) < 0.0).all()
    assert colors[0].tolist() == [253.0, 231.0, 37.0]
    assert colors[-1].tolist() == [68.0, 1.0, 84.0]


@pytest.mark.parametrize(
    ("value", "text"),
    [(1644.2, "1644"), (0.0, "0"), (-0.25, "-0.25"), (12.345, "12.3"), (3e7, "3e+07")],
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert number(value) == text


def test_a_coarsened_mesh_has_fewer_faces_and_nearly_the_same_shape() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    coarse = coarsened(mesh, 2000)
    assert 400 < len(coarse.faces) <= 2000
    radius = np.linalg.norm(coarse.vertices, axis=1)
    assert radius.min() > 0.097
    assert radius.max() < 0.1001
    assert (coarse.face_normals * coarse.triangles_center).sum(axis=1).min() > 0.0


def test_a_mesh_of_few_faces_stays_as_it_is() -> None:
    mesh = trimesh.creation.box()
    np.testing.assert_array_equal(coarsened(mesh, 12).triangles, mesh.triangles)


def test_steps_of_cost_run_from_the_lowest_to_the_highest() -> None:
    assert cost_levels(np.array([1.0, 16.0, 256.0])).tolist() == [0, LEVELS // 2, LEVELS - 1]
    assert cost_levels(np.array([2.0, 2.0])).tolist() == [0, 0]
    assert cost_levels(np.zeros(0)).tolist() == []
