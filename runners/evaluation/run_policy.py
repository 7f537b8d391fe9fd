"""A policy on the session of a trial: what it probes, recorded, and a row about each probe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from scipy.stats import chi2

from chsel.belief import Gripper, Mode, PoseBelief, grasps_work, pose_offsets
from chsel.next_probe.decision_problem import Decision, WeightedPoses
from chsel.numerics.arrays import FloatArray
from chsel.plausible.symmetry import symmetry_of
from chsel.policies.policy import PolicySettings, StopSettings
from chsel.problem import surface
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.poses import (
    Poses,
    compose,
    inverse,
    product,
    random_rotations,
    rotated,
    rotation_vectors,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.session.rehearsal import warm_up, warm_up_policy
from chsel.session.run import Run
from runners.evaluation.contenders import Contender
from runners.evaluation.experiment import Row
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.trial_session import StepRecorder, config_values, probe_config
from runners.run.recording import RecordingConfig
from runners.run.session_run import steps
from runners.run.setup import RunSetup, open_setup, session_started

_GRASPS = 40  # that a belief is asked about
_SHARE = 0.9  # of the ellipsoids of modes
_MIDDLES = {"middle_50": 0.25, "middle_90": 0.05}  # of the members: where they begin
_WIDEST = 3  # directions


def policy_rows(
    plan: Plan, trial: Trial, *, contender: Contender, recorder: StepRecorder
) -> list[Row]:
    """Return a row for every probe of a session as `runners.probe` has it, within the budget."""
    (registering,) = plan.contenders.values()
    method, policy = registering.method(), contender.policy()
    warm_up(method)  # so that no time holds the loading of compiled kernels
    warm_up_policy(policy)
    config = probe_config(plan, trial, policy=contender)
    settings = policy.settings
    setup = open_setup(config)
    rows = list[Row]()
    try:
        started = session_started(
            config, config_values(config), method_name=registering.name, setup=setup
        )
        run = Run(
            method,
            recorder,
            policy=setup.policy,
            with_belief=True,
            snapshot_interval=RecordingConfig.snapshot_interval,
        )
        setup.begin(run, replace(started, runner="evaluate"))
        about = plan.about(trial, contender.label)
        for numbers in steps(run, setup.source, catch=Exception):
            rows.append(about | _row(setup, settings, seed=trial.seed, numbers=numbers, run=run))
            if len(rows) >= settings.probes:  # of a session that no policy ends
                break
    finally:
        setup.source.close()
    return rows


def _row(
    setup: RunSetup, settings: PolicySettings, *, seed: int, numbers: Row, run: Run
) -> dict[str, Any]:
    """Return what is known after a step. numbers: the step's row by `steps`."""
    true_pose = setup.source.world_from_object
    assert true_pose is not None
    truth = Poses.of(inverse(true_pose[None]))

    def errors(poses: FloatArray) -> FloatArray:
        """Return how far the surface in poses (B, 4, 4), object_from_world, is off (B,), metres."""
        return surface.outline_distances_to(setup.sdf, Poses.of(poses), other=truth)

    after = run.loop.state.decided
    found = run.loop.state.previous
    belief = run.loop.belief(settings.belief) if after is None else after.problem.belief
    error = surface.in_order(belief.weights * errors(belief.object_from_world))
    row: dict[str, Any] = {
        "step": run.step,
        "probes": run.step + 1,
        "status": f"failed: {run.failure}" if run.failure else "ok",
        "contacts": numbers["contacts"],
        "free_points": numbers["free_points"],
        "hit": numbers["outcome"] == "contact",
        "poses": len(belief),
        "belief_error": float(error),
        "error": float(error),
        "spread": spread_of(setup.sdf, belief),
        "action": numbers.get("action"),
        "hit_forecast": numbers.get("hit_chance"),
        "forecast_spread": numbers.get("expected_spread"),
    }
    if found is not None and len(found.cost) > 0:
        distances = errors(found.object_from_world)
        row |= {"error": float(distances.mean()), "best_error": float(distances[0])}
    if run.registered is not None and run.problem is not None:
        hypotheses = run.registered.hypotheses
        row |= {
            "hypotheses": len(hypotheses.cost),
            "verdict": numbers.get("verdict"),
            "digest": hypotheses.digest,
            "problem_digest": run.problem.digest,
            "seconds": run.registered.total_seconds,
        }
        if hypotheses.trust is not None and run.belief is not None:
            row |= belief_numbers(
                run.belief,
                setup.mesh,
                sdf=setup.sdf,
                world_from_object=true_pose,
                key=StreamKey(seed, run.step),
            )
    trust = None if found is None else found.trust
    verdict = "" if trust is None else trust.verdict
    diameter = setup.sdf.diameter
    if after is None:
        stop = usual_stop(row["spread"], None, diameter=diameter, verdict=verdict)
        return row | {"stop": stop}
    spread = after.decision.spread
    promised = promised_gain(after.decision)
    stop = usual_stop(spread, promised, diameter=diameter, verdict=verdict)
    return row | {
        "spread": spread,
        "promised": promised,
        "surprise": numbers["surprise"],
        "decision_seconds": numbers["seconds_by_stage"].get("decision"),
        "decision_digest": after.decision.digest,
        "stop": stop or after.decision.stop,
    }


