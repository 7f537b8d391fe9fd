"""Named, counter-based random streams: the only source of randomness."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from chsel.errors import SettingError


class Purpose(IntEnum):
    """What random numbers are for. Values are part of every recording: never renumber them."""

    INITIAL_POSES = 1
    UPDATE_NOISE = 2
    REFINEMENT = 3
    EMITTER = 4
    RESTART = 5
    RESAMPLE = 6
    MESH_SAMPLES = 7
    CONTROL_NOISE = 8
    SENSOR_NOISE = 9


@dataclass(frozen=True)
class StreamKey:
    """Key of all random streams of one registration: the session's seed and the step."""

    seed: int
    step: int

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**64:
            raise SettingError(f"seed is {self.seed}; accepted: an integer from 0 to 2**64 - 1")
        if not 0 <= self.step < 2**32:
            raise SettingError(f"step is {self.step}; accepted: an integer from 0 to 2**32 - 1")

    def stream(self, purpose: Purpose, index: int = 0) -> np.random.Generator:
        """The Philox stream of one purpose; `index` tells repetitions within a step apart."""
        word = (self.step << 32) | (int(purpose) << 20) | index
        return np.random.Generator(np.random.Philox(key=(word << 64) | self.seed))
