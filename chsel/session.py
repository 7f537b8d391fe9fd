"""A session: points come in while a robot moves, poses and the next touch come out, all recorded.

CHSEL, Alg. 2, for programs. Everything that probes goes through this one class: a robot's program,
`runners.probe`, evaluations, and recorded sessions.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self

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
    require_instance,
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
from chsel.methods import METHODS, build_method, default_method, noise_of
from chsel.methods.anchored.anchored import Anchored, AnchoredSettings
from chsel.methods.method import Method
from chsel.next_probe.action_lattice import ActionSettings, around_actions
from chsel.next_probe.decision_problem import Actions, Decision, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray, evenly_spaced, frozen
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
    check_contacts,
    check_points,
    require_parts,
    workspace_around,
)
from chsel.problem.poses import nearest_rigid
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import OBJECT_PADDING, object_grid
from chsel.problem.streams import StreamKey
from chsel.problem.trust import check_trust
from chsel.registration import Registered, one_line, register_recorded
from chsel.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from chsel.sensing.depth_camera import DepthLook, PinholeCamera, depth_look, outside_of
from chsel.sensing.free_space import FreeGrid, interior_lattice, poses_between

if TYPE_CHECKING:
    import trimesh

FROM_SESSION = "session"
"""The code of warnings that come with the points."""
_CLOSE = 2.0  # noise levels: a misfit that needs no explanation
_MOST_SHOWN = 200  # poses of a path, in recordings
_ACROSS = 15.0  # to a diameter: points on the object that a depth image gives
_UNIT = 1e-4  # m: of recorded depths, up to 6.5 m; of others a multiple of it


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


class Session:
    """One object that is sought, from the first point to the last.

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
            hand = HandShape.of(_mesh("hand", hand))
        self._hand = hand
        StreamKey(seed, 0)  # raises for an invalid seed
        require_positive("free_resolution", free_resolution)
        require_positive("moves", moves, zero=True)
        grid = None
        if workspace is not None:
            require_parts(workspace=workspace)
            grid = FreeGrid(workspace, free_resolution)
        sdf = object_grid(mesh, resolution)
        recorder, environment = _recorder(record, live)
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
        parts = name, "live", method_name, seed, config, mesh, sdf
        unknown = Workspace.around(np.zeros((1, 3)), sdf.diameter)  # until there are points
        given = workspace or unknown, free_resolution, KnownPoints(), None, environment
        self._set_up(SessionStarted("session", *parts, *given), method, recorder)
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
            recorder.record(ActionsOffered(-1, steering.actions, steering.hand))
        recorder.flush()
        return session

    def _set_up(self, started: SessionStarted, method: Method, recorder: Recorder) -> None:
        self.started, self.method, self._recorder = started, method, recorder
        self._truth = started.world_from_object  # where the object is now, where that is known
        self._symmetry: ObjectSymmetry | None = None
        self._opening: tuple[InputWarning, ...] = ()
        self._interval = 0
        self._show: Callable[[str, int, int], None] = lambda *_: None
        self._begun = self._closed = False
        self._moves = 0.0
        self._new_warnings: list[InputWarning] = []  # that `register` has not given yet
        self._grid = None
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
    ) -> None:
        """Add what became known; it is in the recording when this returns.

        contacts (M, 3), free (N, 3), occupied (K, 3), known (L, 3) with known_sdf (L,): as in
        `chsel.register`, world frame, metres. Free points are merged into voxels.
        hand, path: a closed mesh in its own frame, and the poses world_from_hand (P, 4, 4) that it
        went through: its inside is free space. contact (3,): where it was stopped.
        depth (H, W): metres along z, 0 or NaN where there is none, of a camera that is a
        PinholeCamera or a matrix (3, 3), at world_from_camera (4, 4): rays are free up to a voxel
        before what they see. mask (H, W): the object's pixels, which give points on it.
        Raises ChselError for malformed input, with nothing added.
        """
        self._check_open()
        if all(each is None for each in (contacts, free, occupied, known, path, contact, depth)):
            raise PointsError("nothing was added; accepted: points, a path or a depth image")
        if (hand is None) is not (path is None):
            raise PointsError("hand and path belong together; accepted: both or none")
        image = [each is not None for each in (depth, camera, world_from_camera)]
        if any(image) is not all(image) or (mask is not None and depth is None):
            raise PointsError(
                "depth, camera and world_from_camera belong together, with or without mask; "
                "accepted: all of them or none"
            )
        spacing, diameter = self.started.free_resolution, self.started.sdf.diameter
        contacts, free = _rows("contacts", contacts), _rows("free", free)
        if contact is not None:
            contacts = np.concatenate([contacts, frozen("contact", contact, (3,))[None]])
        sdf = np.zeros(0) if known_sdf is None else known_sdf
        others = KnownPoints(
            occupied=_rows("occupied", occupied), known=_rows("known", known), known_sdf=sdf
        )
        inside, poses = np.zeros((0, 3)), np.zeros((0, 4, 4))
        between, look = poses, None
        if path is not None:
            hand = _mesh("hand", hand)
            poses = nearest_rigid("path", frozen("path", path, (None, 4, 4), error=PoseError))
            inside = interior_lattice(hand, 0.5 * spacing)
            radius = float(np.sqrt((hand.vertices**2).sum(axis=1)).max())
            between = poses_between(poses, step=0.5 * spacing, radius=radius)
        if depth is not None:
            depth = frozen("depth", depth, (None, None), finite=False)
            if mask is not None:
                mask = frozen("mask", mask, (None, None), dtype=np.bool_)
            seen_by, places = _camera(camera, depth), diameter / _ACROSS
            look = depth_look(depth, seen_by, world_from_camera, mask, before=spacing, side=places)
            others = others.merged(KnownPoints(known=look.surface))
        touching = KnownPoints(known=contacts).merged(others)
        if self._begun:
            points = self.online.points.merged(touching)
            check_points(points, diameter, spacing, self.started.workspace)
        else:
            check_points(touching, diameter, spacing)
            passed = KnownPoints(free=np.concatenate([free, poses[:, :3, 3]]))
            around = touching if touching.count else passed
            if around.count == 0:
                raise PointsError(
                    "nothing says where the object can be; accepted: chsel.Session(..., "
                    "workspace=...), or first points, a path or a mask"
                )
            workspace = workspace_around(around, self.started.sdf)
            self._grid = FreeGrid(workspace, spacing)
            self.started = replace(self.started, workspace=workspace)
            self._begin()
        assert self._grid is not None
        self._grid.at(free)
        self._grid.at(inside, poses=between)
        seen = np.zeros((0, 3))
        if look is not None:
            seen = look.surface
            self._grid.from_depth(look.ends, look.camera, look.pose, look.rays, fraction=1.0)
            self._recorder.record(_image(self.step + 1, look))
        now_free = outside_of(seen, self._grid.new(), spacing)
        outcome = "contact" if len(contacts) else "points" if others.count else "free"
        probe = Probe(
            step=self.step + 1,
            outcome="points" if look is not None else outcome,
            new_points=KnownPoints(free=now_free).merged(touching),
            gripper_path=poses[evenly_spaced(len(poses), _MOST_SHOWN)],
            contacts=contacts,
            contact_normals=np.zeros_like(contacts),
        )
        if self._moves and probe.push is not None:  # what was free has moved with the object
            self._grid = FreeGrid(self.started.workspace, spacing)
        self.observe(probe)
        self.flush()

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
        self._warn(self._opening)
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
            self.flush()
            given, self._new_warnings = self._new_warnings, []
            for warning in given:
                warnings.warn(warning, stacklevel=2)

    def register_step(self) -> Hypotheses:
        """The same, but that the recording may be behind, and what is given is not checked."""
        found = self.register_problem(self.online.pose(self.step))
        self.online.remember(found)
        return found

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

    def failed(self, error: Exception) -> None:
        """Record why this step has no result."""
        self.failure = one_line(error)
        self._recorder.record(Logged(self.step, "warning", f"no result: {self.failure}"))

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
            place = self.started.sdf, self.started.workspace, self.started.free_resolution
            if self.steering is None:
                given = actions, hand
                self.steering = Steering(self._policy, *place, *given, seed=self.started.seed)
            self.steering.actions, self._taken = actions, set()
            self._recorder.record(ActionsOffered(self.step, actions, hand))
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

    def flush(self) -> None:
        """Let all that was recorded survive the end of the process."""
        self._recorder.flush()

    @property
    def belief(self) -> PoseBelief:
        """What the last result says about the object; modes keep their numbers.

        Raises PoseError before there is a result with a pose.
        """
        if self.answer is None:
            raise PoseError("nothing is registered yet; accepted: a belief after `register`")
        if self._belief is None or self._believed is not self.answer:
            symmetry = object_symmetry(self.started.mesh)
            self._belief = PoseBelief(
                self.started.sdf,
                self.answer,
                symmetry,
                self._belief,
                problem=self._answered,
                noise=noise_of(self.method),
            )
            self._believed = self.answer
            if self.registered is not None and not self._closed:
                self._recorder.record(self._belief.event(self.step))
        return self._belief

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

    def end_points(self) -> None:
        """Warn about points as they are at the end."""
        self._check_points()
        self._warn(check_contacts(self.online.points))
        self.flush()

    def close(self, outcome: str = "finished") -> None:
        """End the recording. Closing twice is closing once."""
        if self._closed:
            return
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
                self.warnings.append(StepWarning(step, warning.code, warning.text))
                self._recorder.record(Logged(step, "warning", warning.text))
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
        return load_mesh(target), Path(target).stem
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


def _rows(name: str, given: Any) -> FloatArray:
    """Points (N, 3), none for None."""
    return frozen(name, np.zeros((0, 3)) if given is None else given, (None, 3))


def _image(step: int, look: DepthLook) -> SensorImage:
    """A depth image as recordings have it."""
    unit = _UNIT * np.ceil(max(float(look.depth.max()) / (65535 * _UNIT), 1.0))
    values = np.rint(look.depth / unit).astype(np.uint16)
    camera = look.camera
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return SensorImage(step, "camera", "depth", values, unit, look.rays, intrinsics, look.pose)


def _camera(camera: Any, depth: FloatArray) -> PinholeCamera:
    """The camera of an image (H, W), also of a matrix (3, 3)."""
    if isinstance(camera, PinholeCamera):
        return camera
    matrix = frozen("camera", camera, (3, 3), error=SettingError)
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    return PinholeCamera(depth.shape[1], depth.shape[0], fx, fy, cx, cy)
