"""`python -m runners.bop FILE`: errors of BOP results, as their dataset declares symmetries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from omegaconf import DictConfig

from chsel.errors import ChselError, SessionError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.bop_errors import BopErrors, bop_errors, declared_symmetries
from chsel.problem.settings import CheckedSettings, build_settings
from replay.console import Console
from runners.command.program import command, plain
from runners.reporting.tables import print_table, table_of
from runners.sensors.bop_scene import (
    METRES,
    bop_depth_file,
    bop_image,
    bop_pose,
    read_bop_json,
)
from runners.sensors.log.images import read_image

_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t")
_THRESHOLDS = np.arange(1, 11) * 0.05  # of the diameter; of MSPD, 100 pixels of an image 640 wide
_PIXELS = 100.0
_WIDTH = 640.0
_MILLIMETRES = 1000.0  # in a metre


@dataclass(frozen=True)
class BopConfig(CheckedSettings):
    """conf/bop.yaml, which has all defaults, checked."""

    file: str | None
    dataset: str | None
    split: str
    models: str

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("file", "dataset"):
            if getattr(self, name) is None:
                raise SettingError(f"{name} is missing; pass {name}=")


class Estimates(NamedTuple):
    """The estimates of one object in one image, the highest score first."""

    scene: int
    image: int
    object_id: int
    camera_from_object: FloatArray  # (B, 4, 4), metres


@command("bop")
def main(config: DictConfig) -> None:
    """Print the errors of each object in each image, and the recall that BOP averages."""
    checked = build_settings(BopConfig, plain(config), where="bop")
    console = Console(soft_wrap=True)
    rows = [
        measured(estimates, config=checked)
        for estimates in read_results(Path(checked.file or "").expanduser())
    ]
    lines = [
        {
            "scene": row["scene"],
            "image": row["image"],
            "object": row["object"],
            "poses": row["poses"],
            "MSSD\nmm": row["surface"][0] * _MILLIMETRES,
            "MSPD\npx": row["projection"][0],
            "least\nMSSD mm": row["surface"].min() * _MILLIMETRES,
        }
        for row in rows
    ]
    title = "errors of the pose of the highest score, and the least of all poses"
    print_table(console, table_of(title, lines, labels=3))
    for name in ("surface", "projection"):
        recall = np.mean([row["recall"][name] for row in rows])
        label = "MSSD" if name == "surface" else "MSPD"
        console.print(f"AR of {label}, of these objects: {recall:.3f}")


def read_results(path: Path) -> Iterator[Estimates]:
    """Yield the estimates of a results file of the BOP challenge, object by object.

    Raise SessionError for a file that is none.
    """
    try:
        table = pd.read_csv(path)
        missing = [name for name in _COLUMNS if name not in table]
        if missing or len(table) == 0:
            raise ValueError(f"no {missing[0]}" if missing else "no rows")
        table["pose"] = [
            bop_pose(turn.split(), place.split())
            for turn, place in zip(table["R"], table["t"], strict=True)
        ]
    except (OSError, ValueError, AttributeError, ChselError) as error:
        reason = " ".join(str(error).split())
        raise SessionError(
            f"results {path}: {reason}; accepted: a .csv with {', '.join(_COLUMNS)}"
        ) from None
    for (scene, image, object_id), rows in table.groupby(["scene_id", "im_id", "obj_id"]):
        best = rows.sort_values("score", ascending=False, kind="stable")
        yield Estimates(
            int(scene), int(image), int(object_id), camera_from_object=np.stack(best["pose"])
        )


def measured(estimates: Estimates, *, config: BopConfig) -> dict[str, Any]:
    """Return the errors to the nearest of the object's true poses in the image, and recall."""
    dataset = Path(config.dataset or "").expanduser()
    object_id = estimates.object_id
    scene = dataset / config.split / f"{estimates.scene:06d}"
    models = dataset / config.models
    try:
        info = read_bop_json(models / "models_info.json").get(str(object_id))
        if info is None:
            raise SessionError(f"models_info.json has no object {object_id}")
        camera, truths = bop_image(scene, estimates.image)
        true_poses = [
            bop_pose(one["cam_R_m2c"], one["cam_t_m2c"])
            for one in truths
            if one["obj_id"] == object_id
        ]
        if not true_poses:
            raise SessionError(f"image {estimates.image} of {scene} has no object {object_id}")
        width = read_image(bop_depth_file(scene, estimates.image), "depth").shape[1]
        matrix = np.reshape(np.asarray(camera["cam_K"], dtype=np.float64), (3, 3))
        vertices = _vertices(models / f"obj_{object_id:06d}.ply")
        diameter = METRES * float(info["diameter"])
    except KeyError as error:
        raise SessionError(f"dataset {dataset}: no {error}") from None
    each = [
        bop_errors(
            estimates.camera_from_object,
            truth,
            vertices=vertices,
            symmetries=declared_symmetries(info),
            camera=matrix,
        )
        for truth in true_poses
    ]
    found = min(each, key=lambda errors: float(errors.surface[0]))
    return {
        "scene": estimates.scene,
        "image": estimates.image,
        "object": object_id,
        "poses": len(estimates.camera_from_object),
        **found._asdict(),
        "recall": _recall(found, diameter=diameter, width=width),
    }


def _vertices(path: Path) -> FloatArray:
    """Return all vertices (V, 3) of a model, metres, as they stand in the file."""
    import trimesh

    try:
        model: Any = trimesh.load(str(path), process=False, force="mesh")
        return METRES * np.asarray(model.vertices, dtype=np.float64).reshape(-1, 3)
    except Exception as error:  # readers raise anything
        raise SessionError(f"model {path}: {' '.join(str(error).split())[:200]}") from None


def _recall(errors: BopErrors, *, diameter: float, width: int) -> dict[str, float]:
    """Return the share of BOP's thresholds that the best pose is below, by the kind of error."""
    pixels = _PIXELS * width / _WIDTH
    return {
        "surface": float((errors.surface[0] < _THRESHOLDS * diameter).mean()),
        "projection": float((errors.projection[0] < _THRESHOLDS * pixels).mean()),
    }


if __name__ == "__main__":
    main()
