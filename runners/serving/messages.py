"""Requests to a served session, and its answers, as JSON has them: docs/serve.md describes each."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from chsel.errors import PointsError, SettingError, quoted, require_choice
from chsel.next_probe.decision_problem import Actions
from chsel.problem.mesh import clean_mesh, load_mesh
from chsel.problem.object_symmetry import symmetry_from_settings
from chsel.problem.points import FREE_RESOLUTION, POINT_CLASSES, Workspace
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.poses import inverse
from chsel.problem.settings import CheckedSettings, build_settings, not_negative, positive
from chsel.session.session import Session

if TYPE_CHECKING:
    import trimesh

Json = dict[str, Any]
_FORECASTS = ("score", "hit_chance", "blocked_chance", "expected_spread")
_NAMES = ("float32", "float64", "int32", "uint16", "uint8")
_DTYPES = {name: np.dtype(name).newbyteorder("<") for name in _NAMES}
_PACKED = f"dtype ({', '.join(_DTYPES)}), shape and base64 of as many little-endian numbers"


@dataclass(frozen=True)
class ResumeRequest(CheckedSettings):
    """The arguments of `chsel.Session.resume`; source and record are names of files."""

    source: str
    step: Annotated[int | None, not_negative] = None
    method: str | None = None
    policy: str | None = None
    hand: Any = None
    record: str | None = None


@dataclass(frozen=True)
class OpenRequest(CheckedSettings):
    """The arguments of `chsel.Session`; record is the name of a file."""

    target: Any
    method: str | None = None
    preset: str = "default"
    settings: Any = None
    policy: str = "expected_loss"
    hand: Any = None
    workspace: Workspace | None = None
    noise: Annotated[float | None, positive] = None
    resolution: Annotated[float | None, positive] = None
    free_resolution: Annotated[float, positive] = FREE_RESOLUTION
    seed: Annotated[int, not_negative] = 0
    record: str | None = None
    prior: Any = None
    symmetry: Any = None


def parsed(body: bytes) -> Json:
    """Return the JSON object of a request; an empty body is an empty one."""
    try:
        values = json.loads(body or b"{}")
    except (ValueError, RecursionError) as error:
        raise SettingError(f"the body is not JSON ({error}); accepted: a JSON object") from None
    if not isinstance(values, dict):
        raise SettingError(f"the body is {quoted(values)}; accepted: a JSON object")
    return values


def open_session(body: bytes, folder: Path) -> tuple[Session, Json]:
    """Return a new session, recorded in the folder, and the answer to its client."""
    given = parsed(body)
    if "source" in given:
        return _resumed(given, folder)
    request = build_settings(OpenRequest, given, where="open")
    arguments = dict(vars(request))
    if not isinstance(request.target, str):  # whose path also names the object
        arguments["target"] = _mesh("target", request.target)
    if request.hand is not None:
        arguments["hand"] = _mesh("hand", request.hand)
    if request.record is not None:
        arguments["record"] = _file("record", request.record, folder=folder)
    arguments["prior"] = prior_from_settings("prior", request.prior)
    arguments["symmetry"] = symmetry_from_settings("symmetry", request.symmetry)
    session = Session(**arguments)
    return session, {"object": session.started.object, "record": arguments["record"]}


def _resumed(given: Json, folder: Path) -> tuple[Session, Json]:
    """Return a session that goes on from a recording in the folder, and the answer."""
    request = build_settings(ResumeRequest, given, where="open")
    record = None
    if request.record is not None:
        record = _file("record", request.record, folder=folder)
    session = Session.resume(
        _file("source", request.source, folder=folder),
        step=request.step,
        method=request.method,
        policy=request.policy,
        hand=None if request.hand is None else _mesh("hand", request.hand),
        record=record,
    )
    about = {"object": session.started.object, "record": record, "step": session.step}
    return session, about


def _file(name: str, given: str, *, folder: Path) -> str:
    """Return the path of a file in the server's folder. Raise SettingError for other places."""
    if Path(given).name != given or not given.isprintable():
        accepted = "accepted: a name, of a file in the server's folder"
        raise SettingError(f"{name} is {quoted(given)}; {accepted}")
    return str(folder.resolve() / given)


