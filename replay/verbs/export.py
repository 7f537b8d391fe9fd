"""Write hypotheses, modes, points, archives, numbers, images or decisions as npz, csv or json.

An npz file holds arrays, a csv or json file a table. Numbers are exact. NaN is an empty cell in a
csv file; NaN and infinity are null in a json file.
"""

from __future__ import annotations

import argparse
import inspect
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rich.filesize import decimal

from chsel.errors import RecordingError, SettingError
from chsel.events import Believed, SensorImage
from chsel.next_probe.decision_problem import Actions
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import POINT_CLASSES
from chsel.problem.poses import inverse, quaternions
from chsel.problem.registration_problem import ArchiveSnapshot
from replay.arguments import STEPS_HELP, chosen_steps, path_argument
from replay.comparing.beliefs import BeliefSequence
from replay.console import Console
from replay.files import new_file
from replay.mcap.event_messages import step_numbers
from replay.mcap.reader import Recording, read_recording
from replay.mcap.schemas import NUMBERS
from replay.verbs.info import step_rows

FORMATS = ("npz", "csv", "json")
_MILLIMETRES = 1000.0  # in a metre
_OF_HYPOTHESES = ("object_from_world", "cost", "duplicate", "cell")
_OF_ARCHIVES = tuple(field.name for field in fields(ArchiveSnapshot))
_OF_IMAGES = ("values", "unit", "mask", "intrinsics", "world_from_camera")
_OF_ACTIONS = ("score", "hit_chance", "blocked_chance", "expected_spread")
_OF_DECISIONS = ("chosen", "stop", "spread", *_OF_ACTIONS, "contacts")


class Exported(NamedTuple):
    """The arrays of an npz file by their names, and the table of a csv or json file."""

    arrays: Iterable[tuple[str, Any]]
    table: pd.DataFrame


def exported_hypotheses(recording: Recording, steps: str | None) -> Exported:
    """Return the hypotheses of each step, best first.

    npz: `steps` (S,), the steps that have some; `step_K/object_from_world` (B, 4, 4),
    `step_K/cost` (B,), `step_K/duplicate` (B,), `step_K/cell` (B,); `true_world_from_object`
    (4, 4) where it is known, and `step_K/true_world_from_object` where pushes moved it. Table: a
    row a hypothesis; x, y, z (metres) and the unit quaternion qx to qw are of world_from_object,
    rounded; m00 to m33 are object_from_world, exact.
    """
    results = [step for step in recording.steps if recording.has_result(step)]
    chosen = _chosen(recording, steps, existing=results, name="result")
    arrays: dict[str, Any] = {"steps": np.array(chosen, dtype=np.int64)}
    if recording.start.world_from_object is not None:
        arrays["true_world_from_object"] = recording.start.world_from_object
    tables = []
    for step in chosen:
        found, at_step = recording.hypotheses(step), recording.start_at(step)
        arrays |= {f"step_{step}/{name}": getattr(found, name) for name in _OF_HYPOTHESES}
        if at_step is not recording.start:
            arrays[f"step_{step}/true_world_from_object"] = at_step.world_from_object
        poses = inverse(found.object_from_world)
        columns = {
            "step": np.full(len(poses), step),
            "rank": np.arange(len(poses)),
            "cost": found.cost,
            "duplicate": found.duplicate.astype(int),
            "cell": found.cell,
            **dict(zip("xyz", poses[:, :3, 3].T, strict=True)),
            **dict(zip(("qx", "qy", "qz", "qw"), quaternions(poses[:, :3, :3]).T, strict=True)),
        }
        tables.append(pd.DataFrame(columns | _entries(found.object_from_world)))
    return Exported(arrays.items(), pd.concat(tables))


