"""Whether a result stands: beside what a search for rivals finds, and for input not expected."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from chsel.errors import PointsWarning
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.anchored.near_symmetries import turns_alike
from chsel.methods.anchored.pose_bound import pose_bound
from chsel.methods.method import Method
from chsel.problem.noise import noise_model
from chsel.problem.pose_distances import TURN
from chsel.problem.poses import Poses
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.trust import (
    DETERMINED,
    MANY_CONTACTS,
    SENSOR_NOISE,
    SURE_TURN,
    WIDE,
    explaining,
    fits_elsewhere,
    has_pose,
    pose_energies,
    posed_normals,
    sure_within,
    trust_in,
)

FLIPPED = "normals_flipped"
"""The code of the warning about normals that point into the object."""

_CLOSE = 2.0  # noise levels: a misfit that needs no explanation
_LEAST_NORMALS = 3  # fewer fit some pose either way
_INWARD = -0.5  # cosine with the object's normal, below which one points into the object
_UNEXPLAINED = 2.0  # nats a normal: a best pose of less needs no explanation
_BETTER = 5.0  # nats by which flipped normals have to explain the points better


def noise_of(method: Method) -> float:
    """Return the noise of known points by a method's settings, metres, or SENSOR_NOISE."""
    settings = getattr(method, "settings", None)
    return settings.noise if isinstance(settings, AnchoredSettings) else SENSOR_NOISE


def trust_by(
    method: Method, problem: RegistrationProblem, *, hypotheses: Hypotheses
) -> Trust | None:
    """Return how far to trust what a method found, by the noise in its settings.

    None without a pose. A single mode has to stand beside what a search for other poses finds,
    among them turns under which the object looks nearly alike, and poses that leave out one of few
    contacts. Turns that map the surface to itself are such poses where they are not among declared
    symmetries. Of many contacts, `anchored` has done this search itself. Where pushes may have
    moved the object, it has to stand also beside what is found for other distances of them. How far
    the pose may be off is in `centre_within` and `turn_within`, by `pose_bound`; by more than
    `sure_within` or SURE_TURN, it is not determined.
    """
    if not has_pose(hypotheses):
        return None
    noise = noise_of(method)
    carried = problem.carried(hypotheses.push_distance)
    rivals = _undeclared_copies(carried, hypotheses, noise=noise)
    trust = trust_in(carried, hypotheses, sensor_noise=noise, rivals=rivals)
    searched = isinstance(method, Anchored) and len(carried.points.known) >= MANY_CONTACTS
    if trust.verdict == DETERMINED and not searched:
        found = search_for(noise).minima(carried)
        rivals = found if rivals is None else Poses.joined([rivals, found])
        trust = trust_in(carried, hypotheses, sensor_noise=noise, rivals=rivals)
    if trust.verdict == DETERMINED and _fits_other_pushes(problem, hypotheses, noise=noise):
        reason = "pushes of another length fit elsewhere"
        trust = replace(trust, verdict=WIDE, modes=0, reason=reason)
    poses, _ = explaining(carried, hypotheses, sensor_noise=noise, rivals=rivals)
    centre, turn = pose_bound(carried.sdf, poses)
    most = sure_within(carried.sdf, noise)
    if trust.verdict == DETERMINED and (centre > most or turn > SURE_TURN):
        limits = f"{1000.0 * most:.1f} mm or {math.degrees(SURE_TURN):.0f}°"
        reason = f"poses more than {limits} off explain the points"
        trust = replace(trust, verdict=WIDE, modes=0, reason=reason)
    return replace(trust, centre_within=centre, turn_within=turn)


def _undeclared_copies(
    problem: RegistrationProblem, hypotheses: Hypotheses, *, noise: float
) -> Poses | None:
    """Return the best pose after turns that map the surface to itself and are no symmetries.

    No touch tells these poses from it. None where no symmetries are declared, as all such turns
    are symmetries then.
    """
    sdf = problem.sdf
    if sdf.symmetry is None:
        return None
    alike = turns_alike(sdf)
    counted = sdf.symmetry.rotation_errors(alike[:, :3, :3]) <= TURN
    copies = Poses.of(alike[~counted] @ hypotheses.object_from_world[0])
    return search_for(noise).fitted(problem, copies) if len(copies) else None


def check_normals(
    method: Method, problem: RegistrationProblem, *, hypotheses: Hypotheses
) -> list[PointsWarning]:
    """Return a warning if flipped normals explain the points better; the best pose is finite.

    A search reads normals, so that flipped ones draw it to poses that agree with them. So where the
    best hypothesis leaves normals unexplained, poses are sought once more with all turned around.
    """
    problem = problem.carried(hypotheses.push_distance)
    sdf, points = problem.sdf, problem.points
    known = points.normal_noise > 0.0
    count = int(known.sum())
    if count < _LEAST_NORMALS:
        return []
    noise = noise_of(method)
    model = noise_model(noise)
    best = Poses.of(hypotheses.object_from_world[:1])
    agree = (posed_normals(sdf, points, poses=best).cosines[0][known] > -_INWARD).all()
    explained = _UNEXPLAINED * model.power(len(known)) * count
    if agree or pose_energies(problem, best, noise=model)[0] <= explained:
        return []
    flipped = replace(problem, points=replace(points, normals=-points.normals))
    search = method if isinstance(method, Anchored) else search_for(noise)
    poses = [best, search.minima(flipped)]
    if search is not method:  # which may not have found the best pose with the normals as they are
        poses.append(search.minima(problem))
    every = Poses.joined(poses)
    energies = pose_energies(flipped, every, noise=model)
    least = pose_energies(problem, every, noise=model).min()
    at = int(np.argmin(energies))
    there = every[at : at + 1]
    cosines = posed_normals(sdf, points, poses=there).cosines[0][known]
    inward = int((cosines < _INWARD).sum())
    if inward <= (cosines > -_INWARD).sum() or energies.min() > least - _BETTER:
        return []
    text = (
        f"{inward} of {count} normals point into the object at the pose that explains the points "
        "best: are they flipped? accepted: unit vectors out of the object"
    )
    return [PointsWarning(FLIPPED, text)]


def unexpected_push(
    method: Method, problem: RegistrationProblem, *, trust: Trust | None, pushes: Pushes | None
) -> float:
    """Return by how much each touch seems to have moved the object, metres; or 0.

    problem, trust: of a result by points of an object that stands still. pushes: that may have
    moved it. Where the result leaves contacts off its best pose, points are registered once more
    as if the pushes had moved them.
    """
    if problem.pushes is not None or pushes is None:
        return 0.0
    if trust is None or trust.misfit <= _CLOSE:
        return 0.0
    return search_for(noise_of(method)).register(replace(problem, pushes=pushes)).push_distance


def _fits_other_pushes(
    problem: RegistrationProblem, hypotheses: Hypotheses, *, noise: float
) -> bool:
    """Whether other poses explain the points as well where pushes have another distance."""
    if problem.pushes is None:
        return False
    carried = problem.carried(hypotheses.push_distance)
    search = search_for(noise)
    for distance in problem.pushes.distances:
        other = problem.carried(distance)
        if fits_elsewhere(
            carried, hypotheses, other=other, poses=search.minima(other), sensor_noise=noise
        ):
            return True
    return False


def search_for(noise: float) -> Anchored:
    """Return a search for poses that explain the points, at a noise, metres."""
    return Anchored(AnchoredSettings(noise=noise))