def add(session: Session, values: Json) -> Json:
    """Add what became known."""
    hand = values.pop("hand", None)
    arrays = _arrays(values)
    session.add(**arrays, hand=None if hand is None else _mesh("hand", hand))
    points = session.points
    counts = {name: len(getattr(points, name)) for name in POINT_CLASSES}
    return {"step": session.step, "points": counts, "warnings": _warnings(session)}


def register(session: Session, values: Json) -> Json:
    """Register, and answer with the poses."""
    hypotheses = session.register()
    trust = hypotheses.trust
    return {
        "step": session.step,
        "pose": session.pose,
        "world_from_object": inverse(hypotheses.object_from_world),
        "object_from_world": hypotheses.object_from_world,
        "cost": hypotheses.cost,
        "duplicate": hypotheses.duplicate,
        "trust": None if trust is None else {"text": str(trust), **asdict(trust)},
        "warnings": _warnings(session),
    }


def next_probe(session: Session, values: Json) -> Json:
    """Choose the next probe, of those that are given or of the session."""
    arrays = _arrays(values)
    if arrays and not arrays.keys() >= {"world_from_hand", "length"}:
        raise SettingError("actions are incomplete; accepted: world_from_hand and length")
    probe = session.next_probe(Actions(**arrays) if arrays else None)
    if probe is None:
        return {"step": session.step, "action": None, "stop": session.stop}
    return {
        "step": session.step,
        "action": probe.action,
        "stop": "",
        "world_from_hand": probe.world_from_hand,
        "length": probe.length,
        "spread": probe.decision.spread,
        **{name: getattr(probe.decision, name) for name in _FORECASTS},
    }


def close(session: Session, _: Json) -> Json:
    """End the recording."""
    session.close()
    return {"step": session.step}


REQUESTS: dict[str, tuple[Callable[[Session, Json], Json], tuple[str, ...]]] = {
    "add": (add, tuple(signature(Session.add).parameters)[1:]),
    "register": (register, ()),
    "next_probe": (next_probe, tuple(Actions.__dataclass_fields__)),
    "close": (close, ()),
}
"""The function that answers a request to a session, and the names that the request may have."""


def answered(request: str, session: Session, *, body: bytes) -> Json:
    """Return the answer to one of REQUESTS."""
    answer, accepted = REQUESTS[request]
    values = parsed(body)
    for name in values:
        require_choice(f"a name in {request}", name, accepted=accepted or ["no names"])
    return answer(session, values)


def plain(value: Any) -> Any:
    """Return an answer as lists and numbers; those that are not finite are None."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _warnings(session: Session) -> list[Json]:
    return [asdict(warning) for warning in session.warnings]


def _mesh(name: str, value: Any) -> trimesh.Trimesh:
    """Return the mesh in a file of the server, or of vertices (V, 3), metres, and faces (F, 3)."""
    if isinstance(value, str):
        return load_mesh(value)
    if not isinstance(value, Mapping) or value.keys() != {"vertices", "faces"}:
        accepted = "the path of a mesh, or vertices and faces"
        raise SettingError(f"{name} is {quoted(value)}; accepted: {accepted}")
    arrays = _arrays(value)
    return clean_mesh(arrays.get("vertices"), arrays.get("faces"), name=name)


def _arrays(values: Mapping[str, Any]) -> Json:
    """Return the arrays: nested lists, NaN for null, or packed; nulls are left out."""
    arrays = {}
    for name, value in values.items():
        try:
            if isinstance(value, Mapping):
                data = base64.b64decode(value["base64"], validate=True)
                numbers = np.frombuffer(data, _DTYPES[value["dtype"]]).reshape(value["shape"])
                arrays[name] = numbers.astype(np.float64) * float(value.get("scale", 1.0))
            elif value is not None:
                arrays[name] = np.array(value, dtype=np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            accepted = f"accepted: nested lists of numbers, or {_PACKED}"
            raise PointsError(f"{name} is not an array of numbers; {accepted}") from None
    return arrays
