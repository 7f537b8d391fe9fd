"""Writes a session as a Rerun recording: what people look at."""

from __future__ import annotations

from contextlib import closing, suppress
from functools import singledispatchmethod
from pathlib import Path

import rerun as rr

from chsel import events
from chsel.errors import RecordingError
from chsel.events import Recorder
from replay.colors import number
from replay.files import require_new
from replay.mcap.event_messages import step_numbers
from replay.mcap.reader import Recording
from replay.mcap.schemas import NUMBERS
from replay.rerun.archive import ArchiveMap
from replay.rerun.curves import Curves
from replay.rerun.decisions import Decisions
from replay.rerun.scene import HypothesisMeshes, Scene, coarsened, mode_labels
from replay.rerun.sensors import SensorImages
from replay.rerun.stream import Clock, flush, new_stream
from replay.rerun.text import COLORS, costs_markdown, session_markdown, verdict_markdown
from replay.rerun.viewer import live_sink
from replay.rerun.views import session_blueprint

APPLICATION = "chsel"
_LOG_LEVELS = {"info": rr.TextLogLevel.INFO, "warning": rr.TextLogLevel.WARN}


class RerunRecorder(Recorder):
    """A recorder whose file, live viewer or both show a session as it happens.

    path: where the recording goes; None for a live viewer alone. live: also show it in a viewer on
    this machine; without one, a warning. Timelines are those of `Clock`; no wall clock is written.
    Raises RecordingError if the file exists or cannot be written.
    """

    def __init__(self, path: Path | None, *, live: bool = False) -> None:
        self._path = path
        self._live = live
        self._stream = new_stream(APPLICATION, path, viewer=live_sink() if live else None)
        self._closed = False
        self._clock = Clock(self._stream)
        self._scene = Scene(self._stream)
        self._meshes = HypothesisMeshes(self._stream)
        self._sensors = SensorImages(self._stream)
        self._archive = ArchiveMap(self._stream)
        self._curves = Curves(self._stream)
        self._decisions = Decisions(self._stream, self._curves)
        self._started: events.SessionStarted | None = None
        self._steered = False
        self._laid_out: object = None  # what the layout was made for
        self._known = 0  # points of known signed distance in the last problem
        self._costs = self._verdict = ""  # texts about the last hypotheses

    def record(self, event: events.Event) -> None:
        """Draw one event."""
        if self._closed:
            return
        first = -1 if isinstance(event, events.ActionsOffered | events.Decided) else 0
        self._clock.set_probe(max(getattr(event, "step", 0), first))  # all else is of a probe
        self._draw(event)
        self._lay_out()

    def flush(self) -> None:
        """Hand all events so far to the operating system, and to the viewer if there is one.

        A viewer that is slow, or was closed, is a warning. Raise RecordingError if the file does
        not get them; nothing more is drawn then.
        """
        if self._closed:
            return
        try:
            flush(self._stream, self._path, must=not self._live)
        except RecordingError:
            self._closed = True
            raise

    def close(self) -> None:
        """Finish the file. Closing twice is closing once; raises RecordingError as `flush`."""
        if not self._closed:
            self.flush()
            self._closed = True
            self._stream.disconnect()

    @singledispatchmethod
    def _draw(self, event: events.Event) -> None:
        """Draw an event without a branch of its own: numbers about a step are curves."""
        if event.topic in NUMBERS:
            for name, value in step_numbers(event).items():
                self._curves.add_measured(name, value)
        if isinstance(event, events.Measured):
            self._verdict = verdict_markdown(event.values, self._known)
            if self._verdict:
                self._log_text("result", f"{self._verdict}\n{self._costs}\n")

    @_draw.register
    def _(self, event: events.SessionStarted) -> None:
        self._started = event
        name = f"{event.object}, {event.method}, seed {event.seed}"
        self._stream.send_recording_name(name)
        self._log_text("session", session_markdown(event), static=True)
        self._log_text("colors", COLORS, static=True)
        mesh = coarsened(event.mesh)
        self._scene.set_up(mesh, event.workspace, world_from_object=event.world_from_object)
        self._scene.add_points(event.initial_points)
        self._meshes.set_up(mesh)

    @_draw.register
    def _(self, event: events.RigDescribed) -> None:
        if event.hand is not None:
            self._scene.add_hand(event.hand)

    @_draw.register
    def _(self, event: events.ActionsOffered) -> None:
        self._steered = True
        self._meshes.hide()  # before the first probe, too
        self._scene.add_hand(event.hand)
        self._decisions.set_up(event.actions)

    @_draw.register
    def _(self, event: events.SensorImage) -> None:
        self._clock.tick()
        self._sensors.add(event)

    @_draw.register
    def _(self, event: events.Probe) -> None:
        self._sensors.end_step()
        self._decisions.add_probe(event)
        self._scene.add_probe(event)

    @_draw.register
    def _(self, event: events.ProblemPosed) -> None:
        self._known = len(event.problem.points.known)
        self._clock.tick()
        self._archive.start()

    @_draw.register
    def _(self, event: events.SnapshotTaken) -> None:
        self._clock.advance(f"archive {event.archive.refinement}", event.archive.iteration)
        self._archive.draw(event.step, event.archive)

    @_draw.register
    def _(self, event: events.Traced) -> None:
        self._clock.advance(event.stage, event.iteration)
        self._curves.add_trace(self._clock.iteration, event)

    @_draw.register
    def _(self, event: events.HypothesesFound) -> None:
        found = event.hypotheses
        self._meshes.draw(found)
        self._archive.mark(event.step, found)
        self._curves.add_hypotheses(found)
        self._costs = costs_markdown(found)
        self._log_text("result", self._costs)
        best = f"best cost {number(found.cost[0])}, " if len(found.cost) else ""
        self._log_line(f"{best}{found.distinct} distinct hypotheses", rr.TextLogLevel.INFO)

    @_draw.register
    def _(self, event: events.Decided) -> None:
        self._clock.tick()
        self._decisions.draw(event)
        self._clock.tick()  # what it led to is of a later moment

    @_draw.register
    def _(self, event: events.Believed) -> None:
        self._scene.show_modes(event)
        modes = ", ".join(mode_labels(event))
        self._log_text("result", f"{self._verdict}\n{modes}\n\n{self._costs}\n")

    @_draw.register
    def _(self, event: events.Timed) -> None:
        for stage, seconds in event.seconds.items():
            self._curves.add(f"seconds/{stage.replace(' ', '_')}", seconds)

    @_draw.register
    def _(self, event: events.Logged) -> None:
        self._log_line(event.text, _LOG_LEVELS.get(event.level, event.level.upper()))

    def _log_text(self, entity: str, text: str, *, static: bool = False) -> None:
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._stream.log(entity, document, static=static)

    def _log_line(self, text: str, level: rr.TextLogLevel | str) -> None:
        self._stream.log("log", rr.TextLog(text, level=level))

    def _lay_out(self) -> None:
        """Make views of all that there is to see, if that has changed."""
        counts = len(self._curves.views), len(self._sensors.titles)
        shown = (*counts, self._archive.size, self._steered)
        if self._started is not None and shown != self._laid_out:
            self._laid_out = shown
            layout = session_blueprint(
                self._started.workspace,
                curves=self._curves.views,
                archive=self._archive.size,
                sensors=self._sensors.titles,
                steered=self._steered,
            )
            self._stream.send_blueprint(layout)


def draw_recording(recording: Recording, path: Path, *, last: int | None = None) -> None:
    """Write to `path`, a new file, what the run wrote beside its MCAP file.

    last: the last probe that is drawn; None: all are. Raise RecordingError if the file exists,
    cannot be written, or a problem of the recording is not the recorded one; nothing is left of
    the file then.
    """
    require_new(path)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    recorder = RerunRecorder(path)
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
