"""Plausible sets in files that are found again by the points and the definition they belong to."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, EvaluationError
from chsel.numerics.arrays import FloatArray, digest, frozen
from chsel.plausible.plausible_set import PlausibleSet, rotation_seed
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.problem.file_checks import read_npz
from chsel.problem.poses import check_rigid
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import build_settings

FORMAT = 1
MOST_BYTES = 4 * 2**30  # of a file, unpacked: 30 million members
_UNREADABLE = (ChselError, ValueError, TypeError, KeyError, OverflowError)


def plausible_path(folder: Path, problem: RegistrationProblem, settings: PlausibleSettings) -> Path:
    """Where the set of a problem is kept: FOLDER/<points digest>_<definition digest>.npz."""
    seed = rotation_seed(problem, settings)
    return folder / _name(problem.points.digest, settings, seed, problem.sdf.digest)


def save_plausible(folder: Path, members: PlausibleSet) -> Path:
    """Write a set into a folder, under the name by which `load_plausible` finds it."""
    settings = members.settings
    name = _name(members.points_digest, settings, members.seed, members.sdf_digest)
    path, beside = folder / name, folder / f".{name}.{os.urandom(4).hex()}"
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "world_from_object": members.world_from_object,
        "cost": members.cost,
        "local": members.local,
        "index": members.index,
        "index_cost": members.index_cost,
        "true_pose": members.truth,
        "true_cost": np.array(members.true_cost),
        "epsilon": np.array(settings.epsilon),
        "settings": np.array(settings.text),
        "seed": np.array(members.seed, dtype=np.uint64),
        "points_digest": np.array(members.points_digest),
        "sdf_digest": np.array(members.sdf_digest),
        "digest": np.array(members.digest),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            np.savez_compressed(file, **arrays)
        beside.replace(path)
    except OSError as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise EvaluationError(
            f"plausible set {path} cannot be written ({error.strerror or error}); accepted: a "
            "folder that can be written"
        ) from None
    return path


def load_plausible(
    folder: Path,
    problem: RegistrationProblem,
    settings: PlausibleSettings,
    *,
    world_from_object: FloatArray | None = None,
) -> PlausibleSet | None:
    """The set of a problem by a definition, around this true pose if given; None if there is none.

    Raises EvaluationError for a file under that name that is damaged or belongs to other points,
    another object, definition or true pose.
    """
    path = plausible_path(folder, problem, settings)
    if not path.exists():
        return None
    members = read_plausible(path)
    expected = {
        "known points": (members.points_digest, problem.points.digest),
        "SDF grid": (members.sdf_digest, problem.sdf.digest),
        "definition": (members.settings.digest, settings.digest),
        "seed": (members.seed, rotation_seed(problem, settings)),
    }
    if world_from_object is not None:
        given = frozen("world_from_object", world_from_object, (4, 4))
        expected["true pose"] = digest(members.truth), digest(given)
    for part, (have, want) in expected.items():
        if have != want:
            raise EvaluationError(
                f"plausible set {path} belongs to another {part} ({have}); accepted: {want}, so "
                "remove the file to have it computed again"
            )
    return members


def read_plausible(path: Path) -> PlausibleSet:
    """The set in a file, its digest checked. Raises EvaluationError if it is damaged."""
    try:
        arrays = read_npz(path, most_bytes=MOST_BYTES, error=EvaluationError)
        members = _set_of(arrays)
    except _UNREADABLE as error:
        text = " ".join(str(error).split())
        raise EvaluationError(
            f"plausible set {path} is damaged or not a plausible set ({text}); accepted: a file "
            "that runners.plausible has written"
        ) from None
    if str(arrays["digest"]) != members.digest:
        raise EvaluationError(
            f"plausible set {path} does not hold what was written (digest {members.digest}); "
            f"accepted: {arrays['digest']}"
        )
    return members


def _set_of(arrays: dict[str, Any]) -> PlausibleSet:
    if int(arrays["format"]) != FORMAT:
        raise EvaluationError(f"format {arrays['format']}, accepted: {FORMAT}")
    members = frozen("world_from_object", arrays["world_from_object"], (None, 4, 4))
    check_rigid("world_from_object", members)
    count, on_grid = len(members), len(arrays["index"])
    if count == 0:
        raise EvaluationError("it has no member")
    settings = json.loads(str(arrays["settings"]))
    return PlausibleSet(
        world_from_object=members,
        cost=frozen("cost", arrays["cost"], (count,)),
        local=frozen("local", arrays["local"], (count,), dtype=np.bool_),
        index=frozen("index", arrays["index"], (on_grid,), dtype=np.int64),
        index_cost=frozen("index_cost", arrays["index_cost"], (on_grid,)),
        true_cost=float(arrays["true_cost"]),
        settings=build_settings(PlausibleSettings, settings, "settings"),
        seed=int(arrays["seed"]),
        points_digest=str(arrays["points_digest"]),
        sdf_digest=str(arrays["sdf_digest"]),
    )


def _name(points: str, settings: PlausibleSettings, seed: int, sdf: str) -> str:
    text = "|".join([settings.digest, str(seed), sdf])
    definition = digest(np.frombuffer(text.encode(), dtype=np.uint8))
    return f"{points}_{definition}.npz"
