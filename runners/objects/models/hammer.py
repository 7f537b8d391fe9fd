"""A claw hammer lying on its side, after the YCB object 048_hammer."""

from __future__ import annotations

import trimesh

from runners.objects.models.solids import CrossSection, loft, placed, united

# Frame of the tables: x from the head along the handle, y from the face to the claw, mm.
# Across x: at, y, z, width in y, height in z, power.
HANDLE = [
    CrossSection(-140, -16, 11.5, 52, 33),
    CrossSection(-128, -15.2, 11.3, 43.5, 35),
    CrossSection(-121, -15.4, 10.8, 38, 34.5),
    CrossSection(-110, -16.5, 10.5, 36.3, 34, 2.1),
    CrossSection(-92, -16.2, 12, 33.3, 34.5, 2.3),
    CrossSection(-60, -16, 12.1, 32.7, 33.7, 2.1),
    CrossSection(-32, -15.7, 12.3, 34.3, 35.5),
    CrossSection(-8, -15.5, 11.3, 37, 37.5),
    CrossSection(10, -15.3, 12, 39.5, 41, 1.9),
    CrossSection(40, -14.8, 12.2, 40, 41, 1.9),
    CrossSection(76, -14.5, 12.4, 39.5, 41),
    CrossSection(100, -13.8, 11.5, 38.7, 40.8, 1.9),
    CrossSection(124, -13, 11.4, 40.2, 42.5, 1.9),
    CrossSection(142, -12.4, 12.4, 43.5, 43),
    CrossSection(148, -12.4, 13.4, 43, 41.3, 2.1),
    CrossSection(154, -11.8, 14, 40.5, 39, 2.1),
    CrossSection(159, -11, 14.4, 35, 34.2),
    CrossSection(162, -10.6, 14.5, 28, 28.5, 1.8),
    CrossSection(164.5, -11, 14, 11, 10),
]
# Across y: at, z, x, size in z, size in x, power. The face ends in a stub, as the scan does.
FACE = [
    CrossSection(-69.4, 22.8, -149, 3, 4),
    CrossSection(-66, 22.6, -148.7, 5.7, 7.6),
    CrossSection(-57, 21, -147.9, 6.5, 8.4),
    CrossSection(-52, 20, -147.8, 9.5, 11.5),
    CrossSection(-48, 18.8, -147.8, 13, 15.6),
    CrossSection(-45, 18, -148, 16, 20),
    CrossSection(-40, 16.5, -147.5, 20, 30),
    CrossSection(-35, 16, -144.8, 26, 42.5),
]
EYE = [
    CrossSection(-30, 15, -144, 31, 47),
    CrossSection(-20, 12.3, -144, 35, 48, 2.2),
    CrossSection(-8, 12, -143.5, 35.5, 48, 2.2),
]
CLAW = [
    CrossSection(0, 13.7, -144, 36.5, 42, 2),
    CrossSection(5, 14.2, -146, 35, 35, 1.9),
    CrossSection(10, 14.4, -146.2, 32.5, 30, 1.9),
    CrossSection(15, 15, -144.7, 31, 27, 1.9),
    CrossSection(20, 15.4, -141.7, 28.5, 24.5),
    CrossSection(25, 15, -137.4, 25, 22.5, 2.1),
    CrossSection(30, 15.5, -132.3, 23, 19.5),
    CrossSection(35, 16.8, -127, 20.5, 14),
    CrossSection(38, 17.9, -124.6, 16.5, 9.2, 1.9),
    CrossSection(40.2, 18.6, -123, 6, 2),
]


def build() -> trimesh.Trimesh:
    """The hammer in the frame of its YCB mesh, metres."""
    head = loft(FACE + EYE + CLAW, axis="y")
    return placed(united([head, loft(HANDLE, axis="x")]), yaw_degrees=84)
