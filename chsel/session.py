"""A session: points come in while a robot moves, poses and the next touch come out, all recorded.

CHSEL, Alg. 2, for programs. Everything that probes goes through this one class: a robot's program,
`runners.probe`, evaluations, and recorded sessions.
"""

from __future__ import annotations

import json
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, dataclass, replace
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np

from chsel.api import method_settings
from chsel.belief import Gripper, PoseBelief
from chsel.errors import (
    InputWarning,
    PointsError,
    PointsWarning,
    PoseError,
    SettingError,
    quoted,
    require_between,
    require_instance,
    require_metres,
    require_positive,
)
from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    Logged,
    Probe,
    ProblemPosed,
    Recorder,
    SensorImage,
    SessionEnded,
    SessionStarted,
)
from chsel.methods import METHODS, MOST_NOISE, build_method, default_method, noise_of
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.method import Method
from chsel.next_probe.action_lattice import ActionSettings, around_actions
from chsel.next_probe.decision_problem import Actions, Decision, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray, evenly_spaced
from chsel.numerics.threads import require_ieee_arithmetic
from chsel.plausible.symmetry import ObjectSymmetry, object_symmetry
from chsel.policies import POLICIES, build_policy
from chsel.policies.policy import Policy
from chsel.policies.steering import Choice, Steering
from chsel.problem.mesh import clean_mesh, load_mesh
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.points import (
    FREE_RESOLUTION,
    KnownPoints,
    Workspace,
    away_from,
    check_contacts,
    check_points,
    check_workspace,
    distinct_points,
    require_parts,
    same_place,
    workspace_around,
)
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import COARSEST, FINEST, OBJECT_PADDING, object_grid
from chsel.problem.streams import StreamKey
from chsel.problem.trust import check_trust
from chsel.registration import Registered, one_line, printable, register_recorded
from chsel.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from chsel.sensing.depth_camera import DepthLook, PinholeCamera, outside_of
from chsel.sensing.free_space import FreeGrid
from chsel.sensing.perception import Perception, farthest_depth, hand_bodies, perceived
from chsel.session_recorder import SessionRecorder

if TYPE_CHECKING:
    import trimesh

FROM_SESSION = "session"
"""The code of warnings that come with the points."""
_CLOSE = 2.0  # noise levels: a misfit that needs no explanation
_MOST_SHOWN = 200  # poses of a path, in recordings
_UNIT = 1e-4  # m: of recorded depths, up to 6.5 m; of others a multiple of it
_ROUNDING = 1e-9  # of a number of units
_P = ParamSpec("_P")
_R = TypeVar("_R")


def _one_at_a_time(
    method: Callable[Concatenate[Session, _P], _R],
) -> Callable[Concatenate[Session, _P], _R]:
    """A method of a session that waits for those that other threads have called."""

    @wraps(method)
    def locked(session: Session, *arguments: _P.args, **named: _P.kwargs) -> _R:
        with session._lock:
            return method(session, *arguments, **named)

    return locked


@dataclass(frozen=True)
class StepWarning:
    """What a person should know about the input."""

    step: int  # the probe at which it first holds
    code: str  # the kind of warning
    text: str  # one line


class NextProbe(NamedTuple):
    """Where to touch next: the hand starts at a pose and goes along its z axis."""

    world_from_hand: FloatArray  # (4, 4)
    length: float  # metres, unless it meets something
    action: int  # its index
    decision: Decision  # with forecasts for all of them


class Accepted(NamedTuple):
    """What is added to a session, checked, and what the session becomes by it."""

    started: SessionStarted
    grid: FreeGrid
    given: Perception
    probe: Probe  # but for the points that become free
    image: SensorImage | None
    touching: KnownPoints  # without places that were measured before
    seen: FloatArray  # (M, 3): the same of an image
    warnings: list[InputWarning]


