"""Checks of the values of messages, and of the order of the events of a session.

The writer lets nothing else into a recording, and the reader nothing else out: a file of another
program, or a damaged one, is an error and not a wrong result. Files made to exhaust time or memory
are not defended against, but for the limit of `file.py` on what a chunk may unpack to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from chsel.errors import PoseError, RecordingError
from replay.mcap.texts import check_name, check_text

Check = Callable[[str, Any], None]
"""Takes the name of a field and its value; raises RecordingError unless that is accepted."""

RECOVERED = "recovered: "
"""Opens what a recovery adds to a recording: lines of its log, and the end if there was none."""

_ENDS = ("finished", "interrupted")
_FAILED = "failed: "
_ROUNDING = 1e-6  # of a sum of weights
_BEFORE_ALL_STEPS = -1


def one_of(*accepted: str) -> Check:
    """Return the check of a text that is one of `accepted`."""

    def check(field: str, value: str) -> None:
        if value not in accepted:
            raise RecordingError(f"{field} is {value!r}; accepted: {', '.join(accepted)}")

    return check


def between(low: float, high: float, *, unit: str) -> Check:
    """Return the check of a number from `low` to `high`, in a unit."""

    def check(field: str, value: float) -> None:
        if not low <= value <= high:
            raise RecordingError(f"{field} is {value}; accepted: {low:g} to {high:g} ({unit})")

    return check


def short_names(field: str, value: tuple[str, ...] | Mapping[str, Any]) -> None:
    """Accept short names, or a mapping with such names."""
    for item in value:
        check_name(f"a name of {field}", item)


def plain_texts(field: str, value: Mapping[str, str]) -> None:
    """Accept texts without control characters, by their names."""
    for key, text in value.items():
        check_text(f"{key} of {field}", text)


def session_end(field: str, value: str) -> None:
    """Accept the outcome of a session."""
    check_text(field, value)
    if value not in _ENDS and not value.startswith((_FAILED, RECOVERED)):
        accepted = f"{', '.join(_ENDS)}, {_FAILED}REASON, {RECOVERED}REASON"
        raise RecordingError(f"{field} is {value!r}; accepted: {accepted}")


def stop_reason(field: str, value: str) -> None:
    """Accept why a decision makes no further probe, "" if it makes one."""
    from chsel.next_probe.decision_problem import STOPS

    one_of(*STOPS)(field, value)


def verdict(field: str, value: str) -> None:
    """Accept a verdict on the result before a decision, "" without one."""
    from chsel.problem.registration_problem import VERDICTS

    one_of("", *VERDICTS)(field, value)


def sensor_name(field: str, value: str) -> None:
    """Accept a word, as names of files and topics contain it."""
    check_name(field, value)
    if not value.replace("_", "").isalnum():
        raise RecordingError(f"{field} is {value!r}; accepted: letters, digits and _")


def finite(field: str, value: Any) -> None:
    """Accept finite numbers: an array, a number, or a mapping to numbers."""
    numbers = list(value.values()) if isinstance(value, Mapping) else value
    if not np.isfinite(numbers).all():
        raise RecordingError(f"{field} has a number that is not finite; accepted: finite numbers")


def positive(field: str, value: np.ndarray) -> None:
    """Accept finite numbers above 0."""
    finite(field, value)
    if not (value > 0.0).all():
        raise RecordingError(f"{field} has {value.min():g}; accepted: above 0")


def chances(field: str, value: np.ndarray) -> None:
    """Accept numbers from 0 to 1, but for rounding."""
    if not ((value >= 0.0) & (value <= 1.0 + _ROUNDING)).all():
        raise RecordingError(f"{field} has a number that is no chance; accepted: 0 to 1")


def distribution(field: str, value: np.ndarray) -> None:
    """Accept weights (K,), of sum 1 but for rounding."""
    chances(field, value)
    if abs(float(value.sum()) - 1.0) > _ROUNDING:
        raise RecordingError(f"{field} have the sum {value.sum():g}; accepted: 1")


def not_empty(field: str, value: np.ndarray) -> None:
    """Accept an array of at least one row."""
    if len(value) == 0:
        raise RecordingError(f"{field} is empty; accepted: at least one")


def rigid(field: str, value: np.ndarray) -> None:
    """Accept rigid transforms (B, 4, 4), or one (4, 4)."""
    from chsel.problem.poses import check_rigid

    with np.errstate(all="ignore"):
        try:
            check_rigid(field, value.reshape(-1, 4, 4))
        except PoseError as error:
            raise RecordingError(str(error)) from None


def voxel_side(field: str, value: float) -> None:
    """Accept a side of voxels that a problem can have, metres."""
    from chsel.problem.sdf_grid import COARSEST, FINEST

    between(FINEST, COARSEST, unit="m")(field, value)


def intrinsics(field: str, value: np.ndarray) -> None:
    """Accept focal lengths and centre (4,) of a camera, pixels."""
    from chsel.sensing.depth_camera import MOST_FOCUS

    if not (np.abs(value) <= MOST_FOCUS).all() or not (value[:2] > 0.0).all():
        raise RecordingError(
            f"{field} are {value.tolist()}; accepted: focal lengths above 0, all up to "
            f"{MOST_FOCUS:g} (pixels)"
        )


def ascending_costs(field: str, value: np.ndarray) -> None:
    """Accept costs (B,) in ascending order; the last ones may be inf."""
    if np.isnan(value).any() or not (value[:-1] <= value[1:]).all():
        raise RecordingError(f"{field} is out of order; accepted: ascending numbers")
    if np.isneginf(value).any():
        raise RecordingError(f"{field} is -inf; accepted: finite numbers, or inf")


def numbers_of_points(field: str, value: np.ndarray) -> None:
    """Accept numbers (W,) of points, from 0, ascending, at least one."""
    not_empty(field, value)
    if value[0] < 0 or not (value[:-1] < value[1:]).all():
        raise RecordingError(f"{field} is out of order; accepted: ascending numbers, from 0")


def check_mesh(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Raise RecordingError unless vertices (V, 3) are finite and faces (F, 3) are of them."""
    if len(faces) == 0:
        raise RecordingError("the mesh has no faces; accepted: triangles")
    if not np.isfinite(vertices).all():
        raise RecordingError("the mesh has a vertex that is not finite; accepted: finite numbers")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise RecordingError("the mesh has a face that is no triangle of its vertices")


