"""The hypotheses of a registration as translucent meshes, coloured by cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses
from replay.colors import CostScale, cost_colors
from replay.rerun.scene import HIDDEN, display_mesh, mesh_poses

if TYPE_CHECKING:
    import trimesh

LEVELS = 8
"""Steps of the cost scale; a mesh entity has one colour, so each step is an entity."""
MOST = 200
"""More hypotheses than these are not drawn: the lowest in cost are."""
_ALPHA = (48, 10)  # opacities of the lowest and the highest step, of 255
_BEST_ALPHA = 150


class HypothesisMeshes:
    """Draws sets of hypotheses under the entity `root`: one mesh a step of the scale, and poses."""

    def __init__(self, stream: rr.RecordingStream, root: str = "scene/hypotheses") -> None:
        self._stream = stream
        self._root = root

    def set_up(self, mesh: trimesh.Trimesh) -> None:
        """Store the object's mesh once for each colour, and show none."""
        opacities = np.linspace(*_ALPHA, LEVELS).round().astype(int).tolist()
        for level, opacity in enumerate(opacities):
            drawn = display_mesh(mesh, _color(level, opacity))
            self._stream.log(f"{self._root}/{_name(level)}", drawn, static=True)
        self._stream.log(f"{self._root}/best", display_mesh(mesh), static=True)
        self.hide()

    def draw(self, hypotheses: Hypotheses, scale: CostScale | None = None) -> None:
        """Show the hypotheses that repeat no other, at most MOST; the first is the best.

        scale: of the colours; by default that of the hypotheses shown.
        """
        shown = shown_hypotheses(hypotheses)
        poses, cost = inverse(hypotheses.object_from_world[shown]), hypotheses.cost[shown]
        levels = cost_levels(cost, scale)
        if len(levels):
            best = rr.Mesh3D.from_fields(albedo_factor=_color(levels[0], _BEST_ALPHA))
            self._stream.log(f"{self._root}/best", best)
        levels[:1] = -1
        self._poses("best", poses[:1], cost[:1])
        for level in range(LEVELS):
            chosen = levels == level
            self._poses(_name(level), poses[chosen], cost[chosen])

    def hide(self) -> None:
        """Show none."""
        for name in ("best", *map(_name, range(LEVELS))):
            self._poses(name, HIDDEN[:0], np.zeros(0))

    def _poses(self, name: str, world_from_object: FloatArray, cost: FloatArray) -> None:
        if len(world_from_object) == 0:
            world_from_object, cost = HIDDEN, np.full(1, np.nan)
        poses = mesh_poses(world_from_object)
        self._stream.log(f"{self._root}/{name}", poses, rr.AnyValues(cost=cost))


def shown_hypotheses(hypotheses: Hypotheses) -> IntArray:
    """Indices of the hypotheses that are drawn: no duplicates, the lowest in cost."""
    return np.flatnonzero(~hypotheses.duplicate)[:MOST]


def cost_levels(cost: FloatArray, scale: CostScale | None = None) -> IntArray:
    """The step of the cost scale, from 0, of each cost (B,); by default among its like."""
    fraction = (scale or CostScale.of(cost)).fraction(cost)
    return np.minimum((fraction * LEVELS).astype(np.int64), LEVELS - 1)


def _name(level: int) -> str:
    return f"cost_step_{level + 1}"


def _color(level: int, opacity: int) -> tuple[int, int, int, int]:
    red, green, blue = cost_colors((level + 0.5) / LEVELS).tolist()
    return red, green, blue, opacity