class Session:
    """One object that is sought, from the first point to the last.

    Threads may share it: each call waits for those before it.

    step: of the last points that were added, -1 before. warnings: so far, each kind once. answer:
    the last result, None before. trust: in it. stop: why `next_probe` gave None, "" if it did not.
    grasp, grasp_chance: the world_from_gripper (4, 4) that works with the largest chance, None
        before, and this chance.
    failure: why the last step has no result, "" if nothing failed. registered, problem: of the last
    step, None without a registration. seconds: by stage, of the last step. steering: of the next
    probe, None before there are actions. online: which problem follows, and all known points.
    """

    def __init__(
        self,
        target: trimesh.Trimesh | str | Path,
        *,
        method: str | Method | None = None,
        preset: str = "default",
        settings: Any = None,
        policy: str | Policy = "expected_loss",
        hand: trimesh.Trimesh | HandShape | None = None,
        workspace: Workspace | None = None,
        noise: float | None = None,
        resolution: float | None = None,
        free_resolution: float = FREE_RESOLUTION,
        moves: float = 0.0,
        seed: int = 0,
        record: str | Path | Recorder | None = None,
        live: bool = False,
    ) -> None:
        """Open a session, and compile what it needs: up to a minute the first time.

        target: the object's mesh in metres, or its file. method, preset, settings, resolution: as
        `chsel.register` takes them, or a method of `build_method`. noise: standard deviation of the
        sensor, metres, for methods with such a setting. policy: of `next_probe`, a name or what
        `build_policy` gives. hand: that probes along the z axis of its frame, metres.
        workspace: where the object can be; by default it follows from the first points. moves:
        metres that a touch moves the object at most, along the hand's way. seed: of
        the random streams. record: a new file .mcap or .rrd, or a recorder of one's own. live: show
        the session in the Rerun viewer.
        Raises ChselError for what cannot be used, and RecordingError if the file exists.
        """
        mesh, name = _mesh_of(target)
        if isinstance(method, str | None):
            method_name = default_method(preset) if method is None else method
            sensor = None if noise is None else {"noise": noise}
            method = build_method(
                method_name, method_settings(method_name, preset, settings, sensor)
            )
        else:
            method_name = _name_of("method", method, METHODS, build_method)
        if isinstance(policy, str):
            policy_name, policy = policy, build_policy(policy)
        else:
            policy_name = _name_of("policy", policy, POLICIES, build_policy)
        if not isinstance(hand, HandShape | None):
            hand_bodies(hand)
            hand = HandShape.of(_mesh("hand", hand))
        self._hand = hand
        StreamKey(seed, 0)  # raises for an invalid seed
        require_positive("free_resolution", free_resolution)
        require_between("free_resolution", free_resolution, FINEST, COARSEST)
        require_positive("moves", moves, zero=True)
        grid = None
        if workspace is not None:
            require_parts(workspace=workspace)
            grid = FreeGrid(workspace, free_resolution)
        sdf = object_grid(mesh, resolution)
        require_metres("noise", noise_of(method), MOST_NOISE * sdf.diameter, sdf.diameter)
        require_metres("moves", moves, sdf.diameter, sdf.diameter)
        grid_settings = {  # by which a damaged grid can be made again
            "object_resolution": None if resolution is None else float(resolution),
            "object_padding": OBJECT_PADDING,
        }
        config = {
            "object": {"name": name},
            "session": {"kind": "live", **grid_settings} | ({"moves": moves} if moves else {}),
            "method": {"name": method_name, **_plain(method.settings)},
            "policy": {"name": policy_name, **_plain(policy.settings)},
            "preset": {"name": preset},
            "seed": seed,
        }
        recorder, environment = _recorder(record, live)
        parts = name, "live", method_name, seed, config, mesh, sdf
        unknown = Workspace.around(np.zeros((1, 3)), sdf.diameter)  # until there are points
        given = workspace or unknown, free_resolution, KnownPoints(), None, environment
        advice = "; nothing of the session is lost, and it goes on without a recording"
        self._set_up(SessionStarted("session", *parts, *given), method, recorder, advice)
        self._recorder.check(self.started)
        if workspace is not None:
            self._opening: tuple[InputWarning, ...] = tuple(
                check_workspace(workspace, sdf.diameter)
            )
        self._policy, self._moves = policy, moves
        self._grid: FreeGrid | None = grid  # free space of what was added
        warm_up(method)
        warm_up_sensing()
        if self._hand is not None:
            warm_up_policy(policy)
        if workspace is not None:
            self._begin()

    @classmethod
    def begun(
        cls,
        started: SessionStarted,
        method: Method,
        recorder: Recorder,
        *,
        online: OnlineRegistration | None = None,
        symmetry: ObjectSymmetry | None = None,
        steering: Steering | None = None,
        opening: Iterable[InputWarning] = (),
        snapshot_interval: int = 0,
        show: Callable[[str, int, int], None] = lambda *_: None,
    ) -> Session:
        """A session of which all parts are there; it warns in `warnings` alone.

        online: by default of all known points, from `started`. symmetry: of the object, for errors
        to the true pose; None: without errors. opening: warnings that come with the first points.
        snapshot_interval: iterations between recorded archives; 0: the first and the last. show:
        gets stage, iteration and total.
        """
        session = cls.__new__(cls)
        session._set_up(started, method, recorder)
        session._symmetry, session._opening = symmetry, tuple(opening)
        session._interval, session._show = snapshot_interval, show
        session._begin(online)
        session.steering = steering
        if steering is not None:
            session._recorder.record(ActionsOffered(-1, steering.actions, steering.hand))
        session.flush()
        return session

    def _set_up(
        self, started: SessionStarted, method: Method, recorder: Recorder, advice: str = ""
    ) -> None:
        self.started, self.method = started, method
        self._recorder = SessionRecorder(recorder, advice)
        self._lock = threading.RLock()  # of the calls from outside
        self._truth = started.world_from_object  # where the object is now, where that is known
        self._symmetry: ObjectSymmetry | None = None
        self._opening = ()
        self._interval = 0
        self._show: Callable[[str, int, int], None] = lambda *_: None
        self._begun = self._closed = False
        self._moves = 0.0
        self._new_warnings: list[InputWarning] = []  # that `register` has not given yet
        self._grid = None
        self._size = started.sdf.diameter  # metres, that the density of points depends on
        self._since = KnownPoints()  # on the object, since it was pushed last
        self._seen = np.zeros((0, 3))  # the same of depth images
        self.steering: Steering | None = None
        self.step = -1
        self.outcome = self.failure = self.stop = ""
        self.warnings: list[StepWarning] = []
        self.registered: Registered | None = None
        self.problem: RegistrationProblem | None = None
        self.answer: Hypotheses | None = None
        self.trust: Trust | None = None
        self.grasp: FloatArray | None = None  # (4, 4), the best of the last ones
        self.grasp_chance = 0.0
        self.seconds: dict[str, float] = {}
        self._belief: PoseBelief | None = None  # of the result `_believed`
        self._believed: Hypotheses | None = None
        self._answered: RegistrationProblem | None = None  # whose result `answer` is
        self._decided = -2  # the step of the last decision
        self._taken: set[int] = set()  # actions, of those offered

    def _begin(self, online: OnlineRegistration | None = None) -> None:
        """Open the recording, now that the workspace is known."""
        started = self.started
        around = started.workspace, started.free_resolution
        self.online = online or OnlineRegistration(
            started.sdf,
            *around,
            self.method.online,
            seed=started.seed,
            points=started.initial_points,
            push_distance=self._moves,
        )
        self._recorder.record(started)
        self._begun = True

    @_one_at_a_time
    def add(
        self,
        *,
        contacts: Any = None,
        free: Any = None,
        occupied: Any = None,
        known: Any = None,
        known_sdf: Any = None,
        hand: trimesh.Trimesh | None = None,
        path: Any = None,
        contact: Any = None,
        depth: Any = None,
        camera: PinholeCamera | Any = None,
        world_from_camera: Any = None,
        mask: Any = None,
        surface: Any = None,
    ) -> None:
        """Add what became known; it is in the recording when this returns.

        contacts (M, 3), free (N, 3), occupied (K, 3), known (L, 3) with known_sdf (L,): as in
        `chsel.register`, world frame, metres. Free points are merged into voxels, and a place on
        the object that is measured again counts once.
        hand, path: a closed mesh in its own frame, and the poses world_from_hand (P, 4, 4) that it
        went through: its inside is free space. contact (3,): where it was stopped.
        depth (H, W): metres along z, 0, NaN or masked where there is none, of a camera that is a
        PinholeCamera or a matrix (3, 3), at world_from_camera (4, 4): rays are free up to a voxel
        before what they see. mask (H, W): the object's pixels, which give points on it.
        Raises ChselError for malformed input and for what cannot be recorded, with nothing added;
        RecordingError once, with everything added, where the recording cannot be written any more.
        """
        accepted = self.accepted(
            contacts=contacts,
            surface=surface,
            free=free,
            occupied=occupied,
            known=known,
            known_sdf=known_sdf,
            hand=hand,
            path=path,
            contact=contact,
            depth=depth,
            camera=camera,
            world_from_camera=world_from_camera,
            mask=mask,
        )
        self.take(accepted)

    @_one_at_a_time
    def accepted(self, **what: Any) -> Accepted:
        """What is to be added, once all of it was checked; raises ChselError as `add` does."""
        self._check_open()
        if what.pop("surface", None) is not None:
            raise PointsError("surface is the name in chsel.register; accepted: contacts=")
        require_ieee_arithmetic()
        spacing, diameter = self.started.free_resolution, self.started.sdf.diameter
        given = perceived(**what, diameter=self._size, spacing=spacing)
        look, step = given.look, self.step + 1
        touching, found = distinct_points(given.touching, self._since, same_place(self._size))
        seen = np.zeros((0, 3))
        if look is not None:
            seen = look.surface[away_from(look.surface, self._seen, given.spacing)]
        on_object = touching.merged(KnownPoints(known=seen))
        started, grid = self.started, self._grid
        if self._begun:
            points = self.online.points.merged(on_object)
            check_points(points, diameter, spacing, started.workspace)
        else:
            check_points(on_object, diameter, spacing)
            passed = KnownPoints(free=np.concatenate([given.free, given.path[:, :3, 3]]))
            around = on_object if on_object.count else passed
            if around.count == 0:
                raise PointsError(
                    "nothing says where the object can be; accepted: chsel.Session(..., "
                    "workspace=...), or first points, a path or a mask"
                )
            workspace = workspace_around(around, started.sdf)
            grid = FreeGrid(workspace, spacing)
            started = replace(started, workspace=workspace)
        assert grid is not None
        outcome = "contact" if len(given.contacts) else "points" if given.others.count else "free"
        probe = Probe(
            step=step,
            outcome="points" if look is not None else outcome,
            new_points=on_object,
            gripper_path=given.path[evenly_spaced(len(given.path), _MOST_SHOWN)],
            contacts=given.contacts,
            contact_normals=np.zeros_like(given.contacts),
        )
        image = None
        if look is not None:
            farthest = farthest_depth(look, started.workspace)
            look = look._replace(ends=np.minimum(look.ends, farthest))
            image = _image(step, look, farthest)
            self._recorder.check(image)
        self._recorder.check(probe)
        if not self._begun:
            self._recorder.check(started)
        before = started.workspace if self._begun else None
        return Accepted(
            started=started,
            grid=grid,
            given=given._replace(look=look),
            probe=probe,
            image=image,
            touching=touching,
            seen=seen,
            warnings=[*found, *given.check(diameter, before)],
        )

    @_one_at_a_time
    def take(self, accepted: Accepted) -> None:
        """Let what was accepted become known, and record it."""
        given, look, grid, probe = (
            accepted.given,
            accepted.given.look,
            accepted.grid,
            accepted.probe,
        )
        if not self._begun:
            self.started, self._grid = accepted.started, grid
            self._begin()
        grid.at(given.free)
        grid.at(given.hand, poses=given.swept)
        surface = np.zeros((0, 3))
        if look is not None:
            surface = look.surface
            grid.from_depth(look.ends, look.camera, look.pose, look.rays, fraction=1.0)
        if accepted.image is not None:
            self.observe(accepted.image)
        free = outside_of(surface, grid.new(), self.started.free_resolution)
        probe = replace(probe, new_points=KnownPoints(free=free).merged(probe.new_points))
        self._seen = np.concatenate([self._seen, accepted.seen])
        self._since = self._since.merged(accepted.touching)
        if self._moves and probe.push is not None:  # what was known has moved with the object
            self._grid = FreeGrid(self.started.workspace, self.started.free_resolution)
            self._seen = np.zeros((0, 3))
            self._since = KnownPoints()
        self.observe(probe)
        self._warn(accepted.warnings)
        self.flush()

    def count_places_for(self, diameter: float) -> None:
        """Let the density of points be that of an object of another diameter, metres."""
        self._size = diameter

    @_one_at_a_time
    def observe(self, event: Event) -> None:
        """Record what happened; the new points of a Probe become known."""
        self._recorder.record(event)
        if isinstance(event, Logged) and event.level == "warning":
            self.warnings.append(StepWarning(event.step, FROM_SESSION, event.text))
        if not isinstance(event, Probe):
            return
        self.step, self.outcome = event.step, event.outcome
        self.registered = self.problem = None
        self.failure, self.seconds = "", {}
        steering = self.steering
        if (
            steering is not None
            and self._decided == event.step - 1
            and steering.last is not None
            and steering.last.decision.chosen >= 0
            and event.outcome != "points"
            and steering.felt(event.contacts)
        ):
            self.online.start_afresh(steering.policy.settings.surprise.larger)
        if event.world_from_object is not None:
            self._truth = event.world_from_object
        self.online.perceive(event.new_points, event.push)
        self._warn(self._opening)

    @_one_at_a_time
    def register(self) -> Hypotheses:
        """The plausible poses by all that is known, with how far to trust them (CHSEL, Alg. 1).

        The same result again if nothing was added since. Raises ChselError if nothing is known or
        the points cannot be the object's. Warns with InputWarning about points and results that
        are hardly right.
        """
        self._check_open()
        if self.registered is not None:
            return self.registered.hypotheses
        if self.failure:
            raise PointsError(self.failure)
        if not self._begun or self.online.points.count == 0:
            raise PointsError("nothing is known yet; accepted: a registration after `add`")
        if self._decided == self.step:
            raise SettingError("a probe was chosen since; accepted: `register` before `next_probe`")
        try:
            return self.register_step()
        except Exception as error:
            self.failed(error)
            raise
        finally:
            found, self._new_warnings = self._new_warnings, []
            for warning in found:
                warnings.warn(warning, stacklevel=3)
            self.flush()

    @_one_at_a_time
    def register_step(self) -> Hypotheses:
        """The same, but that the recording may be behind, and what is given is not checked."""
        found = self.register_problem(self.online.pose(self.step))
        self.online.remember(found)
        return found

    @_one_at_a_time
    def register_problem(self, problem: RegistrationProblem) -> Hypotheses:
        """Register a problem of this step, and record it; the next one does not follow from it."""
        self.problem = problem
        self._check_points()
        self.registered = register_recorded(
            ProblemPosed(problem.key.step, problem),
            self.method,
            self._recorder,
            self._truth,
            self._symmetry,
            snapshot_interval=self._interval,
            show=self._show,
        )
        self.seconds |= self.registered.seconds
        self.answer, self._answered = self.registered.hypotheses, problem
        if self.answer.trust is not None:
            self.trust = self.answer.trust
            self._warn(check_trust(self.trust, noise_of(self.method)))
        return self.answer

    @_one_at_a_time
    def failed(self, error: Exception) -> None:
        """Record why this step has no result."""
        failure = one_line(error)
        self._recorder.record(Logged(self.step, "warning", f"no result: {failure}"))
        self.failure = failure

    @_one_at_a_time
    def actions(self, settings: ActionSettings | None = None) -> Actions:
        """Straight probes from four sides and from above, where z is up and the floor at 0.

        settings: by default those of the policy.
        """
        self._require_hand()
        if not self._begun:
            raise SettingError("workspace is missing; accepted: workspace=, or points before this")
        assert self._hand is not None
        settings = settings or self._policy.settings.actions
        return around_actions(settings, self.started.workspace, self._hand)

    @_one_at_a_time
    def next_probe(
        self,
        actions: Actions | None = None,
        *,
        without: Collection[int] = (),
        grasps: tuple[Any, Any] | None = None,
        gripper: Gripper | None = None,
        sure: float = 0.95,
    ) -> NextProbe | None:
        """Where to touch next, by the policy; None if it stops, and `stop` says why.

        actions: that can be taken; by default those of `actions()`. Of the same actions, none is
        chosen twice, and none of `without`, indices. What is added next is taken as the outcome,
        unless it is a depth image.
        grasps: object_from_gripper (G, 4, 4) and widths (G,) of a gripper. Where one of them works
        with a chance of `sure`, `stop` is "grasp", and `grasp` is its world_from_gripper.
        """
        self._check_open()
        hand = self._require_hand()
        if self._decided == self.step and self.stop:
            return None
        if self._decided == self.step:
            raise SettingError("a probe was chosen before; accepted: `add` its outcome first")
        if grasps is not None and self.grasped(*grasps, gripper, sure):
            self.flush()
            return None
        if actions is None:
            actions = self.actions() if self.steering is None else self.steering.actions
        accepted = "chsel.Actions(world_from_hand, length)"
        require_instance("actions", actions, Actions, accepted)
        if not set(without) <= set(range(len(actions))):
            raise SettingError(f"without is {without}; accepted: indices below {len(actions)}")
        if not self._begun:
            raise SettingError("workspace is missing; accepted: workspace=, or points before this")
        if self.steering is None or actions.digest != self.steering.actions.digest:
            steering = self.steering or Steering(
                self._policy,
                self.started.sdf,
                self.started.workspace,
                self.started.free_resolution,
                actions,
                hand,
                seed=self.started.seed,
            )
            self._recorder.record(ActionsOffered(self.step, actions, hand))
            steering.actions = actions
            self.steering, self._taken = steering, set()
        available = np.ones(len(actions), dtype=bool)
        available[[*self._taken, *without]] = False
        decision = self.decide(available).decision
        self.flush()
        self.stop, chosen = decision.stop, decision.chosen
        if chosen < 0:
            return None
        self._taken.add(chosen)
        length = float(actions.length[chosen])
        return NextProbe(actions.world_from_hand[chosen], length, chosen, decision)

    @_one_at_a_time
    def grasped(
        self, object_from_gripper: Any, width: Any, gripper: Gripper | None, sure: float
    ) -> bool:
        """Whether one of some grasps works with a chance of `sure`; `stop` is "grasp" then.

        `grasp` and `grasp_chance` are those of the best one, see `PoseBelief.best_grasp`.
        """
        if self.answer is None or self.answer.trust is None:
            return False
        self.grasp, self.grasp_chance = self.belief.best_grasp(object_from_gripper, width, gripper)
        if self.grasp_chance < sure:
            return False
        text = f"stop: a grasp works with a chance of {self.grasp_chance:.2f}"
        self._recorder.record(Logged(self.step, "info", text))
        self.stop = "grasp"
        return True

    @_one_at_a_time
    def decide(self, available: BoolArray) -> Choice:
        """Choose one of the actions (A,) that are available, and record it."""
        assert self.steering is not None
        begun = time.perf_counter()
        points, found = self.online.points, self.online.previous
        choice = self.steering.decide(self.step + 1, points, found, available)
        if self.step >= 0:
            self.seconds["decision"] = time.perf_counter() - begun
        self._recorder.record(Decided(self.step, *choice, self.steering.surprise))
        self._decided = self.step
        return choice

    @_one_at_a_time
    def flush(self) -> None:
        """Let all that was recorded survive the end of the process."""
        self._recorder.flush()

    @property
    @_one_at_a_time
    def belief(self) -> PoseBelief:
        """What the last result says about the object; modes keep their numbers.

        Raises PoseError before there is a result with a pose.
        """
        if self.answer is None:
            raise PoseError("nothing is registered yet; accepted: a belief after `register`")
        if self._belief is None or self._believed is not self.answer:
            symmetry = object_symmetry(self.started.mesh)
            belief = PoseBelief(
                self.started.sdf,
                self.answer,
                symmetry,
                self._belief,
                problem=self._answered,
                noise=noise_of(self.method),
            )
            if self.registered is not None and not self._closed:
                self._recorder.record(belief.event(self.step))
            self._belief, self._believed = belief, self.answer
        return self._belief

    @_one_at_a_time
    def check_moved(self, most: float = 0.02) -> float:
        """By how much each touch seems to have moved the object, metres, at most `most`; or 0.

        Where the last result leaves contacts off its best pose, points are registered once more as
        if touches had moved them. A distance that explains them better is a warning.
        """
        problem, pushes = self.problem, self.online.pushes(most)
        if problem is None or problem.pushes is not None or pushes is None:
            return 0.0
        if self.trust is None or self.trust.misfit <= _CLOSE:
            return 0.0
        moving = Anchored(AnchoredSettings(noise=noise_of(self.method)))
        distance = moving.register(replace(problem, pushes=pushes)).push_distance
        if distance > 0.0:
            text = (
                f"the points fit better if each touch has moved the object by {distance:.3f} m; "
                "state the most that it may: moves= of a Session, session.expect_moves= of a run"
            )
            self._warn([PointsWarning("moved", text)])
            self.flush()
        return distance

    @_one_at_a_time
    def end_points(self) -> None:
        """Warn about points as they are at the end."""
        self._check_points()
        self._warn(check_contacts(self.online.points))
        self.flush()

    @_one_at_a_time
    def close(self, outcome: str = "finished") -> None:
        """End the recording. Closing twice is closing once."""
        if self._closed:
            return
        outcome = printable(outcome)
        self._closed = True
        level, step = "info" if outcome == "finished" else "warning", max(self.step, 0)
        try:
            if not self._begun:
                self._begin()
            self._recorder.record(Logged(step, level, f"session {outcome}"))
            self._recorder.record(SessionEnded(step, outcome))
        finally:
            self._recorder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        interrupted = isinstance(error, KeyboardInterrupt)
        failed = "" if error is None or interrupted else one_line(error)
        self.close(f"failed: {failed}" if failed else "interrupted" if interrupted else "finished")

    def _check_points(self) -> None:
        """Warn about points known so far; PointsError if they cannot be the object's."""
        started, online = self.started, self.online
        place = started.free_resolution, started.workspace
        self._warn(check_points(online.points, online.sdf.diameter, *place))

    def _warn(self, found: Iterable[InputWarning]) -> None:
        """Record warnings, each kind once a session."""
        for warning in found:
            if warning.code not in {earlier.code for earlier in self.warnings}:
                step = max(self.step, 0)
                self._recorder.record(Logged(step, "warning", printable(warning.text)))
                self.warnings.append(StepWarning(step, warning.code, warning.text))
                self._new_warnings.append(warning)

    def _check_open(self) -> None:
        if self._closed:
            raise SettingError("the session is closed; accepted: a new one")

    def _require_hand(self) -> HandShape:
        if self._hand is None:
            raise SettingError("hand is missing; accepted: chsel.Session(..., hand=mesh)")
        return self._hand


