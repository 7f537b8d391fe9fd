"""The Rerun recording, made anew from the MCAP file alone."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pytest
import trimesh
from rerun.blueprint.components import PlayState
from rerun.chunk import RrdReader

from chsel.errors import RecordingError
from replay import __main__
from replay.events import Event, SessionStarted, Timed
from replay.mcap.reader import read_recording
from replay.rerun import viewer as rerun_viewer
from replay.rerun.rerun_recorder import RerunRecorder, draw_recording
from replay.rerun.viewer import web_server
from tests.tools.rrd_rows import opens_at

QUICK = ("recording=both", "recording.snapshot_interval=5")
KINEMATIC = (
    "object=drill",
    "session=kinematic",
    "session.object_resolution=0.02",
    "session.start_probe=22",
    "method.descent.restarts=2",
    "method.descent.iterations=20",
    "method.emitter.iterations=10",
    "method.archive.bins=10",
)
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in SCREENS}
UUID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
ROOT_CONTAINER = "ViewportBlueprint:root_container"
Write = Callable[[list[Event]], Path]


@pytest.fixture(scope="module", params=["kinematic", "gradient_descent"])
def run_folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both recordings of a small session: of probes, or of points with times and no true pose."""
    folder = tmp_path_factory.mktemp(request.param)
    timed_descent = ("method=gradient_descent", "recording.timings=true")
    choices = {"kinematic": KINEMATIC, "gradient_descent": (*points(folder), *timed_descent)}
    command = [
        sys.executable,
        "-m",
        "runners.probe",
        *QUICK,
        *choices[request.param],
        f"logs={folder / 'logs'}",
    ]
    subprocess.run(command, check=True, capture_output=True, env=ENVIRONMENT)
    (found,) = (folder / "logs" / "probe").iterdir()
    return found


