"""A rig: which topics, frames and thresholds turn a robot's log into known points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from chsel.errors import SettingError
from chsel.numerics.arrays import frozen
from chsel.problem.points import Workspace
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.settings import Check, CheckedSettings, not_negative, one_of, positive
from chsel.sensing.trajectory import TRAJECTORIES

NO_NORMALS = "none"  # setting of a sensor whose normals are not used
_HALF_TURN = 180.0  # degrees


def _fits(accepted: str, is_accepted: Callable[[Any], bool]) -> Check:
    """Return a check by a condition, which NaN does not fulfil, with what is accepted in words."""

    def check(name: str, value: Any) -> None:
        if not is_accepted(value):
            raise SettingError(f"{name} is {value!r}; accepted: {accepted}")

    return check


def _points(name: str, value: Any) -> None:
    """Raise SettingError unless a value is finite points (N, 3)."""
    frozen(name, value, shape=(None, 3), error=SettingError)


def _is_noise(value: Any) -> bool:
    """Return whether a value is a root mean square angle in degrees, or none."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return bool(0.0 < value <= _HALF_TURN) if number else bool(value == NO_NORMALS)


_NEEDED = {
    "pose": ("parent", "frame", "unit", "rotation"),
    "joints": ("joints", "unit"),
    "wrench": ("frame", "unit"),
    "taxels": ("frame", "points", "threshold"),
    "marker": (),
}
"""What the column of a kind has to say."""

_UNITS: dict[str, tuple[str | None, ...]] = {
    "pose": ("m", "cm", "mm"),
    "joints": ("rad", "deg", "m"),
    "wrench": ("N",),
    "taxels": (None,),
    "marker": (None,),
}
_ROTATIONS = {
    "quaternion_xyzw": 4,
    "quaternion_wxyz": 4,
    "rotation_vector": 3,
    "roll_pitch_yaw": 3,
    "matrix": 9,
}
"""Numbers of a rotation."""

_WITH_ANGLE = ("rotation_vector", "roll_pitch_yaw")

Vector = tuple[float, float, float]
Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
Name = Annotated[str, _fits("letters, digits and _", lambda name: name.replace("_", "").isalnum())]
Depths = Annotated[
    tuple[float, float],
    _fits("[nearest, furthest], metres", lambda depths: 0.0 <= depths[0] < depths[1]),
]
Fraction = Annotated[float, _fits("above 0, at most 1", lambda part: 0.0 < part <= 1.0)]
Part = Annotated[float, _fits("from 0 to 1", lambda part: 0.0 <= part <= 1.0)]
Degrees = Annotated[Any, _fits("none, or degrees above 0, up to 180", _is_noise)]
"""A root mean square angle or NO_NORMALS; settings of two types have no type that is read."""

Quantile = Annotated[float, _fits("from 0 to below 1", lambda part: 0.0 <= part < 1.0)]


@dataclass(frozen=True)
class ImageRig(CheckedSettings):
    """A sensor that sends depth images."""

    name: Name
    depth: str  # topic of its images
    info: str  # topic of its intrinsics
    frame: str | None = None  # of the optical centre; null: that of the messages
    unit: Annotated[float | None, positive] = None
    """Metres a unit of the image; null: 0.001 for integers, else 1."""

    range: Depths = (0.2, 5.0)  # metres, depths beyond are invalid
    rectified: bool | None = None
    """Whether P of its intrinsics counts in place of K; null: by the topic of its images, which is
    image_rect or the like by the convention of ROS."""


@dataclass(frozen=True)
class CameraRig(ImageRig):
    """A depth camera that looks at the workspace; its rays are free (CHSEL, Sec. V-B)."""

    fraction: Fraction = 0.95  # how far along its ray each depth is free
    edge: Annotated[float | None, positive] = 0.05
    """Metres; pixels within `edge_reach` pixels of a larger jump of depth are left out, as edges
    are measured badly; null: all pixels count."""

    rate: Annotated[float | None, positive] = 2.0  # images a second at most; null: all
    views: Annotated[int, positive] = 1  # in so many images a voxel must have been seen to be free
    edge_reach: Annotated[int, positive] = 5  # pixels


