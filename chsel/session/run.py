"""A loop whose events are recorded, with warnings about its points and results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from chsel.belief import Gripper, PoseBelief
from chsel.errors import InputWarning, PointsWarning
from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    Logged,
    Probe,
    ProblemPosed,
    Recorder,
    SessionEnded,
    SessionStarted,
)
from chsel.methods.method import Method
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.plausible.symmetry import symmetry_of
from chsel.policies.policy import Policy
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.points import check_contacts, check_points
from chsel.problem.poses import Poses, inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust, check_prior
from chsel.problem.trust import check_trust
from chsel.session.judging import FLIPPED, check_normals, noise_of, unexpected_push
from chsel.session.loop import Loop
from chsel.session.recording import (
    NO_RESULT,
    Registered,
    SessionRecorder,
    one_line,
    printable,
    register_recorded,
    symmetry_for_errors,
)

FROM_SESSION = "session"
"""The code of warnings that come with the points."""


@dataclass(frozen=True)
class StepWarning:
    """A warning about the input, for people."""

    step: int  # the probe at which it first holds
    code: str  # the kind of warning
    text: str  # one line


class Run:
    """A loop, the method and policy that walk it, and the recorder that hears of everything."""

    has_begun: bool
    """Whether the recording is open, and `started` and `loop` are there."""

    started: SessionStarted
    """The first event: object, workspace, settings."""

    loop: Loop
    """The loop, with its state."""

    warnings: list[StepWarning]
    """All so far, each kind once."""

    registered: Registered | None
    """The registration of the step, None without one."""

    problem: RegistrationProblem | None
    """The problem that was registered at the step, None without one."""

    answer: Hypotheses | None
    """The last result, with trust; None before the first."""

    pose: FloatArray | None
    """The best pose of the last result that has one, world_from_object (4, 4), where beliefs are
    wanted: the copy by the object's symmetries that is nearest to the pose before."""

    trust: Trust | None
    """Trust in the last result that has a pose."""

    belief: PoseBelief | None
    """After the last result that has a pose, where beliefs are wanted; modes keep their numbers."""

    failure: str
    """Why the last step has no result, "" if nothing failed."""

    stop: str
    """Why no further probe is made, "" if one is."""

    grasp: FloatArray | None
    """The best of the last grasps that were asked for, world_from_gripper (4, 4)."""

    grasp_chance: float
    """The chance that it works."""

    seconds: dict[str, float]
    """Wall-clock seconds of the step, by stage."""

    def __init__(
        self,
        method: Method,
        recorder: Recorder,
        *,
        policy: Policy | None = None,
        with_belief: bool = False,
        opening: Iterable[InputWarning] = (),
        snapshot_interval: int = 0,
        show: Callable[[str, int, int], None] = lambda *_: None,
        advice: str = "",
    ) -> None:
        """Prepare a run that has not begun.

        with_belief: whether the belief after each result is wanted. opening: warnings that come
        with the first points. snapshot_interval: iterations between recorded archives; 0: the first
        and the last. show: gets stage, iteration and total. advice: ends the text of an error of a
        recorder that cannot go on.
        """
        self.method = method
        self.policy = policy
        self.has_begun = False
        self.warnings = []
        self.registered = None
        self.problem = None
        self.answer = None
        self.pose = None
        self.trust = None
        self.belief = None
        self.failure = ""
        self.stop = ""
        self.grasp = None
        self.grasp_chance = 0.0
        self.seconds = {}
        self.outcome = ""  # of the last probe
        self.recorder = SessionRecorder(recorder, advice)
        self._with_belief = with_belief
        self._opening = tuple(opening)
        self._interval = snapshot_interval
        self._show = show
        self._new_warnings: list[InputWarning] = []  # that `new_warnings` has not returned yet

    def begin(
        self,
        started: SessionStarted,
        *,
        seed: int | None = None,
        settings: OnlineSettings | None = None,
    ) -> None:
        """Open the recording.

        seed: of registrations, by default that of the session. settings: how E_0 and E_l follow,
        by default those of the method.
        """
        self.started = started
        self._truth = started.world_from_object  # (4, 4), where the object is now, where known
        self._symmetry = symmetry_for_errors(started)
        settings = settings or self.method.online
        self.recorder.record(started)
        self.loop = Loop.of_session(started, settings, policy=self.policy, seed=seed)
        self.has_begun = True

    @property
    def step(self) -> int:
        """Index of the last probe, -1 before the first."""
        return self.loop.state.step if self.has_begun else -1

    def observe(self, event: Event) -> None:
        """Record what happened; the new points of a Probe become known."""
        self.recorder.record(event)
        if isinstance(event, Logged) and event.level == "warning":
            self.warnings.append(StepWarning(event.step, FROM_SESSION, text=event.text))
        if isinstance(event, Probe):
            self._perceive(event)

    def _perceive(self, probe: Probe) -> None:
        self.outcome = probe.outcome
        self.registered = None
        self.problem = None
        self.failure = ""
        self.seconds = {}
        if probe.world_from_object is not None:
            self._truth = probe.world_from_object
        self.loop.perceive(probe)
        self.warn(self._opening)

    def register(self) -> Hypotheses:
        """Register what is known; the next problem follows from the result (CHSEL, Alg. 2)."""
        hypotheses = self.register_problem(self.loop.problem())
        self.loop.remember(hypotheses)
        return hypotheses

    def register_problem(self, problem: RegistrationProblem) -> Hypotheses:
        """Register a problem of the step, and record it."""
        self.problem = problem
        self.check_points()
        registered = register_recorded(
            ProblemPosed(problem.key.step, problem),
            self.method,
            recorder=self.recorder,
            world_from_object=self._truth,
            symmetry=self._symmetry,
            snapshot_interval=self._interval,
            show=self._show,
            believe=partial(self._believe, problem) if self._with_belief else None,
        )
        self.seconds |= registered.seconds
        answer = self._answer(registered)
        if answer.trust is not None:
            self.warn(check_trust(answer.trust, noise_of(self.method)))
            self.warn(check_prior(problem, answer))
            if all(earlier.code != FLIPPED for earlier in self.warnings):
                self.warn(check_normals(self.method, problem, hypotheses=answer))
        return answer

    def take(self, problem: RegistrationProblem, registered: Registered) -> None:
        """Let a result that a run before this one has recorded be that of the step."""
        belief = None
        if self._with_belief and registered.hypotheses.trust is not None:
            belief = self._believe(problem, registered.hypotheses)
        self.problem = problem
        self.loop.remember(self._answer(replace(registered, belief=belief)))

    def _answer(self, registered: Registered) -> Hypotheses:
        """Return the result of the step, with what follows from it."""
        self.registered = registered
        answer = self.answer = registered.hypotheses
        if answer.trust is not None:
            self.trust = answer.trust
            if self._with_belief:
                self.pose = self._stable(answer.world_from_object[0])
        self.belief = registered.belief or self.belief
        return answer

    def _stable(self, world_from_object: FloatArray) -> FloatArray:
        """Return the copy (4, 4) of a pose that is nearest to the pose before."""
        if self.pose is None:
            return world_from_object
        symmetry = symmetry_of(self.started.sdf, self.started.mesh)
        before = Poses.of(inverse(self.pose)[None])
        found = Poses.of(inverse(world_from_object)[None])
        return symmetry.nearest_copies(found, before).world_from_object[0]

    def _believe(self, problem: RegistrationProblem, hypotheses: Hypotheses) -> PoseBelief:
        """Return the belief after a result."""
        return PoseBelief(
            self.started.sdf,
            hypotheses,
            symmetry=symmetry_of(self.started.sdf, self.started.mesh),
            previous=self.belief,
            problem=problem,
            noise=noise_of(self.method),
        )

    def fail(self, error: Exception) -> None:
        """Record why the step has no result."""
        failure = one_line(error)
        self.recorder.record(Logged(self.step, "warning", text=f"{NO_RESULT}{failure}"))
        self.failure = failure

    def offer(self, actions: Actions, hand: HandShape) -> None:
        """Let decisions choose among these actions."""
        self.recorder.record(ActionsOffered(self.step, actions, hand=hand))
        self.loop.offer(actions, hand)

    def decide(self, available: BoolArray) -> Decided:
        """Choose one of the actions (A,) that are available, or none, and record it."""
        begun = time.perf_counter()
        decided = self.loop.decide(available)
        if self.step >= 0:
            self.seconds["decision"] = time.perf_counter() - begun
        self.recorder.record(decided)
        self.loop.follow(decided)
        self.stop = decided.decision.stop
        return decided

    def is_graspable(
        self, object_from_gripper: Any, width: Any, *, gripper: Gripper | None, sure: float
    ) -> bool:
        """Whether one of some grasps works with a chance of `sure`; `stop` is "grasp" then.

        `grasp` and `grasp_chance` become those of the best one, see `PoseBelief.best_grasp`.
        """
        if self.belief is None or self.answer is None or self.answer.trust is None:
            return False
        self.grasp, self.grasp_chance = self.belief.best_grasp(
            object_from_gripper, width, gripper=gripper
        )
        if self.grasp_chance < sure:
            return False
        text = f"stop: a grasp works with a chance of {self.grasp_chance:.2f}"
        self.recorder.record(Logged(self.step, "info", text=text))
        self.stop = "grasp"
        return True

    def check_moved(self, most: float = 0.02) -> float:
        """Return by how much each touch seems to have moved the object, metres, at most `most`.

        0 where no distance explains the points better than an object that stands still; else also
        warn. See `unexpected_push`.
        """
        if self.problem is None:
            return 0.0
        pushes = self.loop.pushes(most)
        distance = unexpected_push(self.method, self.problem, trust=self.trust, pushes=pushes)
        if distance > 0.0:
            text = (
                f"the points fit better if each touch has moved the object by {distance:.3f} m; "
                "state the most that it may: moves= of a Session, session.expect_moves= of a run"
            )
            self.warn([PointsWarning("moved", text)])
            self.flush()
        return distance

    def check_points(self) -> None:
        """Warn about points known so far; raise PointsError if they cannot be the object's."""
        started = self.started
        found = check_points(
            self.loop.state.points,
            started.sdf.diameter,
            free_resolution=started.free_resolution,
            workspace=started.workspace,
        )
        self.warn(found)

    def check_points_at_end(self) -> None:
        """Warn about points as they are at the end."""
        self.check_points()
        self.warn(check_contacts(self.loop.state.points))
        self.flush()

    def warn(self, found: Iterable[InputWarning]) -> None:
        """Record warnings, each kind once a run."""
        for warning in found:
            told = {earlier.code for earlier in self.warnings}
            texts = {earlier.text for earlier in self.warnings}  # by a run before this one, too
            if warning.code not in told and printable(warning.text) not in texts:
                step = max(self.step, 0)
                self.recorder.record(Logged(step, "warning", text=printable(warning.text)))
                self.warnings.append(StepWarning(step, warning.code, text=warning.text))
                self._new_warnings.append(warning)

    def new_warnings(self) -> list[InputWarning]:
        """Return warnings since the last call."""
        found = self._new_warnings
        self._new_warnings = []
        return found

    def flush(self) -> None:
        """Let all that was recorded survive the end of the process."""
        self.recorder.flush()

    def end(self, outcome: str = "finished") -> None:
        """End the recording, also where another thread registers: what that finds is lost."""
        step = max(self.step, 0)
        level = "info" if outcome == "finished" else "warning"
        self.loop.end()
        said = Logged(step, level, text=f"session {outcome}")
        self.recorder.end([said, SessionEnded(step, outcome)])
