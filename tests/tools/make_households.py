"""Make the meshes of `object=household/NAME`: things of a kitchen and a workshop, of usual sizes.

python -m tests.tools.make_households

Thirteen families of shapes, chosen before any method ran on one of them: turned ones, flat ones,
long ones, hollow ones, and ones with a handle. Metres.
"""

from pathlib import Path

import numpy as np
import trimesh
from shapely.geometry import Polygon

FOLDER = Path(__file__).parents[2] / "runners/objects/households"
MM = 0.001
SECTIONS = 48


def turned(profile):
    """The solid of a closed profile (N, 2) of radius and height, millimetres, about z."""
    return trimesh.creation.revolve(
        np.array([*profile, profile[0]], dtype=float), sections=SECTIONS
    )


def rod(radius, start, end):
    return trimesh.creation.cylinder(radius, segment=np.array([start, end], float), sections=32)


def joined(*parts):
    return trimesh.boolean.union(list(parts), engine="manifold")


def hull(radius, places):
    """The convex hull of equal balls."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    points = np.concatenate([ball.vertices + place for place in np.array(places, float)])
    return trimesh.convex.convex_hull(points)


def box(lower, upper):
    return trimesh.creation.box(bounds=np.array([lower, upper], float))


def mug():
    ring = trimesh.creation.torus(26, 6, major_sections=32, minor_sections=16)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_translation([46, 0, 50])
    body = joined(turned([(0, 0), (41, 0), (41, 95), (0, 95)]), ring)
    inner = turned([(0, 5), (37, 5), (37, 99), (0, 99)])
    return trimesh.boolean.difference([body, inner], engine="manifold")


def bowl():
    outer = [(0, 0), (38, 0), (42, 4), (62, 24), (75, 48), (80, 70)]
    return turned([*outer, (76, 70), (71, 49), (58, 27), (40, 8), (0, 6)])


def plate():
    return turned([(0, 0), (80, 0), (132, 22), (130, 26), (78, 5), (0, 5)])


def bottle():
    return turned([(0, 0), (37, 0), (37, 190), (30, 215), (15, 235), (14, 300), (0, 300)])


def wine_glass():
    stem = [(0, 0), (36, 0), (36, 3), (6, 8), (4, 20), (4, 85), (12, 95)]
    return turned(
        [*stem, (34, 115), (40, 145), (36, 200), (34, 200), (38, 145), (30, 115), (0, 100)]
    )


def pan():
    dish = turned([(0, 0), (95, 0), (110, 45), (107, 45), (93, 4), (0, 4)])
    return joined(dish, hull(8, [(104, 0, 36), (270, 0, 60)]))


def spoon():
    dip = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    dip.apply_scale([34, 22, 7])
    return joined(dip, hull(3, [(28, -3, 0), (28, 3, 0), (165, -6, 10), (165, 6, 10)]))


def screwdriver():
    grip = turned([(0, 0), (12, 0), (16, 20), (13, 60), (15, 95), (8, 105), (0, 105)])
    return joined(grip, rod(3, (0, 0, 100), (0, 0, 215)), box((-4, -1, 210), (4, 1, 225)))


def wrench():
    jaw = [(0, -13), (-22, -20), (-34, -10), (-34, -7), (-14, -7), (-14, 7), (-34, 7), (-34, 10)]
    outline = Polygon(
        [*jaw, (-22, 20), (0, 13), (150, 9), (165, 16), (178, 0), (165, -16), (150, -9)]
    )
    return trimesh.creation.extrude_polygon(outline, 8)


def remote():
    return hull(8, [(x, y, 0) for x in (-70, 70) for y in (-14, 14)])


def bulb():
    ball = [(14, 28), (18, 40), (28, 58), (30, 75), (24, 93), (12, 104), (0, 107)]
    return turned([(0, 0), (6, 0), (13, 4), (13, 26), *ball])


def roll():
    return turned([(22, 0), (58, 0), (58, 98), (22, 98)])


def iron():
    corners = [(-95, -50, 0), (-95, 50, 0), (70, -30, 0), (70, 30, 0), (130, 0, 0)]
    sole = hull(6, [*corners, (-85, -30, 45), (-85, 30, 45), (60, 0, 45)])
    posts = [hull(10, [(x, 0, 40), (x, 0, 95)]) for x in (-70, 40)]
    return joined(sole, *posts, hull(12, [(-75, 0, 95), (50, 0, 95)]))


FAMILIES = (mug, bowl, plate, bottle, wine_glass, pan, spoon, screwdriver, wrench, remote, bulb)
FAMILIES += (roll, iron)


def main():
    FOLDER.mkdir(exist_ok=True)
    for make in FAMILIES:
        mesh = make()
        mesh.merge_vertices()
        mesh.apply_scale(MM)
        assert mesh.is_watertight, make.__name__
        assert mesh.is_winding_consistent
        assert mesh.volume > 0.0
        path = FOLDER / f"{make.__name__}.ply"
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
        sides = ", ".join(f"{1000.0 * side:.0f}" for side in mesh.extents)
        print(f"{path.name}: {len(mesh.faces)} triangles, {sides} mm, {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