def exported_bop(recording: Recording, steps: str | None) -> Exported:
    """Return the hypotheses of a session of a BOP dataset as results of the BOP challenge.

    Table: a row a hypothesis, the best first, duplicates left out: scene_id, im_id, obj_id, score,
    which is minus the cost, R of object to camera by rows, t in millimetres, and time, -1 as none
    is recorded. npz: `scene_id`, `im_id`, `obj_id`, `score` (B,), `camera_from_object` (B, 4, 4).
    """
    session = recording.start.config.get("session")
    if not isinstance(session, Mapping) or session.get("kind") != "bop":
        raise RecordingError(
            f"recording {recording.path} has no image of a BOP dataset; accepted: one of "
            "session=bop"
        )
    numbers = {
        "scene_id": session["scene"],
        "im_id": session["image"],
        "obj_id": session["object_id"],
    }
    results = [step for step in recording.steps if recording.has_result(step)]
    chosen = _chosen(recording, steps, existing=results, name="result")
    found = recording.hypotheses(chosen[-1])
    kept = ~found.duplicate
    poses = inverse(found.object_from_world[kept])  # the camera is the world
    score = -found.cost[kept]
    arrays = {**numbers, "score": score, "camera_from_object": poses}
    columns = {
        **{name: np.full(len(poses), number) for name, number in numbers.items()},
        "score": score,
        "R": [_spaced(pose[:3, :3]) for pose in poses],
        "t": [_spaced(_MILLIMETRES * pose[:3, 3]) for pose in poses],
        "time": np.full(len(poses), -1),
    }
    return Exported(arrays.items(), pd.DataFrame(columns))


def _spaced(numbers: FloatArray) -> str:
    """Return numbers, exact, with spaces between."""
    return " ".join(repr(value) for value in numbers.ravel().tolist())


def exported_points(recording: Recording, steps: str | None) -> Exported:
    """Return the points that became known at each step, in order, as `session=points` reads them.

    npz: `free` (N, 3), `occupied` (K, 3), `known` (M, 3), metres, with `known_sdf` (M,), the steps
    `free_step`, `occupied_step`, `known_step`, and `world_from_object` (4, 4) where it is known.
    Where normals are known, `known_normal` (M, 3), 0 where one is not, and `known_normal_noise`
    (M,), radians. Table: a row a point; nx, ny, nz and normal_noise where normals are known.
    Contacts are known points of signed distance 0. What was known before the first probe stands
    first, at the step of that probe.
    """
    probes = recording.probes
    news = [(probe.step, probe.new_points) for probe in probes]
    news.insert(0, (probes[0].step if probes else 0, recording.start.initial_points))
    existing = list(dict.fromkeys(step for step, _ in news))
    if not any(new.count for _, new in news):
        existing = []
    chosen = _chosen(recording, steps, existing=existing, name="point")
    news = [(step, new) for step, new in news if step in chosen]
    arrays: dict[str, Any] = {"known_sdf": np.concatenate([new.sdf for _, new in news])}
    with_normals = any(new.has_normals for _, new in news)
    if with_normals:
        arrays["known_normal"] = np.concatenate([new.normals for _, new in news])
        arrays["known_normal_noise"] = np.concatenate([new.normal_noise for _, new in news])
    tables = []
    for kind in POINT_CLASSES:
        groups = [getattr(new, kind) for _, new in news]
        arrays[kind] = np.concatenate(groups)
        arrays[f"{kind}_step"] = np.repeat([step for step, _ in news], list(map(len, groups)))
        columns = dict(zip("xyz", arrays[kind].T, strict=True)) | {"kind": kind}
        columns["sdf"] = arrays["known_sdf"] if kind == "known" else np.nan
        columns["step"] = arrays[f"{kind}_step"]
        if with_normals:
            columns |= _normal_columns(arrays if kind == "known" else {})
        tables.append(pd.DataFrame(columns))
    if recording.start.world_from_object is not None:
        arrays["world_from_object"] = recording.start.world_from_object
    return Exported(arrays.items(), pd.concat(tables))


