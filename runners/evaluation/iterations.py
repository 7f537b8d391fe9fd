"""What a search over an archive would give if it ended at a snapshot (CHSEL, Alg. 1, line 7)."""

from __future__ import annotations

from typing import Any

from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.search_space import search_space
from chsel.problem.streams import Purpose
from chsel.qd.selection import ranked, select_elites


def hypotheses_of(
    snapshot: ArchiveSnapshot, problem: RegistrationProblem, settings: Any
) -> Hypotheses:
    """The cells with the |E_0| lowest costs, chosen as the method with these settings does.

    settings: with `output` and `plane`, as every method that keeps an archive has them.
    """
    space = search_space(settings.plane, problem.sdf)
    stream = problem.key.stream(Purpose.RESAMPLE, snapshot.refinement)
    costs, poses = -snapshot.objectives, space.poses(snapshot.solutions)
    chosen = select_elites(costs, poses, problem, space, settings.output, stream)
    return ranked(poses[chosen].matrices, costs[chosen], snapshot.cells[chosen], poses.matrices)
