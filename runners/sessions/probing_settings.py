"""Settings of sources that probe with a gripper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from chsel.problem.points import NORMAL_NOISE
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.settings import (
    CheckedSettings,
    Presets,
    between,
    build_settings,
    not_negative,
    one_of,
    positive,
)
from runners.sessions.faults import CLEAN, LEVELS, FaultSettings
from runners.sessions.physics_engine import ENGINES
from runners.sessions.probing_hand import DescribedHand

Length = Annotated[float, positive]  # m
Force = Annotated[float, positive]  # N
Count = Annotated[int, not_negative]
_NOT_RECORDED = (
    ("engine", None),  # of a session without one
    *(("moves", 0.0), ("expect_moves", None)),  # an object that stands still
    *(("normals", "none"), ("normal_noise", NORMAL_NOISE)),  # of points in files
)
_NO_NORMALS = (  # of faults, which came later than others
    ("normals", None),
    ("normal_noise", 0.0),
    ("normal_wrong", 0.0),
    ("normal_tilt", 0.0),
)


@dataclass(frozen=True)
class ProbingSettings(CheckedSettings):
    """Settings of the gripper, of its probes, and of what is recorded of them."""

    configuration: str | None = None  # one of the 17, or FITTED; None: the object's
    engine: Annotated[str, one_of(*ENGINES)] | None = None
    """Physics engine of a simulated session; None: PyBullet where it is installed, else MuJoCo."""
    boundary: Annotated[str, one_of("floor_slab", "box_shell", "both")] = "floor_slab"
    """Voxels free from the start: two layers below the floor, the workspace's faces, or both."""
    workspace: Annotated[str, one_of("reference", "paper")] = "reference"
    """In "reference" the hammer's is larger; in "paper" all are alike."""
    sweep: Annotated[str, one_of("mini_steps", "control_steps")] = "mini_steps"
    """Positions at which free space is swept: all, or only those where control steps end."""
    collision_mesh: Annotated[str, one_of("visual", "vhacd")] = "visual"
    """Mesh in PyBullet: the mesh itself, or its convex parts."""
    # Side of a free voxel; None: 25 mm in the 17 configurations, as in the paper, 10 mm in FITTED.
    free_resolution: Length | None = None
    # Of the object's SDF grid; None: by the object, see `ObjectModel.resolution`.
    object_resolution: Length | None = None
    object_padding: Length = 0.05  # of the object's SDF grid
    interior_spacing: Length = 0.005  # of the hand's interior points
    interior_depth: Length = 0.010  # of the hand's interior points
    start_contacts: Count = 4  # registration begins when there are so many contacts
    start_probe: Count = 4  # and after the probe of this index
    step_length: Length = 0.03  # of a control step at full command
    push_steps: Annotated[int, positive] = 10  # most control steps of a push
    stop_force: Force = 5.0  # ends a push
    max_force: Force = 30.0  # of the hand's holder
    noise: Annotated[float, not_negative] = 0.005
    """Standard deviation, of a command between -1 and 1."""
    faults: FaultSettings = field(default_factory=FaultSettings)
    """Faults of what is reported, and of the registered mesh."""
    hand: DescribedHand = field(default_factory=DescribedHand)  # with which is probed
    # m: by which a push that touches the object then moves it. It turns about its centre, too: if
    # it is 0.2 m long, by a standard deviation of 1 degree for 5 mm, and less if it is longer.
    moves: Annotated[float, between(0.0, 0.1)] = 0.0
    # m: the largest distance per push that registration assumes; None: as `moves`.
    expect_moves: Annotated[float, between(0.0, 0.1)] | None = None
    prior: Annotated[Any, prior_from_settings] = None
    """Fields of `chsel.PosePrior`; None: nothing is known of the pose."""

    presets: ClassVar[Presets] = {
        "paper": {
            "boundary": "box_shell",
            "workspace": "paper",
            "start_contacts": 0,
            "start_probe": 0,
        },
        "reference": {"sweep": "control_steps", "collision_mesh": "vhacd"},
    }


def expected_moves(session: Mapping[str, Any]) -> float:
    """Return the largest distance per push that registration assumes, metres."""
    expected = session.get("expect_moves")
    return float(session.get("moves", 0.0) if expected is None else expected)


def without_defaults(session: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as they are recorded: some only where they are not the default."""
    session = _without_no_prior(session)
    defaults = {"faults": LEVELS[CLEAN], "hand": DescribedHand()}
    session = {k: v for k, v in session.items() if (k, v) not in _NOT_RECORDED}
    if isinstance(faults := session.get("faults"), Mapping):
        session["faults"] = {k: v for k, v in faults.items() if (k, v) not in _NO_NORMALS}
    return {
        key: value
        for key, value in session.items()
        if key not in defaults
        or not isinstance(value, Mapping)
        or build_settings(type(defaults[key]), value, where=f"session.{key}") != defaults[key]
    }


def _without_no_prior(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings without a prior that is None, in the settings of a rig, too."""
    return {
        key: _without_no_prior(value) if key == "rig" and isinstance(value, Mapping) else value
        for key, value in settings.items()
        if (key, value) != ("prior", None)
    }
