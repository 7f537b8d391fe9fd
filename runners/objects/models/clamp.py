"""A medium spring clamp, after the YCB object 050_medium_clamp (whose scan closes its gaps)."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import CrossSection, loft, placed, united

# Frame of the tables: z from the handles' ends up to the jaws, y across the handles, mm.
# Across z: at, x, y, width in x, width in y, power.
LEFT_HANDLE = [
    CrossSection(0.5, 2, -9, 5, 8),
    CrossSection(1.5, 1.8, -8, 13, 19),
    CrossSection(3, 2, -6, 19, 26),
    CrossSection(5, 2.2, -5.5, 24.5, 30.5, 2.1),
    CrossSection(9, 3, -4.7, 30, 35, 2.2),
    CrossSection(16, 4, -3, 34.5, 37, 2.1),
    CrossSection(25, 6, 2, 36, 38.5),
    CrossSection(40, 9.2, 7, 33, 36),
]
RIGHT_HANDLE = [
    CrossSection(-1.7, 1.8, 26.7, 5, 5),
    CrossSection(-1, 1.7, 26.7, 9, 10),
    CrossSection(0, 1.8, 26.3, 14, 18),
    CrossSection(1, 1.8, 25.3, 18.5, 23),
    CrossSection(3, 1.9, 25, 23, 27.7, 2.1),
    CrossSection(5, 2.4, 24.5, 26, 29.5, 2.1),
    CrossSection(9, 3.2, 23.5, 31.5, 34, 2.2),
    CrossSection(16, 5, 20.6, 37, 36, 2.1),
    CrossSection(25, 6.7, 15.7, 39, 37),
    CrossSection(40, 9.2, 10, 33, 37),
]
# Around the spring: a gap in the real clamp, filled in the scan.
HOUSING = [
    CrossSection(3, 3, 9.5, 10, 8),
    CrossSection(5, 3, 9.5, 21, 26),
    CrossSection(9, 3.5, 9.3, 30.5, 32, 2.1),
    CrossSection(16, 5, 8.8, 37, 40),
    CrossSection(25, 6.7, 8.5, 39.9, 47),
    CrossSection(30, 7.5, 8.8, 39.7, 47),
    CrossSection(40, 9.3, 8.8, 37.8, 45),
    CrossSection(50, 11.4, 8.7, 33.5, 46, 2.1),
]
JAWS = [
    CrossSection(55, 11.5, 8.6, 32.3, 45.5),
    CrossSection(60, 10.6, 8.5, 33, 44.3),
    CrossSection(65, 9, 8.2, 33.7, 40.7),
    CrossSection(70, 7.7, 8.4, 32.5, 35),
    CrossSection(75, 7.3, 9, 27, 26.3, 1.9),
    CrossSection(78, 7.8, 9.5, 20.7, 19.5, 1.8),
    CrossSection(80, 8.5, 10, 13.8, 13.8, 1.8),
    CrossSection(81.9, 9.5, 10.3, 5, 4),
]


def build() -> trimesh.Trimesh:
    """The clamp in the frame of its YCB mesh, metres."""
    solids = [loft(part) for part in (LEFT_HANDLE, RIGHT_HANDLE, HOUSING + JAWS)]
    return placed(united(solids), yaw_degrees=-7)