def _normal_columns(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of known normals; NaN in rows without one."""
    names = ("nx", "ny", "nz", "normal_noise")
    if not arrays:
        return dict.fromkeys(names, np.nan)
    noise = arrays["known_normal_noise"]
    known = np.where(noise > 0.0, 1.0, np.nan)
    columns = [*arrays["known_normal"].T, noise]
    return {name: column * known for name, column in zip(names, columns, strict=True)}


def exported_archive(recording: Recording, steps: str | None) -> Exported:
    """Return the archive over each registration; the last snapshot of a step is that of its result.

    npz: `steps` (S,); for snapshot I of step K, `step_K/snapshot_I/` with `iteration`,
    `refinement`, `measure_names` (k,), `shape` (k,), `lower` (k,), `upper` (k,), `cells` (C,),
    `objectives` (C,), `measures` (C, k), `solutions` (C, d). Table: a row an occupied cell.
    """
    taken = {step: _archives(recording, step) for step in recording.steps}
    chosen = _chosen(
        recording, steps, existing=[step for step in taken if taken[step]], name="archive"
    )
    arrays: dict[str, Any] = {"steps": np.array(chosen, dtype=np.int64)}
    tables = []
    for step in chosen:
        for index, archive in enumerate(taken[step]):
            folder = f"step_{step}/snapshot_{index}"
            arrays |= {f"{folder}/{name}": getattr(archive, name) for name in _OF_ARCHIVES}
            columns = {
                "step": np.full(len(archive.cells), step),
                "snapshot": index,
                "iteration": archive.iteration,
                "refinement": archive.refinement,
                "cell": archive.cells,
                "objective": archive.objectives,
                **{f"measure_{i}": column for i, column in enumerate(archive.measures.T)},
                **{f"solution_{i}": column for i, column in enumerate(archive.solutions.T)},
            }
            tables.append(pd.DataFrame(columns))
    return Exported(arrays.items(), pd.concat(tables))


def exported_metrics(recording: Recording, steps: str | None) -> Exported:
    """Return every recorded number about a step: a row a number, in all three forms.

    source: "contents" for counts of what is known and found, and the best cost; "measured" for
    numbers about the result, in SI units where the name has none; "timed" for seconds.
    """
    rows = [
        (row["step"], "contents", name, float(value))
        for row in step_rows(recording)
        for name, value in row.items()
        if name not in ("step", "posed") and value is not None
    ]
    for event in recording.events(images=False):
        if event.topic in NUMBERS:
            source = event.topic.strip("/")
            rows += [(event.step, source, *item) for item in step_numbers(event).items()]
    existing = sorted({row[0] for row in rows})
    chosen = _chosen(recording, steps, existing=existing, name="number about a step")
    table = pd.DataFrame(rows, columns=["step", "source", "name", "value"])
    table = table[table["step"].isin(chosen)]
    arrays = {name: table[name].to_numpy() for name in table}
    texts = {name: arrays[name].astype(np.str_) for name in ("source", "name")}
    return Exported((arrays | texts).items(), table)


def exported_images(recording: Recording, steps: str | None) -> Exported:
    """Return the depth and deformation images of each step's sensors, in their order.

    npz: `steps` (S,), those with images; for image I of sensor NAME at step K, `step_K/NAME_I/`
    with `values` (H, W), `unit` (metres that 1 stands for; 0 is no measurement), `mask` (H, W),
    the pixels that count, `intrinsics` (4,), fx, fy, cx, cy in pixels, and `world_from_camera`
    (4, 4). Table: a row an image, without its pixels; m00 to m33 are world_from_camera.
    """
    chosen = _chosen(recording, steps, existing=recording.image_steps, name="image of a sensor")
    rows = [
        {
            "step": seen.step,
            "sensor": seen.sensor,
            "image": number,
            "kind": seen.kind,
            "height": seen.values.shape[0],
            "width": seen.values.shape[1],
            "counting": seen.mask.sum(),
            "unit": seen.unit,
            **dict(zip(("fx", "fy", "cx", "cy"), seen.intrinsics, strict=True)),
            **_entries(seen.world_from_camera),
        }
        for number, seen in _numbered(recording, chosen)
    ]
    return Exported(_image_arrays(recording, chosen), pd.DataFrame(rows))


def exported_decisions(recording: Recording, steps: str | None) -> Exported:
    """Return the decisions of a session, one after each step, -1 before the first probe.

    npz: `steps` (S,); `actions/world_from_hand` (A, 4, 4), `actions/length` (A,), metres, and
    where it is known `actions/seconds` (A,); `step_K/chosen`, the index of the action taken, -1
    for none, `step_K/stop`, why, `step_K/spread`, metres, `step_K/surprise`, nats, of the outcome
    of probe K; `step_K/poses` (P, 4, 4), object_from_world, and `step_K/weights` (P,) of the
    belief; `step_K/available` (A,), `step_K/score` (A,), `step_K/hit_chance` (A,),
    `step_K/blocked_chance` (A,), `step_K/expected_spread` (A,), metres; `step_K/contacts` (P, 3),
    where the chosen action meets the object in each pose, NaN where it does not. `actions/` has
    the actions offered first; where a decision was on others, `step_K/world_from_hand`,
    `step_K/length` and `step_K/seconds` have them. Table: a row a decision; x, y, z (metres) are
    the start of the chosen action, dx, dy, dz its direction.
    """
    chosen = _chosen(recording, steps, existing=recording.decision_steps, name="decision")
    assert recording.offered is not None  # as there is a decision
    first = recording.offered.actions
    arrays: dict[str, Any] = {"steps": np.array(chosen, dtype=np.int64)}
    arrays |= {f"actions/{name}": part for name, part in _parts_of(first).items()}
    config = recording.start.config.get("policy")
    rows = []
    policy = config.get("name", "") if isinstance(config, Mapping) else ""
    for step in chosen:
        decided = recording.decision(step)
        problem, decision = decided.problem, decided.decision
        actions = problem.actions
        parts = {name: getattr(decision, name) for name in _OF_DECISIONS}
        parts |= {"surprise": decided.surprise, "available": problem.available}
        if actions.digest != first.digest:
            parts |= _parts_of(actions)
        parts |= {"poses": problem.belief.object_from_world, "weights": problem.belief.weights}
        arrays |= {f"step_{step}/{name}": part for name, part in parts.items()}
        numbers = np.full(6 + len(_OF_ACTIONS), np.nan)  # without an action
        if decision.chosen >= 0:
            pose = actions.world_from_hand[decision.chosen]
            values = [parts[name][decision.chosen] for name in _OF_ACTIONS]
            numbers = np.array([*pose[:3, 3], *pose[:3, 2], *values])
        names = ("x", "y", "z", "dx", "dy", "dz", *_OF_ACTIONS)
        row = {"step": step, "policy": policy, "chosen": decision.chosen}
        row |= dict(zip(names, numbers, strict=True))
        rows.append(row | {name: parts[name] for name in ("spread", "surprise", "stop")})
    return Exported(arrays.items(), pd.DataFrame(rows))


def _parts_of(actions: Actions) -> dict[str, FloatArray]:
    """Return the arrays of actions by their names, those that are there."""
    parts = {field.name: getattr(actions, field.name) for field in fields(actions)}
    return {name: part for name, part in parts.items() if part is not None}


def exported_modes(recording: Recording, steps: str | None) -> Exported:
    """Return the modes of each recorded belief, or without one those computed of each result.

    npz: `steps` (S,); of step K `step_K/numbers` (M,), the same for a mode at all steps,
    `step_K/weights` (M,), `step_K/object_from_world` (M, 4, 4), `step_K/centres` (M, 3), of the
    object, world, metres, `step_K/covariances` (M, 6, 6), of centres (metres) and rotation vectors
    (radians), world axes, and `step_K/spread`, metres. Table: a row a mode; x, y, z are its centre,
    position_deviation (metres) and rotation_deviation (radians) roots of the covariance's traces,
    m00 to m33 object_from_world.
    """
    believed = {e.step: e for e in recording.events(images=False) if isinstance(e, Believed)}
    believed = believed or {e.step: e for e in _beliefs(recording)}
    chosen = _chosen(recording, steps, existing=[*believed], name="belief")
    arrays: dict[str, Any] = {"steps": np.array(chosen, dtype=np.int64)}
    tables = []
    for step in chosen:
        parts = {name: part for name, part in vars(believed[step]).items() if name != "step"}
        arrays |= {f"step_{step}/{name}": part for name, part in parts.items()}
        squares = np.diagonal(parts["covariances"], axis1=1, axis2=2)
        columns = {
            "step": np.full(len(squares), step),
            "number": parts["numbers"],
            "weight": parts["weights"],
            **dict(zip("xyz", parts["centres"].T, strict=True)),
            "position_deviation": np.sqrt(squares[:, :3].sum(axis=1)),
            "rotation_deviation": np.sqrt(squares[:, 3:].sum(axis=1)),
        }
        tables.append(pd.DataFrame(columns | _entries(parts["object_from_world"])))
    return Exported(arrays.items(), pd.concat(tables))


def _beliefs(recording: Recording) -> Iterator[Believed]:
    """Yield the beliefs of all results that have a pose."""
    results = [step for step in recording.steps if recording.has_result(step)]
    beliefs = BeliefSequence(recording) if results else None
    for step in results:
        assert beliefs is not None
        belief = beliefs.after(recording.problem(step), recording.hypotheses(step))
        if belief is not None:
            yield belief.event(step)


EXPORTS = {
    "hypotheses": exported_hypotheses,
    "modes": exported_modes,
    "points": exported_points,
    "archive": exported_archive,
    "metrics": exported_metrics,
    "images": exported_images,
    "decisions": exported_decisions,
    "bop": exported_bop,
}
"""Exports by the name that `--what` takes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what to export, of which steps, in which form, where."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n\n".join(f"{name}: {inspect.getdoc(of)}" for name, of in EXPORTS.items())
    parser.add_argument("file", metavar="FILE", help="a recording")
    parser.add_argument("--what", required=True, choices=EXPORTS, help="what to write")
    parser.add_argument("--format", choices=FORMATS, help="npz, or as the name of OUT ends")
    parser.add_argument(
        "-o",
        "--out",
        type=path_argument,
        help="a new file; else RECORDING_WHAT.FORMAT in this folder",
    )
    parser.add_argument("--steps", metavar="A..B", help=STEPS_HELP)


def run(given: argparse.Namespace) -> int:
    """Write the file and say where it is."""
    file_format = _format(given.format, given.out)
    recording = read_recording(given.file)
    exported = EXPORTS[given.what](recording, given.steps)
    path = given.out or Path(f"{recording.path.stem}_{given.what}.{file_format}")
    write_export(exported, path, file_format=file_format)
    console = Console(soft_wrap=True)
    console.print(f"{path}  {decimal(path.stat().st_size)}")
    if given.what == "points" and file_format != "json":
        lower, upper = recording.start.workspace.lower, recording.start.workspace.upper
        bounds = ",".join(f"[{a!r},{b!r}]" for a, b in zip(lower, upper, strict=True))
        normals = " session.normals=file" if "nx" in exported.table else ""
        console.print(
            f"probe with these: python -m runners.probe object=NAME session=points "
            f"session.path={path} 'session.workspace=[{bounds}]' "
            f"session.free_resolution={recording.start.free_resolution!r}{normals}",
        )
    return 0


def write_export(exported: Exported, path: Path, *, file_format: str) -> None:
    """Write a new file. RecordingError if it exists or cannot be written."""
    table = exported.table
    with new_file(path) as beside, beside.open("xb") as file:
        if file_format == "npz":
            np.savez(file, **dict(exported.arrays))
        elif file_format == "csv":
            table.to_csv(file, index=False)
        else:
            finite = table.notna() & ~table.isin([np.inf, -np.inf])
            rows = table.astype(object).where(finite, None).to_dict("records")
            file.write(json.dumps(rows, allow_nan=False).encode() + b"\n")


def _chosen(
    recording: Recording, steps: str | None, *, existing: Sequence[int], name: str
) -> tuple[int, ...]:
    """Return the chosen steps that have what is asked for; raise RecordingError if none has."""
    if not existing:
        raise RecordingError(f"recording {recording.path} has no {name}; accepted: one with some")
    return chosen_steps(steps, existing)


def _entries(matrices: FloatArray) -> dict[str, Any]:
    """Return the entries of matrices (..., 4, 4), each by its row and column."""
    return {f"m{row}{column}": matrices.T[column, row] for row, column in np.ndindex(4, 4)}


def _archives(recording: Recording, step: int) -> list[ArchiveSnapshot]:
    """Return the snapshots of a step, and its last archive if that is not among them."""
    taken = recording.snapshots(step)
    final = recording.hypotheses(step).archive if recording.has_result(step) else None
    if final is not None and not any(snapshot is final for snapshot in taken):
        taken.append(final)
    return taken


def _numbered(recording: Recording, steps: Sequence[int]) -> Iterator[tuple[int, SensorImage]]:
    """Yield the images of some steps one at a time, each with its number in sensor and step."""
    counts: Counter[tuple[int, str]] = Counter()
    for seen in recording.sensor_images(steps):
        yield counts[seen.step, seen.sensor], seen
        counts[seen.step, seen.sensor] += 1


def _image_arrays(recording: Recording, steps: Sequence[int]) -> Iterator[tuple[str, Any]]:
    yield "steps", np.array(steps, dtype=np.int64)
    for number, seen in _numbered(recording, steps):
        for name in _OF_IMAGES:
            yield f"step_{seen.step}/{seen.sensor}_{number}/{name}", getattr(seen, name)


def _format(named: str | None, out: Path | None) -> str:
    """Return the format that is asked for, by its name or by that of the file."""
    suffix = out.suffix.lower().removeprefix(".") if out is not None else ""
    if out is not None and suffix not in FORMATS:
        accepted = ", ".join(f".{name}" for name in FORMATS)
        raise SettingError(f"{out} ends in {out.suffix or 'no suffix'}; accepted: {accepted}")
    if named is not None and suffix not in ("", named):
        raise SettingError(f"--format is {named} and {out} ends in {suffix}; accepted: one of them")
    return named or suffix or "npz"
