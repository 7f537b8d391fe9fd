"""Registers with the published package `chsel`, in the interpreter that has it, on request.

A program of its own that imports nothing of this project, whose package has the same name. It
writes versions, then reads requests and writes answers, one JSON object a line; see process.py.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import json
import os
import platform
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

_PACKAGES = ("chsel", "pytorch-volumetric", "pytorch-kinematics", "ribs", "numpy", "torch")
_COSTS = {"default": "VolumetricDirectSDFCost", "equation": "VolumetricDoubleDirectCost"}


class GridSdf:
    """A stand-in for the package's mesh, which answers queries by the nearest node of our grid.

    So both packages read the same signed distances, and the query of the whole mesh that the
    package's constructor makes costs it next to nothing.
    """

    def __init__(self, data: dict[str, Any]) -> None:
        self._origin = torch.tensor(data["sdf_origin"])
        self._resolution = float(data["sdf_resolution"])
        self._values = torch.tensor(data["sdf_values"], dtype=torch.float32)
        self._gradients = torch.tensor(data["sdf_gradients"], dtype=torch.float32)
        self._bounds = torch.tensor(data["object_bounds"], dtype=torch.float32).T  # (3, 2)

    def __call__(self, points: Any, compute_grad: bool = True) -> tuple[Any, Any]:
        """Return values (...) and gradients (..., 3) at points (..., 3)."""
        index = ((points.double() - self._origin) / self._resolution).round().long()
        last = torch.tensor(self._values.shape) - 1
        i, j, k = torch.minimum(index.clamp_min(0), last).unbind(-1)
        return self._values[i, j, k], self._gradients[i, j, k]

    def surface_bounding_box(self, padding: float = 0.0, padding_ratio: float = 0.0) -> Any:
        """Return lowest and highest coordinates (3, 2) of the mesh."""
        margin = padding + padding_ratio * (self._bounds[:, 1] - self._bounds[:, 0])
        return self._bounds + torch.stack([-margin, margin], dim=-1)


class Worker:
    """The package, with the problem that it registers."""

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self._chsel = importlib.import_module("chsel")
        self._volumetric = importlib.import_module("pytorch_volumetric")
        self._descent = self._chsel.sgd.volumetric_registration_sgd
        self._folder = tempfile.mkdtemp()

    def describe(self) -> dict[str, Any]:
        """Return the versions of the packages here."""
        versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
        return {"python": platform.python_version(), **versions}

    def load(self, problem: str) -> dict[str, Any]:
        """Read a problem, and build the package's signed distance grid from it."""
        with np.load(problem) as data:
            self._data = dict(data)
        origin = self._data["sdf_origin"]
        shape = self._data["sdf_values"].shape
        self._resolution = float(self._data["sdf_resolution"])
        last = origin + (np.array(shape) - 1) * self._resolution
        with tempfile.TemporaryDirectory(dir=self._folder) as folder:  # never read again
            self._sdf = self._volumetric.CachedSDF(
                "object",
                self._resolution,
                list(zip(origin.tolist(), last.tolist(), strict=True)),
                GridSdf(self._data),
                cache_path=str(Path(folder) / "sdf.pkl"),
            )
        kinds = self._chsel.SemanticsClass
        classes = {"free": kinds.FREE, "known": kinds.SURFACE, "occupied": kinds.OCCUPIED}
        points = [self._data[name] for name in classes]
        self._positions = torch.tensor(np.concatenate(points), dtype=torch.float32)
        numbers = [kind.value for kind in classes.values()]
        counts = [len(p) for p in points]
        self._semantics = torch.tensor(np.repeat(numbers, counts))
        self._initial_set = torch.tensor(self._data["initial_set"], dtype=torch.float32)
        return {}

    def register(
        self, seed: int, cost: str = "", *, restarts: int = 0, steps: int = 0, search: int = 0
    ) -> dict[str, Any]:
        """Return construct and register once, with the package's own settings where none are given.

        Gives seconds, those of the processor alone, poses (B, 4, 4) of object_from_world with
        their cost (B,), the poses (L, 4, 4) of the archive's elites, E_l of the next registration,
        and counts. cost: one of _COSTS. With `restarts` all restarts x steps are done: the
        package's own test for convergence is false for every cost when its threshold is not a
        number. search: iterations of CMA-MEGA.
        """
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002  (what the package draws from)
        descent: Any = self._descent
        if restarts:
            limits = {"max_iterations": restarts, "iterations": steps}
            descent = functools.partial(descent, relative_rmse_thr=float("nan"), **limits)
        self._chsel.sgd.volumetric_registration_sgd = descent
        construct: dict[str, Any] = {"qd_iterations": search} if search else {}
        counting = _counting(getattr(self._chsel, _COSTS[cost])) if cost else None
        if counting is not None:
            construct["cost"] = counting
        measure = self._chsel.measure.PositionMeasure(2)  # the package's own choice
        start: dict[str, Any] = {}
        if len(self._data["low_cost_set"]):
            low_cost_set = torch.tensor(self._data["low_cost_set"], dtype=torch.float32)
            vectors = measure.get_numpy_x(low_cost_set[:, :3, :3], low_cost_set[:, :3, 3])
            start["low_cost_transform_set"] = vectors
        known_sdf = torch.tensor(self._data["known_sdf"], dtype=torch.float32)
        begun, cpu = time.perf_counter(), time.process_time()
        registration = self._chsel.CHSEL(
            self._sdf,
            self._positions,
            self._semantics,
            resolution=self._resolution,
            free_voxels_resolution=float(self._data["free_spacing"]),
            known_sdf_values=known_sdf,
            savedir=self._folder,
            **construct,
        )
        found, elites = registration.register(
            iterations=1, initial_tsf=self._initial_set, batch=len(self._initial_set), **start
        )
        return {
            "seconds": time.perf_counter() - begun,
            "cpu_seconds": time.process_time() - cpu,
            "poses": _matrices(found.RTs.R, found.RTs.T),
            "cost": found.rmse.tolist(),
            "elites": _matrices(*measure.get_torch_RT(np.asarray(elites))),
            "free_points": len(
                registration.volumetric_cost.free_voxels.get_known_pos_and_values()[0]
            ),
            "gradients": None if counting is None else counting.gradients,
        }


def _counting(cost: Any) -> Any:
    """Return the cost class, counting how often it is called for its gradient."""

    class Counting(cost):
        gradients = 0

        def __call__(self, R: Any, T: Any, s: Any, other_info: Any = None) -> Any:  # noqa: PLR0917
            Counting.gradients += bool(R.requires_grad)
            return super().__call__(R, T, s, other_info)

    return Counting


def _matrices(rotation: Any, position: Any) -> list[Any]:
    """Return transforms (B, 4, 4) as nested lists."""
    transforms = torch.eye(4, dtype=torch.float64).repeat(len(rotation), 1, 1)
    transforms[:, :3, :3], transforms[:, :3, 3] = rotation, position
    return transforms.tolist()


def main() -> None:
    """Answer requests until stdin ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the package prints is not an answer

    def answer(values: dict[str, Any]) -> None:
        answers.write(json.dumps(values) + "\n")
        answers.flush()

    try:
        worker = Worker()
        answer(worker.describe())
    except Exception as error:
        answer({"error": f"{type(error).__name__}: {error}"})
        return
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer(getattr(worker, request.pop("task"))(**request))
        except Exception as error:
            answer({"error": f"{type(error).__name__}: {error}"})


if __name__ == "__main__":
    main()