def _recorder(record: str | Path | Recorder | None, live: bool) -> tuple[Recorder, dict[str, str]]:
    """What records a session, and the environment that it notes."""
    if record is None and not live:
        return Recorder(), {}
    from replay.environment import environment
    from replay.recorder import open_recorder

    if isinstance(record, Recorder):
        return record, environment()
    path = Path(record).expanduser() if isinstance(record, str | Path) else None
    if record is not None and (path is None or path.suffix not in (".mcap", ".rrd")):
        raise SettingError(f"record is {quoted(str(record))}; accepted: a name.mcap or name.rrd")
    files = {path.suffix[1:]: path} if path is not None else {}
    return open_recorder(files.get("mcap"), files.get("rrd"), live=live), environment()


def _mesh_of(target: trimesh.Trimesh | str | Path) -> tuple[trimesh.Trimesh, str]:
    """The object's mesh, and its name."""
    if isinstance(target, str | Path):
        return load_mesh(target), printable(Path(target).stem)
    mesh = _mesh("target", target)
    return clean_mesh(mesh.vertices, mesh.faces, name="target"), "object"


def _mesh(name: str, given: Any) -> trimesh.Trimesh:
    """What is given, if it is a mesh."""
    import trimesh

    require_instance(name, given, trimesh.Trimesh, "a mesh such as chsel.load_mesh(path)")
    return given


def _name_of(what: str, made: Any, names: tuple[str, ...], build: Callable[[str], Any]) -> str:
    """The name under which something is offered, by its class; else that of the class."""
    if not hasattr(made, "settings"):
        raise SettingError(f"{what} is {quoted(made)}; accepted: chsel.build_{what}(name), or name")
    offered = (name for name in names if type(build(name)) is type(made))
    return next(offered, type(made).__name__)


def _plain(settings: Any) -> dict[str, Any]:
    """Settings as recordings have them."""
    return dict(json.loads(json.dumps(asdict(settings))))


def _image(step: int, look: DepthLook, farthest: float) -> SensorImage:
    """A depth image as recordings have it: without depths beyond the farthest, metres."""
    depth = np.where(look.depth > farthest, 0.0, look.depth)
    unit = _UNIT * np.ceil(max(float(depth.max()) / (65535 * _UNIT) - _ROUNDING, 1.0))
    values = np.rint(depth / unit).astype(np.uint16)
    camera = look.camera
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return SensorImage(step, "camera", "depth", values, unit, look.rays, intrinsics, look.pose)
