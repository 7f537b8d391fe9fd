"""Costs as colours."""

from __future__ import annotations

import numpy as np
import pytest

from replay.rerun.colors import CostScale, cost_colors, number


def test_places_on_the_scale_are_logarithmic() -> None:
    scale = CostScale.of([100.0, 1.0, 7.0, np.nan])
    np.testing.assert_allclose(scale.fraction([1.0, 10.0, 100.0, 500.0]), [0.0, 0.5, 1.0, 1.0])
    assert scale.cost_at(0.5) == pytest.approx(10.0)


@pytest.mark.parametrize("costs", [[], [3.0], [0.0, 0.0]])
def test_without_a_range_every_cost_is_the_lowest(costs: list[float]) -> None:
    scale = CostScale.of(costs)
    assert scale.fraction([0.0, 3.0, 9.0]).tolist() == [0.0, 0.0, 0.0]
    assert scale.cost_at(1.0) == (costs[0] if costs else 0.0)


def test_a_cost_of_zero_does_not_swallow_the_scale() -> None:
    scale = CostScale.of([0.0, 1.0])
    np.testing.assert_allclose(scale.fraction([0.0, 0.01, 1.0]), [0.0, 0.5, 1.0])
    assert scale.cost_at(0.0) == 0.0


def test_a_scale_can_be_widened() -> None:
    assert CostScale(2.0, 3.0).including(CostScale(1.0, 2.5)) == CostScale(1.0, 3.0)


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
