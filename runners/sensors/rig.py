"""A rig: which topics, frames and thresholds turn a robot's log into known points."""

from __future__ import annotations

from dataclasses import dataclass, field

from chsel.errors import SettingError, require_at_most, require_choice, require_positive
from chsel.numerics.arrays import frozen
from chsel.problem.points import Workspace

_MOST = 1_000_000  # pixels, metres, shares


@dataclass(frozen=True)
class GateRig:
    """When pixels and points are connected, and which of their regions are left out."""

    jump: float = 0.01
    """Neighbouring pixels are connected unless their depths differ by more than this share of the
    depth, besides what a surface inclined by up to 76 degrees explains."""

    gap: float = 0.02
    """Points of clouds are connected up to this distance, metres, or up to four times the typical
    distance between neighbours where that is more."""

    part: float = 0.05
    """Of an object, regions with fewer pixels or points than this share of the largest are left
    out; 0: none is for its size."""

    speckle: int = 100
    """Where fewer pixels than this are connected, a camera's rays are free up to the least depth
    around them alone; 0: nowhere."""

    def __post_init__(self) -> None:
        for name in ("jump", "gap"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _MOST)
        if not 0.0 <= self.part <= 1.0:
            raise SettingError(f"part is {self.part}; accepted: from 0 to 1")
        require_positive("speckle", self.speckle, zero=True)
        require_at_most("speckle", self.speckle, _MOST)


_MOST_POINTS = 1000
_LEAST_FORCE = 0.001  # N
_LARGEST = 1e6  # seconds, newtons, metres


@dataclass(frozen=True)
class ForceRig:
    """A topic of forces and torques on the hand."""

    topic: str
    frame: str | None = None  # in which, and about whose origin, they are; null: the messages'
    threshold: float = 3.0  # newtons beyond the tare, above which there is a contact
    samples: int = 3  # so many in a row; fewer are a spike
    acts: str = "on_hand"
    """Whether forces are those "on_hand", as the object pushes it, or "by_hand", as it pushes."""

    torque: bool = True
    """Whether torques tell where the contact is; otherwise it is where the hand is furthest against
    the force. Also used while all torques are 0."""

    tare: float = 1.0
    """Seconds before a probe's begin, whose median is subtracted: the hand's weight and drift."""

    reach: float = 0.01  # metres by which the line of force may miss the hand
    points: int = 5  # of a probe at most, the strongest of those in different voxels

    def __post_init__(self) -> None:
        for name in ("threshold", "tare", "reach"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _LARGEST)
        if self.threshold < _LEAST_FORCE:
            raise SettingError(
                f"threshold is {self.threshold:g} N; accepted: from {_LEAST_FORCE:g} N"
            )
        for name in ("samples", "points"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _MOST_POINTS)
        require_choice("acts", self.acts, ("on_hand", "by_hand"))


_LARGEST_HAND = 100.0  # metres
_LONGEST = 1e9  # seconds; they are counted in nanoseconds

Vector = tuple[float, float, float]
Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class CameraRig:
    """A depth camera that looks at the workspace; its rays are free (CHSEL, Sec. V-B).

    depth, info: topics. frame: of the optical centre; null: that of the messages. unit: metres a
    unit of the image; null: 0.001 for integers, 1 for floating point. range: metres, depths beyond
    are invalid. fraction: how far along its ray each pixel's depth is free. edge: metres; pixels
    within `edge_reach` pixels of a larger jump of depth are left out, as occlusion edges are
    measured badly; null: all pixels count. rate: images a second that are used at most; null: all.
    rays: "traversal" of every voxel, or the reference's "scaled_images". views: in so many images a
    voxel must have been seen to be free.
    """

    name: str
    depth: str
    info: str
    frame: str | None = None
    unit: float | None = None
    range: tuple[float, float] = (0.2, 5.0)
    fraction: float = 0.95
    edge: float | None = 0.05
    rate: float | None = 2.0
    rays: str = "traversal"
    views: int = 1
    edge_reach: int = 5

    def __post_init__(self) -> None:
        _check_camera(self.name, self.unit, self.range)
        require_positive("edge_reach", self.edge_reach)
        require_at_most("edge_reach", self.edge_reach, 100)
        require_positive("fraction", self.fraction)
        if self.fraction > 1.0:
            raise SettingError(f"fraction is {self.fraction}; accepted: above 0, at most 1")
        require_choice("rays", self.rays, ("traversal", "scaled_images"))
        for name in ("edge", "rate"):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name))
        require_positive("views", self.views)


