"""What can be exported of a recording: hypotheses, points, archives, numbers, images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

from chsel.problem.poses import inverse
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from replay.arguments import chosen_steps
from replay.export import Exported, require_any
from replay.export_images import exported_images
from replay.mcap.contents import Contents
from replay.mcap.event_messages import step_numbers
from replay.mcap.foxglove_messages import poses_in_world
from replay.mcap.reader import Recording
from replay.mcap.schemas import NUMBERS

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ENTRIES = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
_OF_HYPOTHESES = ("object_from_world", "cost", "duplicate", "cell")
_OF_ARCHIVES = ("cells", "objectives", "measures", "solutions", "lower", "upper")


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
    arrays: dict[str, Any] = {"steps": np.array(list(found), dtype=np.int64)}
    listed = []
    for step, hypotheses in found.items():
        parts = {name: getattr(hypotheses, name) for name in _OF_HYPOTHESES}
        arrays |= {f"step_{step}/{name}": part for name, part in parts.items()}
        listed.append({"step": step, **parts})
    truth = recording.start.world_from_object
    if truth is not None:
        arrays["true_world_from_object"] = truth
    document = {"true_world_from_object": truth, "steps": listed}
    header = ("step", "rank", "cost", "duplicate", "cell", *_POSE, *_ENTRIES)
    rows = (row for step, hypotheses in found.items() for row in _hypothesis_rows(step, hypotheses))
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
    first = probes[0].step if probes else 0
    news.insert(0, (first, recording.start.initial_points))
    require_any(recording, "point", any(new.count for _, new in news))
    existing = list(dict.fromkeys(step for step, _ in news))
    chosen = set(chosen_steps(steps, existing))
    news = [(step, new) for step, new in news if step in chosen]
    arrays: dict[str, Any] = {}
    for name in ("free", "occupied", "known"):
        groups = [getattr(new, name) for _, new in news]
        arrays[name] = np.concatenate([np.zeros((0, 3)), *groups])
        counts = [len(group) for group in groups]
        arrays[f"{name}_step"] = np.repeat(np.array([s for s, _ in news], np.int64), counts)
    arrays["known_sdf"] = np.concatenate([np.zeros(0), *(new.sdf for _, new in news)])
    if recording.start.world_from_object is not None:
        arrays["world_from_object"] = recording.start.world_from_object
    header = ("x", "y", "z", "kind", "sdf", "step")
    return Exported(arrays.items(), arrays, header, _point_rows(arrays))


def exported_archive(recording: Recording, steps: str | None, *, last: bool = False) -> Exported:
    """The archive over each registration, or as it is at the end.

    npz: `steps` (S,); for snapshot I of step K, `step_K/snapshot_I/` with `iteration`,
    `refinement`, `measure_names` (k,), `shape` (k,), `lower` (k,), `upper` (k,), `cells` (C,),
    `objectives` (C,), `measures` (C, k), `solutions` (C, d). csv: a row an occupied cell.
    """
    taken = {step: _archives(recording, step, last=last) for step in recording.steps}
    taken = {step: archives for step, archives in taken.items() if archives}
    require_any(recording, "archive", taken)
    taken = {step: taken[step] for step in chosen_steps(steps, list(taken))}
    arrays: dict[str, Any] = {"steps": np.array(list(taken), dtype=np.int64)}
    listed = []
    for step, archives in taken.items():
        for index, archive in enumerate(archives):
            parts = _archive_parts(archive)
            arrays |= {f"step_{step}/snapshot_{index}/{name}": p for name, p in parts.items()}
            listed.append({"step": step, "snapshot": index, **parts})
    every = [archive for archives in taken.values() for archive in archives]
    measures = max((archive.measures.shape[1] for archive in every), default=0)
    length = max((archive.solutions.shape[1] for archive in every), default=0)
    named = ("step", "snapshot", "iteration", "refinement", "cell", "objective")
    of_measures = tuple(f"measure_{i}" for i in range(measures))
    header = (*named, *of_measures, *(f"solution_{i}" for i in range(length)))
    rows = _archive_rows(taken, measures, length)
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


EXPORTS = {
    "hypotheses": exported_hypotheses,
    "points": exported_points,
    "archive": exported_archive,
    "metrics": exported_metrics,
    "images": exported_images,
}
"""By the name that `--what` takes."""


def _hypothesis_rows(step: int, hypotheses: Hypotheses) -> Iterator[tuple[Any, ...]]:
    poses = PosesInFrame.FromString(poses_in_world(inverse(hypotheses.object_from_world), 0)).poses
    columns = (hypotheses.cost, hypotheses.duplicate, hypotheses.cell)
    flat = hypotheses.object_from_world.reshape(-1, 16)
    for rank, (pose, entries, *values) in enumerate(
        zip(poses, flat.tolist(), *(column.tolist() for column in columns), strict=True)
    ):
        position, turn = pose.position, pose.orientation
        seven = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
        yield (step, rank, *values, *seven, *entries)


def _point_rows(arrays: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for kind in ("free", "occupied", "known"):
        sdf = arrays["known_sdf"].tolist() if kind == "known" else [None] * len(arrays[kind])
        steps = arrays[f"{kind}_step"].tolist()
        for point, distance, step in zip(arrays[kind].tolist(), sdf, steps, strict=True):
            yield (*point, kind, distance, step)


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


def _archive_rows(
    taken: dict[int, list[ArchiveSnapshot]], measures: int, length: int
) -> Iterator[tuple[Any, ...]]:
    for step, archives in taken.items():
        for index, archive in enumerate(archives):
            columns = (archive.cells, archive.objectives, archive.measures, archive.solutions)
            of_cells = zip(*(column.tolist() for column in columns), strict=True)
            for cell, objective, measure, solution in of_cells:
                named = (step, index, archive.iteration, archive.refinement, cell, objective)
                yield (*named, *_padded(measure, measures), *_padded(solution, length))


def _padded(values: Sequence[float], length: int) -> list[float | None]:
    return [*values, *[None] * (length - len(values))]


def _metric_rows(recording: Recording) -> Iterator[tuple[int, str, str, float]]:
    """Step, source, name and value: what is known after all probes, then step by step."""
    contents = Contents()
    numbers: list[tuple[int, str, str, float]] = []
    for event in recording.events(images=False):
        contents.take(event)
        if event.topic in NUMBERS:
            source = event.topic.strip("/")
            numbers += [(event.step, source, *item) for item in step_numbers(event).items()]
    for row in contents.rows:
        for name in ("free", "occupied", "known", "contacts"):
            yield row.step, "contents", name, float(getattr(row, name))
        if row.hypotheses >= 0:
            for name in ("hypotheses", "distinct", "best_cost"):
                yield row.step, "contents", name, float(getattr(row, name))
    yield from numbers
