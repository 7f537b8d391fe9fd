"""What can be exported of a recording, by name: here all but decisions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chsel.problem.poses import inverse, quaternions
from chsel.problem.registration_problem import ArchiveSnapshot
from replay.arguments import chosen_steps
from replay.content.export_decisions import exported_decisions
from replay.content.export_files import Exported, require_any
from replay.content.step_rows import StepRows
from replay.events import SensorImage
from replay.mcap.event_messages import step_numbers
from replay.mcap.foxglove_messages import POINT_CLASSES
from replay.mcap.reader import Recording
from replay.mcap.schemas import NUMBERS

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ENTRIES = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
_OF_HYPOTHESES = ("object_from_world", "cost", "duplicate", "cell")
_OF_ARCHIVES = ("cells", "objectives", "measures", "solutions", "lower", "upper")
_OF_IMAGES = ("values", "mask", "intrinsics", "world_from_camera")


def exported_hypotheses(recording: Recording, steps: str | None) -> Exported:
    """The hypotheses of each step, best first.

    npz: `steps` (S,), the steps that have some; `step_K/object_from_world` (B, 4, 4),
    `step_K/cost` (B,), `step_K/duplicate` (B,), `step_K/cell` (B,); `true_world_from_object`
    (4, 4) where it is known. csv: a row a hypothesis; x, y, z (metres) and the unit quaternion
    qx to qw are of world_from_object, rounded; m00 to m33 are object_from_world, exact.
    """
    results = [step for step in recording.steps if recording.has_result(step)]
    require_any(recording, "result", results)
    found = {step: recording.hypotheses(step) for step in chosen_steps(steps, results)}
    parts = {s: {name: getattr(found[s], name) for name in _OF_HYPOTHESES} for s in found}
    truth = recording.start.world_from_object
    arrays: dict[str, Any] = {"steps": np.array(list(found), dtype=np.int64)}
    for step, part in parts.items():
        arrays |= _in_folder(f"step_{step}", part)
    if truth is not None:
        arrays["true_world_from_object"] = truth
    listed = [{"step": step, **part} for step, part in parts.items()]
    document = {"true_world_from_object": truth, "steps": listed}
    header = ("step", "rank", "cost", "duplicate", "cell", *_POSE, *_ENTRIES)
    rows = (
        (step, rank, *row)
        for step, each in found.items()
        for rank, row in enumerate(
            _rows(
                each.cost,
                each.duplicate,
                each.cell,
                *_positions_and_quaternions(inverse(each.object_from_world)),
                each.object_from_world.reshape(-1, 16),
            )
        )
    )
    return Exported(arrays.items(), document, header, rows)


def exported_points(recording: Recording, steps: str | None) -> Exported:
    """The points that became known at each step, in their order, as `session=points` reads them.

    npz: `free` (N, 3), `occupied` (K, 3), `known` (M, 3), metres, with `known_sdf` (M,), the steps
    `free_step`, `occupied_step`, `known_step`, and `world_from_object` (4, 4) where it is known.
    csv: a row a point. Contacts are known points of signed distance 0. What was known before the
    first probe stands first, at the step of that probe.
    """
    probes = recording.probes
    news = [(probe.step, probe.new_points) for probe in probes]
    news.insert(0, (probes[0].step if probes else 0, recording.start.initial_points))
    require_any(recording, "point", any(new.count for _, new in news))
    chosen = set(chosen_steps(steps, list(dict.fromkeys(step for step, _ in news))))
    news = [(step, new) for step, new in news if step in chosen]
    arrays: dict[str, Any] = {}
    for name in POINT_CLASSES:
        groups = [getattr(new, name) for _, new in news]
        arrays[name] = np.concatenate([np.zeros((0, 3)), *groups])
        counts = [len(group) for group in groups]
        arrays[f"{name}_step"] = np.repeat(np.array([s for s, _ in news], np.int64), counts)
    arrays["known_sdf"] = np.concatenate([np.zeros(0), *(new.sdf for _, new in news)])
    if recording.start.world_from_object is not None:
        arrays["world_from_object"] = recording.start.world_from_object
    header = ("x", "y", "z", "kind", "sdf", "step")
    rows = (
        (*point, kind, distance, step)
        for kind in POINT_CLASSES
        for *point, distance, step in _rows(
            arrays[kind],
            arrays["known_sdf"] if kind == "known" else np.full(len(arrays[kind]), None),
            arrays[f"{kind}_step"],
        )
    )
    return Exported(arrays.items(), arrays, header, rows)


def exported_archive(recording: Recording, steps: str | None, *, last: bool = False) -> Exported:
    """The archive over each registration, or as it is at the end.

    npz: `steps` (S,); for snapshot I of step K, `step_K/snapshot_I/` with `iteration`,
    `refinement`, `measure_names` (k,), `shape` (k,), `lower` (k,), `upper` (k,), `cells` (C,),
    `objectives` (C,), `measures` (C, k), `solutions` (C, d). csv: a row an occupied cell.
    """
    taken = {step: _archives(recording, step, last=last) for step in recording.steps}
    taken = {step: archives for step, archives in taken.items() if archives}
    require_any(recording, "archive", taken)
    chosen = chosen_steps(steps, list(taken))
    numbered = [(step, *pair) for step in chosen for pair in enumerate(taken[step])]
    arrays: dict[str, Any] = {"steps": np.array(chosen, dtype=np.int64)}
    listed = []
    for step, index, archive in numbered:
        parts = _archive_parts(archive)
        arrays |= _in_folder(f"step_{step}/snapshot_{index}", parts)
        listed.append({"step": step, "snapshot": index, **parts})
    measures = max((archive.measures.shape[1] for *_, archive in numbered), default=0)
    length = max((archive.solutions.shape[1] for *_, archive in numbered), default=0)
    named = ("step", "snapshot", "iteration", "refinement", "cell", "objective")
    of_measures = tuple(f"measure_{i}" for i in range(measures))
    header = (*named, *of_measures, *(f"solution_{i}" for i in range(length)))
    rows = (
        (step, index, archive.iteration, archive.refinement, *row)
        for step, index, archive in numbered
        for row in _rows(
            archive.cells,
            archive.objectives,
            _widened(archive.measures, measures),
            _widened(archive.solutions, length),
        )
    )
    return Exported(arrays.items(), {"snapshots": listed}, header, rows)


def exported_metrics(recording: Recording, steps: str | None) -> Exported:
    """Every recorded number about a step: a row a number, in all three forms.

    source: "contents" for counts of what is known and found, and the best cost; "measured" for
    numbers about the result, in SI units where the name has none; "timed" for seconds; the topic
    of other events with numbers about a step.
    """
    rows = list(_metric_rows(recording))
    require_any(recording, "number about a step", rows)
    chosen = set(chosen_steps(steps, sorted({row[0] for row in rows})))
    rows = [row for row in rows if row[0] in chosen]
    header = ("step", "source", "name", "value")
    columns = list(zip(*rows, strict=True)) or [()] * len(header)
    types: tuple[Any, ...] = (np.int64, np.str_, np.str_, np.float64)
    arrays = {
        name: np.array(column, dtype=kind)
        for name, column, kind in zip(header, columns, types, strict=True)
    }
    listed = [dict(zip(header, row, strict=True)) for row in rows]
    return Exported(arrays.items(), listed, header, rows)


def exported_images(recording: Recording, steps: str | None) -> Exported:
    """The depth and deformation images of each step's sensors, in their order.

    npz: `steps` (S,), those with images; for image I of sensor NAME at step K, `step_K/NAME_I/`
    with `values` (H, W), `unit` (metres that 1 stands for; 0 is no measurement), `mask` (H, W),
    the pixels that count, `intrinsics` (4,), fx, fy, cx, cy in pixels, and `world_from_camera`
    (4, 4). csv, json: a row an image, without its pixels; m00 to m33 are world_from_camera.
    """
    require_any(recording, "image of a sensor", recording.image_steps)
    chosen = chosen_steps(steps, recording.image_steps)
    named = ("step", "sensor", "image", "kind", "height", "width", "counting", "unit")
    header = (*named, "fx", "fy", "cx", "cy", *_ENTRIES)
    rows = [_image_row(number, seen) for number, seen in _numbered(recording, chosen)]
    document = [dict(zip(header, row, strict=True)) for row in rows]
    return Exported(_image_arrays(recording, chosen), document, header, rows)


EXPORTS = {
    "hypotheses": exported_hypotheses,
    "points": exported_points,
    "archive": exported_archive,
    "metrics": exported_metrics,
    "images": exported_images,
    "decisions": exported_decisions,
}
"""By the name that `--what` takes."""


def _in_folder(folder: str, parts: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{folder}/{name}": part for name, part in parts.items()}


def _rows(*columns: NDArray[Any]) -> Iterator[list[Any]]:
    """Plain values of arrays (N,) and (N, k), row by row."""
    for parts in zip(*(column.tolist() for column in columns), strict=True):
        row: list[Any] = []
        for part in parts:
            row.extend(part if isinstance(part, list) else [part])
        yield row


def _positions_and_quaternions(poses: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Positions (B, 3) and unit quaternions x, y, z, w (B, 4) of poses (B, 4, 4)."""
    return poses[:, :3, 3], quaternions(poses[:, :3, :3])


