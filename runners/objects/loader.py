"""From the choice of an object to its mesh."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol

import numpy as np

from chsel.errors import MeshWarning, SettingError, require_choice
from chsel.problem.mesh import TESSELLATION, load_mesh
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.points import Workspace
from chsel.problem.pose_distances import with_symmetry
from chsel.problem.sdf_grid import SdfGrid, object_grid
from chsel.problem.settings import CheckedSettings, one_of, positive
from runners.objects.model_info import read_symmetry
from runners.objects.scans import SCANS, scan_file

if TYPE_CHECKING:
    import trimesh

_HERE = Path(__file__).parent
FITTED = "fitted"
"""The configuration that is made for an object of any size, see `fitted_configuration`."""


@dataclass(frozen=True)
class ObjectConfig(CheckedSettings):
    """An object and its scale."""

    name: str
    scale: Annotated[float, positive]  # multiplies the mesh into the metres of the session
    epsilon: Annotated[float, positive]  # tolerance of the plausible set, metres (CHSEL, Sec. V)
    configuration: str  # how simulated sessions place and probe it
    kind: Annotated[str, one_of("model", "household", "scan", "file")] = "model"
    """"model" and "household" ship with the project, "scan" is of the YCB set."""
    path: str | None = None  # the mesh, for "file"
    scan: str | None = None  # official folder name, for "scan"
    tessellation: Annotated[float, positive] = TESSELLATION  # of STEP files, see load_mesh, metres
    symmetry: str | None = None
    """Turns after which it counts as the same: "none", or a JSON file as models_info.json of BOP
    datasets; None: those that map its surface to itself."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path and self.kind != "file":
            raise SettingError(
                f"path is {self.path!r}, and object={self.name} has a mesh of its own; accepted: "
                f"object=mesh object.path={self.path}"
            )
        if self.scan and self.kind != "scan":
            raise SettingError(
                f"scan is {self.scan!r}, and object={self.name} is not of a scan; accepted: "
                "object=ycb/NAME with it"
            )
        if self.kind == "file" and not self.path:
            raise SettingError("path is missing; pass object.path=FILE, a mesh file")
        if self.kind == "scan" and not self.scan:
            raise SettingError("scan is missing; pass object.scan=FOLDER, such as 035_power_drill")


_TRIALS = {
    "drill": (2.5, 0.001, "drill"),
    "mustard": (2.5, 0.0003, "mustard"),
    "hammer": (2.5, 0.001, "hammer"),
    "cracker_box": (1.5, 0.0005, "box"),
    "spam_can": (2.5, 0.0003, "can"),
    "clamp": (5.0, 0.0007, "clamp"),
}
"""Scale, epsilon and configuration of the objects in the paper's trials."""
MODELS = tuple(_TRIALS)
"""Our own models of these objects of the YCB Object and Model Set, files in `models/`."""
OBJECTS = {
    name: ObjectConfig(name, scale, epsilon=epsilon, configuration=configuration)
    for name, (scale, epsilon, configuration) in _TRIALS.items()
}
OBJECTS |= {
    f"ycb/{name}": replace(OBJECTS[name], kind="scan", scan=scan) for scan, name in SCANS.items()
}
HOUSEHOLDS = (
    "mug",
    "bowl",
    "plate",
    "bottle",
    "wine_glass",
    "pan",
    "spoon",
    "screwdriver",
    "wrench",
    "remote",
    "bulb",
    "roll",
    "iron",
)
"""Things of usual sizes on which no method was tuned, files in `households/`."""
OBJECTS |= {
    f"household/{name}": ObjectConfig(
        name, 1.0, epsilon=0.001, configuration=FITTED, kind="household"
    )
    for name in HOUSEHOLDS
}
"""The choices of `object=` but for mesh files."""
PAPER_RESOLUTION = 0.010  # m: of the SDF grids of these in the paper's simulated trials


