"""Registration problems as stored numbers, so that no mesh, sine or BLAS can change them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.sdf_grid import SdfGrid

PROBLEMS_FILE = Path(__file__).with_name("problems.npz")


@dataclass(frozen=True)
class Scene:
    """An object's grid with what is known about it: free, occupied, known-SDF points."""

    sdf: SdfGrid
    points: KnownPoints
    workspace: Workspace
    free_resolution: float


@cache
def _stored():
    with np.load(PROBLEMS_FILE) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


def grid(body):
    """A new grid of a body: "bracket" has flat faces, "mallet" is round."""
    stored = _stored()
    names = ("origin", "resolution", "values", "gradients")
    origin, resolution, values, gradients = (stored[f"grid/{body}/{name}"] for name in names)
    return SdfGrid(origin, float(resolution), values, gradients)


def scene(sdf, place, classes):
    """A place where the object of a grid is.

    place: "bracket" and "mallet" are tilted in space, "standing" is the bracket on a plane.
    classes: of points, "contacts", "free", "felt" (known SDF that is not 0), "occupied".
    """
    prefix = f"points/{place}/"
    stored = {name.removeprefix(prefix): array for name, array in _stored().items()}
    taken = (*classes, "felt_sdf") if "felt" in classes else classes
    contacts, felt, felt_sdf, free, occupied = (
        stored[name] if name in taken else stored[name][:0]
        for name in ("contacts", "felt", "felt_sdf", "free", "occupied")
    )
    known_sdf = np.concatenate([np.zeros(len(contacts)), felt_sdf])
    points = KnownPoints(free, occupied, np.concatenate([contacts, felt]), known_sdf)
    lower, upper = stored["workspace"].tolist()
    workspace = Workspace(tuple(lower), tuple(upper))
    return Scene(sdf, points, workspace, float(stored["free_resolution"]))
