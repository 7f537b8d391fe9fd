"""A cordless power drill, after the YCB object 035_power_drill."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import CrossSection, loft, placed, united

# Frame of the tables: x from the motor's back to the chuck's tip, z from the foot up, mm.
# Across x: at, y, z, width in y, height in z, power.
BODY = [
    CrossSection(-70, 15, 156, 8, 8),
    CrossSection(-68.5, 14, 156, 20, 19),
    CrossSection(-66, 13, 156, 32, 31),
    CrossSection(-62, 13, 156, 40, 42),
    CrossSection(-57, 13, 154.5, 45, 51),
    CrossSection(-50, 13, 152, 47, 57),
    CrossSection(-40, 13, 150, 47, 59),
    CrossSection(-20, 13, 153.5, 50, 55, 2.1),
    CrossSection(10, 13, 154.5, 52, 57, 2.3),
    CrossSection(30, 13, 155, 53, 57, 2.1),
    CrossSection(40, 13, 156, 54, 59, 2),
    CrossSection(50, 13, 157, 51.5, 55),
]
# Goes on where the body ends; the jaws close at its tip.
CHUCK = [
    CrossSection(60, 13, 158, 47.5, 49.5),
    CrossSection(70, 13, 158.5, 44.5, 45.5),
    CrossSection(80, 13, 159.5, 43.5, 43),
    CrossSection(90, 13.5, 160, 41, 40, 2.1),
    CrossSection(100, 13.5, 161, 36, 33.5, 2.1),
    CrossSection(105, 13.5, 161, 29, 26),
    CrossSection(108, 13.5, 161.5, 21.5, 18),
    CrossSection(110.5, 13.5, 162, 9, 8),
]
# Across z: at, x, y, width in x, width in y, power. It flares into the body over the trigger.
HANDLE = [
    CrossSection(18, -14.5, 12, 46, 46, 2.6),
    CrossSection(30, -14.7, 12, 46, 40.5, 2.7),
    CrossSection(35, -14.5, 12, 45, 36, 2.4),
    CrossSection(40, -14.2, 12.2, 45, 33.7, 2.1),
    CrossSection(50, -15.5, 12.5, 43.5, 34, 2.1),
    CrossSection(60, -14.5, 12.5, 47.5, 36.5, 2.1),
    CrossSection(75, -13, 12.5, 49, 38.5, 2.1),
    CrossSection(90, -10.3, 12.5, 49.3, 38.3, 2.1),
    CrossSection(96, -7.5, 12.5, 52, 38, 2),
    CrossSection(110, -0.5, 12.7, 63.5, 36.5, 1.9),
    CrossSection(120, 1, 12.6, 74, 34.5, 2),
    CrossSection(130, 4, 12.6, 94, 34, 2.2),
    CrossSection(140, 5, 12.6, 100, 34, 2.2),
]
FOOT = [
    CrossSection(-5.5, 6, 10.5, 30, 15),
    CrossSection(-4, 9.5, 10.5, 59, 28),
    CrossSection(-2, 10.5, 11, 78, 40, 2.3),
    CrossSection(0, 11, 11, 90, 47.5, 2.6),
    CrossSection(4, 11.5, 11.5, 101, 55, 3.1),
    CrossSection(10, 10.7, 11.8, 105, 57.5, 3.4),
    CrossSection(20, 9.4, 12.2, 103, 52, 3.4),
    CrossSection(26, 8.7, 12.2, 98, 45, 3),
    CrossSection(30, 8, 12, 92.5, 38, 2.5),
    CrossSection(34, 4, 12, 82, 27, 2.2),
    CrossSection(36.5, 4, 12, 70, 15, 2),
]


def build() -> trimesh.Trimesh:
    """The drill in the frame of its YCB mesh, metres."""
    solids = [loft(BODY + CHUCK, axis="x"), loft(HANDLE), loft(FOOT)]
    return placed(united(solids), yaw_degrees=33)
