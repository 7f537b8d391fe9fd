"""Solids against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from runners.objects.models.solids import CrossSection, cut, loft, placed, united

BAR = [CrossSection(0, 1, 2, 4, 6, 40), CrossSection(10, 1, 2, 4, 6, 40)]


@pytest.mark.parametrize(
    ("axis", "bounds"),
    [
        ("x", [[0, -1, -1], [10, 3, 5]]),
        ("y", [[-1, 0, -1], [5, 10, 3]]),
        ("z", [[-1, -1, 0], [3, 5, 10]]),
    ],
)
def test_a_loft_lies_along_its_axis_and_points_outwards(axis: str, bounds: list) -> None:
    bar = loft(BAR, axis=axis)
    np.testing.assert_allclose(bar.bounds, bounds, atol=1e-12)
    assert bar.is_volume
    assert bar.volume == pytest.approx(4 * 6 * 10, rel=0.02)


def test_a_loft_of_ellipses_has_the_volume_of_a_frustum() -> None:
    frustum = loft([CrossSection(0, 0, 0, 8, 4), CrossSection(3, 0, 0, 4, 2)], segments=256)
    assert frustum.volume == pytest.approx(np.pi * 3 / 3 * (4 * 2 + 2 * 1 + 4), rel=1e-3)


def test_a_power_of_one_gives_a_rhombus() -> None:
    prism = loft([CrossSection(0, 0, 0, 2, 2, 1), CrossSection(1, 0, 0, 2, 2, 1)])
    assert prism.volume == pytest.approx(2)


def test_union_and_cut_add_and_take_the_volumes_of_overlapping_bars() -> None:
    bar = loft(BAR)
    upper = loft([section._replace(at=section.at + 5) for section in BAR])
    area = bar.volume / 10
    assert united([bar, upper]).volume == pytest.approx(15 * area, rel=1e-5)
    assert cut(bar, upper).volume == pytest.approx(5 * area, rel=1e-5)


def test_a_placed_solid_is_turned_about_z_and_in_metres() -> None:
    bar = placed(loft(BAR), yaw_degrees=90)
    expected = [[-5e-3, -1e-3, 0], [1e-3, 3e-3, 10e-3]]
    np.testing.assert_allclose(bar.bounds, expected, atol=1e-12)
