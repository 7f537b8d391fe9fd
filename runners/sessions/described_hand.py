"""The hand of a simulated session from boxes and a URDF, in place of the built-in one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import SettingError
from runners.sensors.hand import HandModel
from runners.sensors.rig import BoxRig, HandRig
from runners.sessions.panda_hand import panda_hand
from runners.sessions.probing_hand import ROTATION, ProbingHand

if TYPE_CHECKING:
    import trimesh

LARGEST = 0.5  # m: extent of a hand along any axis
MOST_SURFACE = 1.0  # m^2: of all parts
MOST_FACES = 20_000  # of the convex hulls of all parts


@dataclass(frozen=True)
class DescribedHand:
    """Solid parts of a hand that probes along the z axis of its frame.

    Each counts as its convex hull, as in physics engines. Nothing at all: the built-in hand, a
    Franka hand with closed fingers.
    """

    urdf: str | None = None  # file whose links' collision shapes belong to the hand, joints at 0
    root: str | None = None  # the link of the urdf whose frame is the hand's; None: its base
    boxes: tuple[BoxRig, ...] = ()  # more parts, in the hand's frame


def open_hand(described: DescribedHand) -> ProbingHand:
    """The hand of a session.

    Raises SettingError for a URDF that cannot be used, and for a hand that is too large.
    """
    if described.urdf is None and not described.boxes:
        if described.root is not None:
            raise SettingError("hand.root without hand.urdf; accepted: both, or neither")
        return panda_hand()
    rig = HandRig(frame="hand", boxes=described.boxes, urdf=described.urdf, root=described.root)
    hulls = [_hull(part) for part in HandModel(rig).parts()]
    bounds = np.array([hull.bounds for hull in hulls])
    extents = bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)
    faces, area = sum(len(hull.faces) for hull in hulls), float(sum(hull.area for hull in hulls))
    # The surface is probed with a point to every square millimetre.
    for what, value, most in (
        ("m, its largest extent", float(extents.max()), LARGEST),
        ("m^2 of surface", area, MOST_SURFACE),
        ("faces", faces, MOST_FACES),
    ):
        if value > most:
            raise SettingError(
                f"the hand{_source(described)} has {value:.6g} {what}; accepted: at most {most:g}. "
                "Choose the link of the gripper as hand.root, without the arm, or simpler shapes"
            )
    return ProbingHand(hulls)


def _hull(part: trimesh.Trimesh) -> trimesh.Trimesh:
    """The convex hull of a part of the hand's frame, in the axes of `ProbingHand`."""
    import trimesh

    hull: Any = trimesh.convex.convex_hull(np.asarray(part.vertices) @ ROTATION.T)
    return hull


def _source(described: DescribedHand) -> str:
    return "" if described.urdf is None else f" of {described.urdf}"
