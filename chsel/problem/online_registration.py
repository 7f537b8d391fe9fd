"""Registration again and again while points become known (CHSEL, Alg. 2): the loop, E_0 and E_l."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from chsel.errors import PoseError, require_instance
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import POINT_CLASSES, KnownPoints, Workspace, require_parts
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
from chsel.problem.trust import SENSOR_NOISE, has_pose, trust_in

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


class Start(NamedTuple):
    """When the first registration is possible."""

    contacts: int = 0  # at least so many are known
    step: int = 0  # not before this step


_AT_ONCE = Start()


@dataclass(frozen=True, eq=False)
class OnlineStep:
    """One pass through the loop of `OnlineRegistration.steps`."""

    step: int
    problem: RegistrationProblem | None = None  # None if nothing was to be registered
    hypotheses: Hypotheses | None = None  # with trust; None if nothing was registered
    failure: Exception | None = None  # of posing or registering the problem, if it was to be caught


class OnlineRegistration:
    """Registers an object after every change of its known points.

    sdf: of the object. points: all that are known, in the world. previous: the result that the
    next problem follows from; None before the first.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        workspace: Workspace,
        free_resolution: float,
        settings: OnlineSettings,
        *,
        seed: int = 0,
        points: KnownPoints | None = None,
        previous: Hypotheses | None = None,
        start: Start = _AT_ONCE,
        only: Container[int] | None = None,
        sensor_noise: float = SENSOR_NOISE,
        push_distance: float = 0.0,
    ) -> None:
        """settings: how E_0 and E_l follow from the result before, `method.online` of a method.

        free_resolution: voxel side of free space, metres. seed: of the random streams of all
        steps. points: known before the first step. only: steps that register; None for all.
        sensor_noise: of known points, metres, by which results are judged, see `trust_in`.
        push_distance: metres that a push moves the object at most; 0 if it stands still.
        """
        points = KnownPoints() if points is None else points
        require_parts(sdf=sdf, workspace=workspace, points=points)
        require_instance("settings", settings, OnlineSettings, "method.online of a method")
        self.sdf, self._workspace, self._free_resolution = sdf, workspace, free_resolution
        self._settings, self._seed = settings, seed
        self._start, self._only, self._sensor_noise = start, only, sensor_noise
        self._larger = 1
        self._push_distance = push_distance
        self._pushes: list[tuple[FloatArray, list[int]]] = []  # directions, and points before
        self.points = points
        self.previous = previous

    def steps(
        self,
        perceived: Iterable[tuple[int, KnownPoints] | tuple[int, KnownPoints, FloatArray | None]],
        register: Callable[[RegistrationProblem], Hypotheses | None] | None = None,
        catch: type[Exception] | tuple[type[Exception], ...] = (),
    ) -> Iterator[OnlineStep]:
        """Algorithm 2; yields after every step, whether or not it registered.

        perceived: steps in ascending order with the points that are new in each, such as
        enumerate(points); as a third, the direction of a push that came then, see `perceive`.
        register: finds E, such as `method.register`, or None where it finds
        nothing to remember; without it problems are posed only, and `remember` takes results from
        elsewhere. catch: errors of a step that do not end the loop; the next problem then follows
        from the last result that there was.
        """
        for step, new_points, *push in perceived:
            self.perceive(new_points, *push)  # X <- perceived from environment
            problem = hypotheses = failure = None
            if self.enough(step):
                try:
                    problem = self.pose(step)  # with E_0 and E_l
                    if register is not None:
                        hypotheses = register(problem)  # E <- CHSEL(X, E_0, E_l)
                    if hypotheses is not None and hypotheses.trust is None and has_pose(hypotheses):
                        trust = trust_in(problem, hypotheses, self._sensor_noise)
                        hypotheses = replace(hypotheses, trust=trust)
                except catch as error:
                    failure = error
            if hypotheses is not None:
                self.remember(hypotheses)
            yield OnlineStep(step, problem, hypotheses, failure)

    def perceive(self, new_points: KnownPoints, push: FloatArray | None = None) -> None:
        """Take new points, and the direction (3,) in which the object was then pushed, if it was.

        The direction is a unit vector in the world. It counts where `push_distance` is above 0.
        """
        require_parts(points=new_points)
        self.points = self.points.merged(new_points)
        if push is not None:
            before = [len(getattr(self.points, name)) for name in POINT_CLASSES]
            self._pushes.append((push, before))

    def enough(self, step: int) -> bool:
        """Whether a step registers, with the points that are known."""
        chosen = self._only is None or step in self._only
        started = step >= self._start.step and len(self.points.contacts) >= self._start.contacts
        return chosen and started and self.points.count > 0

    def pose(self, step: int) -> RegistrationProblem:
        """The problem of a step: all known points, E_0 and E_l from the result before.

        Raises PoseError if that result has no poses or some that are not finite, and SettingError
        if no point is known.
        """
        key = StreamKey(self._seed, step)
        settings = replace(self._settings, hypotheses=self._larger * self._settings.hypotheses)
        low_cost_set = np.zeros((0, 4, 4))
        if self.previous is None:
            initial_set = first_initial_set(self._workspace, self.points, key, settings)
        else:
            initial_set = self.previous.object_from_world[: settings.hypotheses]
            if settings.update == "noise":
                initial_set = updated_initial_set(self.previous, key, settings)
            if settings.low_cost_set == "elites":
                low_cost_set = self.previous.elites
            elif settings.low_cost_set == "estimates":
                low_cost_set = self.previous.object_from_world
        around, pushes = (self._workspace, self._free_resolution), None
        if self._push_distance > 0.0:
            pushes = self.pushes(self._push_distance)
        return RegistrationProblem(
            self.sdf, self.points, initial_set, *around, key, low_cost_set, pushes
        )

    def pushes(self, largest: float) -> Pushes | None:
        """The pushes so far, if each has moved the object by so many metres at most; None: none."""
        if not self._pushes:
            return None
        directions, before = zip(*self._pushes, strict=True)
        return Pushes(np.array(directions), np.array(before), largest)

    def start_afresh(self, larger: int = 1) -> None:
        """Let the next problem be a first one, with so many times the hypotheses."""
        self.previous, self._larger = None, larger

    def remember(self, hypotheses: Hypotheses) -> None:
        """Let the next problem follow from this result."""
        self.previous, self._larger = hypotheses, 1
