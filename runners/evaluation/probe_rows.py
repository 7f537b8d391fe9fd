"""What is known after each probe of a steered session, as rows of the table."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.next_probe.decision_problem import Belief, Decision
from chsel.next_probe.forecast import belief_after, belief_before
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import PolicySettings, StopSettings
from chsel.problem.online_registration import OnlineRegistration, OnlineStep
from chsel.problem.outline import (
    in_order,
    outline_distances,
    outline_distances_to,
    surface_spread,
)
from chsel.problem.poses import Poses, inverse
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from runners.evaluation.plan import Plan, Trial
from runners.run.scene import Scene
from runners.run.session_run import SessionRun

Row = dict[str, Any]


def row_about(plan: Plan, trial: Trial, label: str) -> Row:
    """What all rows of a policy in a trial share."""
    (contender,) = plan.contenders.values()
    return {
        "object": plan.configurations[trial.configuration].object,
        "configuration": trial.configuration,
        "seed": trial.seed,
        "policy": label,
        "method": contender.label,
        "preset": contender.preset,
        "faults": plan.faults(trial),
    }


class ProbeRows:
    """Makes a row of the table of what is known after each probe of a session."""

    def __init__(
        self,
        about: Row,
        scene: Scene,
        settings: PolicySettings,
    ) -> None:
        """about: what all rows share. scene: of a session whose true pose is known."""
        session = scene.session
        assert session.world_from_object is not None
        self._about, self._sdf, self._workspace = about, scene.sdf, session.workspace
        self._truth = Poses.of(inverse(session.world_from_object[None]))
        self._settings = settings

    def row(
        self,
        step: OnlineStep,
        numbers: Row,
        run: SessionRun,
        online: OnlineRegistration,
    ) -> Row:
        """The row of a step. numbers: the run's own row. online: the loop that the run walks."""
        after = None if run.steering is None else run.steering.last
        belief = self._belief(step.step, online) if after is None else after.problem.belief
        errors = self.errors(belief.object_from_world)
        row = {
            **self._about,
            "step": step.step,
            "probes": step.step + 1,
            "status": f"failed: {run.failure}" if run.failure else "ok",
            "contacts": numbers["contacts"],
            "free_points": numbers["free_points"],
            "hit": numbers["outcome"] == "contact",
            "poses": len(belief),
            "belief_error": float(in_order(belief.weights * errors)),
            "spread": spread_of(self._sdf, belief),
            "action": numbers.get("action"),
            "hit_forecast": numbers.get("hit_chance"),
            "forecast_spread": numbers.get("expected_spread"),
        }
        row["error"] = row["belief_error"]
        found = online.previous
        if found is not None and len(found.cost) > 0:
            row["error"] = float(self.errors(found.object_from_world).mean())
        if run.registered is not None and step.problem is not None:
            hypotheses = run.registered.hypotheses
            row |= {
                "hypotheses": len(hypotheses.cost),
                "digest": hypotheses.digest,
                "problem_digest": step.problem.digest,
                "seconds": run.registered.total_seconds,
            }
        promised = None
        if after is not None:
            promised = promised_gain(after.decision)
            row |= {
                "spread": after.decision.spread,
                "promised": promised,
                "surprise": numbers["surprise"],
                "decision_seconds": numbers["seconds_by_stage"].get("decision"),
                "decision_digest": after.decision.digest,
            }
        last = "" if after is None else after.decision.stop
        return row | {"stop": usual_stop(row["spread"], promised) or last}

    def errors(self, poses: FloatArray) -> FloatArray:
        """How far the surface in poses (B, 4, 4), object_from_world, is from the true one (B,)."""
        return outline_distances_to(self._sdf, Poses.of(poses), self._truth)

    def _belief(self, step: int, online: OnlineRegistration) -> Belief:
        """What a policy would weigh up after a step of a session that makes no decisions."""
        found, settings = online.previous, self._settings.belief
        if found is not None and len(found.cost) > 0:
            return belief_after(found, settings)
        key = StreamKey(self._about["seed"], step + 1)
        return belief_before(self._sdf, online.points.all(), self._workspace, key, settings)


def spread_of(sdf: SdfGrid, belief: Belief) -> float:
    """Spread of a belief, metres, as decisions have it."""
    poses = Poses.of(belief.object_from_world)
    return surface_spread(outline_distances(sdf, poses), belief.weights)


def promised_gain(decision: Decision) -> float | None:
    """By how much the best action that can be taken would narrow the belief, metres.

    None if there is none.
    """
    feasible = np.isfinite(decision.score)
    if not feasible.any():
        return None
    return decision.spread - float(decision.expected_spread[feasible].min())


def usual_stop(spread: float, promised: float | None) -> str:
    """Why a session would end by the rules that policies have by default; "" if it goes on."""
    rules = StopSettings()
    if spread <= rules.spread:
        return "spread"
    return "gain" if promised is not None and promised < rules.gain else ""
