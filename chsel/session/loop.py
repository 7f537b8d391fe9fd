"""Algorithm 2 as a loop over events: probes come in, problems and decisions go out (CHSEL)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from chsel.errors import ChselError, SettingError, quoted, require_instance, require_positive
from chsel.events import ActionsOffered, Decided, Probe, SessionStarted, Start
from chsel.next_probe.decision_problem import (
    Actions,
    Decision,
    DecisionProblem,
    HandShape,
    WeightedPoses,
)
from chsel.next_probe.forecast import BeliefSettings, belief_after, belief_before, surprise
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.policies.policy import Policy
from chsel.problem.initial_sets import OnlineSettings, posed_problem
from chsel.problem.points import POINT_CLASSES, KnownPoints, Workspace, require_parts
from chsel.problem.pose_prior import PosePrior, require_prior
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey

_AT_ONCE = Start()


class Phase(Enum):
    """Where a loop stands in its step."""

    OPEN = "open"  # points may be known that no problem has
    POSED = "posed"  # the problem of the step has no result yet
    ANSWERED = "answered"  # the step has a result
    DECIDED = "decided"  # the next probe was chosen, or none
    ENDED = "ended"


class Push(NamedTuple):
    """A touch that may have moved the object."""

    direction: FloatArray  # (3,), unit, world
    before: tuple[int, ...]  # numbers of points that were known by then, by class


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopState:
    """All that changes in a loop."""

    points: KnownPoints  # all that are known, world
    phase: Phase = Phase.OPEN
    step: int = -1  # of the last probe, -1 before the first
    pushes: tuple[Push, ...] = ()  # in the order of time
    # The result that the next problem follows from; None for a problem that is a first one.
    previous: Hypotheses | None = None
    enlargement: int = 1  # times the hypotheses of the settings in the next problem
    problem: RegistrationProblem | None = None  # of this step, None until it is posed
    offered: ActionsOffered | None = None  # None before the first were offered
    decided: Decided | None = None  # the last decision
    surprise: float = 0.0  # of the last probe under the decision before it, nats; 0 without one


class Loop:
    """Registers an object after every change of its known points, and chooses the next probe.

    Nothing is recorded and nothing is registered here: whoever walks the loop registers its
    problems, and says what was found.
    """

    sdf: SdfGrid
    """Signed distance grid of the object."""

    workspace: Workspace
    """Where the object can be."""

    state: LoopState
    """Where the loop stands."""

    policy: Policy | None
    """What decides; None where probes come in an order of their own."""

    def __init__(
        self,
        sdf: SdfGrid,
        workspace: Workspace,
        *,
        free_resolution: float,
        settings: OnlineSettings,
        policy: Policy | None = None,
        seed: int = 0,
        points: KnownPoints | None = None,
        previous: Hypotheses | None = None,
        start: Start | None = None,
        moves: float = 0.0,
        prior: PosePrior | None = None,
    ) -> None:
        """Start a loop before its first probe.

        free_resolution: side of free voxels, metres. settings: how E_0 and E_l follow from the
        result before, `online` of a method. seed: of the random streams of all steps. points: known
        before the first probe. previous: a result that the first problem follows from. start: when
        steps register; by default all do. moves: metres that a touch moves the object at most; 0
        if it stands still. prior: on the object's pose before the first probe.
        Raises ChselError for parts of another kind.
        """
        points = KnownPoints() if points is None else points
        require_parts(sdf=sdf, workspace=workspace, points=points)
        if prior is not None:
            require_prior(prior)
        require_instance(
            "settings", settings, kind=OnlineSettings, accepted="method.online of a method"
        )
        require_positive("moves", moves, zero=True)
        if policy is not None and not callable(getattr(policy, "decide", None)):
            given = quoted(policy)
            raise SettingError(f"policy is {given}; accepted: chsel.build_policy(name)")
        self.sdf = sdf
        self.workspace = workspace
        self.policy = policy
        self._free_resolution = free_resolution
        self._settings = settings
        self._seed = seed
        self._start = _AT_ONCE if start is None else start
        self._moves = moves
        self._prior = prior
        self.state = LoopState(points=points, previous=previous)

    @classmethod
    def of_session(
        cls,
        started: SessionStarted,
        settings: OnlineSettings,
        *,
        policy: Policy | None = None,
        seed: int | None = None,
    ) -> Loop:
        """Return the loop of a session, before its first probe. seed: by default the session's."""
        return cls(
            started.sdf,
            started.workspace,
            free_resolution=started.free_resolution,
            settings=settings,
            policy=policy,
            seed=started.seed if seed is None else seed,
            points=started.initial_points,
            start=started.start,
            moves=started.moves or 0.0,
            prior=started.prior,
        )

    def problems(self, probes: Iterable[Probe]) -> Iterator[RegistrationProblem]:
        """Yield the problem of every step that registers; `remember` its result before the next.

        This is Algorithm 2. Without a result the next problem follows from the one before.
        """
        for probe in probes:
            self.perceive(probe)  # X <- perceived from environment
            if self.enough:
                yield self.problem()  # with E_0 and E_l; E <- CHSEL(X, E_0, E_l)

    def perceive(self, probe: Probe) -> None:
        """Take a probe: its points become known, and it may push the object, or be a surprise.

        After a surprise the next problem is a first one, with more hypotheses.
        """
        require_parts(points=probe.new_points)
        state = self.state
        points = probe.added_to(state.points)
        pushes = state.pushes
        if probe.push is not None:
            before = tuple(len(getattr(points, name)) for name in POINT_CLASSES)
            pushes = (*pushes, Push(probe.push, before))
        self.state = replace(
            state,
            phase=Phase.OPEN,
            step=probe.step,
            points=points,
            pushes=pushes,
            problem=None,
            surprise=self._surprise(probe),
        )
        if self._is_surprised:
            assert self.policy is not None
            larger = self.policy.settings.surprise.larger
            self.state = replace(self.state, previous=None, enlargement=larger)

    @property
    def enough(self) -> bool:
        """Whether the step registers, with the points that are known."""
        state, start = self.state, self._start
        chosen = start.steps is None or state.step in start.steps
        started = state.step >= start.step and len(state.points.contacts) >= start.contacts
        return chosen and started and state.points.count > 0

    def problem(self) -> RegistrationProblem:
        """Return the problem of the step: all known points, E_0 and E_l from the result before.

        Raise PoseError if that result has no poses or some that are not finite, and SettingError
        if no point is known.
        """
        state = self.state
        problem = posed_problem(
            self.sdf,
            state.points,
            workspace=self.workspace,
            free_resolution=self._free_resolution,
            key=StreamKey(self._seed, state.step),
            settings=self._settings,
            previous=state.previous,
            enlargement=state.enlargement,
            pushes=self.pushes(self._moves) if self._moves > 0.0 else None,
            prior=self._prior,
        )
        self.state = replace(state, phase=Phase.POSED, problem=problem)
        return problem

    def pushes(self, largest: float) -> Pushes | None:
        """Return the pushes so far, of at most so many metres each; None if there was none."""
        if not self.state.pushes:
            return None
        directions = np.array([push.direction for push in self.state.pushes])
        before = np.array([push.before for push in self.state.pushes])
        return Pushes(directions, before, largest=largest)

    def remember(self, hypotheses: Hypotheses) -> None:
        """Let the next problem, and the next decision, follow from this result."""
        self.state = replace(self.state, phase=Phase.ANSWERED, previous=hypotheses, enlargement=1)

    def offer(self, actions: Actions, hand: HandShape) -> ActionsOffered:
        """Let decisions choose among these actions; return the event that says so."""
        require_instance(
            "actions", actions, kind=Actions, accepted="chsel.Actions(world_from_hand, length)"
        )
        require_instance("hand", hand, kind=HandShape, accepted="chsel.HandShape.of(mesh)")
        offered = ActionsOffered(self.state.step, actions, hand=hand)
        self.state = replace(self.state, offered=offered)
        return offered

    def decide(self, available: BoolArray) -> Decided:
        """Return which of the actions offered that are available (A,) to take next, or why none.

        `follow` it before the next probe. Raise ChselError if the policy, of another package,
        returns anything but a decision.
        """
        if self.policy is None:
            raise SettingError("policy is missing; accepted: Loop(..., policy=)")
        problem = self.decision_problem(available)
        decision = self.policy.decide(problem)
        _check(problem, decision)
        return Decided(self.state.step, problem, decision=decision, surprise=self.state.surprise)

    def follow(self, decided: Decided) -> None:
        """Let the next probe be the outcome of this decision."""
        self.state = replace(self.state, phase=Phase.DECIDED, decided=decided)

    def decision_problem(
        self, available: BoolArray, hypotheses: Hypotheses | None = None
    ) -> DecisionProblem:
        """Return the problem of the next decision, by a result, by default the last one.

        available (A,): the actions that can be taken now.
        """
        state = self.state
        if state.offered is None:
            raise SettingError("no action was offered; accepted: a decision after `offer`")
        assert self.policy is not None
        hypotheses = state.previous if hypotheses is None else hypotheses
        trust = None if hypotheses is None else hypotheses.trust
        return DecisionProblem(
            sdf=self.sdf,
            points=state.points,
            workspace=self.workspace,
            free_resolution=self._free_resolution,
            belief=self.belief(self.policy.settings.belief, hypotheses),
            actions=state.offered.actions,
            available=available,
            hand=state.offered.hand,
            key=self._next_key,
            verdict="" if trust is None else trust.verdict,
        )

    def belief(
        self, settings: BeliefSettings, hypotheses: Hypotheses | None = None
    ) -> WeightedPoses:
        """Return the poses that a decision weighs, by a result, by default the last one.

        Free space alone lets a result be anywhere else, so before a point on the object is known
        there are poses all over the workspace. Raise SettingError then if the floor is above it.
        """
        hypotheses = self.state.previous if hypotheses is None else hypotheses
        points = self.state.points
        on_object = len(points.known) + len(points.occupied) > 0
        if hypotheses is not None and len(hypotheses.cost) > 0 and on_object:
            return belief_after(hypotheses, settings)
        top = self.workspace.upper[2]
        if settings.floor is not None and settings.floor > top:
            raise SettingError(
                f"policy.belief.floor is {settings.floor:g}, above the workspace; accepted: a "
                f"height below its top at {top:g} m, or null"
            )
        return belief_before(
            self.sdf,
            self.state.points,
            workspace=self.workspace,
            key=self._next_key,
            settings=settings,
        )

    def end(self) -> None:
        """End the loop."""
        self.state = replace(self.state, phase=Phase.ENDED)

    @property
    def _next_key(self) -> StreamKey:
        """Key of the decision after this step: its step is the number of probes."""
        return StreamKey(self._seed, self.state.step + 1)

    def _surprise(self, probe: Probe) -> float:
        """Return how far a probe is off what was forecast for the action before it, nats.

        0 where it is not the outcome of an action, or where none of its outcomes was forecast.
        """
        decided = self.state.decided
        if self.policy is None or decided is None or decided.step != probe.step - 1:
            return 0.0
        if decided.decision.chosen < 0 or probe.outcome == "points":
            return 0.0
        if len(decided.decision.contacts) != len(decided.problem.belief):
            return 0.0
        contact = np.asarray(probe.contacts[0]) if len(probe.contacts) else None
        noise = self.policy.settings.noise
        return surprise(decided.problem, decided.decision, noise=noise, contact=contact)

    @property
    def _is_surprised(self) -> bool:
        """Whether the last probe is a surprise."""
        if self.policy is None:
            return False
        return bool(self.state.surprise > self.policy.settings.surprise.limit)


def _check(problem: DecisionProblem, decision: Decision) -> None:
    """Raise ChselError unless a decision is about this problem."""
    count = len(problem.actions)
    chosen = decision.chosen
    stops = decision.stop != "" and chosen == -1
    taken = decision.stop == "" and 0 <= chosen < count and bool(problem.available[chosen])
    arrays = ("score", "hit_chance", "blocked_chance", "expected_spread", "contacts")
    shapes = [np.shape(getattr(decision, name)) for name in arrays]
    contacts = (len(problem.belief) if taken else 0, 3)
    if not (stops or taken) or shapes != [*[(count,)] * 4, contacts]:
        raise ChselError(
            f"the policy decided on action {chosen} with stop {decision.stop!r} and arrays of "
            f"shapes {shapes}; accepted: an available action, or -1 with a reason to stop, arrays "
            f"of shape ({count},) and contacts of shape {contacts}"
        )
