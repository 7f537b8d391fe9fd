"""The published package on the recorded session of a trial, each step from the one before."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from chsel.errors import PoseError
from chsel.numerics.arrays import FloatArray
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses, inverse, nearest_rigid
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.settings import in_preset
from chsel.problem.streams import Purpose
from chsel.qd.selection import repeated
from runners.published_package.problem_file import save_problem
from runners.published_package.process import PublishedPackage, RefusedError
from runners.sessions.recorded import RecordedSession, RecordedSettings

HOW = replace(in_preset(OnlineSettings(), "reference"), initial="so3")
"""E_0 and E_l as the package's authors make them, but first from the starts that all others get."""


@dataclass(frozen=True, eq=False)
class PackageSet:
    """What the package has found."""

    hypotheses: Hypotheses
    seconds: float  # that it took, its constructor included
    cpu_seconds: float  # of its one thread alone: fewer where others keep the processor busy
    free_points: int  # that it knew of

    @property
    def world_from_object(self) -> FloatArray:
        """The poses (B, 4, 4), best first."""
        return inverse(self.hypotheses.object_from_world)


@dataclass
class PackageSession:
    """Registers a session with the package, step by step.

    seed: of all random numbers. warm: whether it has registered before; the first of all
    registrations runs twice, so that no time holds what is loaded only once.
    """

    package: PublishedPackage
    seed: int
    warm: bool = False

    def sets(self, path: Path, steps: Collection[int]) -> Iterator[tuple[int, PackageSet | str]]:
        """What is found at each of the steps, or why nothing is. path: of the recording."""
        session = RecordedSession(RecordedSettings(str(path), start_contacts=0, start_probe=0))
        found: PackageSet | None = None

        def register(problem: RegistrationProblem) -> Hypotheses:
            nonlocal found
            found = self._registered(problem, session.recorded.mesh)
            return found.hypotheses

        online = session.online(HOW, self.seed, only=steps)
        for step in online.steps(session.perceived(), register, (RefusedError, PoseError)):
            if step.failure is not None:
                yield step.step, " ".join(str(step.failure).split())
            elif step.problem is not None:
                assert found is not None
                yield step.step, found

    def _registered(self, problem: RegistrationProblem, mesh: trimesh.Trimesh) -> PackageSet:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "problem.npz"
            save_problem(problem, mesh.bounds, path)
            self.package.ask("load", problem=str(path))
        # It draws from generators of its own, of one number that follows from ours.
        seed = int(problem.key.stream(Purpose.EMITTER).integers(2**32))
        if not self.warm:
            self.package.ask("register_as_published", seed=seed)
            self.warm = True
        answer = self.package.ask("register_as_published", seed=seed)
        poses = nearest_rigid("a pose of the package", np.array(answer["poses"]))
        elites = nearest_rigid("an elite of the package", np.array(answer["elites"]))
        cost = np.array(answer["cost"], dtype=np.float64)
        if not np.isfinite(cost).all():
            raise RefusedError("a cost of the package is not finite")
        order = np.argsort(cost, kind="stable")
        poses, cells = poses[order], np.full(len(poses), -1, dtype=np.int64)
        found = Hypotheses(poses, cost[order], repeated(Poses.of(poses)), cells, elites)
        seconds, cpu = float(answer["seconds"]), float(answer["cpu_seconds"])
        return PackageSet(found, seconds, cpu, int(answer["free_points"]))
