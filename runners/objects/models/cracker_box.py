"""A box of crackers, after the YCB object 003_cracker_box."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import CrossSection, loft, placed

# Frame of the table: z up, x along the box's width, mm. The box leans by about a degree.
# Across z: at, x, y, width in x, width in y, power.
BOX = [
    CrossSection(1.8, -3, -24, 60, 26),
    CrossSection(3, -6, -22, 100, 42, 3),
    CrossSection(4.5, -8, -21.2, 140, 50, 4),
    CrossSection(6, -9.3, -21.2, 151, 54, 6),
    CrossSection(10, -9.3, -21.8, 157, 59.5, 8),
    CrossSection(20, -9.5, -21.7, 161, 63.3, 8),
    CrossSection(60, -9.6, -23, 163, 67, 8),
    CrossSection(120, -10, -24.6, 163.7, 67, 8),
    CrossSection(180, -10, -26, 163.5, 65, 8),
    CrossSection(220, -9.5, -25.8, 161.5, 61.5, 8),
    CrossSection(226, -9.8, -26.2, 158, 60, 7),
    CrossSection(230, -10.5, -26.2, 152, 55, 7),
    CrossSection(234, -14, -27, 138, 48, 4),
    CrossSection(236.5, -26, -27.5, 104, 42, 3),
    CrossSection(239.5, -38, -28.5, 46, 22),
]


def build() -> trimesh.Trimesh:
    """The cracker box in the frame of its YCB mesh, metres."""
    return placed(loft(BOX, segments=48), yaw_degrees=80.5)
