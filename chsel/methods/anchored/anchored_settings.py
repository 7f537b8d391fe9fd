"""Settings of the contact-anchored search, and how much each size of it computes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from chsel.methods.anchor_sampling import AnchorSettings
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.search_space import PlaneSettings
from chsel.problem.settings import CheckedSettings, at_most, not_negative, one_of, positive
from chsel.qd.selection import ArchiveSettings

# Bounds of settings, by what a process has memory and time for.
MOST_SAMPLES = 1_000_000_000
MOST_POSES = 1_000_000
MOST_MOVES = 100_000
MOST_POOL = 5_000  # 200 MB of squared distances
MOST_ROUNDS = 1_000

_Samples = Annotated[int, positive, at_most(MOST_SAMPLES)]
_Poses = Annotated[int, positive, at_most(MOST_POSES)]
_Moves = Annotated[int, not_negative, at_most(MOST_MOVES)]


@dataclass(frozen=True)
class Effort(CheckedSettings):
    """Amounts of computation, by the stages of docs/anchored.md."""

    # Sample
    samples: _Samples = 120_000  # poses drawn in a round
    kept: _Poses = 200  # the best of them, which are fitted
    contacts: _Poses = 64  # known points that rate poses, far from each other; more add little
    # Fit
    previous: _Poses = 60  # poses of E_0 and E_l that are fitted in the first round, at most
    first_steps: _Moves = 6  # of the rough fit of all these poses
    refined: _Poses = 100  # the best of them, which are fitted further
    steps: _Moves = 15  # of this fit
    # Descend
    descents: _Poses = 96  # basins whose best pose walks down in a round
    descent_moves: _Moves = 266  # of each walk
    polished: Annotated[int, not_negative, at_most(MOST_POSES)] = 16  # basins that walk further
    polish_moves: _Moves = 300  # of each of these walks, after the last round
    # Rounds of the stages above: a second one, and further ones while the last found a new mode.
    evaluations: Annotated[int, not_negative, at_most(MOST_SAMPLES)] = 0  # of them; 0: one round
    rounds: Annotated[int, positive, at_most(MOST_ROUNDS)] = 12  # at most
    # Twins
    twins: _Poses = 12  # basins whose best pose is turned by near symmetries
    # Spread
    chains: _Poses = 96  # walks
    moves: _Moves = 300  # of each
    states: Annotated[int, positive, at_most(MOST_MOVES)] = 6  # of each, which are candidates
    # Choose
    pool: Annotated[int, positive, at_most(MOST_POOL)] = 400  # candidates for hypotheses, at most


# Measured: PD against time of one thread, see docs/results.md.
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
_ARCHIVE = ArchiveSettings(bins=40, outliers="none")  # all candidates are below the limit
_ONLINE = OnlineSettings(update="own")  # hypotheses of the last step, which are fitted again


@dataclass(frozen=True)
class AnchoredSettings(CheckedSettings):
    """Settings of the contact-anchored search, the same in all presets.

    The method is neither in the paper nor in its authors' code.
    """

    size: Annotated[str, one_of(*EFFORTS)] = "adaptive"  # name of an Effort
    effort: Effort | None = None  # in place of the one that `size` names
    noise: Annotated[float, positive] = 0.0005  # of contacts by the datasheet: deviation, metres
    rough_noise: Annotated[float, positive] = 0.015  # metres, of the rough fit: draws from far
    limit: Annotated[float, positive] = 9.0  # nats above the lowest energy of candidates
    modes: _Poses = 3  # whose best pose is always among the hypotheses, at most
    reach: Annotated[float, not_negative] = 1.0  # nats above the true pose of plausible ones
    # What contacts are off that no residual shows, metres: calibration of hand and camera, scale
    # of the mesh.
    shared_error: Annotated[float, not_negative] = 0.004
    anchors: AnchorSettings = field(default_factory=AnchorSettings)  # where poses are sampled
    archive: ArchiveSettings = _ARCHIVE  # of candidates, for recordings and views
    online: OnlineSettings = _ONLINE  # E_0 and E_l of the next problem of a session
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)
