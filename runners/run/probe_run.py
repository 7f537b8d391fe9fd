"""A session of `runners.probe` from its first probe to its summary, shown on the terminal."""

from __future__ import annotations

import json
import signal
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Self

from chsel.errors import RecordingError
from chsel.methods.method import Method
from replay.events import Logged, Recorder, SessionEnded, SessionStarted
from replay.files import WritingError, file_digest
from replay.registration import symmetry_for_errors
from runners.run.display import Display
from runners.run.recording import open_recorder, write_in_run_folder
from runners.run.scene import ProbeConfig, Scene
from runners.run.session_run import Row, SessionRun


class Interrupt:
    """Within this context the first Ctrl-C is remembered, and the second takes effect at once."""

    def __init__(self) -> None:
        self._asked = False
        self._previous = signal.getsignal(signal.SIGINT)

    def __enter__(self) -> Self:
        signal.signal(signal.SIGINT, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed."""
        if self._asked:
            raise KeyboardInterrupt

    def _remember(self, _: int, __: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True


def run(
    folder: Path,
    config: ProbeConfig,
    method: Method,
    scene: Scene,
    started: SessionStarted,
    interrupt: Interrupt,
    display: Display,
) -> bool:
    """Run the session to its end or to Ctrl-C; whether it was interrupted."""
    if started.session == "recorded":  # the title was printed before its object was known
        display.say(f"object: {started.object}")
    steering = scene.steering
    display.probes(scene.session.count if steering is None else steering.policy.settings.probes)

    def show(stage: str, iteration: int, total: int) -> None:
        interrupt.check()
        display.working(stage, iteration, total)

    scene.watcher.show = show
    recorder = open_recorder(folder, config.recording)
    session_run = SessionRun(
        scene.session,
        scene.online(method.online, config.seed),
        method,
        recorder,
        symmetry=symmetry_for_errors(started),
        recording=config.recording,
        show=show,
        opening=scene.warnings,
        steering=steering,
    )
    display.warn(scene.warnings)
    rows: list[Row] = []
    ending = _Ending(folder, recorder, session_run, started, scene, rows)
    try:
        recorder.record(started)
        recorder.flush()
        for _, row in session_run.steps():
            rows.append(row)
            display.probe(row)
            display.warn(session_run.warnings)
            interrupt.check()
        display.warn(session_run.warnings)
        outcome = "finished"
    except KeyboardInterrupt:
        outcome = "interrupted"
    except SystemExit:  # the reader of the output has closed it
        ending.finish("interrupted")
        raise
    except Exception as error:
        with suppress(OSError, WritingError):  # the first error is the one to report
            ending.finish(f"failed: {error}")
        raise
    finally:
        display.close()
    ending.finish(outcome)
    if scene.report is not None:
        display.sensed(scene.report)
    display.table(rows)
    if outcome == "interrupted":
        display.say("interrupted: the recording holds everything up to here")
    if steering is not None:
        display.stopped(steering)
    display.written(folder, ending.sizes())
    display.pose(rows, folder)
    display.verdict(session_run.trust)
    return outcome == "interrupted"


@dataclass(frozen=True, eq=False)
class _Ending:
    """What a run writes when it ends: the end of the recording, and summary.json."""

    folder: Path
    recorder: Recorder
    session_run: SessionRun
    started: SessionStarted
    scene: Scene
    rows: list[Row]

    def finish(self, outcome: str) -> None:
        """End the recording, and write the summary even if the recording is what has failed."""
        finished = outcome == "finished"
        try:
            with nullcontext() if finished else suppress(RecordingError):
                self._end_recording("info" if finished else "warning", outcome)
        except RecordingError as error:
            with suppress(OSError, WritingError):  # the first error is the one to report
                self._summarise(f"failed: {error}")
            raise
        self._summarise(outcome)

    def _end_recording(self, level: str, outcome: str) -> None:
        step = self.session_run.step
        try:
            self.recorder.record(Logged(step, level, f"session {outcome}"))
            self.recorder.record(SessionEnded(step, outcome))
        finally:
            self.recorder.close()

    def _summarise(self, outcome: str) -> None:
        """Write the outcome, warnings, and the numbers of every step, times included."""
        started, trust, report = self.started, self.session_run.trust, self.scene.report
        sensors = report.total().items() if report else ()
        recording = self.folder / "recording.mcap"
        summary = {
            "runner": started.runner,
            "object": started.object,
            "session": started.session,
            "method": started.method,
            "seed": started.seed,
            "outcome": outcome,
            "recording_digest": file_digest(recording) if recording.is_file() else None,
            "trust": None if trust is None else asdict(trust),  # of the last result
            "warnings": [asdict(warning) for warning in self.session_run.warnings],
            "sensors": {name: asdict(counts) for name, counts in sensors},
            "steps": self.rows,
            "bytes": self.sizes(),
            "environment": dict(started.environment),
        }
        write_in_run_folder(self.folder / "summary.json", json.dumps(summary, indent=2) + "\n")

    def sizes(self) -> dict[str, int]:
        """Bytes of the files in the run's folder."""
        return {file.name: file.stat().st_size for file in sorted(self.folder.iterdir())}