@dataclass(frozen=True)
class BubbleRig:
    """A soft-bubble pad: a depth camera behind a membrane that gives way (CHSEL, Sec. V-B).

    kind: its topic has "depth" images, whose change against a reference is the deformation, or
    "deformation" images. reference: an image file (.png, .npy) of the untouched membrane; null: the
    median of the first images before the first probe.
    """

    name: str
    depth: str
    info: str
    frame: str | None = None
    unit: float | None = None
    range: tuple[float, float] = (0.01, 0.5)
    kind: str = "depth"
    reference: str | None = None

    def __post_init__(self) -> None:
        _check_camera(self.name, self.unit, self.range)
        require_choice("kind", self.kind, ("depth", "deformation"))


@dataclass(frozen=True)
class ContactRig:
    """How contacts follow from deformations (CHSEL, Sec. V-B; methods, Sec. 10.2).

    filter: side in pixels of the mean filter. quantile, threshold: a pixel is in contact if its
    deformation is above this quantile of its image's and above so many metres. pixels: fewer of
    them are no contact. points: of a contact at most, a random subset. per: a "contact", whose
    points the pads share, or each "camera". reference_images: so many make up a missing reference.
    """

    filter: int = 10
    quantile: float = 0.9
    threshold: float = 0.004
    pixels: int = 6
    points: int = 50
    per: str = "contact"
    reference_images: int = 10

    def __post_init__(self) -> None:
        for name in ("filter", "threshold", "pixels", "points", "reference_images"):
            require_positive(name, getattr(self, name))
        require_at_most("filter", self.filter, 200)
        if not 0.0 <= self.quantile < 1.0:
            raise SettingError(f"quantile is {self.quantile}; accepted: from 0 to below 1")
        require_choice("per", self.per, ("contact", "camera"))


@dataclass(frozen=True)
class BoxRig:
    """A box of the hand in its frame: full sides, centre, metres; roll, pitch, yaw, radians."""

    size: Vector
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for side in self.size:
            require_positive("size", side)
            require_at_most("size", side, _LARGEST_HAND)
        for distance in frozen("position", self.position, (3,), error=SettingError).tolist():
            require_at_most("distance from the hand's frame", abs(distance), _LARGEST_HAND)


@dataclass(frozen=True)
class HandRig:
    """The hand, whose way is free space.

    frame: its transform frame; pose: a topic with its pose in place of transforms. boxes, urdf: its
    solid parts, in that frame; urdf: a file whose links' collision shapes, posed by the messages
    of `joints`, belong to the hand; root: the link of the urdf that is `frame`; null: its base.
    sweep: all of the "path", or as the reference the pads' surfaces and what is between them,
    drawn "backwards" along the hand's z axis.
    """

    frame: str
    pose: str | None = None
    boxes: tuple[BoxRig, ...] = ()
    urdf: str | None = None
    root: str | None = None
    joints: str | None = None
    sweep: str = "path"

    def __post_init__(self) -> None:
        require_choice("sweep", self.sweep, ("path", "backwards"))


@dataclass(frozen=True)
class CloudRig:
    """A topic of points, in the frame of its messages.

    role: "rays", whose way from the frame's origin is free; "surface", points on the object; or
    "contacts", the same, within probes alone. fraction: of "rays", as of a camera.
    """

    topic: str
    role: str
    fraction: float = 0.95

    def __post_init__(self) -> None:
        require_choice("role", self.role, ("rays", "surface", "contacts"))
        require_positive("fraction", self.fraction)


@dataclass(frozen=True)
class ProbeTimes:
    """A probe from its begin to its end, seconds since the first message of the log."""

    begin: float
    end: float


