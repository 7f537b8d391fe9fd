"""The search where pushes may have moved the object: docs/moving_objects.md."""

from __future__ import annotations

from typing import NamedTuple

from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.anchored.search import RatedPoses, Search
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Observer, RegistrationProblem

# All of docs/moving_objects.md.
_LEAST_PUSHES = 5  # that a distance is estimated of
_HALVINGS = 2  # of the step between distances, around the best
_LIKELIER = 3.3  # nats: half of the 99 % point of chi-squared with one degree of freedom


class PushSearch(NamedTuple):
    """A search that takes every push to have moved the object by one distance."""

    distance: float  # metres
    search: Search  # of the problem whose points have moved along
    minima: RatedPoses  # that it found, the lowest first

    @property
    def lowest(self) -> float:
        """Energy of the best pose, nats."""
        return float(self.minima.energies[0])


def likeliest_push(
    problem: RegistrationProblem, settings: AnchoredSettings, *, observer: Observer
) -> PushSearch:
    """Return the search for the likeliest distance of a push; 0 if the object may stand still."""
    standing = _searched(problem, 0.0, settings=settings, observer=observer)
    pushes = problem.pushes
    if pushes is None or len(pushes.directions) < _LEAST_PUSHES:
        return standing
    moved = _lowest_above_zero(problem, pushes, settings=settings, observer=observer)
    return moved if moved.lowest < standing.lowest - _LIKELIER else standing


def _lowest_above_zero(
    problem: RegistrationProblem,
    pushes: Pushes,
    *,
    settings: AnchoredSettings,
    observer: Observer,
) -> PushSearch:
    """Return the search of lowest energy over distances above 0.

    The energy of the best pose has a minimum that a few searches find. Around it, distances lie
    half a step, then a quarter away, and the best one's minima are only fitted again.
    """
    _, step, *others = pushes.distances
    searches = [
        _searched(problem, distance, settings=settings, observer=observer)
        for distance in (step, *others)
    ]
    best = min(searches, key=lambda each: each.lowest)
    for _ in range(_HALVINGS):
        step *= 0.5
        nearby = [best]
        for distance in (best.distance - step, best.distance + step):
            if distance <= pushes.largest:
                search = Search(problem.carried(distance), settings, observer=observer)
                minima = search.refined(search.rated(best.minima.poses))
                nearby.append(PushSearch(distance, search, minima=minima))
        best = min(nearby, key=lambda each: each.lowest)
    return best


def _searched(
    problem: RegistrationProblem, distance: float, *, settings: AnchoredSettings, observer: Observer
) -> PushSearch:
    search = Search(problem.carried(distance), settings, observer=observer)
    return PushSearch(distance, search, minima=search.minima())
