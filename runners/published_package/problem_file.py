"""A registration problem as a file, from which another process starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey


def save_problem(problem: RegistrationProblem, object_bounds: FloatArray, path: Path) -> None:
    """Write the arrays of a problem; object_bounds (2, 3): of the mesh, in its frame, metres."""
    np.savez(
        path,
        sdf_origin=problem.sdf.origin,
        sdf_resolution=problem.sdf.resolution,
        sdf_values=problem.sdf.values,
        sdf_gradients=problem.sdf.gradients,
        object_bounds=np.asarray(object_bounds, dtype=np.float64),
        free=problem.points.free,
        free_spacing=problem.free_resolution,
        contacts=problem.points.known,
        known_sdf=problem.points.sdf,
        occupied=problem.points.occupied,
        initial_set=problem.initial_set,
        low_cost_set=problem.low_cost_set,
        workspace=problem.workspace.bounds,
    )


def load_problem(path: Path) -> RegistrationProblem:
    """Read what `save_problem` wrote, with the random streams of seed 0, step 0."""
    with np.load(path) as data:
        origin, values = data["sdf_origin"], data["sdf_values"]
        sdf = SdfGrid(origin, float(data["sdf_resolution"]), values, data["sdf_gradients"])
        points = KnownPoints(
            free=data["free"],
            occupied=data["occupied"],
            known=data["contacts"],
            known_sdf=data["known_sdf"],
        )
        lower, upper = data["workspace"].tolist()
        return RegistrationProblem(
            sdf,
            points,
            data["initial_set"],
            Workspace(tuple(lower), tuple(upper)),
            float(data["free_spacing"]),
            StreamKey(0, 0),
            data["low_cost_set"],
        )
