"""A mustard bottle, after the YCB object 006_mustard_bottle."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import CrossSection, loft, placed

# Frame of the tables: z from the base up, x along the long axis of the bottle's ellipse, mm.
# Across z: at, x, y, width in x, width in y, power.
BASE = [
    CrossSection(2.8, -6, -2, 35, 25),
    CrossSection(4, 0, -1, 64, 44, 2.1),
    CrossSection(5, 3, -0.5, 75, 49.5, 2.3),
    CrossSection(7, 6, -1, 87, 55, 2.3),
    CrossSection(10, 8.3, -1, 94, 58.5, 2.2),
    CrossSection(15, 9, -1, 99, 60.5, 2.2),
    CrossSection(20, 9, -1, 100.5, 59.5, 2.3),
]
BODY_AND_SHOULDERS = [
    CrossSection(30, 9, -1.5, 99.5, 57.5, 2.4),
    CrossSection(50, 9.3, -2.2, 93, 56, 2.8),
    CrossSection(70, 9, -2.3, 86.5, 56, 3),
    CrossSection(90, 9.3, -2.5, 93.5, 57, 2.7),
    CrossSection(100, 9.3, -2.5, 100.5, 58, 2.4),
    CrossSection(110, 9.2, -2.5, 103.7, 58.5, 2.4),
    CrossSection(120, 9.3, -2.5, 102, 59.5, 2.3),
    CrossSection(130, 9.2, -2.5, 96.5, 60, 2.4),
    CrossSection(140, 9.2, -2.5, 83, 62, 2.4),
]
CAP_AND_NOZZLE = [
    CrossSection(150, 9.2, -2.6, 62.5, 61.5, 2.1),
    CrossSection(155, 9.2, -2.7, 54.5, 56.5, 2.1),
    CrossSection(160, 9.3, -2.8, 49.5, 51.5, 2.1),
    CrossSection(165, 9.4, -2.9, 46.5, 48),
    CrossSection(170, 9.5, -3.1, 42, 43.2, 2.1),
    CrossSection(175, 9.5, -3.2, 35.7, 35.7, 2.1),
    CrossSection(180, 9.5, -3, 29.5, 29.8, 2.1),
    CrossSection(185, 9.5, -3, 23, 23.3),
    CrossSection(188, 9.7, -2.8, 17.8, 17.4),
    CrossSection(190.2, 10, -2, 8, 8),
]


def build() -> trimesh.Trimesh:
    """The mustard bottle in the frame of its YCB mesh, metres."""
    return placed(loft(BASE + BODY_AND_SHOULDERS + CAP_AND_NOZZLE), yaw_degrees=-54)
