"""A source that repeats the probes of an earlier recording, in its order or as actions."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from chsel.errors import PointsError, PoseError, SessionError, SettingError
from chsel.events import ActionsOffered, Decided, Probe, SessionStarted, Start
from chsel.next_probe.action_lattice import ActionSettings, straight_actions
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.points import Lattice, check_points
from chsel.problem.poses import apply, nearest_rigid
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import build_settings
from chsel.sensing.free_space import interior_lattice, poses_between
from chsel.session.loop import Loop
from chsel.session.resuming import retraced
from chsel.session.run import Run
from replay.comparing.choices import recorded_method
from replay.files import file_digest
from replay.mcap.reader import read_recording
from runners.objects.loader import ObjectModel
from runners.sessions.probing import PROBING
from runners.sessions.probing_hand import DescribedHand, open_hand
from runners.sessions.probing_settings import ProbingSettings, expected_moves
from runners.sessions.source import ObjectOrigin, SourceKind, Steerable, require_available


@dataclass(frozen=True)
class RecordedSettings:
    """A recording, which brings the object, workspace and resolutions."""

    path: str | None = None  # the recording.mcap
    start_contacts: int | None = None  # a registration needs so many; None: as in the recording
    start_probe: int | None = None  # and this index of the probe

    def __post_init__(self) -> None:
        if not self.path:
            raise SettingError("path is missing; pass session.path=FILE, a recording.mcap")


class RecordedSource(Steerable):
    """Gives the probes of a recording, with every point as it was.

    Raises RecordingError for a file that is not one, PointsError for points that cannot be those of
    its object.
    """

    def __init__(self, settings: RecordedSettings) -> None:
        assert settings.path is not None
        recording = read_recording(settings.path)
        start = recording.start
        self._recording = recording
        self._probes = recording.probes
        self.recorded: SessionStarted = start
        self.workspace = start.workspace
        self.free_resolution = start.free_resolution
        self.world_from_object = start.world_from_object
        self.initial_points = start.initial_points
        self.prior = start.prior
        self.count = len(self._probes)
        self._config: Mapping[str, Any] = start.config.get("session", {})
        self.push_distance = expected_moves(self._config) if start.moves is None else start.moves
        self.start = _start(settings, self._config)
        self._after = -1  # the step after which probes are given
        every = self.initial_points
        for probe in self._probes:
            every = probe.added_to(every)
        try:  # before any work; warnings are given when the points become known
            check_points(
                every,
                start.sdf.diameter,
                free_resolution=self.free_resolution,
                workspace=self.workspace,
            )
        except PointsError as error:
            raise PointsError(f"recording {settings.path}: {error}") from None

    def probes(self) -> Iterator[Probe]:
        """Yield the recorded probes in their order."""
        for probe in self._probes:
            if probe.world_from_object is not None:
                self.world_from_object = probe.world_from_object
            if probe.step > self._after:
                yield probe

    @property
    def digest(self) -> str:
        """Digest of the recording's file."""
        return file_digest(self._recording.path)

    def require_step(self, step: int) -> None:
        """Raise SessionError unless the recording has a probe of this step."""
        known = [probe.step for probe in self._probes]
        if step not in known:
            accepted = f"{known[0]} to {known[-1]}" if known else "none, as it has no probe"
            raise SessionError(
                f"recording {self._recording.path} has no step {step}; accepted: from={accepted}"
            )

    def retrace(self, run: Run, step: int) -> None:
        """Let a run that has begun come to a step of the recording; probes after it are given.

        With the method of the recording, its settings and its seed, results of the recording count;
        another one begins anew, with all points. Raise RecordingError where this version finds
        other values than the recording has.
        """
        recorded = recorded_method(self._recording).build()
        same = type(recorded) is type(run.method) and recorded.settings == run.method.settings
        same = same and run.started.seed == self.recorded.seed
        offered = (ActionsOffered, Decided)  # as this run has its own
        retraced(
            run,
            None,
            events=[one for one in self._recording.events() if not isinstance(one, offered)],
            step=step,
            with_results=same,
            with_decisions=False,
        )
        self._after = step
        if run.policy is not None:
            for number, probe in enumerate(self._probes):
                if probe.step <= step:
                    self._actions.take(probe.step, number)

    @cached_property
    def hand(self) -> HandShape:
        """The recording's hand, which probes along the z axis of its path; see `Steerable`.

        Raises SessionError if the recording does not describe it.
        """
        if self._recording.offered is not None:
            return self._recording.offered.hand
        if self._recording.rig is not None and self._recording.rig.hand is not None:
            return HandShape.of(self._recording.rig.hand)
        if self.recorded.session not in PROBING:
            raise SessionError(
                f"recording {self._recording.path} does not describe the hand, so that its probes "
                f"cannot be chosen; accepted: a session of kind {' or '.join(PROBING)}, or of "
                "sensors with solid parts of the hand in the rig"
            )
        described = build_settings(
            DescribedHand, self._config.get("hand", {}), where="session.hand"
        )
        return open_hand(described).shape

    def offer(self, settings: ActionSettings) -> Actions:
        """Return the recorded probes, each as an action, whatever is chosen; see `Steerable`."""
        if any(probe.world_from_object is not None for probe in self._probes):
            raise SessionError(
                f"recording {self._recording.path} has an object that moved, so that its probes "
                "cannot be taken in another order; accepted: policy=grid"
            )
        if any(probe.withdrawn is not None for probe in self._probes):
            raise SessionError(
                f"recording {self._recording.path} has points that were withdrawn, so that its "
                "probes cannot be taken in another order; accepted: policy=grid"
            )
        return self._actions.offer(settings)

    def available(self) -> BoolArray:
        """Return the probes (A,) that were not taken yet."""
        return self._actions.available.copy()

    def take(self, step: int, action: int) -> Iterator[Probe]:
        """Yield a recorded probe as that of this step, with all of its path that is free.

        What another one has shown before is not new. Raise SessionError if it was taken.
        """
        require_available(action, self._actions.available)
        yield self._actions.take(step, action)

    @cached_property
    def _actions(self) -> RecordedActions:
        hand, depth = self.hand, 0.0
        if self.recorded.session in PROBING:
            depth = self._config.get("interior_depth", ProbingSettings.interior_depth)
        lattice = Lattice(self.workspace.lower, self.free_resolution)
        try:
            return RecordedActions(self._probes, hand, lattice=lattice, depth=depth)
        except (PoseError, SessionError) as error:
            raise SessionError(f"recording {self._recording.path}: {error}") from None

    def loop(
        self, settings: OnlineSettings, *, seed: int, steps: Collection[int] | None = None
    ) -> Loop:
        """Return the loop of this session, before its first probe.

        settings, seed: as of `Loop`. steps: of no others than these; None for all.
        """
        return Loop(
            self.recorded.sdf,
            self.workspace,
            free_resolution=self.free_resolution,
            settings=settings,
            seed=seed,
            points=self.initial_points,
            start=self.start_of(steps),
            moves=self.push_distance,
            prior=self.prior,
        )

    def start_of(self, steps: Collection[int] | None) -> Start:
        """Return when steps register, if it is none but these; None for all."""
        return replace(self.start, steps=None if steps is None else tuple(sorted(steps)))

    def close(self) -> None:
        """Release nothing, as nothing is held open."""


