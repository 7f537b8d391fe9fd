"""The sets that a registration starts from: E_0 and E_l by the result before (CHSEL, Alg. 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from chsel.errors import PoseError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_prior import PosePrior
from chsel.problem.poses import (
    axis_angle,
    compose,
    inverse,
    product,
    random_rotations,
    rotation_vector,
)
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms

MOST_HYPOTHESES = 1_000_000
_CENTROID_SPREAD = 0.05


@dataclass(frozen=True)
class OnlineSettings(CheckedSettings):
    """How the sets of a registration follow from the previous one."""

    hypotheses: Annotated[int, positive, at_most(MOST_HYPOTHESES)] = 30  # B
    # First E_0: "so3" uniform in workspace and SO(3), "upright" with yaw alone, "origin" upright at
    # the world's origin, "contact_centroid" upright within 5 cm of the mean contact (uniform in the
    # workspace while there is none).
    initial: Annotated[str, one_of("so3", "upright", "origin", "contact_centroid")] = "so3"
    translation_noise: Annotated[float, not_negative] = 0.05  # sigma_t, metres
    rotation_noise: Annotated[float, not_negative] = 0.3  # sigma_R, radians
    # "axis_gauss" a uniform axis and a Gaussian angle, "rotvec_gauss" a Gaussian rotation vector.
    rotation_law: Annotated[str, one_of("axis_gauss", "rotvec_gauss")] = "rotvec_gauss"
    keep_best: bool = True  # the first of E_0 is the best pose itself
    # E_l: "elites" of the whole archive, the "estimates" alone, or "none".
    low_cost_set: Annotated[str, one_of("elites", "estimates", "none")] = "elites"
    # The next E_0: "noise" around the best pose, or each of the "own" poses.
    update: Annotated[str, one_of("noise", "own")] = "noise"

    presets: ClassVar[Presets] = {
        "paper": {"rotation_law": "axis_gauss", "keep_best": False},
        "reference": {"initial": "upright"},
    }


def first_initial_set(
    workspace: Workspace, points: KnownPoints, *, key: StreamKey, settings: OnlineSettings
) -> FloatArray:
    """Return E_0 before any registration: object_from_world (B, 4, 4)."""
    stream = key.stream(Purpose.INITIAL_POSES)
    count = settings.hypotheses
    position = uniforms(stream, workspace.lower, upper=workspace.upper, shape=(count, 3))
    if settings.initial == "so3":
        rotation = random_rotations(stream, count)
    else:
        yaw = uniforms(stream, 0.0, upper=2.0 * np.pi, shape=count)
        rotation = axis_angle(np.broadcast_to([0.0, 0.0, 1.0], (count, 3)), yaw)
    if settings.initial == "origin":
        position = np.zeros((count, 3))
    elif settings.initial == "contact_centroid" and len(points.contacts):
        spread = uniforms(stream, -_CENTROID_SPREAD, upper=_CENTROID_SPREAD, shape=(count, 3))
        position = points.contacts.mean(axis=0) + spread
    return inverse(compose(rotation, position))


def updated_initial_set(
    previous: Hypotheses, key: StreamKey, *, settings: OnlineSettings
) -> FloatArray:
    """Return E_0 around the best previous hypothesis: object_from_world (B, 4, 4).

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
    direction = normals(stream, (count, 3))
    if settings.rotation_law == "rotvec_gauss":
        turn = rotation_vector(settings.rotation_noise * direction)
    else:
        axis = direction / np.sqrt((direction**2).sum(axis=1, keepdims=True))
        turn = axis_angle(axis, settings.rotation_noise * normals(stream, count))
    rotation = product(turn, world_from_best[:3, :3])
    initial_set = inverse(compose(rotation, world_from_best[:3, 3] + shift))
    if settings.keep_best:
        initial_set[0] = best
    return initial_set


def posed_problem(
    sdf: SdfGrid,
    points: KnownPoints,
    *,
    workspace: Workspace,
    free_resolution: float,
    key: StreamKey,
    settings: OnlineSettings,
    previous: Hypotheses | None = None,
    enlargement: int = 1,
    pushes: Pushes | None = None,
    prior: PosePrior | None = None,
) -> RegistrationProblem:
    """Return the problem of a step: known points, with E_0 and E_l from the result before.

    free_resolution: side of free voxels, metres. previous: that result, None for a first problem.
    enlargement: times the hypotheses of the settings. pushes: that may have moved the object.
    prior: on its pose before them.
    Raise PoseError if that result has no poses or some that are not finite, and SettingError if no
    point is known.
    """
    settings = replace(settings, hypotheses=enlargement * settings.hypotheses)
    low_cost_set = np.zeros((0, 4, 4))
    if previous is None:
        initial_set = first_initial_set(workspace, points, key=key, settings=settings)
    else:
        initial_set = previous.object_from_world[: settings.hypotheses]
        if settings.update == "noise":
            initial_set = updated_initial_set(previous, key, settings=settings)
        if settings.low_cost_set == "elites":
            low_cost_set = previous.elites
        elif settings.low_cost_set == "estimates":
            low_cost_set = previous.object_from_world
    return RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=initial_set,
        workspace=workspace,
        free_resolution=free_resolution,
        key=key,
        low_cost_set=low_cost_set,
        pushes=pushes,
        prior=prior,
    )
