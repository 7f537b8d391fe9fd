"""A session: points come in while a robot moves, poses and the next touch come out, all recorded.

CHSEL, Alg. 2, for programs.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np

from chsel.belief import Gripper, PoseBelief
from chsel.errors import (
    InputWarning,
    PointsError,
    PoseError,
    RecordingError,
    SettingError,
    quoted,
    require_between,
    require_instance,
    require_metres,
    require_positive,
)
from chsel.events import Recorder, SessionStarted
from chsel.methods import METHODS, MOST_NOISE, build_method, default_method, method_settings
from chsel.methods.method import Method
from chsel.next_probe.action_lattice import ActionSettings, around_actions
from chsel.next_probe.decision_problem import Actions, Decision, HandShape
from chsel.numerics.arrays import FloatArray, frozen
from chsel.numerics.threads import require_ieee_arithmetic
from chsel.policies import POLICIES, build_policy
from chsel.policies.policy import Policy
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.points import (
    FREE_RESOLUTION,
    KnownPoints,
    Workspace,
    check_workspace,
    require_parts,
)
from chsel.problem.pose_distances import with_symmetry
from chsel.problem.pose_prior import PosePrior, require_prior
from chsel.problem.poses import nearest_rigid
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import COARSEST, FINEST, OBJECT_PADDING, object_grid
from chsel.problem.streams import StreamKey
from chsel.sensing.depth_camera import PinholeCamera
from chsel.sensing.free_space import FreeGrid
from chsel.session.arguments import mesh_and_name, mesh_argument, name_of, plain_settings
from chsel.session.judging import noise_of
from chsel.session.loop import Phase
from chsel.session.perception import Intake, Prepared, hand_bodies
from chsel.session.pose_judgement import PoseJudgement, judged_pose
from chsel.session.recording import one_line, printable
from chsel.session.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from chsel.session.resuming import retraced
from chsel.session.run import Run, StepWarning

if TYPE_CHECKING:
    import trimesh

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _locked(
    method: Callable[Concatenate[Session, _P], _R],
) -> Callable[Concatenate[Session, _P], _R]:
    """Return a method of a session that waits for those that other threads have called."""

    @wraps(method)
    def locked(session: Session, *arguments: _P.args, **named: _P.kwargs) -> _R:
        with session._lock:
            return method(session, *arguments, **named)

    return locked


class NextProbe(NamedTuple):
    """A probe to make next: the hand starts at a pose and goes along its z axis."""

    world_from_hand: FloatArray  # (4, 4)
    length: float  # metres, unless it meets something
    action: int  # its index
    decision: Decision  # with forecasts for all of them


class Session:
    """One object that is sought, from the first point to the last.

    Threads may share it: each call waits for those before it.
    """

    started: SessionStarted
    """How the session began: object, workspace, settings."""

    method: Method
    """What registers."""

    intake: Intake
    """What checks and merges that which is added."""

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
        prior: PosePrior | None = None,
        symmetry: ObjectSymmetry | None = None,
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
        metres that a touch moves the object at most, along the hand's way. prior: what is known of
        the pose beforehand, read by `anchored` and by trust. symmetry: turns after which the object
        counts as the same, by which errors, verdicts, modes and `pose` go; by default those that
        map its surface to itself. seed: of the random streams. record: a
        new file .mcap or .rrd, or a recorder of one's own. live: show the session in the Rerun
        viewer.
        Raises ChselError for what cannot be used, and RecordingError if the file exists.
        """
        mesh, name = mesh_and_name(target)
        if isinstance(method, str | None):
            method_name = default_method(preset) if method is None else method
            sensor = None if noise is None else {"noise": noise}
            chosen = method_settings(method_name, preset, settings, sensor)
            method = build_method(method_name, chosen)
        else:
            method_name = name_of("method", method, names=METHODS, build=build_method)
        if isinstance(policy, str):
            policy_name = policy
            policy = build_policy(policy)
        else:
            policy_name = name_of("policy", policy, names=POLICIES, build=build_policy)
        if not isinstance(hand, HandShape | None):
            hand_bodies(hand)
            hand = HandShape.of(mesh_argument("hand", hand))
        StreamKey(seed, 0)  # raises for an invalid seed
        require_positive("free_resolution", free_resolution)
        require_between("free_resolution", free_resolution, low=FINEST, high=COARSEST)
        require_positive("moves", moves, zero=True)
        if prior is not None:
            require_prior(prior)
        grid = None
        if workspace is not None:
            require_parts(workspace=workspace)
            grid = FreeGrid(workspace, free_resolution)
        sdf = with_symmetry(object_grid(mesh, resolution), symmetry)
        require_metres(
            "noise", noise_of(method), most=MOST_NOISE * sdf.diameter, diameter=sdf.diameter
        )
        require_metres("moves", moves, most=sdf.diameter, diameter=sdf.diameter)
        grid_settings = {  # by which a damaged grid can be made again
            "object_resolution": None if resolution is None else float(resolution),
            "object_padding": OBJECT_PADDING,
        }
        config = {
            "object": {"name": name},
            "session": {"kind": "live", **grid_settings} | ({"moves": moves} if moves else {}),
            "method": {"name": method_name, **plain_settings(method.settings)},
            "policy": {"name": policy_name, **plain_settings(policy.settings)},
            "preset": {"name": preset},
            "seed": seed,
        }
        recorder, environment = _recorder(record, live)
        unknown = Workspace.around(np.zeros((1, 3)), sdf.diameter)  # until there are points
        self.started = SessionStarted(
            runner="session",
            object=name,
            session="live",
            method=method_name,
            seed=seed,
            config=config,
            mesh=mesh,
            sdf=sdf,
            workspace=workspace or unknown,
            free_resolution=free_resolution,
            initial_points=KnownPoints(),
            environment=environment,
            moves=float(moves),
            prior=prior,
        )
        opening = () if workspace is None else check_workspace(workspace, sdf.diameter)
        self._open(recorder, grid, method=method, policy=policy, hand=hand, opening=opening)
        if workspace is not None:
            self._run.begin(self.started)

    def _open(
        self,
        recorder: Recorder,
        grid: FreeGrid | None,
        *,
        method: Method,
        policy: Policy,
        hand: HandShape | None,
        opening: Iterable[InputWarning] = (),
    ) -> None:
        """Prepare a session whose start is known. Arguments as `Run`, `Intake` take them."""
        self.method = method
        self.intake = Intake(self.started, grid, moves=self.started.moves or 0.0)
        self._run = Run(
            method,
            recorder,
            policy=policy,
            with_belief=True,
            opening=opening,
            advice="; nothing of the session is lost, and it goes on without a recording",
        )
        self._lock = threading.RLock()
        self._policy = policy
        self._hand = hand
        self._taken: set[int] = set()  # actions, of those offered
        self._closed = False
        self._run.recorder.check(self.started)
        warm_up(method)
        warm_up_sensing()
        if hand is not None:
            warm_up_policy(policy)

    @classmethod
    def resume(
        cls,
        path: str | Path,
        *,
        step: int | None = None,
        method: str | Method | None = None,
        policy: str | Policy | None = None,
        hand: trimesh.Trimesh | HandShape | None = None,
        record: str | Path | Recorder | None = None,
        live: bool = False,
    ) -> Self:
        """Return a session that stands where a recording ends, or after one of its steps.

        What comes next has the bits of the session that was recorded, had it gone on. The
        recording stays as it is; `record`, another file, has all of it up to the step, and its
        digest. A registration that was cut short does not count.
        method, policy: others from there on; by default those of the recording. With another
        method no recorded result counts, with another policy no recorded decision. hand: by default
        that of the actions that were offered. record, live: as of a new session.
        Raises RecordingError for a file that cannot be read or lacks the step, and where this
        version computes other values.
        """
        from replay.comparing.choices import recorded_method, recorded_policy
        from replay.files import file_digest
        from replay.mcap.reader import read_recording

        recording = read_recording(Path(path).expanduser())
        steps = [probe.step for probe in recording.probes]
        if not steps:
            raise RecordingError(f"recording {path} has no probe; accepted: a new session")
        if step is not None and step not in steps:
            shown = f"{min(steps)} to {max(steps)}"
            raise RecordingError(f"recording {path} has no step {step}; accepted: {shown}")
        config = dict(recording.start.config)
        same_method = method is None
        same_policy = policy is None
        if method is None:
            method = recorded_method(recording).build()
        elif isinstance(method, str):
            method = build_method(method)
        if policy is None:
            is_there = isinstance(config.get("policy"), Mapping)
            policy = recorded_policy(recording).build() if is_there else "expected_loss"
        if isinstance(policy, str):
            policy = build_policy(policy)
        names = {
            "method": name_of("method", method, names=METHODS, build=build_method),
            "policy": name_of("policy", policy, names=POLICIES, build=build_policy),
        }
        config["method"] = {"name": names["method"], **plain_settings(method.settings)}
        config["policy"] = {"name": names["policy"], **plain_settings(policy.settings)}
        if hand is None and recording.offered is not None:
            hand = recording.offered.hand
        elif not isinstance(hand, HandShape | None):
            hand_bodies(hand)
            hand = HandShape.of(mesh_argument("hand", hand))
        recorder, environment = _recorder(record, live)
        session = cls.__new__(cls)
        session.started = replace(
            recording.start,
            method=names["method"],
            config=config,
            environment=environment,
            source=file_digest(Path(path).expanduser()),
        )
        session._open(recorder, None, method=method, policy=policy, hand=hand)
        session._run.begin(session.started)
        try:
            session._taken = retraced(
                session._run,
                session.intake,
                events=recording.events(),
                step=step,
                with_results=same_method,
                with_decisions=same_policy,
            )
        except Exception as error:
            session.close(f"failed: {one_line(error)}")  # so that the new file has an end
            raise
        session._run.flush()
        return session

    @property
    def points(self) -> KnownPoints:
        """All that are known, world frame."""
        return self._run.loop.state.points if self._run.has_begun else KnownPoints()

    @property
    def step(self) -> int:
        """Index of what was added last, -1 before the first."""
        return self._run.step

    @property
    def outcome(self) -> str:
        """Outcome of what was added last: "contact", "free" or "points"; "" before."""
        return self._run.outcome

    @property
    def answer(self) -> Hypotheses | None:
        """The last result, with trust; None before the first."""
        return self._run.answer

    @property
    def pose(self) -> FloatArray | None:
        """The best pose as a control loop takes it, world_from_object (4, 4); None before one.

        Of the copies that the object's symmetries make of it, the nearest to the pose before, so
        that it does not jump among them from step to step.
        """
        return self._run.pose

    @property
    def trust(self) -> Trust | None:
        """Trust in the last result that has a pose."""
        return self._run.trust

    @property
    def problem(self) -> RegistrationProblem | None:
        """The problem registered since the last `add`; None if none was."""
        return self._run.problem

    @property
    def warnings(self) -> list[StepWarning]:
        """All so far, each kind once."""
        return self._run.warnings

    @property
    def failure(self) -> str:
        """Why the last registration has no result, "" if it has one."""
        return self._run.failure

    @property
    def stop(self) -> str:
        """Why `next_probe` returned None, "" if it did not."""
        return self._run.stop

    @property
    def surprise(self) -> float:
        """Surprise of the last outcome by its forecast, nats; 0 where nothing was forecast."""
        return self._run.loop.state.surprise if self._run.has_begun else 0.0

    @property
    def grasp(self) -> FloatArray | None:
        """The best of the grasps that `next_probe` was given, world_from_gripper (4, 4)."""
        return self._run.grasp

    @property
    def grasp_chance(self) -> float:
        """The chance that it works; 0 before there is one."""
        return self._run.grasp_chance

    @property
    def seconds(self) -> dict[str, float]:
        """Wall-clock times of the last step, by stage."""
        return self._run.seconds

    @property
    def belief(self) -> PoseBelief:
        """Belief about the object after the last result; modes keep their numbers.

        Raises PoseError before there is a result, and where the last one has no pose.
        """
        if self._run.answer is None:
            raise PoseError("nothing is registered yet; accepted: a belief after `register`")
        if self._run.answer.trust is None or self._run.belief is None:
            raise PoseError("the last result has no pose; accepted: a belief after one that has")
        return self._run.belief

    @_locked
    def add(
        self,
        *,
        contacts: Any = None,
        normals: Any = None,
        normal_noise: Any = None,
        free: Any = None,
        occupied: Any = None,
        known: Any = None,
        known_sdf: Any = None,
        hand: trimesh.Trimesh | None = None,
        path: Any = None,
        contact: Any = None,
        normal: Any = None,
        depth: Any = None,
        camera: PinholeCamera | Any = None,
        world_from_camera: Any = None,
        mask: Any = None,
        image_normal_noise: Any = None,
        withdraw: Any = None,
        surface: Any = None,
    ) -> None:
        """Add what became known; it is in the recording when this returns.

        contacts (M, 3), free (N, 3), occupied (K, 3), known (L, 3) with known_sdf (L,): as in
        `chsel.register`, world frame, metres. Free points are merged into voxels, and a place on
        the object that is measured again counts once, with the normal of the first time.
        normals (M, 3), normal_noise: of the contacts, as in `chsel.register`.
        hand, path: a closed mesh in its own frame, and the poses world_from_hand (P, 4, 4) that it
        went through: its inside is free space. contact (3,): where it was stopped. normal (3,): of
        the object there, with normal_noise, which is one number then.
        depth (H, W): metres along z, 0, NaN or masked where there is none, of a camera that is a
        PinholeCamera or a matrix (3, 3), at world_from_camera (4, 4): rays are free up to a voxel
        before what they see. mask (H, W): the object's pixels, which give points on it.
        image_normal_noise: root mean square angle by which normals of the image are off, radians;
        its points then have normals where their pixel is on no edge.
        withdraw (W,): numbers of points of `points.known` that are not the object's after all, such
        as touches of another one.
        Raises ChselError for malformed input and for what cannot be recorded, with nothing added;
        RecordingError once, with everything added, where the recording cannot be written any more.
        """
        prepared = self.prepare(
            contacts=contacts,
            normals=normals,
            normal_noise=normal_noise,
            free=free,
            occupied=occupied,
            known=known,
            known_sdf=known_sdf,
            hand=hand,
            path=path,
            contact=contact,
            normal=normal,
            depth=depth,
            camera=camera,
            world_from_camera=world_from_camera,
            mask=mask,
            image_normal_noise=image_normal_noise,
            withdraw=withdraw,
            surface=surface,
        )
        self.commit(prepared)

    @_locked
    def prepare(self, **what: Any) -> Prepared:
        """Check what is to be added, with nothing added yet.

        Takes what `add` takes, and raises ChselError as it does. `commit` before the next `add`.
        """
        self._check_open()
        require_ieee_arithmetic()
        prepared = self.intake.prepare(self.points, step=self.step + 1, **what)
        recorder = self._run.recorder
        if prepared.image is not None:
            recorder.check(prepared.image)
        recorder.check(prepared.probe)
        if not self._run.has_begun:
            recorder.check(prepared.started)
        return prepared

    @_locked
    def commit(self, prepared: Prepared) -> None:
        """Add what was prepared, and record it."""
        if not self._run.has_begun:
            self.started = prepared.started
            self._run.begin(self.started)
        for event in self.intake.take(prepared):
            self._run.observe(event)
        self._run.warn(prepared.warnings)
        self._run.flush()

    @_locked
    def register(self) -> Hypotheses:
        """Return the plausible poses by all that is known, with trust (CHSEL, Alg. 2).

        The same result again if nothing was added since. Raises ChselError if nothing is known or
        the points cannot be the object's. Warns with InputWarning about suspicious points and
        results.
        """
        self._check_open()
        run = self._run
        if run.registered is not None:
            return run.registered.hypotheses
        if run.failure:
            raise PointsError(run.failure)
        if self.points.count == 0:
            raise PointsError("nothing is known yet; accepted: a registration after `add`")
        if run.loop.state.phase is Phase.DECIDED:
            raise SettingError("a probe was chosen since; accepted: `register` before `next_probe`")
        try:
            return run.register()
        except Exception as error:
            run.fail(error)
            raise
        finally:
            for warning in run.new_warnings():
                warnings.warn(warning, stacklevel=3)
            run.flush()

    @_locked
    def actions(self, settings: ActionSettings | None = None) -> Actions:
        """Return straight probes from four sides and from above, where z is up, the floor at 0.

        settings: by default those of the policy, whose spacing follows the object's diameter.
        """
        hand = self._require_hand()
        self._require_workspace()
        settings = settings or self._policy.settings.actions
        diameter = self.started.sdf.diameter
        return around_actions(settings, self.started.workspace, hand=hand, diameter=diameter)

    @_locked
    def next_probe(
        self,
        actions: Actions | None = None,
        *,
        without: Collection[int] = (),
        grasps: tuple[Any, Any] | None = None,
        gripper: Gripper | None = None,
        sure: float = 0.95,
    ) -> NextProbe | None:
        """Return where to touch next, by the policy; None if it stops, and `stop` says why.

        actions: that can be taken; by default those of `actions()`. Of the same actions, none is
        chosen twice, and none of `without`, indices. What is added next is taken as the outcome,
        unless it is a depth image.
        grasps: object_from_gripper (G, 4, 4) and widths (G,) of a gripper. Where one of them works
        with a chance of `sure`, `stop` is "grasp", and `grasp` is its world_from_gripper.
        """
        self._check_open()
        run = self._run
        hand = self._require_hand()
        decided = run.has_begun and run.loop.state.phase is Phase.DECIDED
        if decided and run.stop:
            return None
        if decided:
            raise SettingError("a probe was chosen before; accepted: `add` its outcome first")
        if grasps is not None:
            poses, widths = grasps
            if run.is_graspable(poses, widths, gripper=gripper, sure=sure):
                run.flush()
                return None
        offered = run.loop.state.offered if run.has_begun else None
        if actions is None:
            actions = self.actions() if offered is None else offered.actions
        accepted = "chsel.Actions(world_from_hand, length)"
        require_instance("actions", actions, kind=Actions, accepted=accepted)
        if not set(without) <= set(range(len(actions))):
            raise SettingError(f"without is {without}; accepted: indices below {len(actions)}")
        self._require_workspace()
        if offered is None or actions.digest != offered.actions.digest:
            run.offer(actions, hand)
            self._taken = set()
        available = np.ones(len(actions), dtype=bool)
        available[[*self._taken, *without]] = False
        decision = run.decide(available).decision
        run.flush()
        if decision.chosen < 0:
            return None
        self._taken.add(decision.chosen)
        return NextProbe(
            actions.world_from_hand[decision.chosen],
            float(actions.length[decision.chosen]),
            action=decision.chosen,
            decision=decision,
        )

    @_locked
    def judge(self, world_from_object: Any) -> PoseJudgement:
        """Return what the points say of a pose (4, 4) of another estimator, after a result.

        Raises PoseError for a matrix that is not rigid, and where the last step has no pose.
        """
        pose = frozen("world_from_object", world_from_object, shape=(4, 4), error=PoseError)
        pose = nearest_rigid("world_from_object", pose[None])[0]
        found = self._run.answer
        if self.problem is None or found is None or found.trust is None:
            raise PoseError("nothing is registered yet; accepted: a judgement after `register`")
        return judged_pose(self.method, self.problem, hypotheses=found, world_from_object=pose)

    @_locked
    def check_moved(self, most: float = 0.02) -> float:
        """Return by how much each touch seems to have moved the object, metres, at most `most`.

        Where the last result leaves contacts off its best pose, points are registered once more as
        if touches had moved them. A distance that explains them better is a warning; else 0.
        """
        return self._run.check_moved(most)

    @_locked
    def close(self, outcome: str = "finished") -> None:
        """End the recording. Closing twice is closing once."""
        if self._closed:
            return
        self._closed = True
        if not self._run.has_begun:
            self._run.begin(self.started)
        self._run.end(printable(outcome))

    def interrupt(self) -> None:
        """End the recording at once, also where another thread registers: what it finds is lost."""
        if not self._closed and self._run.has_begun:
            self._closed = True
            self._run.end("interrupted")

    def __enter__(self) -> Self:
        return self

    def __exit__(  # noqa: PLR0917
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        outcome = "finished"
        if isinstance(error, KeyboardInterrupt):
            outcome = "interrupted"
        elif error is not None:
            outcome = f"failed: {one_line(error)}"
        self.close(outcome)

    def _check_open(self) -> None:
        if self._closed:
            raise SettingError("the session is closed; accepted: a new one")

    def _require_workspace(self) -> None:
        if not self._run.has_begun:
            raise SettingError("workspace is missing; accepted: workspace=, or points before this")

    def _require_hand(self) -> HandShape:
        if self._hand is None:
            raise SettingError("hand is missing; accepted: chsel.Session(..., hand=mesh)")
        return self._hand


def _recorder(record: str | Path | Recorder | None, live: bool) -> tuple[Recorder, dict[str, str]]:
    """Return what records a session, and the environment that it notes."""
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