def open_recorded(  # noqa: PLR0917
    settings: RecordedSettings, object_model: ObjectModel | None, seed: int
) -> RecordedSource:
    """Open the source of a recording, whatever the seed. Raise RecordingError if it is none."""
    return RecordedSource(settings)


RECORDED = SourceKind(RecordedSettings, open_recorded, object=ObjectOrigin.RECORDED)


def _start(settings: RecordedSettings, config: Mapping[str, Any]) -> Start:
    """Return when steps register: by the settings, else as in the configuration recorded."""
    contacts = settings.start_contacts
    step = settings.start_probe
    return Start(
        contacts=config.get("start_contacts") or 0 if contacts is None else contacts,
        step=config.get("start_probe") or 0 if step is None else step,
    )


_ASIDE = 0.010  # m: from the line of a push, what is before it
_AT_START = 0.002  # m: within which a push has not begun
_SHORTEST = 0.010  # m: of the longest push of a recording
_FINE = 5.0  # of a voxel's side: steps in which a path is swept
_NODES = 3.0  # of a voxel's side: nodes of the hand's interior
_TOGETHER = 200  # poses that are swept at once


class RecordedActions:
    """Probes that can be taken in any order, each once.

    A recording names each voxel of free space once, with the probe that swept it first. A probe
    that is taken out of order also sweeps what earlier ones of the recording had swept: so much
    of its path is free.
    """

    def __init__(
        self, probes: Sequence[Probe], hand: HandShape, *, lattice: Lattice, depth: float
    ) -> None:
        """Make the actions of probes.

        lattice: of the voxels of free space. depth: of the hand's interior that sweeps, metres.

        Raise SessionError for probes without a push along the hand's z axis.
        """
        self._probes = list(probes)
        self._lattice = lattice
        pushes = [_push(probe) for probe in self._probes]
        self._length = max((length for _, length in pushes), default=0.0)
        if self._length < _SHORTEST:
            raise SessionError(
                f"no probe goes {_SHORTEST:g} m along the z axis of the hand, "
                f"the farthest {self._length:.3g} m; accepted: straight pushes"
            )
        self._starts = np.array([start for start, _ in pushes])  # (A, 4, 4)
        self.available: BoolArray = np.ones(len(self._probes), dtype=bool)
        self._interior = _interior(
            hand, lattice.spacing / _NODES, depth=depth
        )  # (M, 3), hand frame
        self._radius = float(np.sqrt((np.asarray(hand.vertices) ** 2).sum(axis=1)).max())
        free = [probe.new_points.free for probe in self._probes]
        self._free = np.concatenate(free)  # (N, 3), in the order of the recording
        self._first = np.repeat(np.arange(len(free)), [len(points) for points in free])  # (N,)
        self._given = np.zeros(len(self._free), dtype=bool)
        self._voxels = lattice.voxels(self._free)  # (N, 3)

    def offer(self, settings: ActionSettings) -> Actions:
        """Return an action for each probe, as long as the longest push; reach does not matter."""
        length = np.full(len(self._starts), self._length)
        return straight_actions(replace(settings, reach=None), self._starts, length=length)

    def take(self, step: int, action: int) -> Probe:
        """Return the probe of an action, as the one of this step."""
        probe = self._probes[action]
        self.available[action] = False
        chosen = ~self._given & (self._first <= action)
        earlier = np.flatnonzero(chosen & (self._first < action))
        chosen[earlier] = self._swept(self._voxels[earlier], probe.gripper_path)
        self._given |= chosen
        new = replace(probe.new_points, free=self._free[chosen])
        return replace(probe, step=step, new_points=new)

    def _swept(self, voxels: np.ndarray, path: FloatArray) -> BoolArray:
        """Return which of voxels (N, 3) the hand's interior meets on a path (P, 4, 4)."""
        if len(voxels) == 0 or len(self._interior) == 0:
            return np.zeros(len(voxels), dtype=bool)
        low = voxels.min(axis=0)
        shape = voxels.max(axis=0) - low + 1
        met = np.zeros(shape, dtype=bool)
        poses = poses_between(path, step=self._lattice.spacing / _FINE, radius=self._radius)
        for first in range(0, len(poses), _TOGETHER):
            places = apply(poses[first : first + _TOGETHER], self._interior).reshape(-1, 3)
            at = self._lattice.voxels(places) - low
            at = at[((at >= 0) & (at < shape)).all(axis=1)]
            met[tuple(at.T)] = True
        return np.asarray(met[tuple((voxels - low).T)])


