"""One object in an image of a BOP dataset (Hodan et al., ECCV 2018), as a depth image with a label.

The files are those of https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md,
in millimetres as there. The camera's frame is the world.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose, nearest_rigid
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.depth_frame import DepthFrame
from runners.sensors.log.images import read_image

METRES = 0.001  # of a millimetre


def bop_depth_file(folder: Path, image: int) -> Path:
    """Return the depth image of a scene's folder."""
    return folder / "depth" / f"{image:06d}.png"


def read_bop_frame(folder: Path, image: int, *, object_id: int, instance: int = 0) -> DepthFrame:
    """Return the frame of an object in an image of a scene, SPLIT/000002, with its true pose.

    instance: which of those of this object, in the order of scene_gt.json. Its label is what the
    dataset says is visible of it. Raise SessionError, which names the file and what is missing.
    """
    try:
        camera, truths = bop_image(folder, image)
        numbers = [n for n, one in enumerate(truths) if one["obj_id"] == object_id]
        if instance not in range(len(numbers)):
            objects = sorted({one["obj_id"] for one in truths})
            raise SessionError(
                f"image {image} has {len(numbers)} of object {object_id}, so no instance "
                f"{instance}; its objects are {', '.join(map(str, objects))}"
            )
        number = numbers[instance]
        truth = truths[number]
        stored = read_image(bop_depth_file(folder, image), "depth")
        height, width = stored.shape
        label = read_image(folder / "mask_visib" / f"{image:06d}_{number:06d}.png", "mask") > 0
        if label.shape != stored.shape or not label.any():
            raise SessionError(f"the mask of object {object_id} shows nothing of it in this image")
        matrix = np.reshape(camera["cam_K"], (3, 3))
        depth = stored.astype(np.float64) * (METRES * float(camera["depth_scale"]))
        return DepthFrame(
            PinholeCamera.of_matrix(matrix, width, height=height),
            depth,
            world_from_camera=np.eye(4),
            label=label,
            world_from_object=bop_pose(truth["cam_R_m2c"], truth["cam_t_m2c"]),
        )
    except (ChselError, KeyError, TypeError, ValueError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise SessionError(f"BOP scene {folder}, image {image}: {reason}") from None


def bop_pose(rotation: Any, translation: Any) -> FloatArray:
    """Return camera_from_object (4, 4), metres, of nine numbers by rows, and millimetres."""
    pose = compose(
        np.reshape(np.asarray(rotation, dtype=np.float64), (3, 3)),
        METRES * np.reshape(np.asarray(translation, dtype=np.float64), 3),
    )
    return nearest_rigid("cam_R_m2c, cam_t_m2c", pose[None])[0]


def read_bop_json(path: Path) -> Mapping[str, Any]:
    """Return a JSON file of a dataset. Raise SessionError if it is none."""
    try:
        values = json.loads(path.read_bytes())
    except OSError as error:
        raise SessionError(f"{path.name} cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise SessionError(f"{path.name} is not JSON ({error})") from None
    if not isinstance(values, dict):
        raise SessionError(f"{path.name} is no mapping of keys to values")
    return values


def bop_image(folder: Path, image: int) -> tuple[Any, Any]:
    """Return what scene_camera.json and scene_gt.json of a scene's folder say of an image."""
    return _of_image(folder / "scene_camera.json", image), _of_image(
        folder / "scene_gt.json", image
    )


def _of_image(path: Path, image: int) -> Any:
    values = read_bop_json(path)
    if str(image) not in values:
        there = sorted(map(int, values))
        span = f"{there[0]} to {there[-1]}" if there else "none"
        raise SessionError(f"{path.name} has {len(there)} images, {span}, and not {image}")
    return values[str(image)]
