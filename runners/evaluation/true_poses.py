"""What the trials of an evaluation tell about the true poses that were sought for them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class FoundPose:
    """The true pose of one trial, as it was found near a guess; metres and radians.

    cost, guess_cost: by the evaluation cost. mean_distance: of contacts from the surface.
    violations: free points inside of the object. moved, turned: from the guess. position_error,
    rotation_error: from the truth, where a simulation knows it. Distances and angles between poses
    are modulo the object's symmetries, at its centre.
    """

    configuration: str
    seed: int
    cost: float
    guess_cost: float
    mean_distance: float
    violations: int
    moved: float
    turned: float
    position_error: float | None = None
    rotation_error: float | None = None


def true_poses(folder: Path, experiment: Mapping[str, Any]) -> list[FoundPose]:
    """Of all trials of an evaluation for which one was sought, and which are there."""
    found = []
    for configuration in experiment.get("configurations") or ():
        for seed in experiment.get("seeds") or ():
            path = folder / "trials" / str(configuration) / f"seed_{seed}" / "session.json"
            with suppress(OSError, ValueError, KeyError, TypeError):  # not there, or half there
                found.append(_found(str(configuration), int(seed), json.loads(path.read_text())))
    return found


def _found(configuration: str, seed: int, session: Mapping[str, Any]) -> FoundPose:
    told = session["truth"]
    guess, truth = told["from_guess"], told.get("from_simulated") or {}
    return FoundPose(
        configuration,
        seed,
        float(told["cost"]),
        float(told["guess_cost"]),
        float(told["mean_distance"]),
        int(told["violations"]),
        float(guess["position"]),
        float(guess["rotation"]),
        truth.get("position"),
        truth.get("rotation"),
    )
