"""The configuration of an object of any size, with a grid of probes that meet it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from chsel.next_probe.action_lattice import CLEARANCE
from chsel.problem.points import FREE_RESOLUTION, Workspace
from chsel.problem.poses import apply
from runners.objects.loader import FITTED
from runners.sessions.configurations import Configuration
from runners.sessions.gripper import X_REST
from runners.sessions.placement import laid_down
from runners.sessions.probing_hand import ProbingHand

if TYPE_CHECKING:
    import trimesh

GAP = 0.05  # m: between the object and the hand before it
_YAW = 0.5  # radians: a box shows the hand two of its sides
_ACROSS = (0.0, 0.5, -0.5, 0.85, -0.85)  # y of probes, in halves of the width that they can meet
_UP = (0.15, 0.4, 0.6, 0.85)  # z of probes, in heights that they can meet
FITTED_PROBES = len(_ACROSS) * len(_UP)
_BELOW = 3  # free voxels in the workspace below the object


def fitted_configuration(mesh: trimesh.Trimesh, hand: ProbingHand) -> Configuration:
    """Return the configuration FITTED of a mesh, in metres in its own frame, for a hand.

    The object lies as it would on the floor, on a stand so high that the hand can reach all of it
    from the side. Probes are spread over the width and height of its box and of the foremost part
    of the hand. The workspace is its box, padded by its diameter, but hardly below it.
    """
    flat = Configuration(
        FITTED, "", y=(), z=(), position=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, _YAW)
    )
    placed = apply(laid_down(mesh, flat), np.asarray(mesh.vertices))
    solids = np.array([solid.bounds for solid in hand.solids])  # (S, 2, 3), x forward
    foremost = solids[np.argmax(solids[:, 1, 0])]
    stand = CLEARANCE - float(solids[:, 0, 2].min()) + float(foremost[1, 2])
    x = X_REST + float(foremost[1, 0]) + GAP - placed[:, 0].min()
    y = -0.5 * (placed[:, 1].min() + placed[:, 1].max())
    placed += [x, y, stand]
    lower, upper = placed.min(axis=0), placed.max(axis=0)
    diameter = float(np.sqrt(((upper - lower) ** 2).sum()))
    around = Workspace.around(placed, diameter)
    bottom = (*around.lower[:2], stand - _BELOW * FREE_RESOLUTION)
    # The hand meets the object as long as their boxes overlap.
    first, last = lower - foremost[1], upper - foremost[0]
    middle = 0.5 * (first + last)
    half = 0.5 * (last - first)
    return replace(
        flat,
        y=tuple(float(middle[1] + share * half[1]) for share in _ACROSS),
        z=tuple(float(first[2] + 2.0 * share * half[2]) for share in _UP),
        position=(float(x), float(y), 0.0),
        workspace=Workspace(bottom, around.upper),
        stand=stand,
        free_resolution=FREE_RESOLUTION,
    )
