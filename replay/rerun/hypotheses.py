"""The hypotheses of a registration as translucent meshes, coloured by cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses
from replay.colors import CostScale, cost_colors
from replay.rerun.meshes import DISPLAY_FACES, HIDDEN, coarsened, display_mesh, mesh_poses

if TYPE_CHECKING:
    import trimesh

LEVELS = 8
"""Steps of the cost scale; a mesh entity has one colour, so each step is an entity."""
MOST = 200
"""More hypotheses than these are not drawn: the lowest in cost are."""
ALPHA = (48, 10)
"""Opacities of the lowest and the highest step, of 255."""

_NO_POSES = np.zeros((0, 4, 4))
_NO_COST = np.full(1, np.nan)
_BEST_ALPHA = 150


class HypothesisMeshes:
    """Draws sets of hypotheses under the entity `root`: one mesh a step of the scale, and poses."""

    def __init__(self, stream: rr.RecordingStream, root: str = "scene/hypotheses") -> None:
        self._stream = stream
        self._root = root
        self._best_color: tuple[int, int, int, int] | None = None
        self._hidden: set[str] = set()  # entities that show nothing, by what was logged last

    def set_up(
        self,
        mesh: trimesh.Trimesh,
        *,
        most_faces: int = DISPLAY_FACES,
        alpha: tuple[int, int] = ALPHA,
    ) -> None:
        """Store the object's mesh once for each colour, and show none.

        alpha: opacities of the lowest and the highest step, of 255.
        """
        coarse = coarsened(mesh, most_faces)
        self._stream.log(f"{self._root}/best", display_mesh(coarse), static=True)
        for level in range(LEVELS):
            fraction = level / (LEVELS - 1)
            opacity = round(alpha[0] + fraction * (alpha[1] - alpha[0]))
            drawn = display_mesh(coarse, (*_rgb((level + 0.5) / LEVELS), opacity))
            self._stream.log(self._level(level), drawn, static=True)
        self.hide()

    def draw(self, hypotheses: Hypotheses, scale: CostScale | None = None) -> None:
        """Show the hypotheses that repeat no other, at most MOST; the first is the best.

        scale: of the colours; by default that of the hypotheses shown.
        """
        shown = shown_hypotheses(hypotheses)
        poses = inverse(hypotheses.object_from_world[shown])
        cost = hypotheses.cost[shown]
        levels = cost_levels(cost, scale)
        if len(levels):
            self._color_best(0.0 if scale is None else (levels[0] + 0.5) / LEVELS)
        levels[:1] = -1
        self._poses(f"{self._root}/best", poses[:1], cost[:1])
        for level in range(LEVELS):
            chosen = levels == level
            self._poses(self._level(level), poses[chosen], cost[chosen])

    def hide(self) -> None:
        """Show none, whatever was shown before on any timeline."""
        self._hidden.clear()
        for entity in (f"{self._root}/best", *map(self._level, range(LEVELS))):
            self._poses(entity, _NO_POSES, np.zeros(0))

    def _color_best(self, fraction: float) -> None:
        """Colour the best hypothesis by its place on the scale, if it has another colour yet."""
        color = (*_rgb(fraction), _BEST_ALPHA)
        if color != self._best_color:
            self._best_color = color
            self._stream.log(f"{self._root}/best", rr.Mesh3D.from_fields(albedo_factor=color))

    def _level(self, level: int) -> str:
        return f"{self._root}/cost_step_{level + 1}"

    def _poses(self, entity: str, world_from_object: FloatArray, cost: FloatArray) -> None:
        if len(world_from_object) == 0:
            if entity in self._hidden:
                return
            self._hidden.add(entity)
            world_from_object, cost = HIDDEN, _NO_COST
        else:
            self._hidden.discard(entity)
        self._stream.log(entity, mesh_poses(world_from_object), rr.AnyValues(cost=cost))


def shown_hypotheses(hypotheses: Hypotheses) -> IntArray:
    """Indices of the hypotheses that are drawn: no duplicates, the lowest in cost."""
    return np.flatnonzero(~hypotheses.duplicate)[:MOST]


def cost_levels(cost: FloatArray, scale: CostScale | None = None) -> IntArray:
    """The step of the cost scale, from 0, of each cost (B,); by default among its like."""
    fraction = (scale or CostScale.of(cost)).fraction(cost)
    return np.minimum((fraction * LEVELS).astype(np.int64), LEVELS - 1)


def _rgb(fraction: float) -> tuple[int, int, int]:
    red, green, blue = cost_colors(fraction).tolist()
    return red, green, blue