def check_hand(values: Mapping[str, Any]) -> None:
    """Raise RecordingError unless the hand of a message is a mesh, or absent."""
    vertices, faces = values["hand_vertices"], values["hand_faces"]
    if (vertices is None) is not (faces is None):
        raise RecordingError("the hand lacks its vertices or its faces; accepted: both or none")
    if vertices is not None:
        check_mesh(vertices, faces)


def check_decision(made: Mapping[str, Any]) -> None:
    """Raise RecordingError unless choice, scores and contacts of a message `Decision` agree."""
    from chsel.next_probe.forecast import MOST_POSES

    chosen = made["chosen"]
    score = made["score"]
    contacts = made["contacts"]
    if len(made["weights"]) > MOST_POSES:
        raise RecordingError(f"it has {len(made['weights'])} poses; accepted: at most {MOST_POSES}")
    if not -1 <= chosen < len(score):
        raise RecordingError(f"chosen is {chosen}; accepted: -1 to {len(score) - 1}")
    if (chosen < 0) is not bool(made["stop"]):
        raise RecordingError(f"action {chosen} is chosen with the stop {made['stop']!r}")
    if not (score < math.inf).all():
        raise RecordingError("score has NaN or inf; accepted: finite numbers, or -inf")
    if chosen >= 0 and not (made["available"][chosen] and np.isfinite(score[chosen])):
        raise RecordingError(f"action {chosen} is chosen, which cannot be taken")
    if len(contacts) not in (0, len(made["weights"])):
        counts = f"{len(contacts)} contacts for {len(made['weights'])} poses"
        raise RecordingError(f"it has {counts}; accepted: one for each, or none")
    if not (np.isfinite(contacts).all(axis=1) | np.isnan(contacts).all(axis=1)).all():
        raise RecordingError("a contact is not finite; accepted: finite numbers, or NaN alone")


def check_archive(archive: Mapping[str, Any]) -> None:
    """Raise RecordingError unless axes and cells of a message `ArchiveSnapshot` fit together."""
    from chsel.qd.selection import MOST_CELLS

    shape, occupied = archive["shape"], archive["cells"]
    counts = [len(archive[name]) for name in ("measure_names", "lower")]
    counts.append(archive["measures"].shape[-1])
    if not shape or set(counts) != {len(shape)}:
        raise RecordingError(f"it has {len(shape)} axes, but names, ranges or measures of {counts}")
    cells = math.prod(shape)
    if not 0 < cells <= MOST_CELLS or min(shape) < 1:
        raise RecordingError(f"it has {cells} cells, {shape}; accepted: 1 to {MOST_CELLS}")
    if not (archive["lower"] < archive["upper"]).all():
        raise RecordingError("it has an empty range; accepted: lower below upper")
    if len(occupied) and not (
        occupied[0] >= 0 and occupied[-1] < cells and (occupied[:-1] < occupied[1:]).all()
    ):
        raise RecordingError(f"it has cells out of order; accepted: ascending, below {cells}")