def belief_numbers(
    belief: PoseBelief,
    mesh: trimesh.Trimesh,
    *,
    sdf: SdfGrid,
    world_from_object: FloatArray,
    key: StreamKey,
) -> Row:
    """Return how far a belief is right about the true pose (4, 4), and about grasps."""
    symmetry = symmetry_of(sdf, mesh)
    truth = inverse(world_from_object)
    members = belief.object_from_world
    off = pose_offsets(symmetry, members[0], others=np.concatenate([truth[None], members]))
    off[:, 3:] *= 0.25 * sdf.diameter  # metres
    off -= off[1:].mean(axis=0)
    directions = np.linalg.eigh(off[1:].T @ off[1:])[1][:, -_WIDEST:]
    true, along = off[0] @ directions, off[1:] @ directions
    row: dict[str, Any] = {}
    for name, first in _MIDDLES.items():
        lower, upper = np.quantile(along, [first, 1.0 - first], axis=0)
        row[name] = float(((lower <= true) & (true <= upper)).mean())
    if belief.modes:
        squares = [
            mode_distance(mode, world_from_object, symmetry=symmetry) for mode in belief.modes
        ]
        row["modes_90"] = bool(min(squares) <= chi2.ppf(_SHARE, df=6))
    stream = key.stream(Purpose.GRASPS)
    drawn = inverse(members[uniforms(stream, 0, upper=len(members), shape=_GRASPS).astype(int)])
    lower, upper = mesh.bounds
    held = (
        rotated(drawn[:, :3, :3], uniforms(stream, lower, upper=upper, shape=(_GRASPS, 3)))
        + drawn[:, :3, 3]
    )
    grasps = compose(random_rotations(stream, _GRASPS), held)
    gripper = Gripper()
    chance = belief.grasp_chance(grasps, gripper.opening).chance
    best = int(np.argmax(chance))
    there = Poses.of(truth[None])
    works = grasps_work(
        sdf, there, world_from_gripper=grasps[[best]], width=gripper.opening, gripper=gripper
    )
    return row | {"grasp_chance": float(chance[best]), "grasp_works": bool(works[0, 0])}


def mode_distance(mode: Mode, world_from_object: FloatArray, *, symmetry: ObjectSymmetry) -> float:
    """Return the squared Mahalanobis distance of a pose (4, 4) from a mode, as a planner has both.

    By the covariance about the origin of the object's frame, of the copy by the object's symmetries
    that is nearest to the mode.
    """
    found = Poses.of(inverse(world_from_object)[None])
    near = symmetry.nearest_copies(found, Poses.of(mode.object_from_world[None]))
    off = near.world_from_object[0]
    own = mode.world_from_object
    turn = rotation_vectors(product(off[:3, :3], own[:3, :3].T)[None])[0]
    vector = np.concatenate([off[:3, 3] - own[:3, 3], turn])
    return float(vector @ np.linalg.solve(mode.pose_covariance, vector))


def spread_of(sdf: SdfGrid, belief: WeightedPoses) -> float:
    """Return the spread of a belief, metres, as decisions have it."""
    poses = Poses.of(belief.object_from_world)
    return surface.surface_spread(surface.outline_distances(sdf, poses), belief.weights)


def promised_gain(decision: Decision) -> float | None:
    """Return by how much the best action would narrow the belief, metres; None without one."""
    spreads = decision.expected_spread[np.isfinite(decision.score)]
    return decision.spread - float(spreads.min()) if len(spreads) else None


def usual_stop(spread: float, promised: float | None, *, diameter: float, verdict: str) -> str:
    """Return why a session would end by the default rules of policies; "" if it goes on.

    spread, promised: of the belief and by the best action, metres. diameter: of the object.
    """
    rules = StopSettings()
    if rules.is_narrow(spread, diameter, verdict=verdict):
        return "spread"
    return "gain" if promised is not None and rules.is_useless(promised, diameter) else ""