def _widened(values: NDArray[Any], width: int) -> NDArray[Any]:
    """Values (N, k) with columns of None up to a width."""
    wide = np.full((len(values), width), None)
    wide[:, : values.shape[1]] = values
    return wide


def _archives(recording: Recording, step: int, *, last: bool) -> list[ArchiveSnapshot]:
    """The snapshots of a step, and its last archive if that is not among them."""
    taken = recording.snapshots(step)
    final = recording.hypotheses(step).archive if recording.has_result(step) else None
    if final is not None and not any(snapshot is final for snapshot in taken):
        taken.append(final)
    return taken[-1:] if last else taken


def _archive_parts(archive: ArchiveSnapshot) -> dict[str, Any]:
    return {
        "iteration": np.int64(archive.iteration),
        "refinement": np.int64(archive.refinement),
        "measure_names": np.array(archive.measure_names, dtype=np.str_),
        "shape": np.array(archive.shape, dtype=np.int64),
        **{name: getattr(archive, name) for name in _OF_ARCHIVES},
    }


def _metric_rows(recording: Recording) -> Iterator[tuple[int, str, str, float]]:
    """Step, source, name and value: what is known after all probes, then step by step."""
    known = StepRows()
    numbers: list[tuple[int, str, str, float]] = []
    for event in recording.events(images=False):
        known.take(event)
        if event.topic in NUMBERS:
            source = event.topic.strip("/")
            numbers += [(event.step, source, *item) for item in step_numbers(event).items()]
    for row in known.rows:
        for name in ("free", "occupied", "known", "contacts"):
            yield row.step, "contents", name, float(getattr(row, name))
        if row.hypotheses >= 0:
            for name in ("hypotheses", "distinct", "best_cost"):
                yield row.step, "contents", name, float(getattr(row, name))
    yield from numbers


def _numbered(recording: Recording, steps: Sequence[int]) -> Iterator[tuple[int, SensorImage]]:
    """The images of some steps, one at a time, each with its number of its sensor and step."""
    counts: Counter[tuple[int, str]] = Counter()
    for seen in recording.sensor_images(steps):
        yield counts[seen.step, seen.sensor], seen
        counts[seen.step, seen.sensor] += 1


def _image_arrays(recording: Recording, steps: Sequence[int]) -> Iterator[tuple[str, NDArray[Any]]]:
    yield "steps", np.array(steps, dtype=np.int64)
    for number, seen in _numbered(recording, steps):
        folder = f"step_{seen.step}/{seen.sensor}_{number}"
        yield f"{folder}/unit", np.array(seen.unit)
        for name in _OF_IMAGES:
            yield f"{folder}/{name}", getattr(seen, name)


def _image_row(number: int, seen: SensorImage) -> tuple[Any, ...]:
    size = (*seen.values.shape, int(seen.mask.sum()), seen.unit)
    pose = seen.world_from_camera.ravel().tolist()
    return (seen.step, seen.sensor, number, seen.kind, *size, *seen.intrinsics.tolist(), *pose)