def _push(probe: Probe) -> tuple[FloatArray, float]:
    """Return where the push of a probe begins, a pose (4, 4), and how far it goes, metres."""
    path = probe.gripper_path
    if len(path) < 2:
        raise SessionError(
            f"probe {probe.step} has {len(path)} poses of the hand; accepted: the path of its "
            "push, at least 2"
        )
    path = nearest_rigid(f"the hand's path in probe {probe.step}", path)
    z = path[:, :3, 2]
    furthest = int(np.argmax((path[:, :3, 3] * z[0]).sum(axis=1)))
    way = path[: furthest + 1, :3, 3] - path[furthest, :3, 3]
    along = (way * z[furthest]).sum(axis=1)  # not positive, but for curved paths
    aside = np.sqrt(((way - along[:, None] * z[furthest]) ** 2).sum(axis=1))
    off = np.flatnonzero(aside > _ASIDE)
    begin = int(off[-1]) + 1 if len(off) else 0
    waiting = np.flatnonzero(along[begin:] <= along[begin:].min() + _AT_START)
    start = begin + int(waiting[-1])
    return path[start], max(-float(along[start]), 0.0)


def _interior(hand: HandShape, spacing: float, *, depth: float) -> FloatArray:
    """Return points (M, 3) in the hand, deeper than `depth` in one of its bodies, in its frame."""
    import trimesh

    mesh = trimesh.Trimesh(hand.vertices, hand.faces, process=False)
    bodies = [body for body in mesh.split(only_watertight=False) if body.is_watertight]
    deep = [np.zeros((0, 3))]
    for body in bodies:
        nodes = interior_lattice(body, spacing)
        deep.append(nodes[mesh_sdf(body, nodes)[0] < -depth])
    return np.concatenate(deep)
