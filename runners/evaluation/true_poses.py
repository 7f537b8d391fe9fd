"""True poses T* of trials from sensor logs: sought near a guess, and read from results."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.pose_scan import TruePose, find_true_pose
from chsel.plausible.symmetry import ObjectSymmetry, object_symmetry
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.events import Event, Probe
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.sensor_logs import guessed_pose, simulated_truth
from runners.sensors.alignment_fit import fit_of
from runners.sessions.session import Session


def known_at_the_end(
    trial: Trial, session: Session, sdf: SdfGrid, events: Sequence[Event]
) -> RegistrationProblem:
    """All that a session tells, as a problem of its last step.

    Raises SessionError if it has no contact.
    """
    probes = [event for event in events if isinstance(event, Probe)]
    points = reduce(
        KnownPoints.merged, [probe.new_points for probe in probes], session.initial_points
    )
    if len(points.known) == 0:
        raise SessionError(f"none of {len(probes)} probes has a contact; accepted: at least one")
    return RegistrationProblem(
        sdf,
        points,
        np.eye(4)[None],
        session.workspace,
        session.free_resolution,
        StreamKey(trial.seed, probes[-1].step),
    )


def find_truth(
    plan: Plan, problem: RegistrationProblem, mesh: trimesh.Trimesh, log: Path
) -> tuple[FloatArray, dict[str, Any]]:
    """T* as world_from_object (4, 4), and what the table says of it, plain values.

    Of the problem of a trial's last step: the pose of least evaluation cost near the guess that
    belongs to the log. mesh: of the object, m. Distances are in metres and radians, modulo the
    object's symmetries, at its centre.
    """
    guess, truth = guessed_pose(log), simulated_truth(log)
    found = find_true_pose(problem, guess, plan.truth)
    return found.world_from_object, _record(
        plan, problem, object_symmetry(mesh), found, guess, truth
    )


def _record(
    plan: Plan,
    problem: RegistrationProblem,
    symmetry: ObjectSymmetry,
    found: TruePose,
    guess: FloatArray,
    truth: FloatArray | None,
) -> dict[str, Any]:
    fit = fit_of(problem, found.world_from_object, found.cost, plan.truth.cost)
    record: dict[str, Any] = {
        "cost": found.cost,
        "mean_distance": fit.mean_distance,
        "violations": fit.violations,
        "guess": guess.tolist(),
        "guess_cost": found.guess_cost,
        "from_guess": _between(found.world_from_object, guess, symmetry),
    }
    if truth is not None:
        record["simulated"] = truth.tolist()
        record["from_simulated"] = _between(found.world_from_object, truth, symmetry)
    return record


def _between(one: FloatArray, other: FloatArray, symmetry: ObjectSymmetry) -> dict[str, float]:
    position, rotation = pose_errors(inverse(one)[None], other, symmetry)
    return {"position": float(position[0]), "rotation": float(rotation[0])}


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
    record = session["truth"]
    guess, truth = record["from_guess"], record.get("from_simulated") or {}
    return FoundPose(
        configuration,
        seed,
        float(record["cost"]),
        float(record["guess_cost"]),
        float(record["mean_distance"]),
        int(record["violations"]),
        float(guess["position"]),
        float(guess["rotation"]),
        truth.get("position"),
        truth.get("rotation"),
    )
