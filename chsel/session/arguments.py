"""The arguments of a session: meshes, methods and policies, as programs pass them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chsel.errors import SettingError, quoted, require_instance
from chsel.problem.mesh import clean_mesh, load_mesh
from chsel.session.recording import printable

if TYPE_CHECKING:
    import trimesh


def mesh_and_name(target: trimesh.Trimesh | str | Path) -> tuple[trimesh.Trimesh, str]:
    """Return the object's mesh, and its name."""
    if isinstance(target, str | Path):
        return load_mesh(target), printable(Path(target).stem)
    mesh = mesh_argument("target", target)
    return clean_mesh(mesh.vertices, mesh.faces, name="target"), "object"


def mesh_argument(name: str, given: Any) -> trimesh.Trimesh:
    """Return what was given, if it is a mesh."""
    import trimesh

    require_instance(
        name, given, kind=trimesh.Trimesh, accepted="a mesh such as chsel.load_mesh(path)"
    )
    return given


def name_of(what: str, built: Any, *, names: tuple[str, ...], build: Callable[[str], Any]) -> str:
    """Return the name under which something is offered, by its class; else that of the class."""
    if not hasattr(built, "settings"):
        accepted = f"chsel.build_{what}(name), or name"
        raise SettingError(f"{what} is {quoted(built)}; accepted: {accepted}")
    offered = (name for name in names if type(build(name)) is type(built))
    return next(offered, type(built).__name__)


def plain_settings(settings: Any) -> dict[str, Any]:
    """Return settings as recordings have them."""
    return dict(json.loads(json.dumps(asdict(settings))))
