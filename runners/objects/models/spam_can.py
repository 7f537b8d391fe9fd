"""A can of potted meat, after the YCB object 010_potted_meat_can."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import CrossSection, cut, loft, placed

# Frame of the table: z up, x along the can's long side, mm.
# Across z: at, x, y, width in x, width in y, power.
CAN = [
    CrossSection(-2, 5.5, 8, 40, 16),
    CrossSection(-1, 5.7, 8, 57.5, 26),
    CrossSection(0, 6.2, 8, 72.5, 34.5, 2.4),
    CrossSection(2, 6.5, 7.8, 87.7, 44.6, 2.5),
    CrossSection(4, 6.6, 7.7, 93.7, 49.8, 2.8),
    CrossSection(6, 6.7, 7.7, 96.8, 52.3, 3),
    CrossSection(10, 6.8, 7.8, 99.3, 55, 3.5),
    CrossSection(15, 6.8, 7.6, 100.2, 55.3, 3.7),
    CrossSection(70, 7, 7.7, 100.3, 55, 3.7),
    CrossSection(75, 7.1, 7.9, 98.6, 52.7, 3.7),
    CrossSection(78, 7.2, 8.2, 95.3, 49.5, 3.5),
    CrossSection(80, 7.4, 8.2, 91, 46, 3.4),
    CrossSection(82.9, 7.2, 8, 82, 37, 3),
]
# The lid lies below its rim.
RECESS = [
    CrossSection(79.5, 3, 4, 40, 18, 3),
    CrossSection(83.5, 5, 5, 68, 34, 3),
]


def build() -> trimesh.Trimesh:
    """The can in the frame of its YCB mesh, metres."""
    return placed(cut(loft(CAN), loft(RECESS)), yaw_degrees=38.5)
