"""How the gripper of a simulated session probes, and what is written down of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from chsel.errors import require_choice, require_positive
from chsel.problem.settings import Presets, build_settings
from runners.sessions.faults import CLEAN, LEVELS, FaultSettings
from runners.sessions.probing_hand import DescribedHand

BOUNDARIES = ("floor_slab", "box_shell", "both")
SWEEPS = ("mini_steps", "control_steps")
COLLISION_MESHES = ("visual", "vhacd")
WORKSPACES = ("reference", "paper")


@dataclass(frozen=True)
class ProbingSettings:
    """How the gripper probes, and what is written down of it."""

    configuration: str | None = None  # name of one of the 17; None: the object's own
    boundary: str = "floor_slab"
    """Voxels free from the start: two layers below the floor, the workspace's faces, or both."""
    workspace: str = "reference"  # in which the hammer's is larger; in "paper" all are alike
    sweep: str = "mini_steps"  # where free space is swept, or only where control steps end
    collision_mesh: str = "visual"  # of PyBullet: the mesh itself, or its convex parts
    free_resolution: float = 0.025  # side of a free voxel, m
    object_resolution: float = 0.010  # of the object's SDF grid, m
    object_padding: float = 0.05  # of the object's SDF grid, m
    interior_spacing: float = 0.005  # of the hand's interior points, m
    interior_depth: float = 0.010  # of the hand's interior points, m
    start_contacts: int = 4  # registration begins when there are so many contacts
    start_probe: int = 4  # and after the probe of this index
    step_length: float = 0.03  # of a control step at full command, m
    push_steps: int = 10  # most control steps of a push
    stop_force: float = 5.0  # ends a push, N
    max_force: float = 30.0  # of the hand's holder, N
    noise: float = 0.005  # standard deviation, of a command between -1 and 1
    faults: FaultSettings = field(default_factory=FaultSettings)
    """Of what is reported, and of the registered mesh."""
    hand: DescribedHand = field(default_factory=DescribedHand)  # with which is probed

    presets: ClassVar[Presets] = {
        "paper": {
            "boundary": "box_shell",
            "workspace": "paper",
            "start_contacts": 0,
            "start_probe": 0,
        },
        "reference": {"sweep": "control_steps", "collision_mesh": "vhacd"},
    }

    def __post_init__(self) -> None:
        require_choice("boundary", self.boundary, BOUNDARIES)
        require_choice("workspace", self.workspace, WORKSPACES)
        require_choice("sweep", self.sweep, SWEEPS)
        require_choice("collision_mesh", self.collision_mesh, COLLISION_MESHES)
        for name in (
            "free_resolution",
            "object_resolution",
            "object_padding",
            "interior_spacing",
            "interior_depth",
            "step_length",
            "push_steps",
            "stop_force",
            "max_force",
        ):
            require_positive(name, getattr(self, name))
        for name in ("start_contacts", "start_probe", "noise"):
            require_positive(name, getattr(self, name), zero=True)


def without_defaults(session: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a session as they are recorded: `faults` and `hand` only where there are any."""
    defaults = {"faults": LEVELS[CLEAN], "hand": DescribedHand()}
    return {
        key: value
        for key, value in session.items()
        if key not in defaults
        or not isinstance(value, Mapping)
        or build_settings(type(defaults[key]), value, f"session.{key}") != defaults[key]
    }
