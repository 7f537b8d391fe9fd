"""How a session's registrations hang together: E_0 and E_l (CHSEL, Alg. 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from chsel.errors import PoseError, require_at_most, require_choice, require_positive
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import (
    axis_angle,
    compose,
    inverse,
    product,
    random_rotations,
    rotation_vector,
)
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms

MOST_HYPOTHESES = 1_000_000
_CENTROID_SPREAD = 0.05


@dataclass(frozen=True)
class OnlineSettings:
    """How the sets of a registration follow from the previous one.

    hypotheses: B. initial: first E_0: "so3" uniform in workspace and SO(3), "upright" with yaw
    alone, "origin" upright at the world's origin, "contact_centroid" upright within 5 cm of the
    mean contact (uniform in the workspace while there is none). translation_noise: sigma_t,
    metres. rotation_noise: sigma_R, radians. rotation_law: "axis_gauss" a uniform axis and a
    Gaussian angle, "rotvec_gauss" a Gaussian rotation vector. keep_best: the first of E_0 is the
    best pose itself. low_cost_set: E_l is "elites" of the whole archive, the "estimates" alone,
    or "none". update: the next E_0 is "noise" around the best pose, or each of the "own" poses.
    """

    hypotheses: int = 30
    initial: str = "so3"
    translation_noise: float = 0.05
    rotation_noise: float = 0.3
    rotation_law: str = "rotvec_gauss"
    keep_best: bool = True
    low_cost_set: str = "elites"
    update: str = "noise"

    presets: ClassVar[Presets] = {
        "paper": {"rotation_law": "axis_gauss", "keep_best": False},
        "reference": {"initial": "upright"},
    }

    def __post_init__(self) -> None:
        require_positive("hypotheses", self.hypotheses)
        require_at_most("hypotheses", self.hypotheses, MOST_HYPOTHESES)
        choices = ("so3", "upright", "origin", "contact_centroid")
        require_choice("initial", self.initial, choices)
        require_choice("rotation_law", self.rotation_law, ("axis_gauss", "rotvec_gauss"))
        require_choice("low_cost_set", self.low_cost_set, ("elites", "estimates", "none"))
        require_choice("update", self.update, ("noise", "own"))
        require_positive("translation_noise", self.translation_noise, zero=True)
        require_positive("rotation_noise", self.rotation_noise, zero=True)


def pose_problem(
    sdf: SdfGrid,
    points: KnownPoints,
    workspace: Workspace,
    free_resolution: float,
    key: StreamKey,
    settings: OnlineSettings,
    previous: Hypotheses | None,
) -> RegistrationProblem:
    """The next registration of a session, given the result of the previous one if there is any."""
    if previous is None:
        initial_set = first_initial_set(workspace, points, key, settings)
        low_cost_set = np.zeros((0, 4, 4))
    else:
        own = settings.update == "own"
        initial_set = (
            previous.object_from_world if own else updated_initial_set(previous, key, settings)
        )
        low_cost_set = _low_cost_set(previous, settings)
    return RegistrationProblem(
        sdf, points, initial_set, workspace, free_resolution, key, low_cost_set
    )


def first_initial_set(
    workspace: Workspace, points: KnownPoints, key: StreamKey, settings: OnlineSettings
) -> FloatArray:
    """E_0 before any registration: object_from_world (B, 4, 4)."""
    stream = key.stream(Purpose.INITIAL_POSES)
    count = settings.hypotheses
    position = uniforms(stream, workspace.lower, workspace.upper, (count, 3))
    if settings.initial == "so3":
        rotation = random_rotations(stream, count)
    else:
        yaw = uniforms(stream, 0.0, 2.0 * np.pi, count)
        rotation = axis_angle(np.broadcast_to([0.0, 0.0, 1.0], (count, 3)), yaw)
    if settings.initial == "origin":
        position = np.zeros((count, 3))
    elif settings.initial == "contact_centroid" and len(points.contacts):
        spread = uniforms(stream, -_CENTROID_SPREAD, _CENTROID_SPREAD, (count, 3))
        position = points.contacts.mean(axis=0) + spread
    return inverse(compose(rotation, position))


def updated_initial_set(
    previous: Hypotheses, key: StreamKey, settings: OnlineSettings
) -> FloatArray:
    """E_0 around the best previous hypothesis: object_from_world (B, 4, 4).

    The noise acts on world_from_object: added to the position, multiplied from the left onto
    the rotation. Raises PoseError if there is no previous hypothesis.
    """
    if len(previous.cost) == 0:
        raise PoseError("the previous result has no hypotheses; accepted: at least one")
    best = previous.object_from_world[int(np.argmin(previous.cost))]
    world_from_best = inverse(best)
    stream = key.stream(Purpose.UPDATE_NOISE)
    count = settings.hypotheses
    shift = settings.translation_noise * normals(stream, (count, 3))
    turn = _rotation_noise(stream, count, settings)
    rotation = product(turn, world_from_best[:3, :3])
    initial_set = inverse(compose(rotation, world_from_best[:3, 3] + shift))
    if settings.keep_best:
        initial_set[0] = best
    return initial_set


def _rotation_noise(
    stream: np.random.Generator, count: int, settings: OnlineSettings
) -> FloatArray:
    direction = normals(stream, (count, 3))
    if settings.rotation_law == "rotvec_gauss":
        return rotation_vector(settings.rotation_noise * direction)
    axis = direction / np.sqrt((direction**2).sum(axis=1, keepdims=True))
    return axis_angle(axis, settings.rotation_noise * normals(stream, count))


def _low_cost_set(previous: Hypotheses, settings: OnlineSettings) -> FloatArray:
    if settings.low_cost_set == "elites":
        return previous.elites
    if settings.low_cost_set == "estimates":
        return previous.object_from_world
    return np.zeros((0, 4, 4))
