"""Triangles of a grid's zero level, against loops over tetrahedra and the area of a ball."""

from itertools import pairwise, permutations, product

import numpy as np
import pytest

from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points
from tests.chsel.samples import ball_grid


def zero_level(sdf):
    surface_points(sdf, 1, stream=StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))
    return sdf.derived("surface", None)


def areas_by_loops(sdf):
    """Areas of triangles: by the number of corners inside, cell, tetrahedron, and triangle."""
    found = []
    for cell in product(*(range(n - 1) for n in sdf.shape)):
        for order in permutations(range(3)):
            corners = [np.array(cell)]
            for axis in order:
                corners.append(corners[-1] + np.eye(3, dtype=int)[axis])
            inside = [c for c in corners if sdf.values[tuple(c)] < 0.0]
            outside = [c for c in corners if sdf.values[tuple(c)] >= 0.0]
            if not inside or not outside:
                continue

            def crossing(a, b):
                p, q = sdf.values[tuple(a)], sdf.values[tuple(b)]
                return sdf.origin + sdf.resolution * (a + p / (p - q) * (b - a))

            if len(inside) == 2:
                (a, b), (c, d) = inside, outside
                polygon = [crossing(a, c), crossing(a, d), crossing(b, d), crossing(b, c)]
            else:
                polygon = [crossing(a, b) for a in inside for b in outside]
            for one, two in pairwise(polygon[1:]):
                normal = np.cross(one - polygon[0], two - polygon[0])
                found.append((len(inside), 0.5 * np.linalg.norm(normal)))
    return np.array([area for _, area in sorted(found, key=lambda each: each[0])])


@pytest.mark.parametrize("part", [1, 7, 10_000])
def test_triangles_are_those_of_loops_over_tetrahedra_in_their_order(part, monkeypatch):
    monkeypatch.setattr("chsel.problem.surface._PART", part)
    sdf = ball_grid(0.021, 0.01, half=4)
    areas = np.diff(zero_level(sdf).reached, prepend=0.0)
    assert areas == pytest.approx(2.0 * areas_by_loops(sdf), rel=1e-9, abs=1e-18)


def test_the_surface_of_a_ball_has_its_area():
    radius = 0.03
    reached = zero_level(ball_grid(radius, 0.002, half=20)).reached
    assert 0.5 * reached[-1] == pytest.approx(4.0 * np.pi * radius**2, rel=5e-3)
