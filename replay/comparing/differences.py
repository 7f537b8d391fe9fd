"""Differences of values and events to the bit, in words and in units in the last place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chsel.events import (
    Decided,
    Event,
    HypothesesFound,
    Measured,
    ProblemPosed,
    SensorImage,
    SnapshotTaken,
    Traced,
)

ABSENT = object()
"""Stands for a value that one side does not have."""
RELATIVE, ABSOLUTE = 1e-9, 1e-12
"""Tolerance of a measured number beside the recorded one: libraries may round otherwise."""

ERRORS = 1e-4
"""m or rad: how far errors to the true pose may be, as symmetries depend on LAPACK and libigl."""

MEASURED = "the measured values"
Content = dict[str, Any]
"""Arrays, numbers, texts and None by path, such as "config.method.cost.free_scale"."""

_OF_OTHER_EVENTS = {"sdf", "points", "actions", "hand"}  # in a problem
_NOT_RECORDED = {"trust", "candidates"}  # of hypotheses
_SETTINGS = "config"  # of a session: numbers that people wrote, with no last place to count in
_LONGEST_TEXT = 60
_SIGN = np.uint64(2**63)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A field whose two values differ."""

    field: str  # its name; empty where something as a whole has no counterpart
    text: str  # what is different, with the name
    ulps: int | None = None  # units in the last place, the most over an array; None: not a double


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[Difference]:
    """Return the differences between two contents, in the order of the first."""
    pairs = (
        difference(name, first.get(name, ABSENT), second=second.get(name, ABSENT))
        for name in dict.fromkeys([*first, *second])
    )
    return [found for found in pairs if found is not None]


def difference(name: str, first: Any, *, second: Any) -> Difference | None:
    """Return how two values differ, or None if they have the same type and the same bits."""
    if _is_equal(first, second):
        return None
    distance = None if name.startswith(_SETTINGS) else _largest_ulps(first, second)
    if _are_alike(first, second):
        text = f"{name}: {_array_difference(first, second)}"
    elif isinstance(first, bytes) and isinstance(second, bytes):
        text = f"{name}: {len(first)} bytes -> {len(second)} others"
    else:
        text = f"{name}: {_shown(first)} -> {_shown(second)}"
        text += "" if distance is None else f" ({distance} ulp)"
    return Difference(field=name, text=text, ulps=distance)


def ulps(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.uint64]:
    """Return steps between neighbouring doubles from each number to the other, entry by entry.

    -0.0 is right below 0.0. Of two equal NaN it is 0, as of all numbers with the same bits.
    """
    a, b = _ranks(left), _ranks(right)
    return np.where(a > b, a - b, b - a)


def _is_equal(first: Any, second: Any) -> bool:
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return _are_alike(first, second) and first.tobytes() == second.tobytes()
    if type(first) is not type(second):
        return False
    if isinstance(first, float):
        return np.float64(first).tobytes() == np.float64(second).tobytes()
    return first is second or bool(first == second)


def _are_alike(first: Any, second: Any) -> bool:
    """Return whether both are arrays of one type and shape."""
    both = isinstance(first, np.ndarray) and isinstance(second, np.ndarray)
    return both and first.dtype == second.dtype and first.shape == second.shape


def _largest_ulps(first: Any, second: Any) -> int | None:
    """Return the most units in the last place between doubles, or arrays of one shape."""
    if isinstance(first, float) and isinstance(second, float):
        first, second = np.array([first]), np.array([second])
    if not _are_alike(first, second) or first.dtype != np.float64:
        return None
    return int(ulps(first, second).max(initial=0))


def _array_difference(first: NDArray[Any], second: NDArray[Any]) -> str:
    """Return in how many entries two arrays of one type and shape differ, and where first."""
    if first.dtype != np.float64:
        unequal = np.flatnonzero((_bytes(first) != _bytes(second)).any(axis=1))
        return f"{len(unequal)} of {first.size} entries, the first at {unequal[0]}"
    steps = ulps(first, second).ravel()
    unequal = np.flatnonzero(steps)
    with np.errstate(invalid="ignore"):
        largest = float(np.nanmax(np.abs(first - second), initial=0.0))
    return (
        f"{len(unequal)} of {first.size} numbers by up to {steps.max()} ulp "
        f"({largest:.3g}), the first at {unequal[0]}"
    )


