"""The published package, in an environment and a process of its own that registers on request."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import settings_mapping
from runners.command.choices import store
from runners.published_package.worker_process import WorkerError, WorkerProcess, last_line

PUBLISHED = "0.2.1"


class PackageError(ChselError):
    """The published package cannot be installed, started or run."""


@dataclass(frozen=True)
class PackageConfig:
    """The place of the published package."""

    python: str | None = None  # an interpreter that has the package
    directory: str = "~/.cache/chsel/published"  # else, where its environment is, or is made
    pip: tuple[str, ...] = ()  # more arguments for pip, such as "--index-url=URL"


store("package", "default", node=settings_mapping(PackageConfig()))


def interpreter(config: PackageConfig, say: Callable[[str], None]) -> Path:
    """Return the interpreter that has the package; its environment is made first if there is none.

    The environment has torch in the version and build of ours.
    """
    if config.python is not None:
        return Path(config.python).expanduser()
    directory = Path(config.directory).expanduser()
    finished = directory / f"chsel-{PUBLISHED}"
    python = directory / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not finished.exists():
        torch = f"torch=={version('torch')}"
        say(f"making an environment for chsel {PUBLISHED} in {directory}, once: some minutes")
        _run("venv", [sys.executable, "-m", "venv", str(directory)])
        install = [str(python), "-m", "pip", "install", "--quiet", *config.pip]
        for packages in ([torch], [torch, f"chsel=={PUBLISHED}"]):
            say(f"installing {packages[-1]}")
            _run("pip", [*install, *packages])
        finished.touch()
    return python


def _run(what: str, command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise PackageError(
            f"{what} failed: {last_line(done.stderr or done.stdout)}; accepted: "
            "package.python=PATH of an interpreter that has the package, package.pip=[OPTION,...] "
            "for pip, or package.skip=true"
        )


_WORKER = Path(__file__).with_name("worker.py")
_ACCEPTED = f"accepted: an interpreter that has chsel=={PUBLISHED}, or package.skip=true"


class PublishedPackage(WorkerProcess):
    """A process that registers with the package, one request at a time."""

    def __init__(self, python: Path) -> None:
        """Use an interpreter; raise PackageError if it does not have the package."""
        self._warm = False
        # -I: no chsel but the installed one.
        command = [str(python), "-I", str(_WORKER)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
        try:
            super().__init__(command, environment)
        except OSError as error:
            raise PackageError(
                f"package.python {python} does not run ({error.strerror}); {_ACCEPTED}"
            ) from None
        except WorkerError as error:
            raise PackageError(
                f"{python} cannot use the published package: {error}; {_ACCEPTED}"
            ) from None
        self.versions = self.description
        if self.versions["chsel"] != PUBLISHED:
            self.close()
            raise PackageError(
                f"{python} cannot use the published package: it has chsel "
                f"{self.versions['chsel']}; {_ACCEPTED}"
            )

    def load(self, problem: RegistrationProblem, object_bounds: FloatArray) -> None:
        """Hand a problem over; object_bounds (2, 3): of the mesh, in its frame, metres."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "problem.npz"
            np.savez(
                path,
                sdf_origin=problem.sdf.origin,
                sdf_resolution=problem.sdf.resolution,
                sdf_values=problem.sdf.values,
                sdf_gradients=problem.sdf.gradients,
                object_bounds=np.asarray(object_bounds, dtype=np.float64),
                free=problem.points.free,
                free_spacing=problem.free_resolution,
                known=problem.points.known,
                known_sdf=problem.points.sdf,
                occupied=problem.points.occupied,
                initial_set=problem.initial_set,
                low_cost_set=problem.low_cost_set,
            )
            self.ask("load", problem=str(path))

    def register(self, **arguments: Any) -> dict[str, Any]:
        """Return the answer of the worker's `register`; the first runs twice, to load all code."""
        if not self._warm:
            self.ask("register", **arguments)
            self._warm = True
        return self.ask("register", **arguments)