@dataclass(frozen=True)
class BubbleRig(ImageRig):
    """A soft-bubble pad: a depth camera behind a membrane that gives way (CHSEL, Sec. V-B)."""

    range: Depths = (0.01, 0.5)
    kind: Annotated[str, one_of("depth", "deformation")] = "depth"
    """Whether its images are of depth, whose change against a reference is the deformation, or of
    deformation."""

    reference: str | None = None
    """An image file (.png, .npy) of the untouched membrane; null: the median of the first images
    before the first probe."""

    normals: Degrees = NO_NORMALS
    """Root mean square angle by which normals of contacts, those of the membrane, are off, degrees;
    none: they are not used."""


@dataclass(frozen=True)
class ContactRig(CheckedSettings):
    """Thresholds by which contacts follow from deformations (CHSEL, Sec. V-B)."""

    filter: Annotated[int, positive] = 10  # side of the mean filter, pixels
    quantile: Quantile = 0.9
    """A pixel is in contact if its deformation is above this quantile of its image's, and above
    `threshold`."""

    threshold: Annotated[float, positive] = 0.004  # metres
    pixels: Annotated[int, positive] = 6  # fewer of them are no contact
    points: Annotated[int, positive] = 50
    """Most points of a contact, a random subset, which the pads share."""


@dataclass(frozen=True)
class BoxRig:
    """A box of the hand in its frame."""

    size: Vector  # full sides, metres
    position: Vector = (0.0, 0.0, 0.0)  # of its centre, metres
    rotation: Vector = (0.0, 0.0, 0.0)  # roll, pitch, yaw, radians

    def __post_init__(self) -> None:
        for side in self.size:
            positive("size", side)
        for name in ("position", "rotation"):
            frozen(name, getattr(self, name), shape=(3,), error=SettingError)


@dataclass(frozen=True)
class HandRig:
    """The hand, whose way is free space."""

    frame: str  # its transform frame
    pose: str | None = None  # topic of its pose, in place of transforms
    boxes: tuple[BoxRig, ...] = ()  # its solid parts, in its frame
    urdf: str | None = None  # file whose links' collision shapes belong to the hand
    root: str | None = None  # the link of the urdf that is `frame`; null: its base
    joints: str | None = None  # topic of the joints that pose the links


@dataclass(frozen=True)
class TouchRig(CheckedSettings):
    """A sensor that looks at a gel from behind, such as GelSight and DIGIT, and sends heights."""

    name: Name
    height: str  # topic of images of how far the gel is pressed in
    pixel: Annotated[float, positive]  # metres from one to the next
    frame: str | None = None
    """Of the middle of the image on the untouched gel, x along columns, y along rows, z out of the
    gel; null: that of the messages."""

    unit: Annotated[float | None, positive] = None
    """Metres a unit of the image; null: 1, for floating point alone."""

    threshold: Annotated[float, positive] = 0.0001  # metres: pixels pressed in by more touch
    normals: Degrees = NO_NORMALS
    """Root mean square angle by which normals are off, degrees; none: they are not used."""


@dataclass(frozen=True)
class TrajectoryRig(CheckedSettings):
    """A file of poses of a frame, as of motion capture, beside the transforms of the log."""

    file: str  # relative to the folder of the log
    kind: Annotated[str, one_of(*TRAJECTORIES)]
    parent: str  # frame in which the poses are
    child: str  # frame that was followed
    offset: float = 0.0  # seconds to be added to its times, for those of the log's stamps
    times: str | None = None  # file of a time a row, seconds, for kitti

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.kind == "kitti") is not (self.times is not None):
            raise SettingError(
                f"times is {self.times}, and kind {self.kind}; accepted: times=FILE for kitti, "
                "whose rows have none, and null for others"
            )


