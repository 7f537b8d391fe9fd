"""The solid parts of the hand: boxes of the rig, and the links of a URDF."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from chsel.errors import SettingError
from chsel.problem.poses import compose, roll_pitch_yaw
from runners.sensors.rig import BoxRig, HandRig

if TYPE_CHECKING:
    import trimesh

_MOVING = ("revolute", "continuous", "prismatic")
_TYPES = (*_MOVING, "fixed", "floating", "planar")
_CYLINDER_SIDES = 32  # the prism lies within the cylinder, so it claims no free space too much


class HandModel:
    """The solids of a hand, read once, placed as often as joints move.

    joint_names: joints whose values move any of them. warnings: what a user should know of how
    they were read. Raises SettingError for a URDF that cannot be used.
    """

    def __init__(self, rig: HandRig) -> None:
        self._boxes = [_box(box) for box in rig.boxes]
        self._linkage = None if rig.urdf is None else _Linkage(Path(rig.urdf), rig.root)
        self.joint_names = () if self._linkage is None else self._linkage.joint_names
        self.warnings = () if self._linkage is None else self._linkage.warnings

    def parts(self, joints: Mapping[str, float] | None = None) -> list[trimesh.Trimesh]:
        """Closed solids in the hand's frame, metres; they may overlap.

        joints: values by name, radians or metres. Those of other joints do not matter, missing
        ones are 0.
        """
        links = [] if self._linkage is None else self._linkage.solids(joints or {})
        return self._boxes + links

    def solids(self, joints: Mapping[str, float] | None = None) -> trimesh.Trimesh | None:
        """All parts as one mesh of several closed bodies; None if the rig describes none."""
        import trimesh

        parts = self.parts(joints)
        joined: Any = trimesh.util.concatenate(parts) if parts else None
        return joined


def _box(box: BoxRig) -> trimesh.Trimesh:
    import trimesh

    hand_from_box = compose(roll_pitch_yaw(np.array(box.rotation)), np.array(box.position))
    return trimesh.creation.box(box.size, hand_from_box)


class _Linkage:
    """The links of a URDF at and below `root`, which move with it; kinematics by yourdfpy."""

    def __init__(self, path: Path, root: str | None) -> None:
        self._where = f"hand.urdf {path}"
        path = path.expanduser()
        robot = self._read(path)
        links = {link.name: link for link in robot.links}
        joints = {joint.name: joint for joint in robot.joints}
        self._check_joints(robot.joints, links)
        self._root = self._chosen_root(root, [link.name for link in robot.links], robot.joints)
        below = [self._root]
        for link in below:  # grows while it is walked
            below += [joint.child for joint in robot.joints if joint.parent == link]
        robot.links = [links[name] for name in below]
        robot.joints = [joint for name in below for joint in robot.joints if joint.parent == name]
        moving = [joint for joint in robot.joints if joint.type in _MOVING]
        self._drivers = {joint.name: self._driver(joint, joints) for joint in moving}
        self.joint_names = tuple(dict.fromkeys(name for name, _, _ in self._drivers.values()))
        self.warnings = [
            f"{self._where}: joint {joint.name} is {joint.type}; it stays at its origin"
            for joint in robot.joints
            if joint.type not in (*_MOVING, "fixed")
        ]
        self._shapes = [
            (link.name, self._solid(collision, path, f"{self._where} link {link.name}"))
            for link in robot.links
            for collision in link.collisions
        ]
        if not self._shapes:
            raise self._error(
                f"has no collision shape at or below link {self._root}; accepted: at least one"
            )
        self._model = self._kinematics(robot)

    def solids(self, joints: Mapping[str, float]) -> list[trimesh.Trimesh]:
        """Closed solids in the root's frame; joints: values, radians or metres, 0 if missing."""
        values = {
            name: joints[name] if name in joints else factor * joints.get(driver, 0.0) + offset
            for name, (driver, factor, offset) in self._drivers.items()
        }
        self._model.update_cfg(values)
        return [
            mesh.copy().apply_transform(self._model.get_transform(link, self._root))
            for link, mesh in self._shapes
        ]

    def _read(self, path: Path) -> Any:
        """The file as a Robot of yourdfpy: its links and joints."""
        if not path.is_file():
            kind = "is a folder" if path.is_dir() else "does not exist"
            raise self._error(f"{kind}; accepted: a URDF file")
        try:
            from yourdfpy import URDF  # optional: rigs of boxes need none
        except ImportError:
            raise self._error(
                "needs the package yourdfpy; install it where the project is: "
                "pip install -e '.[sensors]'"
            ) from None
        content = path.read_bytes()
        if b"<xacro:" in content:
            raise self._error("holds xacro macros; accepted: what the tool xacro makes")
        try:
            ElementTree.fromstring(content)  # yourdfpy logs what is wrong, and goes on
            file = io.BytesIO(content)
            robot = URDF.load(file, build_scene_graph=False, load_meshes=False).robot
        except Exception as error:  # it raises whatever it stumbles over
            raise self._error(
                f"is not a URDF ({type(error).__name__}: {_one_line(error)}); accepted: a robot of "
                "links and joints with all their attributes"
            ) from None
        return robot

    def _check_joints(self, joints: list[Any], links: Mapping[str, Any]) -> None:
        for joint in joints:
            if not {joint.parent, joint.child} <= links.keys():
                raise self._error(
                    f"joint {joint.name} joins {joint.parent!r}, {joint.child!r}; accepted: links"
                )
            if joint.type not in _TYPES:
                raise self._error(f"joint {joint.name} has type {joint.type!r}; accepted: {_TYPES}")
            if joint.type in _MOVING and not (len(joint.axis) == 3 and np.any(joint.axis)):
                raise self._error(f"joint {joint.name}: axis is {joint.axis}; accepted: x y z")

    def _chosen_root(self, root: str | None, links: list[str], joints: list[Any]) -> str:
        children = [joint.child for joint in joints]
        bases = [name for name in links if name not in children]
        if len(set(links)) < len(links) or len(set(children)) < len(children) or not bases:
            raise self._error("is not a tree; accepted: each link once, with one parent at most")
        accepted = bases if root is None and len(bases) > 1 else links
        if root not in accepted and (root is not None or len(bases) > 1):
            raise SettingError(
                f"hand.root {root!r} is not one of {self._where}; accepted: {', '.join(accepted)}"
            )
        return root or bases[0]

    def _driver(self, joint: Any, joints: Mapping[str, Any]) -> tuple[str, float, float]:
        """The joint at the end of a chain of mimics, and the factor and offset from its value."""
        name, factor, offset = joint.name, 1.0, 0.0
        for _ in joints:
            if joint.mimic is None:
                return joint.name, factor, offset
            mimicked = joint.mimic.joint
            if mimicked not in joints:
                break
            offset += factor * joint.mimic.offset
            factor *= joint.mimic.multiplier
            joint = joints[mimicked]
        raise self._error(
            f"joint {name} mimics {mimicked!r}; accepted: another joint, which does not in turn "
            "mimic it"
        )

    def _kinematics(self, robot: Any) -> Any:
        """The model whose transforms follow from values of joints.

        yourdfpy follows one mimic alone, looks up another joint's value after a planar or floating
        one, and moves prismatic joints by the length of their axes: values are resolved here.
        """
        from yourdfpy import URDF

        for joint in robot.joints:
            joint.mimic = None
            if joint.type in _MOVING:
                joint.axis = joint.axis / np.sqrt((joint.axis**2).sum())
        for link in robot.links:
            link.visuals = []
        return URDF(robot, load_meshes=False)

    def _solid(self, collision: Any, urdf: Path, where: str) -> trimesh.Trimesh:
        """The closed solid of a Collision of yourdfpy in its link's frame."""
        import trimesh

        shape = collision.geometry
        if shape.mesh is not None:
            solid = self._mesh(shape.mesh, urdf, where)
        elif shape.box is not None:
            solid = trimesh.creation.box(_sizes(where, *shape.box.size))
        elif shape.sphere is not None:
            (radius,) = _sizes(where, shape.sphere.radius)
            solid = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        else:
            radius, height = _sizes(where, shape.cylinder.radius, shape.cylinder.length)
            solid = trimesh.creation.cylinder(radius, height, sections=_CYLINDER_SIDES)
        if collision.origin is not None:
            solid.apply_transform(collision.origin)
        if not np.isfinite(solid.vertices).all():
            raise SettingError(f"{where}: a collision shape is not finite")
        return solid

    def _mesh(self, described: Any, urdf: Path, where: str) -> trimesh.Trimesh:
        """The closed solid in a file; its convex hull if it is open."""
        import trimesh

        path = _mesh_file(described.filename or "", urdf, where)
        try:
            loaded: Any = trimesh.load(
                str(path), force="mesh", process=False, skip_materials=True, ignore_broken=True
            )
            mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
            mesh.merge_vertices()
            closed = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume != 0.0
            mesh = mesh if closed else mesh.convex_hull
        except Exception as error:  # readers of damaged files raise whatever they stumble over
            raise SettingError(
                f"{where}: mesh {path} cannot be read, or is no solid: {_one_line(error)}"
            ) from None
        if not closed:
            self.warnings.append(f"{where}: mesh {path} is open; its convex hull is used")
        if mesh.volume < 0.0:
            mesh.invert()
        if described.scale is not None:
            scale = np.broadcast_to(described.scale, (3,))
            mesh.apply_transform(np.diag([*scale, 1.0]))
        return mesh

    def _error(self, text: str) -> SettingError:
        return SettingError(f"{self._where} {text}")


def _mesh_file(name: str, urdf: Path, where: str) -> Path:
    """The path of a mesh; a package is one of the folders above the URDF, or in one."""
    folder = urdf.resolve().parent
    scheme, _, rest = name.partition("://")
    if not rest:
        tried = [folder / name]
    elif scheme == "file":
        tried = [Path(rest)]
    else:
        within = PurePosixPath(*PurePosixPath(rest).parts[1:])
        above = (folder, *folder.parents)
        tried = [parent / part for parent in above for part in (within, rest)]
    for path in tried:
        if path.is_file():
            return path
    places = ", ".join(map(str, tried[:5]))
    raise SettingError(f"{where}: mesh {name} does not exist; looked for {places}")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _sizes(where: str, *sizes: float) -> list[float]:
    """The measures of a shape, metres, all above 0."""
    if not all(size > 0.0 for size in sizes):
        raise SettingError(f"{where}: size {sizes} of a shape; accepted: above 0")
    return list(sizes)
