"""A session that repeats the probes of an earlier recording."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from chsel.errors import PointsError, PoseError, SessionError, SettingError
from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray
from chsel.problem.online_registration import OnlineRegistration, OnlineSettings, Start
from chsel.problem.points import KnownPoints, check_points
from chsel.problem.settings import build_settings
from replay.events import Probe
from replay.mcap.reader import read_recording
from runners.sessions.probing_hand import DescribedHand, open_hand
from runners.sessions.probing_settings import ProbingSettings
from runners.sessions.recorded_actions import RecordedActions
from runners.sessions.session import require_available

_OF_GRIPPERS = ("simulated", "kinematic")  # sessions with a hand of ours


@dataclass(frozen=True)
class RecordedSettings:
    """A recording brings its own object, workspace and resolutions."""

    path: str | None = None  # the recording.mcap
    start_contacts: int | None = None  # a registration needs so many; None: as in the recording
    start_probe: int | None = None  # and this index of the probe

    def __post_init__(self) -> None:
        if not self.path:
            raise SettingError("path is missing; pass session.path=FILE, a recording.mcap")


class RecordedSession:
    """Gives the probes of a recording, with every point as it was.

    Raises RecordingError for a file that is not one, PointsError for points that cannot be those of
    its object.
    """

    def __init__(self, settings: RecordedSettings) -> None:
        assert settings.path is not None
        recording = read_recording(settings.path)
        self._recording = recording
        self.recorded = recording.start
        self.workspace = self.recorded.workspace
        self.free_resolution = self.recorded.free_resolution
        self.world_from_object = self.recorded.world_from_object
        self.initial_points = self.recorded.initial_points
        self._probes = recording.probes
        self.count = len(self._probes)
        self._check(settings.path)
        self.start = Start(
            self._rule("start_contacts", settings.start_contacts),
            self._rule("start_probe", settings.start_probe),
        )

    def _check(self, path: str) -> None:
        """Before any work; warnings are given when the points become known."""
        new = (probe.new_points for probe in self._probes)
        every = KnownPoints.joined([self.initial_points, *new])
        diameter = self.recorded.sdf.diameter
        try:
            check_points(every, diameter, self.free_resolution, self.workspace)
        except PointsError as error:
            raise PointsError(f"recording {path}: {error}") from None

    def probes(self) -> Iterator[Probe]:
        """The recorded probes in their order."""
        yield from self._probes

    @cached_property
    def hand(self) -> HandShape:
        """That of the recording, which probes along the z axis of its path; see `Steerable`.

        Raises SessionError if the recording does not describe it.
        """
        if self._recording.offered is not None:
            return self._recording.offered.hand
        if self._recording.rig is not None and self._recording.rig.hand is not None:
            return HandShape.of(self._recording.rig.hand)
        if self.recorded.session not in _OF_GRIPPERS:
            raise SessionError(
                f"recording {self._recording.path} does not describe the hand, so that its probes "
                "cannot be chosen; accepted: a session of kind simulated or kinematic, or of "
                "sensors with solid parts of the hand in the rig"
            )
        described = build_settings(DescribedHand, self._config("hand", {}), "session.hand")
        return open_hand(described).shape

    def offer(self, settings: ActionSettings) -> Actions:
        """The recorded probes, each as an action, whatever is chosen; see `Steerable`."""
        return self._actions.offer(settings)

    def available(self) -> BoolArray:
        """The probes (A,) that were not taken yet."""
        return self._actions.available.copy()

    def take(self, step: int, action: int) -> Iterator[Probe]:
        """A recorded probe as that of this step, with all of its path that is free.

        What another one has shown before is not new. Raises SessionError if it was taken.
        """
        require_available(action, self._actions.available)
        yield self._actions.take(step, action)

    @cached_property
    def _actions(self) -> RecordedActions:
        ours, hand = self.recorded.session in _OF_GRIPPERS, self.hand
        depth = self._config("interior_depth", ProbingSettings.interior_depth) if ours else 0.0
        workspace, resolution = self.workspace, self.free_resolution
        try:
            return RecordedActions(self._probes, hand, workspace, resolution, depth=depth)
        except (PoseError, SessionError) as error:
            raise SessionError(f"recording {self._recording.path}: {error}") from None

    def online(
        self, settings: OnlineSettings, seed: int, *, only: Container[int] | None = None
    ) -> OnlineRegistration:
        """The loop of this session, before its first step; see `OnlineRegistration`."""
        return OnlineRegistration(
            self.recorded.sdf,
            self.workspace,
            self.free_resolution,
            settings,
            seed=seed,
            points=self.initial_points,
            start=self.start,
            only=only,
        )

    def perceived(self) -> Iterator[tuple[int, KnownPoints]]:
        """The steps of the session with the points that are new in each."""
        return ((probe.step, probe.new_points) for probe in self._probes)

    def _rule(self, name: str, chosen: int | None) -> int:
        """What was chosen, or else what the recording says; 0 if it says nothing sensible."""
        value = self._config(name, 0) if chosen is None else chosen
        return value if isinstance(value, int) else 0

    def _config(self, name: str, default: Any) -> Any:
        """A setting of the recorded session, of the type of the default, else the default."""
        session = self.recorded.config.get("session")
        recorded = session.get(name, default) if isinstance(session, Mapping) else default
        return recorded if isinstance(recorded, type(default)) else default

    def close(self) -> None:
        """Nothing is held open."""
