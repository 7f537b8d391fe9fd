"""A cordless power drill, after the YCB object 035_power_drill."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import Section, loft, placed, united

# Frame of the tables: x from the motor's back to the chuck's tip, z from the foot up, mm.
# Across x: at, y, z, width in y, height in z, power.
BODY = [
    Section(-70, 15, 156, 8, 8),
    Section(-68.5, 14, 156, 20, 19),
    Section(-66, 13, 156, 32, 31),
    Section(-62, 13, 156, 40, 42),
    Section(-57, 13, 154.5, 45, 51),
    Section(-50, 13, 152, 47, 57),
    Section(-40, 13, 150, 47, 59),
    Section(-20, 13, 153.5, 50, 55, 2.1),
    Section(10, 13, 154.5, 52, 57, 2.3),
    Section(30, 13, 155, 53, 57, 2.1),
    Section(40, 13, 156, 54, 59, 2),
    Section(50, 13, 157, 51.5, 55),
]
# Goes on where the body ends; the jaws close at its tip.
CHUCK = [
    Section(60, 13, 158, 47.5, 49.5),
    Section(70, 13, 158.5, 44.5, 45.5),
    Section(80, 13, 159.5, 43.5, 43),
    Section(90, 13.5, 160, 41, 40, 2.1),
    Section(100, 13.5, 161, 36, 33.5, 2.1),
    Section(105, 13.5, 161, 29, 26),
    Section(108, 13.5, 161.5, 21.5, 18),
    Section(110.5, 13.5, 162, 9, 8),
]
# Across z: at, x, y, width in x, width in y, power. It flares into the body over the trigger.
HANDLE = [
    Section(18, -14.5, 12, 46, 46, 2.6),
    Section(30, -14.7, 12, 46, 40.5, 2.7),
    Section(35, -14.5, 12, 45, 36, 2.4),
    Section(40, -14.2, 12.2, 45, 33.7, 2.1),
    Section(50, -15.5, 12.5, 43.5, 34, 2.1),
    Section(60, -14.5, 12.5, 47.5, 36.5, 2.1),
    Section(75, -13, 12.5, 49, 38.5, 2.1),
    Section(90, -10.3, 12.5, 49.3, 38.3, 2.1),
    Section(96, -7.5, 12.5, 52, 38, 2),
    Section(110, -0.5, 12.7, 63.5, 36.5, 1.9),
    Section(120, 1, 12.6, 74, 34.5, 2),
    Section(130, 4, 12.6, 94, 34, 2.2),
    Section(140, 5, 12.6, 100, 34, 2.2),
]
FOOT = [
    Section(-5.5, 6, 10.5, 30, 15),
    Section(-4, 9.5, 10.5, 59, 28),
    Section(-2, 10.5, 11, 78, 40, 2.3),
    Section(0, 11, 11, 90, 47.5, 2.6),
    Section(4, 11.5, 11.5, 101, 55, 3.1),
    Section(10, 10.7, 11.8, 105, 57.5, 3.4),
    Section(20, 9.4, 12.2, 103, 52, 3.4),
    Section(26, 8.7, 12.2, 98, 45, 3),
    Section(30, 8, 12, 92.5, 38, 2.5),
    Section(34, 4, 12, 82, 27, 2.2),
    Section(36.5, 4, 12, 70, 15, 2),
]


def build() -> trimesh.Trimesh:
    """The drill in the frame of its YCB mesh, metres."""
    solids = [loft(BODY + CHUCK, axis="x"), loft(HANDLE), loft(FOOT)]
    return placed(united(solids), yaw_degrees=33)