@dataclass(frozen=True)
class ColumnRig(CheckedSettings):
    """A column of a LeRobot dataset, whose files say neither frames nor units.

    Where another part of the rig names a topic, it names the column.
    """

    column: str
    kind: Annotated[str, one_of(*_NEEDED)]
    """"pose" of a frame, "joints", of which a urdf gives the pose of a link, "wrench": force and
    torque, "taxels", or "marker": the index of a probe, below 0 outside of probes."""

    select: tuple[int, ...] = ()  # which numbers of the column, in their order; none: all
    parent: str | None = None  # frame in which a pose is, or in which the root of the urdf is
    frame: str | None = None  # that is posed; a link; that of forces; that of taxels
    unit: str | None = None  # of places or joints: m, cm, mm, rad or deg; of forces: N
    rotation: str | None = None
    """How a pose has it behind its place: quaternion_xyzw, quaternion_wxyz, rotation_vector,
    roll_pitch_yaw, or matrix, row by row."""

    angle: str | None = None  # rad or deg, of a rotation_vector or roll_pitch_yaw
    joints: tuple[str, ...] = ()  # names of the numbers
    urdf: str | None = None  # file, relative to the dataset
    root: str | None = None  # link that is `parent`; null: the base of the urdf
    points: Annotated[tuple[Vector, ...], _points] = ()  # of taxels, metres, in their frame
    normals: Annotated[tuple[Vector, ...], _points] = ()
    """Out of the object, as taxels touch it, in their frame; none: they are not known."""

    threshold: float | None = None  # above which a taxel touches, in the unit of the column

    def __post_init__(self) -> None:
        super().__post_init__()
        needed = list(_NEEDED[self.kind])
        if self.rotation in _WITH_ANGLE:
            needed.append("angle")
        if self.urdf is not None:
            needed += ["parent", "frame"]
        missing = [name for name in needed if not getattr(self, name) and name != "threshold"]
        if "threshold" in needed and self.threshold is None:
            missing.append("threshold")
        if missing:
            raise SettingError(
                f"column {self.column} does not say {', '.join(missing)}, and no file of the "
                f"dataset does; accepted: all of kind {self.kind}, {', '.join(needed)}"
            )
        for name, accepted in (
            ("unit", _UNITS[self.kind]),
            ("rotation", (None, *_ROTATIONS)),
            ("angle", (None, "rad", "deg")),
        ):
            if getattr(self, name) not in accepted:
                shown = ", ".join(str(each) for each in accepted if each is not None) or "null"
                raise SettingError(f"{name} is {getattr(self, name)!r}; accepted: {shown}")
        if self.normals and len(self.normals) != len(self.points):
            raise SettingError(
                f"normals are {len(self.normals)} and points {len(self.points)}; accepted: as many"
            )
        if min(self.select, default=0) < 0:
            raise SettingError(f"select is {self.select}; accepted: indices from 0")

    @property
    def counts(self) -> tuple[int, ...]:
        """Accepted numbers of values in a row."""
        if self.kind == "pose":
            return (3 + _ROTATIONS[self.rotation or ""],)
        if self.kind == "joints":
            return (len(self.joints),)
        if self.kind == "taxels":
            return (len(self.points),)
        return (1,) if self.kind == "marker" else (3, 6)


