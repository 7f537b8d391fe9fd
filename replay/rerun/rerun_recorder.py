"""Writes a session as a Rerun recording: what people look at."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import singledispatchmethod
from pathlib import Path

import rerun as rr

from chsel.errors import RecordingError
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from replay import events
from replay.colors import number
from replay.events import Recorder
from replay.files import require_new
from replay.mcap.event_messages import step_numbers
from replay.mcap.reader import Recording
from replay.mcap.schemas import NUMBERS
from replay.rerun.archive import ArchiveMap, map_frame
from replay.rerun.blueprint import USUAL_ARCHIVE, Bounds, bounds_in_sight, session_blueprint
from replay.rerun.clock import Clock
from replay.rerun.curves import Curves, SearchPlot
from replay.rerun.decisions import Decisions
from replay.rerun.hypotheses import HypothesisMeshes
from replay.rerun.legend import Legend
from replay.rerun.meshes import HandMesh, bare_mesh, hand_mesh
from replay.rerun.plane import Frame
from replay.rerun.scene import Scene
from replay.rerun.sensors import SensorImages
from replay.rerun.stream import RrdFile, abandon, new_stream
from replay.rerun.text import session_markdown, verdict_markdown
from replay.rerun.viewer import live_sink

APPLICATION = "chsel"
_LOG_LEVELS = {"info": rr.TextLogLevel.INFO, "warning": rr.TextLogLevel.WARN}
_FLUSH_SECONDS = 10.0
_LONG_FLUSH = 5.0  # seconds


class RerunRecorder(Recorder):
    """A recorder whose file, live viewer or both show a session as it happens.

    path: where the recording goes; None for a live viewer alone. live: also show it in a viewer on
    this machine; without one, a warning. follow: the viewer opens at the last probe, as a live one
    does, and not at the first registration. Timelines are those of `Clock`; no wall clock is
    written. Raises RecordingError if the file cannot be written.
    """

    def __init__(self, path: Path | None, *, live: bool = False, follow: bool = False) -> None:
        self._file = None if path is None else RrdFile(path)
        self._live = live
        sinks = [] if self._file is None else [self._file.sink]
        viewer = live_sink() if live else None
        self._stream = new_stream(APPLICATION, *sinks, *([viewer] if viewer else []))
        self._grown = False  # whether something that takes space was drawn since the last flush
        self._closed = False
        self._clock = Clock(self._stream)
        self._scene = Scene(self._stream)
        self._meshes = HypothesisMeshes(self._stream)
        self._hand = HandMesh(self._stream)
        self._sensors = SensorImages(self._stream)
        self._legend = Legend(self._stream)
        self._archive = ArchiveMap(self._stream)
        self._curves = Curves(self._stream)
        self._search = SearchPlot(self._stream)
        self._decisions = Decisions(self._stream)
        self._started: events.SessionStarted | None = None
        self._known = 0  # points of known signed distance in the last problem
        self._early: list[events.Probe | events.Logged] = []  # before the first registration
        self._follow = live or follow
        self._archive_frame: Frame | None = USUAL_ARCHIVE
        self._fitted = False
        self._in_sight: Bounds | None = None
        self._timed = False
        self._lagging = False

    def record(self, event: events.Event) -> None:
        """Draw one event."""
        if self._closed:
            return
        first = -1 if isinstance(event, events.ActionsOffered | events.Decided) else 0
        self._clock.set_probe(max(getattr(event, "step", 0), first))  # all else is of a probe
        self._draw(event)
        if isinstance(event, events.Probe | events.Logged) and not self._clock.registering:
            self._early.append(event)
        self._grown |= isinstance(event, events.SessionStarted | events.Probe | events.Logged)

    def flush(self) -> None:
        """Hand all events so far to the operating system, and to the viewer if there is one.

        Raises RecordingError if the file does not get them; nothing more is drawn then.
        """
        if self._closed:
            return
        self._curves.send_traces()
        self._archive.send()
        begun = time.monotonic()
        try:
            self._stream.flush(timeout_sec=_FLUSH_SECONDS)
        except RuntimeError as error:
            if not self._lagging:
                self._lagging = True
                warnings.warn(f"the live view or the file does not follow: {error}", stacklevel=2)
        late = time.monotonic() - begun > _LONG_FLUSH
        if self._file is not None and not self._live:  # a slow viewer may hold the file up, too
            with self._last_error():
                self._file.check(grown=self._grown, late=late)
        self._grown = False

    def close(self) -> None:
        """Finish the file, and wait until it is on the disk. Closing twice is closing once.

        Raises RecordingError if it does not get there.
        """
        if not self._closed:
            self.flush()
            self._closed = True
            self._stream.disconnect()
            if self._file is not None:
                with self._last_error():
                    self._file.finish(whole=not self._live)

    @contextmanager
    def _last_error(self) -> Iterator[None]:
        """Draw no more after an error of the file."""
        try:
            yield
        except RecordingError:
            self._closed = True
            abandon(self._stream)
            raise

    @singledispatchmethod
    def _draw(self, event: events.Event) -> None:
        """Events without a branch of their own: numbers about a step are curves."""
        if event.topic in NUMBERS:
            for name, value in step_numbers(event).items():
                self._curves.add_measured(name, value)
        if isinstance(event, events.Measured):
            text = verdict_markdown(event.values, self._known)
            if text:
                self._stream.log("verdict", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    @_draw.register
    def _(self, event: events.SessionStarted) -> None:
        name = f"{event.object}, {event.method}, seed {event.seed}"
        known = event.world_from_object is not None
        self._stream.send_recording_name(name)
        self._started = event
        self._lay_out()
        text = rr.TextDocument(session_markdown(event), media_type=rr.MediaType.MARKDOWN)
        self._stream.log("session", text, static=True)
        mesh = bare_mesh(event.mesh)
        self._scene.set_up(mesh, event.workspace, event.world_from_object)
        self._meshes.set_up(mesh)
        self._legend.set_up(pose_known=known)
        self._legend.add_kinds(event.initial_points)
        self._curves.set_up()
        self._scene.add_points(event.initial_points, new=False)

    @_draw.register
    def _(self, event: events.RigDescribed) -> None:
        if event.hand is not None:
            self._hand.set_up(event.hand)

    @_draw.register
    def _(self, event: events.ActionsOffered) -> None:
        self._meshes.hide()  # before the first probe, too
        self._hand.set_up(hand_mesh(event.hand))
        self._decisions.set_up(event.actions)
        self._lay_out()

    @_draw.register
    def _(self, event: events.SensorImage) -> None:
        self._clock.tick()
        if self._sensors.add(event):
            self._lay_out()

    @_draw.register
    def _(self, event: events.Probe) -> None:
        self._sensors.end_step()
        self._legend.add_kinds(event.new_points)
        self._decisions.add_probe(event)
        self._draw_probe(event)

    @_draw.register
    def _(self, event: events.ProblemPosed) -> None:
        self._known = len(event.problem.points.known)
        if not self._clock.registering:
            self._begin_registrations()
        self._clock.start_registration()
        self._archive.start()
        self._search.start()

    @_draw.register
    def _(self, event: events.SnapshotTaken) -> None:
        self._clock.advance(f"archive {event.archive.refinement}", event.archive.iteration)
        self._archive.draw(event.step, self._clock.moment, event.archive)
        self._fit_layout(event.archive)

    @_draw.register
    def _(self, event: events.Traced) -> None:
        self._clock.advance(event.stage, event.iteration)
        self._search.add(self._clock.iteration, event)
        self._curves.add_trace(self._clock.moment, event)

    @_draw.register
    def _(self, event: events.HypothesesFound) -> None:
        self._meshes.draw(event.hypotheses)
        self._legend.draw(event.hypotheses)
        self._archive.mark(event.step, self._clock.moment, event.hypotheses)
        self._fit_layout(event.hypotheses.archive, event.hypotheses)
        self._curves.add_hypotheses(event.hypotheses)
        self._search.draw(event.step)
        self._log_result(event.hypotheses)

    @_draw.register
    def _(self, event: events.Decided) -> None:
        self._clock.tick()
        self._decisions.draw(event)
        self._clock.tick()  # what it led to is of a later moment

    @_draw.register
    def _(self, event: events.Timed) -> None:
        for stage, seconds in event.seconds.items():
            self._curves.add_seconds(stage, seconds)
        if not self._timed:
            self._timed = True
            self._lay_out()

    @_draw.register
    def _(self, event: events.Logged) -> None:
        level = _LOG_LEVELS.get(event.level, event.level.upper())
        self._stream.log("log", rr.TextLog(event.text, level=level))

    def _draw_probe(self, probe: events.Probe) -> None:
        self._hand.draw(probe)
        self._scene.add_probe(probe)

    def _begin_registrations(self) -> None:
        """Draw all that there is to see by now as the first moment of the registrations."""
        with self._clock.beginning_of_registrations():
            self._meshes.hide()
            self._sensors.draw_again()
            if self._started is not None:
                self._scene.add_points(self._started.initial_points, new=False)
            for event in self._early:
                if isinstance(event, events.Probe):
                    self._draw_probe(event)
                else:
                    self._draw(event)
        self._early.clear()

    def _log_result(self, hypotheses: Hypotheses) -> None:
        """A line of text about the result."""
        best = f"best cost {number(hypotheses.cost[0])}, " if len(hypotheses.cost) else ""
        text = f"{best}{hypotheses.distinct} distinct hypotheses"
        self._stream.log("log", rr.TextLog(text, level=rr.TextLogLevel.INFO))

    def _fit_layout(
        self, archive: ArchiveSnapshot | None, hypotheses: Hypotheses | None = None
    ) -> None:
        """Lay the views out anew once the first registration shows archive and hypotheses."""
        fitted, in_sight = self._fitted, self._in_sight
        if not fitted:
            self._fitted = True
            self._archive_frame = None if archive is None else map_frame(archive)
        if in_sight is None and hypotheses is not None and self._started is not None:
            self._in_sight = bounds_in_sight(self._started, [hypotheses])
        if not fitted or in_sight is not self._in_sight:
            self._lay_out()

    def _lay_out(self) -> None:
        if self._started is not None:
            layout = session_blueprint(
                self._started.workspace,
                in_sight=self._in_sight,
                pose_known=self._started.world_from_object is not None,
                archive=self._archive_frame,
                timed=self._timed,
                steered=self._decisions.offered,
                sensors=[*self._sensors.pictures.values()],
                follow=self._follow or not self._clock.registering,
            )
            self._stream.send_blueprint(layout)


def draw_recording(recording: Recording, path: Path, *, last: int | None = None) -> None:
    """Write to `path`, a new file, what the run wrote beside its MCAP file.

    last: the last probe that is drawn, where the viewer opens; None: all are, and the viewer opens
    at the first registration.
    Raises RecordingError if the file exists, cannot be written, or a problem of the recording is
    not the recorded one; nothing is left of the file then.
    """
    require_new(path)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    recorder = RerunRecorder(path, follow=last is not None)
    try:
        with closing(recorder):
            for event in recording.events():
                if last is not None and getattr(event, "step", last) > last:
                    break
                if isinstance(event, events.Probe):
                    recorder.flush()
                recorder.record(event)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
