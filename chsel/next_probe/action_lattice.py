"""The actions that a session with a free hand offers: straight probes on a lattice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from chsel.problem.settings import CheckedSettings, not_negative, one_of, positive


@dataclass(frozen=True)
class ActionSettings(CheckedSettings):
    """Which probes a session offers."""

    # "configuration" the grid of the session itself, "forward" along its approach direction on a
    # lattice across the workspace, "around" from the sides and from above.
    choice: Annotated[str, one_of("configuration", "forward", "around")] = "around"
    spacing: Annotated[float, positive] = 0.05  # of the lattice, metres
    # Metres a second of the hand, with which the way to a start and back takes time; None: all
    # actions count as equally long.
    speed: Annotated[float | None, positive] = None
    setup: Annotated[float, not_negative] = 1.0  # seconds that every probe takes besides
