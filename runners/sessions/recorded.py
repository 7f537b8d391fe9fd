"""A session that repeats the probes of an earlier recording."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass

from chsel.errors import PointsError, SettingError
from chsel.problem.input_checks import check_points
from chsel.problem.online_registration import OnlineRegistration, OnlineSettings, Start
from chsel.problem.points import KnownPoints
from replay.events import Probe
from replay.mcap.reader import read_recording


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
        session = self.recorded.config.get("session")
        recorded = session.get(name) if isinstance(session, dict) else None
        value = recorded if chosen is None else chosen
        return value if isinstance(value, int) else 0

    def close(self) -> None:
        """Nothing is held open."""
