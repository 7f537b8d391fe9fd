"""Starts beside E_0: poses that put the object's surface onto contacts (for Alg. 1, line 1)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from chsel.anchors import AnchorSettings, anchored_poses, in_telling_order
from chsel.arrays import FloatArray
from chsel.errors import require_at_most, require_positive
from chsel.pose import compose
from chsel.problem import RegistrationProblem
from chsel.space import SearchSpace, transforms_of
from chsel.surface import has_surface

MOST_SAMPLES = 100_000_000
MOST_KEPT = 100_000


@dataclass(frozen=True)
class AnchoredStarts:
    """How many: samples, the poses drawn on contacts; kept, those of them that score best."""

    samples: int = 10_000
    kept: int = 30
    anchors: AnchorSettings = field(default_factory=AnchorSettings)

    def __post_init__(self) -> None:
        require_positive("samples", self.samples)
        require_positive("kept", self.kept)
        require_at_most("samples", self.samples, MOST_SAMPLES)
        require_at_most("kept", self.kept, MOST_KEPT)


def anchored_starts(
    problem: RegistrationProblem, space: SearchSpace, settings: AnchoredStarts, index: int
) -> FloatArray:
    """Transforms (K, 4, 4), best first; none of an object too thin to have a surface on its grid.

    index: of the pass, each of which draws its own.
    """
    if not has_surface(problem.sdf):
        return np.zeros((0, 4, 4))
    poses = anchored_poses(
        problem,
        in_telling_order(problem.points),
        space,
        settings.anchors,
        samples=settings.samples,
        most=settings.kept,
        index=index,
    )
    transforms = compose(poses[:, :9].reshape(-1, 3, 3), poses[:, 9:])
    return transforms_of(space, space.encode(transforms))