def check_hypotheses(found: Mapping[str, Any]) -> None:
    """Raise RecordingError unless poses, costs and cells of a message `Hypotheses` fit together.

    Poses that are not finite are those of a descent that diverged: their cost is not finite. Cells
    are not checked while the message leaves out the archive, as it repeats the last snapshot.
    """
    poses = found["object_from_world"]
    cost = found["cost"]
    cell = found["cell"]
    diverged = ~np.isfinite(poses).all(axis=(1, 2))
    if (np.isfinite(cost) & diverged).any():
        raise RecordingError(
            "object_from_world is not finite where the cost is; accepted: rigid transforms"
        )
    rigid("object_from_world", poses[~diverged])
    elites = found["elites"]
    rigid("elites", elites[np.isfinite(elites).all(axis=(1, 2))])
    if found["archive"] is not None or not found["archive_is_last_snapshot"]:
        check_cells(cell, () if found["archive"] is None else found["archive"]["shape"])


def check_cells(cell: np.ndarray, shape: tuple[int, ...]) -> None:
    """Raise RecordingError unless cells are of an archive of some shape, or -1."""
    cells = math.prod(shape) if shape else 0
    if len(cell) and not (cell.min() >= -1 and cell.max() < cells):
        raise RecordingError(f"cell is out of range; accepted: -1 to {cells - 1}")


def check_digest(what: str, digest: str, *, recorded: str) -> None:
    """Raise RecordingError unless a digest is the recorded one."""
    if digest != recorded:
        raise RecordingError(f"{what} has digest {digest}, not {recorded} as recorded")


class EventOrder:
    """The order of the events of one session: steps ascend, with one problem and result each."""

    def __init__(self) -> None:
        self.step = _BEFORE_ALL_STEPS  # of the last event
        self.has_rig = False  # a rig was described
        self.has_actions = False  # actions were offered
        self._probe = _BEFORE_ALL_STEPS  # the step of the last probe
        self._posed = _BEFORE_ALL_STEPS  # the step of the last problem
        self._registering = False  # a problem is posed and has no result yet
        self._decided = _BEFORE_ALL_STEPS - 1  # the step of the last decision
        self._ended = False

    def take(self, topic: str, step: int) -> None:
        """Raise RecordingError unless an event with this topic can follow those before it."""
        if self._ended:
            raise RecordingError("an event follows the end of the session")
        if not _BEFORE_ALL_STEPS <= step < 2**31:
            raise RecordingError(f"step is {step}; accepted: an integer from {_BEFORE_ALL_STEPS}")
        if step < self.step:
            raise RecordingError(f"an event of step {step} follows one of step {self.step}")
        self.step = step
        match topic:
            case "/probe":
                if step <= self._probe:
                    raise RecordingError(f"probe {step} follows probe {self._probe}")
                self._probe = step
            case "/rig":
                if self.has_rig or step != _BEFORE_ALL_STEPS:
                    raise RecordingError(
                        f"there is a rig of step {step}; accepted: one, before all steps"
                    )
                self.has_rig = True
            case "/sensor_image":
                if step <= self._probe:
                    raise RecordingError(
                        f"an image of step {step} does not precede the probe of its step"
                    )
            case "/actions":
                if step == self._decided:
                    raise RecordingError(f"the actions of step {step} follow its decision")
                self.has_actions = True
            case "/decision":
                self._check_decision(step)
                self._decided = step
            case "/problem":
                if step <= self._posed:
                    raise RecordingError(f"step {step} has a second registration problem")
                if step == self._decided:
                    raise RecordingError(f"the registration of step {step} follows its decision")
                self._posed, self._registering = step, True
            case "/archive" | "/trace" | "/hypotheses":
                if not self._registering or step != self._posed:
                    raise RecordingError(f"{topic} of step {step} is in no registration of it")
                self._registering = topic != "/hypotheses"
            case "/session_ended":
                self._ended = True

    def _check_decision(self, step: int) -> None:
        """Raise RecordingError unless a decision can be made now."""
        if not self.has_actions:
            raise RecordingError(f"a decision of step {step} has no actions before it")
        if step != self._probe:
            raise RecordingError(f"a decision of step {step} follows probe {self._probe}")
        if step == self._decided:
            raise RecordingError(f"step {step} has a second decision")
        if self._registering:
            raise RecordingError(f"a decision of step {step} stands within a registration")
