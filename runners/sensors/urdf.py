"""The links of a URDF below one of them: collision shapes, placed by the values of joints."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.parsers import expat

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import axis_angle, compose
from runners.sensors.collision_shapes import MeshFiles, collision_solid

if TYPE_CHECKING:
    import trimesh


MOST_BYTES = 8 * 2**20  # those of whole humanoids have 0.3 MB
MOST_ELEMENTS = 50_000
_DEEPEST = 32  # level of nested elements; a URDF has 5


def read_robot(path: Path, where: str) -> Any:
    """The file as a Robot of yourdfpy: its links and joints, no mesh read yet.

    where: names the file in messages. Raises SettingError for a file that is no URDF or out of
    bounds, and if the package yourdfpy is missing.
    """
    content = _content(path, where)
    _check_xml(content, where)
    try:
        from yourdfpy import URDF  # optional: rigs of boxes need none
    except ImportError:
        raise SettingError(
            f"{where} needs the package yourdfpy; install it where the project is: "
            "pip install -e '.[urdf]'"
        ) from None
    try:
        model = URDF.load(io.BytesIO(content), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # it raises whatever it stumbles over
        reason = " ".join(str(error).split())[:200]
        raise SettingError(
            f"{where} is not a URDF ({type(error).__name__}: {reason}); accepted: a robot of links "
            "and joints with all their attributes"
        ) from None
    return model.robot


def _content(path: Path, where: str) -> bytes:
    if not path.is_file():
        kind = "is a folder" if path.is_dir() else "does not exist"
        raise SettingError(f"{where} {kind}; accepted: a URDF file")
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise SettingError(f"{where} is too large; accepted: at most {MOST_BYTES} bytes")
    return content


def _check_xml(content: bytes, where: str) -> None:
    """Refuse what could make a reader of XML expand, recurse or read other files."""
    parser, depth, count = expat.ParserCreate(), 0, 0

    def start(tag: str, _: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > _DEEPEST or count > MOST_ELEMENTS:
            raise SettingError(
                f"{where} has too many elements, or too deep ones; accepted: at most "
                f"{MOST_ELEMENTS}, {_DEEPEST} deep"
            )
        if tag.startswith("xacro:"):
            raise SettingError(f"{where} holds xacro macros; accepted: what the tool xacro makes")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: Any) -> None:
        raise SettingError(f"{where} has a DOCTYPE; accepted: URDF without one")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise SettingError(f"{where} is not XML ({error}); accepted: a URDF file") from None


MOST_FACES = 1_000_000  # of all shapes of a hand
_MOST_MIMICS = 100  # joints in a chain of mimicry
_TURNING = ("revolute", "continuous")
_TYPES = (*_TURNING, "prismatic", "fixed", "floating", "planar")


class Linkage:
    """The links of a URDF below one of them, which move with it.

    path: of the file. root: the link whose frame is the hand's; None: the link that is below no
    other. joint_names: joints whose values move any solid. warnings: on how the file was taken.
    Raises SettingError, which names the file, for one that cannot be used.
    """

    def __init__(self, path: Path, root: str | None = None) -> None:
        self._where = f"hand.urdf {path}"
        path = path.expanduser()
        robot = read_robot(path, self._where)
        self._joints = {joint.name: joint for joint in robot.joints}
        links = {link.name: link for link in robot.links}
        self._check(robot, links)
        self._root = self._chosen_root(root, list(links))
        self._chain = self._below(self._root)  # from the root outwards
        own = [self._root, *(joint.child for joint in self._chain)]
        files = MeshFiles(path)
        self._shapes = self._all_shapes([links[name] for name in own], files)
        moving = self._moving()
        self.joint_names = tuple(dict.fromkeys(self._driver(joint)[0] for joint in moving))
        self.warnings = (*files.warnings, *self._fixed_remarks())

    def solids(self, joints: Mapping[str, float]) -> list[trimesh.Trimesh]:
        """Closed solids in the root's frame; joints: values, radians or metres, 0 if missing."""
        root_from_link = {self._root: np.eye(4)}
        for joint in self._chain:
            root_from_link[joint.child] = root_from_link[joint.parent] @ self._placed(joint, joints)
        return [
            mesh.copy().apply_transform(root_from_link[link])
            for link, meshes in self._shapes.items()
            for mesh in meshes
        ]

    def _check(self, robot: Any, links: Mapping[str, Any]) -> None:
        if not links:
            raise self._error("has no links; accepted: a robot of links and joints")
        if len(links) < len(robot.links) or len(self._joints) < len(robot.joints):
            raise self._error("has two links or two joints of one name; accepted: each name once")
        children: set[str] = set()
        for joint in robot.joints:
            for link in (joint.parent, joint.child):
                if link not in links:
                    raise self._error(f"joint {joint.name} holds link {link!r}, which is missing")
            if joint.child in children:
                raise self._error(f"link {joint.child} has two parent joints; accepted: one")
            children.add(joint.child)
            self._check_joint(joint)

    def _check_joint(self, joint: Any) -> None:
        if joint.type not in _TYPES:
            raise self._error(
                f"joint {joint.name} has type {joint.type!r}; accepted: {', '.join(_TYPES)}"
            )
        if joint.origin is not None and not np.isfinite(joint.origin).all():
            raise self._error(f"joint {joint.name}: origin is not finite")
        if joint.type in (*_TURNING, "prismatic"):
            axis = np.asarray(joint.axis, dtype=float)
            if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
                raise self._error(f"joint {joint.name}: axis is {axis.tolist()}; accepted: x y z")
        if joint.mimic is not None:
            self._driver(joint)

    def _chosen_root(self, root: str | None, links: list[str]) -> str:
        if root is not None:
            if root in links:
                return root
            raise SettingError(
                f"hand.root {root!r} is no link of {self._where}; accepted: {_some(links)}"
            )
        children = {joint.child for joint in self._joints.values()}
        bases = [name for name in links if name not in children]
        if len(bases) == 1:
            return bases[0]
        if not bases:
            raise self._error("has a cycle of joints and no base link; accepted: a tree of links")
        raise self._error(f"has several base links; set hand.root, accepted: {_some(bases)}")

    def _below(self, root: str) -> list[Any]:
        """The joints below a link, each after the one above it."""
        hanging: dict[str, list[Any]] = {}
        for joint in self._joints.values():
            hanging.setdefault(joint.parent, []).append(joint)
        chain: list[Any] = list(hanging.get(root, []))
        for joint in chain:  # grows while it is walked
            if joint.child == root:
                raise self._error(f"has a cycle of joints through link {root}; accepted: a tree")
            chain += hanging.get(joint.child, [])
        return chain

    def _all_shapes(self, links: list[Any], files: MeshFiles) -> dict[str, list[trimesh.Trimesh]]:
        """The solids of each link that has any, in the link's frame."""
        shapes: dict[str, list[trimesh.Trimesh]] = {}
        faces = 0
        for link in links:
            for collision in link.collisions:
                mesh = collision_solid(collision, files, f"{self._where} link {link.name}")
                faces += len(mesh.faces)
                if faces > MOST_FACES:
                    raise self._error(f"has more than {MOST_FACES} faces; accepted: fewer")
                shapes.setdefault(link.name, []).append(mesh)
        if not shapes:
            raise self._error(
                f"has no collision shape at or below link {self._root}; accepted: at least one"
            )
        return shapes

    def _placed(self, joint: Any, joints: Mapping[str, float]) -> FloatArray:
        """parent_from_child (4, 4) of a joint at its value."""
        origin = np.eye(4) if joint.origin is None else joint.origin
        if joint.type not in (*_TURNING, "prismatic"):
            return origin
        value = self._value(joint, joints)
        axis = joint.axis / np.sqrt((joint.axis**2).sum())
        if joint.type == "prismatic":
            return origin @ compose(np.eye(3), value * axis)
        return origin @ compose(axis_angle(axis, value), np.zeros(3))

    def _value(self, joint: Any, joints: Mapping[str, float]) -> float:
        """A joint's value: its own, or by the joint that it mimics, or 0."""
        name, multiplier, offset = joint.name, 1.0, 0.0
        if name not in joints:
            name, multiplier, offset = self._driver(joint)
        value = multiplier * float(joints.get(name, 0.0)) + offset
        if not np.isfinite(value):
            raise SettingError(f"joint {name} is {joints.get(name)!r}; accepted: a finite number")
        return value

    def _driver(self, joint: Any) -> tuple[str, float, float]:
        """The joint at the end of a chain of mimicry, and the factor and offset from its value."""
        multiplier, offset, seen = 1.0, 0.0, {joint.name}
        while joint.mimic is not None:
            mimic = joint.mimic
            offset += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            if mimic.joint not in self._joints or mimic.joint in seen or len(seen) > _MOST_MIMICS:
                raise self._error(
                    f"joint {joint.name} mimics {mimic.joint!r}; accepted: another joint, which "
                    "does not in turn mimic it"
                )
            seen.add(mimic.joint)
            joint = self._joints[mimic.joint]
        return joint.name, multiplier, offset

    def _moving(self) -> list[Any]:
        """The joints with values that have a solid below them."""
        laden, moving = set(self._shapes), []
        for joint in reversed(self._chain):
            if joint.child in laden:
                laden.add(joint.parent)
                if joint.type in (*_TURNING, "prismatic"):
                    moving.append(joint)
        return moving[::-1]

    def _fixed_remarks(self) -> Iterator[str]:
        for joint in self._chain:
            if joint.type in ("floating", "planar"):
                yield f"{self._where}: joint {joint.name} is {joint.type}; it stays at its origin"

    def _error(self, text: str) -> SettingError:
        return SettingError(f"{self._where} {text}")


def _some(names: list[str]) -> str:
    """Names for a message, which stays a line."""
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