@dataclass(frozen=True)
class CloudRig(CheckedSettings):
    """A topic of points, in the frame of its messages."""

    topic: str
    role: Annotated[str, one_of("rays", "surface", "contacts")]
    """Points whose way from the frame's origin is free; points on the object; or the same, within
    probes alone."""

    fraction: Annotated[float, positive] = 0.95  # of rays, as of a camera
    normals: Degrees = NO_NORMALS
    """Root mean square angle by which normals are off, degrees; none: they are not used.

    They are the fields normal_x, normal_y and normal_z of the messages, out of the object.
    Without these fields they are those of planes through the points up to twice
    `surface_resolution` away, towards the frame's origin.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.role == "rays" and self.normals != NO_NORMALS:
            raise SettingError(
                f"normals is {self.normals!r}, and role rays has no points on the object; "
                "accepted: none, or role surface or contacts"
            )


@dataclass(frozen=True)
class ForceRig(CheckedSettings):
    """A topic of forces and torques on the hand."""

    topic: str
    frame: str | None = None  # in which, and about whose origin, they are; null: the messages'
    threshold: Annotated[float, positive] = 3.0
    """Newtons beyond the tare, above which there is a contact."""

    samples: Annotated[int, positive] = 3  # so many in a row; fewer are a spike
    acts: Annotated[str, one_of("on_hand", "by_hand")] = "on_hand"
    """Whether forces are those on the hand, as the object pushes it, or by it, as it pushes."""

    torque: bool = True
    """Whether torques locate the contact; otherwise it is where the hand is furthest against
    the force. Also used while all torques are 0."""

    tare: Annotated[float, positive] = 1.0
    """Seconds before a probe's begin, whose median is subtracted: the hand's weight and drift."""

    reach: Annotated[float, positive] = 0.01
    """Metres by which the line of force may miss the hand."""

    points: Annotated[int, positive] = 5
    """Most points of a probe, the strongest of those in different voxels."""

    normals: Degrees = NO_NORMALS
    """Root mean square angle by which normals are off, degrees; none: they are not used.

    The normal of a contact is the direction of the force on the hand, which friction tilts.
    """


@dataclass(frozen=True)
class GateRig(CheckedSettings):
    """When pixels and points are connected, and which of their regions are left out."""

    jump: Annotated[float, positive] = 0.01
    """Neighbouring pixels are connected unless their depths differ by more than this share of the
    depth, besides what a surface inclined by up to 76 degrees explains."""

    gap: Annotated[float, positive] = 0.02
    """Points of clouds are connected up to this distance, metres, or up to four times the typical
    distance between neighbours where that is more."""

    part: Part = 0.05
    """Share of the largest region of an object; regions with fewer pixels or points are left out.

    With 0 none is left out for its size.
    """

    speckle: Annotated[int, not_negative] = 100
    """Fewest connected pixels whose rays are free up to their depth.

    Rays of fewer pixels are free up to the least depth around them alone; 0: none are.
    """


@dataclass(frozen=True)
class ProbeTimes:
    """A probe from its begin to its end, seconds since the first message of the log."""

    begin: float
    end: float


@dataclass(frozen=True)
class ExtraContacts(CheckedSettings):
    """Contacts that no sensor measured."""

    probe: int
    points: Annotated[tuple[Vector, ...], _points]  # (C, 3), metres, world


@dataclass(frozen=True)
class Annotations:
    """Knowledge of a person about one log."""

    exclude: tuple[int, ...] = ()  # probes whose contacts are not used
    contacts: tuple[ExtraContacts, ...] = ()


@dataclass(frozen=True)
class ClockRig(CheckedSettings):
    """Choice of the times that count."""

    stamp: Annotated[str, one_of("header", "log")] = "header"  # of the sender, or of the log
    offset: Annotated[float, positive] = 1.0
    """Seconds by which a topic's stamps may differ from the log's clock more than those of other
    topics do; beyond that they are shifted."""

    gap: Annotated[float, positive] = 0.5
    """Seconds between two transforms over which none is interpolated."""


@dataclass(frozen=True)
class Rig(CheckedSettings):
    """A rig."""

    name: str
    world: str  # frame of the workspace and of all known points
    workspace: Bounds | None = None  # of x, y and z, metres
    boundary: Annotated[str, one_of("box_shell", "none")] = "box_shell"
    """Whether the workspace's six faces are free."""

    cameras: tuple[CameraRig, ...] = ()
    bubbles: tuple[BubbleRig, ...] = ()
    contact: ContactRig = field(default_factory=ContactRig)
    hand: HandRig | None = None
    touches: tuple[TouchRig, ...] = ()
    trajectories: tuple[TrajectoryRig, ...] = ()
    columns: tuple[ColumnRig, ...] = ()  # of a LeRobot dataset, in place of a log's topics
    episode: Annotated[int | None, not_negative] = None  # of the dataset; null: its only one
    clouds: tuple[CloudRig, ...] = ()
    forces: tuple[ForceRig, ...] = ()
    markers: str | None = None
    """Topic of the begins and ends of probes: texts "begin N" and "end", integers (below 0: end),
    or true and false."""

    probes: tuple[ProbeTimes, ...] | None = None
    """Times in place of markers; without either the whole log is one probe."""

    clock: ClockRig = field(default_factory=ClockRig)
    annotations: Annotations = field(default_factory=Annotations)
    surface_resolution: Annotated[float, positive] = 0.005
    """Metres; one surface point a voxel of this side is kept of clouds and masks."""

    gate: GateRig = field(default_factory=GateRig)
    max_speed: Annotated[float, positive] = 3.0
    """m/s; a frame or a joint that moves faster has jumped: nothing is swept across."""

    max_turn: Annotated[float, positive] = 10.0  # rad/s, the same
    prior: Annotated[Any, prior_from_settings] = None
    """Fields of `chsel.PosePrior`, in the frame `world`; null: nothing is known of the pose."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workspace is not None:
            self.box()
        if self.forces and (self.hand is None or not (self.hand.boxes or self.hand.urdf)):
            raise SettingError(
                "forces need the solids of the hand, on which they act; accepted: hand.boxes, "
                "hand.urdf"
            )

    def box(self) -> Workspace:
        """Return the workspace. Raise SettingError if there is none, PointsError if it is empty."""
        if self.workspace is None:
            raise SettingError("workspace is missing; accepted: [[x0, x1], [y0, y1], [z0, z1]]")
        (x0, x1), (y0, y1), (z0, z1) = self.workspace
        return Workspace((x0, y0, z0), (x1, y1, z1))
