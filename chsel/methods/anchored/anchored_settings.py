"""How much the contact-anchored search computes, and what it takes points for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from chsel.errors import require_at_most
from chsel.methods.anchor_sampling import AnchorSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.search_space import PlaneSettings
from chsel.problem.settings import CheckedSettings, at_most, not_negative, one_of, positive
from chsel.qd.measures import measure_named
from chsel.qd.selection import ArchiveSettings

MOST_SAMPLES = 1_000_000_000
MOST_POSES = 1_000_000
MOST_MOVES = 100_000
MOST_WORK = 1_000_000_000  # of the two
_ARCHIVE = ArchiveSettings(bins=40, outliers="none")
_ONLINE = OnlineSettings(update="own")


@dataclass(frozen=True)
class Effort(CheckedSettings):
    """How much is computed."""

    samples: Annotated[int, positive, at_most(MOST_SAMPLES)] = 120_000  # poses drawn
    kept: Annotated[int, positive, at_most(MOST_POSES)] = 200  # the best of them, which are fitted
    first_steps: Annotated[int, not_negative, at_most(MOST_MOVES)] = 6  # of these fits
    refined: Annotated[int, positive, at_most(MOST_POSES)] = 100  # of these, fitted further
    steps: Annotated[int, not_negative, at_most(MOST_MOVES)] = 15  # of these fits
    descents: Annotated[int, positive, at_most(MOST_POSES)] = 96  # chains that descend to the limit
    descent_moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 266
    chains: Annotated[int, positive, at_most(MOST_POSES)] = 96  # chains that spread below it
    moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 300
    # As many of the lowest, and of candidates far apart, are taken to their minima.
    polished: Annotated[int, not_negative, at_most(MOST_POSES)] = 16
    polish_moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 300
    # How many evaluations may be spent in rounds of all stages up to the descent: a second one, and
    # further ones while the last found a new mode; 0: one round.
    evaluations: Annotated[int, not_negative, at_most(MOST_SAMPLES)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_most("descents x descent_moves", self.descents * self.descent_moves, MOST_WORK)
        require_at_most("polished x polish_moves", self.polished * self.polish_moves, MOST_WORK)
        require_at_most("chains x moves", self.chains * self.moves, MOST_WORK)


_SMALL = Effort(
    samples=40_000,
    kept=64,
    first_steps=10,
    refined=40,
    descents=24,
    descent_moves=60,
    chains=24,
    moves=150,
    polished=8,
    polish_moves=200,
)
_LARGE = Effort(
    samples=400_000,
    kept=504,
    refined=150,
    descents=120,
    descent_moves=500,
    chains=120,
    moves=1000,
    polished=32,
    polish_moves=1000,
)
EFFORTS = {
    "small": _SMALL,
    "medium": Effort(),
    "large": _LARGE,
    "adaptive": replace(_SMALL, chains=60, moves=400, evaluations=600_000),
}


@dataclass(frozen=True)
class AnchoredSettings(CheckedSettings):
    """All settings of the contact-anchored search, the same in all presets.

    The method is neither in the paper nor in its authors' code.
    """

    size: Annotated[str, one_of(*EFFORTS)] = "adaptive"
    effort: Effort | None = None  # in place of the one that `size` names
    # Of the sensor, as in its data sheet: standard deviation of known points, metres. The noise
    # that is estimated from the points is no less.
    noise: Annotated[float, positive] = 0.0005
    # Candidates have energies at most so much above the lowest, nats.
    limit: Annotated[float, positive] = 9.0
    # What contacts are off that no residual shows, metres: calibration of hand and camera, scale
    # of the mesh.
    shared_error: Annotated[float, not_negative] = 0.004
    anchors: AnchorSettings = field(default_factory=AnchorSettings)
    archive: ArchiveSettings = _ARCHIVE
    online: OnlineSettings = _ONLINE
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    def __post_init__(self) -> None:
        super().__post_init__()
        measure_named(self.archive.measure, planar=self.plane is not None)
