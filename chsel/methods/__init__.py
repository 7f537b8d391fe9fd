"""Registration methods by name: ours, each a file or folder here, and those of other packages."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from chsel.errors import require_choice
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.anchored.pose_bound import pose_bound
from chsel.methods.chsel import Chsel, ChselSettings
from chsel.methods.cvo import Cvo, CvoSettings
from chsel.methods.gradient_descent import GradientDescent, GradientDescentSettings
from chsel.methods.icp import Icp, IcpSettings
from chsel.methods.medial_constraint import (
    MedialConstraint,
    MedialConstraintCmaMe,
    MedialConstraintCmaMeSettings,
    MedialConstraintSettings,
)
from chsel.methods.method import Method
from chsel.methods.svgd import Svgd, SvgdSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.settings import PRESETS, Entry, NamedChoices
from chsel.problem.trust import (
    DETERMINED,
    MANY_CONTACTS,
    SENSOR_NOISE,
    WIDE,
    explaining,
    fits_elsewhere,
    has_pose,
    trust_in,
)

_OURS: dict[str, Entry[Method]] = {
    "chsel": (Chsel, ChselSettings()),
    "chsel_cma_me": (Chsel, ChselSettings(search="cma_me")),
    "gradient_descent": (GradientDescent, GradientDescentSettings()),
    "icp": (Icp, IcpSettings()),
    "svgd": (Svgd, SvgdSettings()),
    "cvo": (Cvo, CvoSettings()),
    "cvo_no_free_space": (Cvo, CvoSettings(free_space=False)),
    "medial_constraint": (MedialConstraint, MedialConstraintSettings()),
    "medial_constraint_cma_me": (MedialConstraintCmaMe, MedialConstraintCmaMeSettings()),
    "anchored": (Anchored, AnchoredSettings()),
}
OURS = tuple(_OURS)
MOST_NOISE = 0.25  # of points, in diameters of the object: more is in millimetres


def _lacks(method: Any) -> str | None:
    """Return why an object with settings is not a method, and what is; None if it is one."""
    if not isinstance(getattr(method, "online", None), OnlineSettings):
        return "no `online`; accepted: a property that returns OnlineSettings"
    if not callable(getattr(method, "register", None)):
        return "no `register`; accepted: register(problem, observer=None)"
    return None


_CHOICES = NamedChoices[Method](
    "method", "chsel.methods", "docs/writing_a_method.md", _OURS, _lacks
)
METHODS = _CHOICES.names
build_method, preset_settings = _CHOICES.build, _CHOICES.settings


def default_method(preset: str = "default") -> str:
    """Return the method for a program's points; in the paper's presets the paper's method."""
    require_choice("preset", preset, PRESETS)
    return "anchored" if preset == "default" else "chsel"


def noise_of(method: Method) -> float:
    """Return the noise of known points by a method's settings, metres; else SENSOR_NOISE."""
    settings = getattr(method, "settings", None)
    return settings.noise if isinstance(settings, AnchoredSettings) else SENSOR_NOISE


def trust_by(method: Method, problem: RegistrationProblem, hypotheses: Hypotheses) -> Trust | None:
    """How far to trust what a method found, by the noise in its settings; None without a pose.

    A single mode has to stand beside what a search for other poses finds, among them turns under
    which the object looks nearly alike, and poses that leave out one of few contacts. Of many
    contacts, `anchored` has done this search itself. Where pushes may have moved the object, also
    beside what is found for other distances of them. How far the pose may be off is in
    `centre_within` and `turn_within`, by `pose_bound`.
    """
    if not has_pose(hypotheses):
        return None
    noise, pushes, posed = noise_of(method), problem.pushes, problem
    problem = posed.carried(hypotheses.push_distance)
    trust, rivals = trust_in(problem, hypotheses, noise), None
    searched = isinstance(method, Anchored) and len(problem.points.known) >= MANY_CONTACTS
    if trust.verdict == DETERMINED and not searched:
        rivals = Anchored(AnchoredSettings(noise=noise)).minima(problem)
        trust = trust_in(problem, hypotheses, noise, rivals)
    if trust.verdict == DETERMINED and pushes is not None:
        search = Anchored(AnchoredSettings(noise=noise))
        others = [posed.carried(distance) for distance in pushes.distances]
        found = ((other, search.minima(other)) for other in others)
        if any(fits_elsewhere(problem, hypotheses, *one, noise) for one in found):
            reason = "pushes of another length fit elsewhere"
            trust = replace(trust, verdict=WIDE, modes=0, reason=reason)
    poses, _ = explaining(problem, hypotheses, noise, rivals)
    centre, turn = pose_bound(problem.sdf, poses)
    return replace(trust, centre_within=centre, turn_within=turn)