class GridSettings(Protocol):
    """Settings of a source for which the object is loaded."""

    @property
    def object_resolution(self) -> float | None:
        """Spacing of the object's SDF grid, metres; None: by the object."""

    @property
    def object_padding(self) -> float:
        """Padding of the object's SDF grid, metres."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object as a source sees it: its mesh in metres, with the scale already applied."""

    name: str  # as its choice is called
    mesh: trimesh.Trimesh  # in its own frame, metres
    scale: float  # applied to the mesh
    epsilon: float  # tolerance of the plausible set, metres
    configuration: str  # by which simulated sources place and probe it, unless settings name one
    of_paper: bool = False  # one of the paper's simulated trials, at its scale there
    symmetry: ObjectSymmetry | None = None  # as declared; None: that of its surface
    _grids: dict[tuple[float | None, float], SdfGrid] = field(default_factory=dict, repr=False)

    def resolution(self, settings: GridSettings) -> float | None:
        """Return the spacing in metres of the SDF grid that settings ask for.

        Where they leave it open, an object of the paper's trials has that of the paper, and every
        other that of `object_grid`, which None stands for.
        """
        chosen = settings.object_resolution
        return PAPER_RESOLUTION if chosen is None and self.of_paper else chosen

    def grid(self, settings: GridSettings) -> SdfGrid:
        """Return the signed distance grid that settings ask for, made once."""
        resolution = self.resolution(settings)
        padding = settings.object_padding
        if (resolution, padding) not in self._grids:
            grid = object_grid(self.mesh, resolution, padding=padding)
            self._grids[resolution, padding] = with_symmetry(grid, self.symmetry)
        return self._grids[resolution, padding]

    @property
    def diameter(self) -> float:
        """Diagonal of the mesh's bounding box, metres: no two points are further apart."""
        return float(np.sqrt((np.asarray(self.mesh.extents) ** 2).sum()))


def load_object(config: ObjectConfig, assets: Path) -> ObjectModel:
    """Return the object that `config` names; scans come from the folder `assets`.

    Raise SettingError for an unknown model, MeshError if the mesh is missing or unusable.
    """
    if config.kind == "file":
        path = config.path or ""
        mesh = load_mesh(path, scale=config.scale, tessellation=config.tessellation)
    elif config.kind == "scan":
        mesh = load_mesh(scan_file(assets, config.scan or ""), scale=config.scale)
    elif config.kind == "household":
        require_choice("object.name", config.name, accepted=HOUSEHOLDS)
        mesh = load_mesh(_HERE / "households" / f"{config.name}.ply", scale=config.scale)
    else:
        mesh = load_model(config.name, config.scale)
    return ObjectModel(
        config.name,
        mesh,
        scale=config.scale,
        epsilon=config.epsilon,
        configuration=config.configuration,
        of_paper=_of_paper(config),
        symmetry=_symmetry(config),
    )


def _symmetry(config: ObjectConfig) -> ObjectSymmetry | None:
    """Return the symmetries that settings declare. Raise SettingError for a file that has none."""
    if config.symmetry is None:
        return None
    if config.symmetry == "none":
        return ObjectSymmetry()
    path = Path(config.symmetry).expanduser()
    return read_symmetry(path, mesh=config.path or config.name, scale=config.scale)


def _of_paper(config: ObjectConfig) -> bool:
    """Return whether an object is one of the paper's simulated trials, at its scale there."""
    shipped = config.kind == "model" or SCANS.get(config.scan or "") == config.name
    return shipped and config.kind in ("model", "scan") and config.scale == _TRIALS[config.name][0]


def check_size(model: ObjectModel, workspace: Workspace) -> list[MeshWarning]:
    """Return a warning for an object that is enlarged, or longer than the workspace.

    The objects of simulated sessions are enlarged by default; given points are of real ones.
    """
    longest = float(model.mesh.extents.max())
    side = float(np.ptp(workspace.bounds, axis=0).max())
    if model.scale <= 1.0 and longest <= side:
        return []
    text = (
        f"the object is {longest:.3g} m long at scale {model.scale:g}, the workspace "
        f"{side:.3g} m; objects of real size have object.scale=1"
    )
    return [MeshWarning("object_size", text)]


def load_model(name: str, scale: float = 1.0) -> trimesh.Trimesh:
    """Return one of MODELS in the frame of its YCB mesh; metres at scale 1."""
    require_choice("object.name", name, accepted=MODELS)
    return load_mesh(_HERE / "models" / f"{name}.ply", scale=scale)