def points(folder: Path) -> tuple[str, ...]:
    """A session of three steps on a can."""
    can = trimesh.creation.cylinder(0.04, 0.2, sections=37)
    surface = trimesh.sample.sample_surface(can, 15, seed=0)[0]
    np.savez(folder / "can.npz", surface=surface, surface_step=np.arange(15) // 5)
    can.export(folder / "can.ply")
    object_choice = ("object=mesh", f"object.path={folder / 'can.ply'}")
    return ("session=points", f"session.path={folder / 'can.npz'}", *object_choice)


def content(path: Path) -> list[list[tuple[str, ...]]]:
    """All that a Rerun file says: the rows of each entity, for its data and for each layout.

    Without what differs from one write to the next: row ids, the wall clock of a layout, and the
    random names of views, which are numbered in their order.
    """
    reader = RrdReader(path)
    stores = [*reader.recordings(), *reader.blueprints()]
    in_order = sorted((_rows(reader, store) for store in stores), key=lambda rows: rows[0][0])
    return [_comparable(rows) for rows in in_order]


def _rows(reader: RrdReader, store: Any) -> list[tuple[Any, ...]]:
    """Row id, entity and values of each row in the order in which they were logged."""
    rows = []
    for chunk in reader.stream(store=store).to_chunks():
        batch = chunk.to_record_batch()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        keys = columns.pop("rerun.controls.RowId").to_pylist()
        columns.pop("log_time", None)
        for index, key in enumerate(keys):
            values = {name: column.slice(index, 1) for name, column in columns.items()}
            there = {name: exact(value) for name, value in values.items() if not value.null_count}
            if ROOT_CONTAINER in there:  # the one name that is not text
                bits = values[ROOT_CONTAINER].to_pylist()[0][0]
                there[ROOT_CONTAINER] = str(uuid.UUID(bytes=bytes(bits)))
            rows.append((key, chunk.entity_path, tuple(sorted(there.items()))))
    return sorted(rows, key=lambda row: row[0])


def _comparable(rows: list[tuple[Any, ...]]) -> list[tuple[str, ...]]:
    names: dict[str, str] = {}

    def numbered(found: re.Match[str]) -> str:
        return names.setdefault(found[0], f"#{len(names)}")

    texts = [tuple(UUID.sub(numbered, str(part)) for part in row) for _, *row in rows]
    return sorted(texts, key=lambda row: row[0])


def exact(values: pa.Array) -> Any:
    """Type, lengths and values of an array; NaN equals itself, and zero is not minus zero."""
    kind = values.type
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        lengths = pa.compute.list_value_length(values).to_pylist()
        return str(kind), lengths, exact(values.flatten())
    if pa.types.is_floating(kind):
        return str(kind), values.to_numpy(zero_copy_only=False).tobytes().hex()
    return str(kind), values.to_pylist()


def test_it_is_equal_to_the_one_that_the_run_wrote(run_folder: Path, tmp_path: Path) -> None:
    recording = read_recording(run_folder / "recording.mcap")
    draw_recording(recording, tmp_path / "again.rrd")
    written, again = content(run_folder / "recording.rrd"), content(tmp_path / "again.rrd")
    assert len(again) == len(written)
    for rows, rows_again in zip(written, again, strict=True):
        for row, row_again in zip(rows, rows_again, strict=True):
            assert row_again == row
    hypotheses = [row for rows in written for row in rows if "hypotheses/best" in row[0]]
    assert len(hypotheses) > len(recording.steps)


def test_a_difference_in_one_bit_is_one_in_content(events: list[Event], tmp_path: Path) -> None:
    def drawn(name: str, events: list[Event]) -> list[list[tuple[str, ...]]]:
        recorder = RerunRecorder(tmp_path / name)
        for event in events:
            recorder.record(event)
        recorder.close()
        return content(tmp_path / name)

    first = drawn("a.rrd", events)
    assert drawn("b.rrd", events) == first
    index, timed = next((n, e) for n, e in enumerate(events) if isinstance(e, Timed))
    seconds = {name: np.nextafter(value, 1.0) for name, value in timed.seconds.items()}
    later = dataclasses.replace(timed, seconds=seconds)
    assert drawn("c.rrd", [*events[:index], later, *events[index + 1 :]]) != first
    untimed = [event for event in events if not isinstance(event, Timed)]
    assert len(drawn("d.rrd", untimed)) == len(first) - 1  # one layout less


def test_what_an_mcap_file_does_not_keep_is_not_drawn(
    events: list[Event], tmp_path: Path, write: Write
) -> None:
    start = events[0]
    assert isinstance(start, SessionStarted)
    upward = np.tile([0.0, 0.0, 1.0], (len(start.mesh.vertices), 1))
    mesh = trimesh.Trimesh(start.mesh.vertices, start.mesh.faces, vertex_normals=upward)
    shared = [1, 2]
    start = dataclasses.replace(start, mesh=mesh, config={"a": shared, "b": shared})
    recorder = RerunRecorder(tmp_path / "a.rrd")
    recorder.record(start)
    recorder.close()
    draw_recording(read_recording(write([start])), tmp_path / "b.rrd")
    assert content(tmp_path / "b.rrd") == content(tmp_path / "a.rrd")


def test_save_writes_a_new_file_and_opens_nothing(
    events: list[Event], tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    file, saved = write(events), tmp_path / "saved.rrd"
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 0
    assert capsys.readouterr().out.strip() == str(saved)
    draw_recording(read_recording(file), tmp_path / "drawn.rrd")
    assert content(saved) == content(tmp_path / "drawn.rrd")
    before = saved.read_bytes()
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 2
    assert "saved.rrd exists; accepted: the name of a new file" in capsys.readouterr().err
    assert saved.read_bytes() == before


def test_nothing_after_the_step_asked_for_is_saved(
    events: list[Event], tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    file, saved = str(write(events)), tmp_path / "saved.rrd"
    assert __main__.main(["view", file, "--save", str(saved), "--step", "7"]) == 2
    assert "has no probe 7; accepted: 0 to 2" in capsys.readouterr().err
    assert not saved.exists()
    assert __main__.main(["view", file, "--save", str(saved), "--step", "1"]) == 0
    probes = {
        step
        for chunk in RrdReader(saved).stream().to_chunks()
        if "probe" in chunk.timeline_names
        for step in chunk.to_record_batch().column("probe").to_pylist()
    }
    assert max(probes) == 1
    assert opens_at(saved) == ("probe", PlayState.Following)  # at that probe, the last


def test_it_opens_at_the_first_registration(
    events: list[Event], tmp_path: Path, write: Write
) -> None:
    draw_recording(read_recording(write(events)), tmp_path / "a.rrd")
    assert opens_at(tmp_path / "a.rrd") == ("registration", PlayState.Paused)


def test_what_is_whole_of_an_unfinished_file_is_drawn_with_a_warning(
    events: list[Event], tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    file, saved = write(events), tmp_path / "saved.rrd"
    file.write_bytes(file.read_bytes()[:-1])
    assert __main__.main(["view", str(file), "--save", str(saved)]) == 0
    assert "is unfinished; what is whole of it is shown" in capsys.readouterr().err
    whole = read_recording(file, partial=True)
    assert len(list(whole.events())) == len(events)
    assert any("/scene/hypotheses/best" in row[0] for rows in content(saved) for row in rows)


def test_nothing_is_left_of_a_file_that_cannot_be_drawn(
    events: list[Event], tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read_recording(write(events))

    def some_events() -> Iterator[Event]:
        yield events[0]
        raise RecordingError("the problem of step 1 is not the recorded one")

    monkeypatch.setattr(recording, "events", some_events)
    with pytest.raises(RecordingError, match="is not the recorded one"):
        draw_recording(recording, tmp_path / "a.rrd")
    assert not (tmp_path / "a.rrd").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a screen")
def test_without_a_screen_the_other_ways_are_named(
    events: list[Event],
    write: Write,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in SCREENS:
        monkeypatch.delenv(name, raising=False)
    assert __main__.main(["view", str(write(events))]) == 2
    error = capsys.readouterr().err
    assert "there is no screen" in error
    assert "accepted: --save OUT.rrd, or --web" in error


def test_a_viewer_that_does_not_start_says_why(
    events: list[Event],
    tmp_path: Path,
    write: Write,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    program = tmp_path / "viewer"
    program.write_text("#!/bin/sh\necho no graphics today\nexit 1\n")
    program.chmod(0o700)
    monkeypatch.setattr(rerun_viewer, "viewer_program", lambda: program)
    monkeypatch.setenv("DISPLAY", ":99")
    file = str(write(events))
    assert __main__.main(["view", file]) == 2
    assert "the Rerun viewer does not start: no graphics today" in capsys.readouterr().err


@pytest.mark.usefixtures("interruptible")
@pytest.mark.skipif(os.name == "nt", reason="there are no such signals on Windows")
@pytest.mark.parametrize(("ending", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_web_viewer_is_served_here_alone_and_ends_with_the_command(
    events: list[Event], tmp_path: Path, write: Write, ending: signal.Signals, status: int
) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    command = [sys.executable, "-m", "replay", "view", str(write(events)), "--web"]
    environment = {**ENVIRONMENT, "TMPDIR": str(folder), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as viewing:
        try:
            assert viewing.stdout is not None
            address = viewing.stdout.readline().strip()
            page, data = map(int, re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address))
            with urllib.request.urlopen(f"http://127.0.0.1:{page}/") as answer:
                assert b"<html" in answer.read()
            assert rerun_viewer.is_listening(data)
            assert [file.name for file in folder.rglob("*.rrd")] == ["recording.rrd"]
            viewing.send_signal(ending)
            assert viewing.wait(30.0) == status
        finally:
            viewing.kill()  # else the block would wait for one that a failure has left behind
    assert not rerun_viewer.is_listening(page)
    assert not rerun_viewer.is_listening(data)
    assert list(folder.iterdir()) == []


def test_the_web_viewer_ends_with_the_block(tmp_path: Path, events: list[Event]) -> None:
    recorder = RerunRecorder(tmp_path / "a.rrd")
    recorder.record(events[0])
    recorder.close()
    with web_server(tmp_path / "a.rrd") as (server, _):
        assert server.poll() is None
    assert server.poll() is not None