@dataclass(frozen=True)
class ExtraContacts:
    """Contacts that no sensor told: points (C, 3) in the world, or the mean of the bubbles'
    `foremost` points furthest along the hand's z axis at the end of the probe's push."""

    probe: int
    points: tuple[Vector, ...] = ()
    foremost: int = 0

    def __post_init__(self) -> None:
        for index, point in enumerate(self.points):
            frozen(f"points[{index}]", point, (3,), error=SettingError)
        require_positive("foremost", self.foremost, zero=True)


@dataclass(frozen=True)
class Annotations:
    """What a person knows about one log. exclude: probes whose contacts are not used."""

    exclude: tuple[int, ...] = ()
    contacts: tuple[ExtraContacts, ...] = ()


@dataclass(frozen=True)
class ClockRig:
    """Which times count. stamp: "header", by the sender, or "log".

    offset: seconds by which a topic's stamps may differ from the log's clock more than those of
    other topics do; beyond that they are shifted. gap: seconds between two transforms over which
    none is interpolated. jump: seconds by which the log's time may step before it is reported.
    """

    stamp: str = "header"
    offset: float = 1.0
    gap: float = 0.5
    jump: float = 10.0

    def __post_init__(self) -> None:
        require_choice("stamp", self.stamp, ("header", "log"))
        for name in ("offset", "gap", "jump"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _LONGEST)


@dataclass(frozen=True)
class Rig:
    """All about a rig.

    world: frame of the workspace and of all known points. workspace: x, y, z bounds, metres.
    boundary: the workspace's six faces are free ("box_shell"), or not ("none"). markers: topic that
    says where probes begin and end, with texts "begin N" and "end", integers (below 0: end), or
    true and false. probes: their times in place of markers; without either the whole log is one.
    surface_resolution: metres; one surface point a voxel of this side is kept of clouds and masks.
    gate: which pixels and points are left out, as they are not connected with the others.
    """

    name: str
    world: str
    workspace: Bounds | None = None
    boundary: str = "box_shell"
    cameras: tuple[CameraRig, ...] = ()
    bubbles: tuple[BubbleRig, ...] = ()
    contact: ContactRig = field(default_factory=ContactRig)
    hand: HandRig | None = None
    clouds: tuple[CloudRig, ...] = ()
    forces: tuple[ForceRig, ...] = ()
    markers: str | None = None
    probes: tuple[ProbeTimes, ...] | None = None
    clock: ClockRig = field(default_factory=ClockRig)
    annotations: Annotations = field(default_factory=Annotations)
    surface_resolution: float = 0.005
    gate: GateRig = field(default_factory=GateRig)

    def __post_init__(self) -> None:
        require_choice("boundary", self.boundary, ("box_shell", "none"))
        require_positive("surface_resolution", self.surface_resolution)
        if self.workspace is not None:
            self.box()
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) < len(names):
            raise SettingError(f"sensors are named {', '.join(names)}; accepted: each name once")
        if self.forces and (self.hand is None or not (self.hand.boxes or self.hand.urdf)):
            raise SettingError(
                "forces need the solids of the hand, on which they act; accepted: hand.boxes, "
                "hand.urdf"
            )

    @property
    def sensors(self) -> tuple[CameraRig | BubbleRig, ...]:
        """All that send depth images: the cameras, then the pads."""
        return (*self.cameras, *self.bubbles)

    def box(self) -> Workspace:
        """The workspace. Raises SettingError if there is none, PointsError if it is empty."""
        if self.workspace is None:
            raise SettingError("workspace is missing; accepted: [[x0, x1], [y0, y1], [z0, z1]]")
        (x0, x1), (y0, y1), (z0, z1) = self.workspace
        return Workspace((x0, y0, z0), (x1, y1, z1))


def _check_camera(name: str, unit: float | None, reach: tuple[float, float]) -> None:
    if not name or not name.replace("_", "").isalnum():
        raise SettingError(f"name is {name!r}; accepted: letters, digits and _")
    if unit is not None:
        require_positive("unit", unit)
    if not 0.0 <= reach[0] < reach[1]:
        raise SettingError(f"range is {list(reach)}; accepted: [nearest, furthest], metres")
