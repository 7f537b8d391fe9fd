"""What differs between events: of two recordings, or of a recorded result and today's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from replay.comparing.differences import differences
from replay.events import (
    Decided,
    Event,
    HypothesesFound,
    Measured,
    ProblemPosed,
    SensorImage,
    SnapshotTaken,
    Traced,
)

RELATIVE, ABSOLUTE = 1e-9, 1e-12
"""How far a measured number may be from the recorded one: libraries may round otherwise."""

ERRORS = 1e-4
"""m or rad: how far errors to the true pose may be, as symmetries depend on LAPACK and libigl."""

MEASURED = "the measured values"
Content = dict[str, Any]
"""Arrays, numbers, texts and None by path, such as "config.method.cost.free_scale"."""

_OF_OTHER_EVENTS = {"sdf", "points", "actions", "hand"}  # in a problem
_NOT_RECORDED = {"trust", "candidates"}  # of hypotheses


@dataclass
class ResultDifferences:
    """What differs between a recorded registration or decision and another one, stage by stage."""

    stage: str = ""  # the first that differs; empty if none does
    before: int = 0  # how many stages before it are equal
    lines: list[str] = field(default_factory=list)
    largest_ulps: int = 0  # over all numbers in these lines

    def add(self, stage: str, lines: Sequence[str] = (), *, ulps: int = 0) -> None:
        """A stage differs."""
        self.stage = self.stage or stage
        self.lines += lines
        self.largest_ulps = max(self.largest_ulps, ulps)


def result_differences(recorded: Sequence[Event], other: Sequence[Event]) -> ResultDifferences:
    """Compare the events of two registrations, or two decisions, in the order of the recorded."""
    found, others = ResultDifferences(), _by_stage(other)
    for stage, values in _by_stage(recorded).items():
        if stage not in others:
            found.add(f"{stage}, which does not come about")
            continue
        pair = values, others[stage]
        differing = differences(*(_out_of_tolerance(*pair) if stage == MEASURED else pair))
        if not differing:
            found.before += not found.stage
        elif "digest" in values or (stage.startswith("archive") and found.stage):
            found.add(stage)  # of no interest to people
        else:
            ulps = max(item.ulps or 0 for item in differing)
            found.add(stage, [item.text for item in differing], ulps=ulps)
    if MEASURED in others and not any(isinstance(event, Measured) for event in recorded):
        found.add(f"{MEASURED}, which are not recorded")
    return found


def event_name(event: Event) -> tuple[str, int, str]:
    """Topic, step, and stage and iteration of a trace or archive, or the sensor of an image.

    Events of the same name belong together, in their order.
    """
    about = ""
    match event:
        case Traced():
            about = f"{event.stage} iteration {event.iteration}"
        case SnapshotTaken():
            again = event.archive.refinement
            about = f"iteration {event.archive.iteration}" + f" (pass {again + 1})" * (again > 0)
        case SensorImage():
            about = event.sensor
    return event.topic, event.step, about


def content(event: Event) -> Content:
    """All that an event says; of a problem, what no other event says."""
    parts = dict(_parts(event))
    parts.pop("step", None)
    if isinstance(event, ProblemPosed | Decided):
        problem = dict(_parts(parts.pop("problem")))
        parts = {name: problem[name] for name in problem if name not in _OF_OTHER_EVENTS} | parts
    for name in ("archive", "hypotheses", "decision"):  # paths begin behind these
        parts |= dict(_parts(parts.pop(name, {})))
    return dict(_leaves("", {name: parts[name] for name in parts if name not in _NOT_RECORDED}))


def _stages(event: Event) -> dict[str, Content]:
    """What a result says, by the stages in which it comes about."""
    values = content(event)
    match event:
        case ProblemPosed():
            sets = {"E_0": values["initial_set"], "E_l": values["low_cost_set"]}
            return {f"making {name}": {name: poses} for name, poses in sets.items()}
        case Traced():
            return {f"{event.stage}, iteration {event.iteration}": values}
        case SnapshotTaken():
            return {f"archive, iteration {event.archive.iteration}": values}
        case HypothesesFound():
            archive = {name: values.pop(name) for name in [*values] if name.startswith("archive")}
            return {"choosing the hypotheses": values, "the last archive": archive}
        case Measured():
            return {MEASURED: values}
        case Decided():
            belief = {name: values.pop(name) for name in [*values] if name.startswith("belief")}
            made = [part.name for part in fields(event.decision)] + ["surprise"]
            stages = {name.replace("_", " "): {name: values[name]} for name in made}
            return {"belief": belief, **stages}
    return {}


def _by_stage(events: Sequence[Event]) -> dict[str, Content]:
    """Content by a name of its stage; those of later passes are numbered."""
    named: dict[str, Content] = {}
    for event in events:
        for stage, values in _stages(event).items():
            name, number = stage, 1
            while name in named:
                number += 1
                name = f"{stage} (pass {number})"
            named[name] = values
    return named


def _out_of_tolerance(recorded: Content, other: Content) -> tuple[Content, Content]:
    """The recorded numbers that the other lacks, or has outside their tolerance."""
    far = [name for name in recorded if not is_close(recorded[name], other.get(name), name)]
    one, two = ({name: of[name] for name in far if name in of} for of in (recorded, other))
    return one, two


def is_close(recorded: float, other: float | None, name: str) -> bool:
    """Whether a measured number of this name may be in place of the recorded one."""
    if other is None:
        return False
    absolute = ERRORS if name.endswith("_error") else ABSOLUTE
    both_nan = math.isnan(recorded) and math.isnan(other)
    return both_nan or math.isclose(recorded, other, rel_tol=RELATIVE, abs_tol=absolute)


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    """The fields of a value that has some."""
    if hasattr(value, "vertices"):  # a mesh or hand, which have more than these
        yield "vertices", np.asarray(value.vertices)
        yield "faces", np.asarray(value.faces)
    elif is_dataclass(value):
        yield from ((part.name, getattr(value, part.name)) for part in fields(value))
    elif isinstance(value, Mapping):
        yield from ((str(name), inner) for name, inner in value.items())
    elif isinstance(value, list | tuple):
        yield from ((f"[{index}]", inner) for index, inner in enumerate(value))


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What is at the ends of nested values, with its path."""
    parts = list(_parts(value))
    for name, inner in parts:
        dot = "." if path and not name.startswith("[") else ""
        yield from _leaves(f"{path}{dot}{name}", inner)
    if not parts:
        yield path, value