def _bytes(entries: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes (N, B) of each entry of an array."""
    return np.frombuffer(entries.tobytes(), dtype=np.uint8).reshape(entries.size, -1)


def _ranks(numbers: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the rank of each number in the order of all doubles."""
    bits = np.ascontiguousarray(numbers, dtype=np.float64).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _shown(value: Any) -> str:
    if value is ABSENT:
        return "absent"
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    text = value if isinstance(value, str) and value.isprintable() else repr(value)
    return text if len(text) <= _LONGEST_TEXT else f"{text[: _LONGEST_TEXT - 1]}…"


@dataclass
class ResultDifferences:
    """The differences of a registration or decision from the recorded one, stage by stage."""

    stage: str = ""  # the first that differs; empty if none does
    before: int = 0  # how many stages before it are equal
    lines: list[str] = field(default_factory=list)
    largest_ulps: int = 0  # over all numbers in these lines

    def add(self, stage: str, lines: Sequence[str] = (), *, ulps: int = 0) -> None:
        """Add the lines of a stage that differs."""
        self.stage = self.stage or stage
        self.lines += lines
        self.largest_ulps = max(self.largest_ulps, ulps)


def result_differences(recorded: Sequence[Event], other: Sequence[Event]) -> ResultDifferences:
    """Compare the events of two registrations, or two decisions, in the order of the recorded."""
    found = ResultDifferences()
    others = _by_stage(other)
    for stage, values in _by_stage(recorded).items():
        if stage not in others:
            found.add(f"{stage}, which does not come about")
            continue
        left, right = values, others[stage]
        if stage == MEASURED:
            left, right = _out_of_tolerance(left, right)
        differing = differences(left, right)
        if not differing:
            found.before += not found.stage
        elif "digest" in values or (stage.startswith("archive") and found.stage):
            found.add(stage)  # of no interest to people
        else:
            ulps = max(item.ulps or 0 for item in differing)
            found.add(stage, [item.text for item in differing], ulps=ulps)
    if not recorded and others:
        found.add("a registration, which is not recorded")
    if MEASURED in others and not any(isinstance(event, Measured) for event in recorded):
        found.add(f"{MEASURED}, which are not recorded")
    return found


def event_name(event: Event) -> tuple[str, int, str]:
    """Return topic, step, and stage and iteration of a trace or archive, or the sensor of an image.

    Events of the same name belong together, in their order.
    """
    about = ""
    match event:
        case Traced():
            about = f"{event.stage} iteration {event.iteration}"
        case SnapshotTaken():
            passes = event.archive.refinement
            about = f"iteration {event.archive.iteration}" + f" (pass {passes + 1})" * (passes > 0)
        case SensorImage():
            about = event.sensor
    return event.topic, event.step, about


def content(event: Event) -> Content:
    """Return all that an event says; of a problem, what no other event says."""
    parts = dict(_parts(event))
    parts.pop("step", None)
    if isinstance(event, ProblemPosed | Decided):
        problem = dict(_parts(parts.pop("problem")))
        parts = {name: problem[name] for name in problem if name not in _OF_OTHER_EVENTS} | parts
    for name in ("archive", "hypotheses", "decision"):  # paths begin behind these
        parts |= dict(_parts(parts.pop(name, {})))
    return dict(_leaves("", {name: parts[name] for name in parts if name not in _NOT_RECORDED}))


def _stages(event: Event) -> dict[str, Content]:
    """Return the content of a result by the stages of its method."""
    values = content(event)
    match event:
        case ProblemPosed():
            pushes, prior = (
                {name: values[name] for name in values if name.split(".")[0] == part}
                for part in ("pushes", "prior")
            )
            return {
                "making E_0": {"E_0": values["initial_set"]},
                "making E_l": {"E_l": values["low_cost_set"]},
                "pushes": pushes,
                "prior": prior,
            }
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
            return {"belief": belief | {"verdict": values["verdict"]}, **stages}
    return {}


def _by_stage(events: Sequence[Event]) -> dict[str, Content]:
    """Return content by a name of its stage; those of later passes are numbered."""
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
    """Return the recorded numbers that the other lacks, or has outside their tolerance."""
    far = [name for name in recorded if not is_close(recorded[name], other.get(name), name=name)]
    one, two = ({name: of[name] for name in far if name in of} for of in (recorded, other))
    return one, two


def is_close(recorded: float, other: float | None, *, name: str) -> bool:
    """Return whether a measured number of this name may be in place of the recorded one."""
    if other is None:
        return False
    absolute = ERRORS if name.endswith("_error") else ABSOLUTE
    both_nan = math.isnan(recorded) and math.isnan(other)
    return both_nan or math.isclose(recorded, other, rel_tol=RELATIVE, abs_tol=absolute)


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields of a value that has some."""
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
    """Yield the leaves of nested values, with their paths."""
    parts = list(_parts(value))
    for name, inner in parts:
        dot = "." if path and not name.startswith("[") else ""
        yield from _leaves(f"{path}{dot}{name}", inner)
    if not parts:
        yield path, value
