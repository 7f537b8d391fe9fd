"""The published package on the recorded session of a trial, each step from the one before."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from chsel.errors import PoseError
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses, inverse, nearest_rigid
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.settings import in_preset
from chsel.problem.streams import Purpose
from chsel.qd.selection import repeated
from replay.files import file_digest, whole_file
from runners.evaluation.contenders import repeat_label, repeat_seed
from runners.evaluation.plan import Task, Trial
from runners.evaluation.run_method import REPEAT_FOLDER
from runners.published_package.process import PublishedPackage, RefusedError
from runners.sessions.recorded import RecordedSession, RecordedSettings

HOW = replace(in_preset(OnlineSettings(), "reference"), initial="so3")
"""E_0 and E_l as the package's authors make them, but first from the starts that all others get."""


@dataclass(frozen=True)
class PackageSession:
    """One draw of a trial: what registers it, and the files of what is found, in a folder of sets.

    session: the trial's recording. steps: those to register.
    """

    package: PublishedPackage
    folder: Path
    trial: Trial
    draw: int
    session: Path
    steps: tuple[int, ...]

    @property
    def unit(self) -> Task:
        """As progress names it."""
        return Task(self.trial, repeat_label("package", self.draw))

    @property
    def sets(self) -> Path:
        """The hypotheses, as runners.evaluate takes them."""
        of_draw = self.folder / REPEAT_FOLDER.format(self.draw) if self.draw else self.folder
        return of_draw / self.trial.configuration / f"seed_{self.trial.seed}.npz"

    @property
    def about(self) -> Path:
        """How the sets came about, and why steps have none; written last."""
        return self.sets.with_suffix(".about.json")

    def failures(self) -> Mapping[str, str] | None:
        """Why steps have no set; None if the sets are not there, or of another session or version.

        A file that cannot be read is made again.
        """
        with suppress(OSError, ValueError):
            about = json.loads(self.about.read_text())
            if self.sets.is_file() and self._source().items() <= about.items():
                return dict(about["failed"])
        return None

    def register(self) -> Iterator[int]:
        """Yields each step when the package is done with it; the files are there at the end."""
        session = RecordedSession(RecordedSettings(str(self.session), 0, 0))
        arrays: dict[str, Any] = {}
        about: dict[str, Any] = {"failed": {}, "cpu_seconds": {}, "free_points": {}}

        def register(problem: RegistrationProblem) -> Hypotheses:
            found, answer = registered(self.package, problem, session.recorded.mesh)
            step = problem.key.step
            arrays[f"step_{step}"] = inverse(found.object_from_world)
            arrays[f"cost_{step}"] = found.cost
            arrays[f"seconds_{step}"] = np.array(answer["seconds"])
            for name in ("cpu_seconds", "free_points"):
                about[name][str(step)] = answer[name]
            return found

        online = session.online(HOW, repeat_seed(self.trial.seed, self.draw), only=self.steps)
        for step in online.steps(session.perceived(), register, (RefusedError, PoseError)):
            if step.failure is not None:
                about["failed"][str(step.step)] = " ".join(str(step.failure).split())
            yield step.step
        with whole_file(self.sets) as beside, beside.open("wb") as file:
            np.savez(file, **arrays)
        with whole_file(self.about) as beside:
            beside.write_text(json.dumps({**self._source(), **about}, indent=2) + "\n")

    def _source(self) -> dict[str, Any]:
        return {
            "session": file_digest(self.session),
            "steps": list(self.steps),
            "draw": self.draw,
            "versions": dict(self.package.versions),
        }


def registered(
    package: PublishedPackage, problem: RegistrationProblem, mesh: trimesh.Trimesh
) -> tuple[Hypotheses, Mapping[str, Any]]:
    """What the package finds with its own settings, best first, and its whole answer."""
    package.load(problem, mesh.bounds)
    # It draws from generators of its own, of one number that follows from ours.
    seed = int(problem.key.stream(Purpose.EMITTER).integers(2**32))
    answer = package.register(seed=seed)
    poses = nearest_rigid("a pose of the package", np.array(answer["poses"]))
    elites = nearest_rigid("an elite of the package", np.array(answer["elites"]))
    cost = np.array(answer["cost"], dtype=np.float64)
    if not np.isfinite(cost).all():
        raise RefusedError("a cost of the package is not finite")
    order = np.argsort(cost, kind="stable")
    poses, cells = poses[order], np.full(len(poses), -1, dtype=np.int64)
    return Hypotheses(poses, cost[order], repeated(Poses.of(poses)), cells, elites), answer
